"""What a sink is, and what it is given: results and events in batches."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

from driftfit.service.connector import Connector
from driftfit.service.core.results import Results


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
    """Its name; empty for what is wrong with the journal."""
    at: float
    """Wall clock, seconds since 1970."""
    kind: str
    """new, alarm, over, failed, calibrated, action, damaged"""
    detail: Mapping[str, Any]

    @property
    def key(self) -> str:
        """The same when the event comes again, and that of no other: several alarms may begin at one sample."""
        return f"{self.number}-{self.kind}" + f"-{self.detail.get('kind')}" * (self.kind == "alarm")


class RefusedError(ConnectionError):
    """The receiver answered, and did not take the event."""


@dataclass(frozen=True)
class Outcome:
    """A batch for a sink."""

    group: int
    """Number of the first group in it; a batch that comes again begins with the same group."""
    parts: Sequence[Results]
    """The results in columns, for sinks that take columns."""
    events: list[Event]
    names: Mapping[int, str]
    """Names of the units by their numbers in ``parts``."""
    about: Mapping[str, Mapping[str, Any]]
    """By unit: names of parameters, y and u, topic and the parts that its pattern matched."""

    def __len__(self) -> int:
        return sum(len(one.number) for one in self.parts)

    @cached_property
    def results(self) -> list[Result]:
        return self._listed(self.parts)

    @cached_property
    def last(self) -> list[Result]:
        """The last result of each unit."""
        found = {one.unit: one for part in self.parts for one in self._listed([part.last()])}
        return list(found.values())

    def _listed(self, parts: Sequence[Results]) -> list[Result]:
        return [Result(row[0], self.names[row[1]], *row[2:]) for one in parts for row in one.rows()]


@dataclass(frozen=True)
class Sink(Connector):
    """A sink of results and events."""

    most: ClassVar[int] = 5_000
    """Results of one batch at which it is not collected further."""
    one_by_one: ClassVar[bool] = False
    """Whether it takes events alone, one in a batch."""

    @property
    def gather(self) -> float:
        """Seconds for which results are collected into one batch."""
        return 0.0

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
