"""A sink consists of options and of ``write``. A new sink is one file in this folder, with a class of its name.

    class Mine(Sink):                           # src/driftfit/service/sinks/mine.py, kind = "mine"
        url: str                                # options are the fields of a frozen dataclass
        def open(self): ...                     # connect, and return a Writer
                                                # Writer.write(batch) returns once the batch is safe

A sink reads the stored results from where it stopped, so one that is away or slow never delays the tracking and loses
nothing. After a crash the last batches come again: every result has a ``number``, by which an idempotent sink skips
results that it already has. An exception means that the sink is away; the batch is written again after a pause.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple


class Result(NamedTuple):
    """The tracker's result for one sample."""

    number: int
    """Number of the sample in the journal."""
    unit: str
    time: float | None
    """Seconds, in UTC since 1970 for dates."""
    y: float
    y_hat: float
    e: float
    s: float
    ok: bool
    theta: list[float]
    std: list[float]
    alarm: bool
    """Whether an alarm is on."""


class Event(NamedTuple):
    """Something that happened to a unit."""

    number: int
    """Number of the sample or action that caused it."""
    unit: str
    at: float
    """Wall clock, seconds since 1970."""
    kind: str
    """new, alarm, over, failed, calibrated, action"""
    detail: Mapping[str, Any]


class Outcome(NamedTuple):
    """A batch for a sink."""

    group: int
    """Number of the first group in it; a batch that comes again begins with the same group."""
    results: list[Result]
    events: list[Event]
    about: Mapping[str, Mapping[str, Any]]
    """By unit: names of parameters, y and u, topic and the parts that its pattern matched."""


@dataclass(frozen=True)
class Sink(ABC):
    """A sink of results and events."""

    name: str
    most: ClassVar[int] = 5_000
    """Results of one batch at which it is not collected further."""

    @property
    def gather(self) -> float:
        """Seconds for which results are collected into one batch."""
        return 0.0

    def check(self) -> None:
        """Raise ValueError or ImportError if the options cannot work."""
        return None

    @abstractmethod
    def open(self) -> Writer:
        """Connect."""


class Writer(ABC):
    """An open sink."""

    @abstractmethod
    def write(self, batch: Outcome) -> None:
        """Write a batch; return once it is safe."""

    def close(self) -> None:
        """Disconnect."""
        return None
