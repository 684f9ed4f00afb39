"""What a gate left out of a run, as a table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.readings.gate import INPUT
from driftfit.readings.remarks import SAID, counts


class Decision(NamedTuple):
    """One sample that was not used: its number, the signal, its reading of y, and why."""

    sample: int
    signal: str
    value: float
    reason: str


@dataclass(frozen=True)
class LeftOut:
    """The decisions of a gate in the order of the samples: ``sample`` (k,), ``code`` (k,) of the reason
    (`driftfit.readings.gate`), and ``value`` (k,), the readings of y there.
    """

    sample: Array
    code: Array
    value: Array

    def __len__(self) -> int:
        return len(self.sample)

    def __iter__(self) -> Iterator[Decision]:
        for t, code, value in zip(self.sample.tolist(), self.code.tolist(), self.value.tolist(), strict=True):
            yield Decision(t, "u" if code == INPUT else "y", value, SAID[code][1])

    @property
    def counts(self) -> dict[str, int]:
        """How many samples there are for each reason, by the name that summaries use."""
        return {SAID[code][0]: count for code, count in counts(self.code).items()}

    def __str__(self) -> str:
        lines = [f"{count:6d}  {SAID[code][1]}" for code, count in counts(self.code).items()]
        return "\n".join(lines) if lines else "nothing left out"


NOTHING_LEFT_OUT = LeftOut(np.empty(0, int), np.empty(0, int), np.empty(0))


def left_out_of(reason: Array, y: Array) -> LeftOut:
    """The decisions in a run, from what its gate stored for every sample (T,), and its readings."""
    sample = np.flatnonzero(reason)
    return LeftOut(sample, reason[sample].astype(int), y[sample])
