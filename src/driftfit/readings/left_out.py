"""What a gate left out of a run, as a table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.readings.gate import AT_START, FROZEN, INPUT, LEVERAGE, REFUSED

REASONS = {
    REFUSED: "far from its forecast and from all readings before",
    FROZEN: "the sensor repeats its last reading",
    INPUT: "an input far outside its range, to which the output does not respond",
    LEVERAGE: "a regressor out of all proportion: weight lowered",
    AT_START: "contradicted by the other first samples",
}
"""What is said of each decision."""


class Decision(NamedTuple):
    """One sample that was not used as it is: its number, the signal, its reading, why, and the factor of its noise."""

    sample: int
    signal: str
    value: float
    reason: str
    factor: float


@dataclass(frozen=True)
class LeftOut:
    """The decisions of a gate in the order of the samples: ``sample`` (k,), ``reason`` (k,), ``factor`` (k,), and
    ``value`` (k,), the readings of y there.
    """

    sample: Array
    reason: Array
    factor: Array
    value: Array

    def __len__(self) -> int:
        return len(self.sample)

    def __iter__(self) -> Iterator[Decision]:
        for t, reason, factor, value in zip(*(a.tolist() for a in self._columns), strict=True):
            signal = "u" if reason == INPUT else "y"
            yield Decision(t, signal, value, REASONS[reason], factor)

    @property
    def _columns(self) -> tuple[Array, ...]:
        return self.sample, self.reason, self.factor, self.value

    @property
    def refused(self) -> Array:
        """The numbers (k,) of the samples that were not used at all."""
        found: Array = self.sample[self.reason != LEVERAGE]
        return found

    @property
    def counts(self) -> dict[str, int]:
        """How many samples there are for each reason."""
        values, counts = np.unique(self.reason, return_counts=True)
        return {REASONS[value]: count for value, count in zip(values.tolist(), counts.tolist(), strict=True)}

    def __str__(self) -> str:
        if not len(self):
            return "nothing left out"
        return "\n".join(f"{count:6d}  {reason}" for reason, count in self.counts.items())


NOTHING_LEFT_OUT = LeftOut(np.empty(0, int), np.empty(0, int), np.empty(0), np.empty(0))


def left_out_of(reason: Array, factor: Array, y: Array) -> LeftOut:
    """The decisions in a run, from what its gate stored for every sample (T,), and its readings."""
    sample = np.flatnonzero(reason)
    return LeftOut(sample, reason[sample].astype(int), factor[sample], y[sample])
