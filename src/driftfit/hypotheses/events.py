"""Events: what the probabilities of a run add up to, dated and with what is plausible beside the date.

The mass of one jump splits between neighbouring samples, so an event is a cluster of them: while the probability of a
change in the window is above the threshold, samples with a share in it belong together. Its date is the likeliest of
them, its interval the fewest that hold nine tenths of the mass.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from driftfit.kernel import Array

if TYPE_CHECKING:
    from driftfit.hypotheses.results import Hypotheses

FAINT = 0.02
"""Probability below which a sample does not count to a cluster."""
MASS = 0.9
"""Share of the mass that the interval of a date holds."""


@dataclass(frozen=True)
class Event:
    """One change or sensor fault.

    Attributes
    ----------
    date, first, last : int
        Sample that it is first visible in, and the first and last plausible one (of a fault: of its duration).
    known : int
        The sample after which it was known at this threshold.
    prob : float
        Probability that it happened.
    name : str
        The likeliest change, or the sensor fault.
    names : mapping from names of changes to their share
    shift, std : mapping from parameters to how far they moved and its standard error (changes only)
        From the smoothed path given the events: conditional on them.
    """

    kind: str
    date: int
    first: int
    last: int
    known: int
    prob: float
    name: str
    names: dict[str, float] = field(default_factory=dict)
    shift: dict[str, float] = field(default_factory=dict)
    std: dict[str, float] = field(default_factory=dict)

    def row(self) -> dict[str, Any]:
        """For a table."""
        moved = ", ".join(
            f"{name} {shift:+.3g} ({self.std[name]:.2g})"
            for name, shift in self.shift.items()
            if abs(shift) > 2.0 * self.std[name]
        )
        return {
            "kind": self.kind, "date": self.date, "first": self.first, "last": self.last, "known": self.known,
            "prob": self.prob, "name": self.name, "moved": moved,
        }  # fmt: skip


def changes_of(told: Hypotheses, threshold: float) -> list[Event]:
    """Clusters of samples at which theta may have jumped."""
    Hm, latest = told.sensors, np.nan_to_num(told.latest)
    by_change = latest.reshape(len(latest), -1, Hm).sum(axis=2)
    changes = told.tracker.all_changes
    p = by_change[:, 1:].sum(axis=1)
    W = told.lag_prob.shape[1]
    events: list[Event] = []
    for a, b in runs(told.window > threshold):
        reach = slice(max(0, a - W + 1, events[-1].last + 1 if events else 0), b)
        for first, last in clusters(p, reach, threshold):
            mass = p[first:last]
            share = by_change[first:last, 1:].sum(axis=0)
            low, high = densest(mass)
            names = [told.tracker.change_names[i] for i in range(1, len(changes))]
            known = max(a, first)
            events.append(
                Event(
                    "change", first + int(mass.argmax()), first + low, first + high, known, float(min(mass.sum(), 1.0)),
                    names[int(share.argmax())], dict(zip(names, (share / share.sum()).tolist(), strict=True)),
                )
            )  # fmt: skip
    return events


def clusters(p: Array, reach: slice, threshold: float) -> list[tuple[int, int]]:
    """Groups of neighbouring samples with a share each; the whole where no group alone passes the threshold."""
    part = p[reach]
    found = [(reach.start + a, reach.start + b) for a, b in runs(part > FAINT) if part[a:b].sum() > threshold]
    if found or not len(part) or part.sum() <= threshold:
        return found
    seen = np.flatnonzero(part > FAINT)
    return [(reach.start + int(seen[0]), reach.start + int(seen[-1]) + 1)] if len(seen) else []


def densest(mass: Array) -> tuple[int, int]:
    """First and last of the fewest entries that hold `MASS` of all."""
    order = np.argsort(-mass, kind="stable")
    count = int(np.searchsorted(np.cumsum(mass[order]), MASS * mass.sum())) + 1
    kept = order[:count]
    return int(kept.min()), int(kept.max())


def faults_of(told: Hypotheses, threshold: float) -> list[Event]:
    """Stretches at which the sensor was likely not nominal."""
    Hm, events = told.sensors, []
    by_sensor = np.nan_to_num(told.latest).reshape(len(told.latest), -1, Hm).sum(axis=1)
    W = told.lag_prob.shape[1]
    for j in range(1, Hm):
        for a, b in runs(by_sensor[:, j] > threshold):
            name = told.tracker.all_sensors[j].name
            p = float(by_sensor[a:b, j].max())
            events.append(Event("sensor", a, a, b - 1, min(a + W - 1, len(by_sensor) - 1), p, name))
    return events


def runs(on: Array) -> list[tuple[int, int]]:
    """Stretches [a, b) over which a condition holds."""
    edges = np.flatnonzero(np.diff(np.r_[False, on, False].astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
