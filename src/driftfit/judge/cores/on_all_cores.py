"""Judge many runs on all cores, in threads where that takes seconds and in processes where it takes longer.

Half of the time of a verdict is spent in Python, which only one thread executes at a time, so a second thread gains
little. A process has a core of its own; the price is its start (about a second) and sending it the runs (a tenth of the
time of a verdict).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from time import monotonic
from typing import Any, TypeVar

from driftfit.engine.compile_notice import PATIENCE
from driftfit.judge.cores.processes import Processes, available
from driftfit.run.parallel_lanes import cores
from driftfit.run.program import progress_bar

Result = TypeVar("Result")
FIRST = 5
"""Runs that are judged first, one by one: one compiles, and the others show how long a run takes."""
WORTH = 5.0
"""Processes are started for more seconds of work than this."""
BATCH = 0.2
"""Seconds of work that are sent to a process at once."""


def on_all_cores(
    keys: Iterable[Hashable], arguments: Callable[[Hashable], tuple[Any, ...]], judge: Callable[..., Result], what: str
) -> dict[Hashable, Result]:
    """``judge(*arguments(key))`` for each key, in their order; the first few one by one: one thread compiles.

    Processes find ``judge`` by its name, so it must be a function of a module.
    """
    keys = list(keys)
    found = [judge(*arguments(key)) for key in keys[:1]]
    begun = monotonic()
    found += [judge(*arguments(key)) for key in keys[1:FIRST]]
    each = (monotonic() - begun) / (FIRST - 1)
    progress = progress_bar()
    task, begun, shown = progress.add_task(what, total=len(keys), completed=len(found)), monotonic(), False
    with ExitStack() as stack:
        for some in _judged(stack, keys[FIRST:], arguments, judge, each):
            found += some
            progress.advance(task, len(some))
            if not shown and monotonic() - begun > PATIENCE:
                stack.enter_context(progress)
                shown = True
    return dict(zip(keys, found, strict=True))


def _judged(
    stack: ExitStack,
    keys: list[Hashable],
    arguments: Callable[[Hashable], tuple[Any, ...]],
    judge: Callable[..., Result],
    each: float,
) -> Iterator[list[Result]]:
    """The results of batches of keys, as they become known, in order; ``each`` is the time for one in seconds."""
    many = each * len(keys) > WORTH and cores() > 1 and available()
    size = min(max(int(BATCH / each), 1), 64) if many else 1
    batches = [keys[k : k + size] for k in range(0, len(keys), size)]
    processes = stack.enter_context(Processes(cores())) if many else None
    pool = stack.enter_context(ThreadPoolExecutor(cores()))

    def judged(batch: list[Hashable]) -> list[Result]:
        chosen = [arguments(key) for key in batch]
        return processes.map(judge, chosen) if processes else [judge(*one) for one in chosen]

    yield from pool.map(judged, batches)
