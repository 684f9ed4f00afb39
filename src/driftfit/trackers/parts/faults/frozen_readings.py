"""Frozen readings: a sensor that repeats its last value although the system moves.

Whether the sensor is frozen is a two-state chain, which enters with probability ENTER at every reading and stays with
probability STAY. A frozen sensor repeats its last reading for certain. A sensor that works repeats it with at most the
probability max(delta p, a) <= 1, where delta is the resolution, the smallest step between two readings so far, p the
largest predicted density of the values that are rounded to the reading, and a the share of readings that repeated
although they were not frozen. So

    pi <- odds / (1 + odds),    odds = pi' / (1 - pi') / max(delta p, a),    pi' = ENTER (1 - pi) + STAY pi

if the reading repeats, and 0 if it does not; pi = pi' where nothing can be predicted, such as after lags that are
missing because the sensor is frozen. A reading that is more likely frozen than not is not used: theta is held,
with its uncertainty growing as in a gap, and the lag of the reading is that of a missing one. One repeated reading is
enough where readings have many digits; a coarse meter needs several, and none is enough where repeats are predicted. A
summary counts those of two in a row and more, because one in a few thousand readings repeats by chance.

Source: a hidden Markov chain with a known emission; ours. Cost per sample: a few operations.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, exp, kernel
from driftfit.trackers.parts.coarse.resolution import reading, same_reading

ENTER, STAY = 0.001, 0.98
"""Probability that a sensor freezes, and that it stays frozen, per reading."""
MOVES = 10.0
"""Number of steps between readings before the smallest of them is a resolution."""


def not_frozen() -> dict[str, Any]:
    """Fields before the first reading."""
    return {"frozen": 0.0, "before": np.nan, "held": 0.0, "in_a_row": 0.0, "frozen_readings": 0.0}


@kernel
def leave_out_frozen(s: State, l: int) -> None:
    """Leave out a reading that is more likely frozen than not; s.y_hat and s.s must have been computed."""
    if s.observed[l] > 0.0:
        repeats = same_reading(s, s.before[l], l)
        s.before[l] = reading(s, l)
        frozen = 0.0
        if repeats & (s.steps[l] >= MOVES):
            prior, chance = ENTER * (1.0 - s.frozen[l]) + STAY * s.frozen[l], 1.0
            if (s.valid[l] > 0.0) & (s.s[l] < np.inf) & (s.s[l] > 0.0):
                e = max(abs(s.y[l] - s.y_hat[l]) - 0.5 * s.quantum[l], 0.0)
                others = s.repeats[l] - 1.0 - s.held[l]
                chance = max(
                    others / (others + s.steps[l]),
                    s.quantum[l] * exp(-0.5 * e * e / s.s[l]) / np.sqrt(2.0 * np.pi * s.s[l]),
                )
                chance = min(chance, 1.0)
            frozen = prior / (prior + (1.0 - prior) * chance)
        s.frozen[l] = frozen
        if frozen > 0.5:
            s.ok[l], s.observed[l] = 0.0, 0.0
            s.held[l] += 1.0
        s.in_a_row[l] = s.in_a_row[l] + 1.0 if frozen > 0.5 else 0.0
        s.frozen_readings[l] += 0.0 if s.in_a_row[l] < 2.0 else 2.0 if s.in_a_row[l] == 2.0 else 1.0


def held_readings(lane: Mapping[str, Array]) -> tuple[tuple[str, str], ...]:
    """Its remark in a summary: nothing if no sensor was frozen."""
    count = int(lane["frozen_readings"])
    return (
        (("Frozen", f"{count} readings that repeat the one before where a change was expected: not used"),)
        if count
        else ()
    )
