"""Frozen readings: a sensor that repeats its last value although the system moves.

With p the share of readings that repeat the one before, k repeats in a row at which the forecast moved have the
probability p^k. A reading is refused if that is below `Gate.frozen`. The forecast moves if it changes by more than half
of its own standard deviation and more than the smallest step of the readings: a plant at rest, and one whose meter is
too coarse to show a movement, repeat their readings too. One repeat may be chance; two are enough where readings have
many digits.

Source: ours. Cost per sample: a few operations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from driftfit.engine.kernel import State, kernel
from driftfit.readings.resolution import repeats_last

MOVED = 0.25
"""Share of the variance of the forecast by which the square of its change counts as a movement."""


def not_frozen() -> Mapping[str, Any]:
    """Fields before the first reading."""
    return {"gate_chance": 1.0, "gate_forecast": np.nan}


def frozen_rule(limit: float) -> Callable[[State, float, int], bool]:
    """``frozen(s, v, l)``: whether the reading is one of a frozen sensor, given the variance v of its forecast."""
    limit = float(limit)

    @kernel
    def frozen(s: State, v: float, l: int) -> bool:
        repeats, chance = repeats_last(s, l), s.gate_chance[l]
        share = (s.gate_repeats[l] + 1.0) / (s.gate_repeats[l] + s.gate_steps[l] + 2.0)
        if s.valid[l] > 0.0:
            moved = s.y_hat[l] + s.shift[l] - s.gate_forecast[l]
            moves = moved * moved > max(MOVED * v, s.gate_finest[l] * s.gate_finest[l])
            chance *= share if moves else 1.0
            s.gate_forecast[l] = s.y_hat[l] + s.shift[l]
        s.gate_chance[l] = chance if repeats else 1.0
        return s.gate_chance[l] < limit  # type: ignore[no-any-return]

    return frozen  # type: ignore[no-any-return]
