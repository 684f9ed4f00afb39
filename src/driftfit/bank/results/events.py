"""Events: clusters of the probabilities of a run, with a date and an interval.

The probability of one jump is divided among neighbouring samples, so an event is a cluster of them: while the
probability of a change in the window is above the threshold, samples with a share in it belong together. The date is
the most likely of them, and the interval the smallest set of neighbours with `LEVEL` of the probability of the leaves.
Samples that were not used belong to the next one that was: a jump in an outage may have been at any of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import Array

FAINT = 0.02
"""Probability below which a sample does not belong to a cluster."""
LEVEL = 0.95
"""Share of the probability in the interval of a date, and its level if the whole record is used."""


class Span(NamedTuple):
    """Date, first, last and known of an event as sample numbers."""

    date: int
    first: int
    last: int
    known: int

    def moved(self, by: int) -> Span:
        """The same, counted from another sample."""
        return Span(*(sample + by for sample in self))


@dataclass(frozen=True)
class Event:
    """One change or sensor fault.

    Attributes
    ----------
    date, first, last
        When it is first visible, and the ends of the interval that contains the date with probability ``level`` (of a
        fault: the ends of its duration): times if there are any, otherwise sample numbers.
    known
        When it was detected at this threshold, likewise.
    span : Span
        The four as sample numbers.
    level : float
        Level of the interval: 0.95 for changes in a record, whose dates are those of the smoother
        (`driftfit.bank.results.smoothed`), checked by simulation in `benchmarks/event_dates.py`. NaN for
        faults, and in a stream, where the interval contains only the dates of the leaves that were kept.
    prob : float
        Probability that it happened.
    name : str
        The most likely change, or the sensor fault.
    names : mapping from names of changes to their share
    shift, std, z : mappings from parameters to their change, its standard error, and their ratio (changes only)
        Over all dates of the interval, given that there was a change.
    """

    kind: str
    span: Span
    prob: float
    name: str
    names: dict[str, float] = field(default_factory=dict)
    shift: dict[str, float] = field(default_factory=dict)
    std: dict[str, float] = field(default_factory=dict)
    times: tuple[Any, ...] = ()
    level: float = float("nan")

    @property
    def date(self) -> Any:
        return self._at(0)

    @property
    def first(self) -> Any:
        return self._at(1)

    @property
    def last(self) -> Any:
        return self._at(2)

    @property
    def known(self) -> Any:
        return self._at(3)

    def _at(self, k: int) -> Any:
        return self.times[k] if self.times else self.span[k]

    def timed(self, time: Callable[[int], Any]) -> Event:
        """The same event with times from sample numbers."""
        return replace(self, times=tuple(time(sample) for sample in self.span))

    def measured(self, names: tuple[str, ...], shift: Array, std: Array) -> Event:
        """The same event with the change of each parameter (n,), and its standard deviation."""
        shifts, stds = shift.tolist(), std.tolist()
        return replace(self, shift=dict(zip(names, shifts, strict=True)), std=dict(zip(names, stds, strict=True)))

    @property
    def z(self) -> dict[str, float]:
        """The change of each parameter in standard errors."""
        return {name: shift / self.std[name] if self.std[name] > 0.0 else 0.0 for name, shift in self.shift.items()}

    def row(self, names: tuple[str, ...]) -> dict[str, Any]:
        """A row of a table, with change and standard error of every parameter, None if there is none."""
        row = {
            "kind": self.kind, "date": self.date, "first": self.first, "last": self.last, "known": self.known,
            "prob": self.prob, "name": self.name,
            "moved": ", ".join(name for name, z in self.z.items() if abs(z) > 2.0),
        }  # fmt: skip
        for name in names:
            row |= {name: self.shift.get(name), f"std_{name}": self.std.get(name)}
        return row


class Probabilities(NamedTuple):
    """The probabilities from which events are made."""

    latest: Array
    """(T, H): probabilities of the joint events of each sample, from the latest sample that the bank remembers."""
    window: Array
    """(T,): probability, at each sample, of a change in the newest W levels."""
    used: Array
    """(T,) bool"""
    W: int
    change_names: tuple[str, ...]
    sensor_names: tuple[str, ...]


def changes_of(given: Probabilities, threshold: float) -> list[Event]:
    """Clusters of samples at which theta may have jumped."""
    Hm, latest = len(given.sensor_names), np.nan_to_num(given.latest)
    by_change = latest.reshape(len(latest), -1, Hm).sum(axis=2)
    p, names = by_change[:, 1:].sum(axis=1), given.change_names[1:]
    events: list[Event] = []
    for a, b in runs(given.window > threshold):
        reach = slice(max(0, a - given.W + 1, events[-1].span.last + 1 if events else 0), b)
        for first, end in clusters(p, reach, threshold):
            mass, share = p[first:end], by_change[first:end, 1:].sum(axis=0)
            low, high = densest(mass)
            low = back_to(first + low, reach.start, given.used)
            shares = dict(zip(names, (share / share.sum()).tolist(), strict=True))
            likely, date = names[int(share.argmax())], first + int(mass.argmax())
            prob = float(min(mass.sum(), 1.0))
            span = Span(date, low, first + high, max(a, date))
            events.append(Event("change", span, prob, likely, shares))
    return events


def clusters(p: Array, reach: slice, threshold: float) -> list[tuple[int, int]]:
    """Groups of neighbouring samples with a share each; the whole if no group alone passes the threshold."""
    part = p[reach]
    found = [(reach.start + a, reach.start + b) for a, b in runs(part > FAINT) if part[a:b].sum() > threshold]
    if found or not len(part) or part.sum() <= threshold:
        return found
    likely = np.flatnonzero(part > FAINT)
    return [(reach.start + int(likely[0]), reach.start + int(likely[-1]) + 1)] if len(likely) else []


def back_to(first: int, start: int, used: Array) -> int:
    """The first of the unused samples before this one: changes at them become visible here."""
    while first > start and not used[first - 1]:
        first -= 1
    return first


def densest(mass: Array) -> tuple[int, int]:
    """First and last of the smallest set of neighbours with `LEVEL` of the total."""
    total = np.r_[0.0, np.cumsum(mass)]
    wanted = LEVEL * total[-1] * (1.0 - ROUNDING)
    ends = np.searchsorted(total, total[:-1] + wanted)
    first = int(np.argmin(np.where(ends <= len(mass), ends - np.arange(len(mass)), len(mass) + 1)))
    return first, int(ends[first]) - 1


def faults_of(given: Probabilities, threshold: float) -> list[Event]:
    """Intervals in which the sensor was probably not nominal."""
    Hm, T, events = len(given.sensor_names), len(given.latest), []
    by_sensor = np.nan_to_num(given.latest).reshape(T, -1, Hm).sum(axis=1)
    for j in range(1, Hm):
        for a, b in runs(by_sensor[:, j] > threshold):
            p, known = float(by_sensor[a:b, j].max()), min(a + given.W - 1, T - 1)
            events.append(Event("sensor", Span(a, a, b - 1, known), p, given.sensor_names[j]))
    return events


def all_of(given: Probabilities, threshold: float) -> list[Event]:
    """Changes and faults, sorted by time."""
    return sorted(changes_of(given, threshold) + faults_of(given, threshold), key=lambda event: event.span.date)


def runs(on: Array) -> list[tuple[int, int]]:
    """Intervals [a, b) in which a condition holds."""
    edges = np.flatnonzero(np.diff(np.r_[False, on, False].astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
