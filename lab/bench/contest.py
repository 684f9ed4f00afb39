"""A contest of speed: the same model in several packages, checked to give the same numbers, timed in turns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from lab.bench.computer import times
from lab.bench.peers import silence

Answer = Callable[[], Array]

SAME = 1e-6
"""Answers that differ by less than this, relative to the largest number, are the same."""


class Job(NamedTuple):
    """Something to time: ``steps`` samples per run. ``answer`` gives theta (T, n) or (n,); None: another algorithm."""

    name: str
    run: Callable[[], object]
    steps: int
    answer: Answer | None = None


@dataclass(frozen=True)
class Contest:
    """Ours against others; each other is a function that raises ImportError where its package is absent."""

    title: str
    note: str
    ours: Job
    others: Sequence[Callable[[], Job]] = ()
    repeats: int = 11


class Line(NamedTuple):
    """One package: nanoseconds per step, multiples of ours, and by how much its numbers differ (NaN: another
    algorithm).
    """

    name: str
    ns: float
    ratio: float
    difference: float


@dataclass(frozen=True)
class Finish:
    """The outcome of a contest, ours first."""

    title: str
    note: str
    lines: list[Line]
    absent: list[str] = field(default_factory=list)


def need(module: str, name: str | None = None) -> Any:
    """A module, or something in it; ImportError by name where it does not exist."""
    found = import_module(module)
    if name is None:
        return found
    if not hasattr(found, name):
        raise ImportError(f"{module} has no {name}", name=f"{module}.{name}")
    return getattr(found, name)


def hold(contest: Contest, repeats: int) -> Finish:
    """Time all installed packages, then compare their results."""
    jobs, absent = [contest.ours], []
    with silence():
        for make in contest.others:
            try:
                jobs.append(make())
            except ImportError as error:
                absent.append((error.name or str(error)).partition(".")[0])
        seconds = times(repeats, [job.run for job in jobs])
    ns = [1e9 * s / job.steps for s, job in zip(seconds, jobs, strict=True)]
    lines = [
        Line(job.name, each, each / ns[0], difference(contest.ours, job)) for job, each in zip(jobs, ns, strict=True)
    ]
    return Finish(contest.title, contest.note, lines, absent)


def difference(ours: Job, other: Job) -> float:
    """Largest difference of answers relative to the largest number, on the samples that both have."""
    if other.answer is None or ours.answer is None:
        return float("nan")
    a, b = np.atleast_2d(ours.answer()), np.atleast_2d(other.answer())
    length = min(len(a), len(b))
    a, b = a[length // 2 : length], b[length // 2 : length]
    return float(np.max(np.abs(a - b)) / np.max(np.abs(a)))
