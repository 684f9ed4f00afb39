"""Readings that repeat the one before in all digits: coarse meters, and sensors that are frozen.

Readings of an integer meter, a counter or a converter of few bits are accurate to half a step, and where they are
constant, residuals are zero although nothing was measured exactly. A noise variance learned from those residuals
collapses, and bands and likelihood with it. Therefore

    quantum    the smallest step between two consecutive readings, if steps of its size (up to one and a half) are a
               tenth of all steps, and a tenth of the readings repeat the previous one
    floor      quantum^2 / 12, the variance of the rounding error, below which no tracker estimates the variance of the
               noise of a reading; 0 if readings are not coarse

Readings of a fine sensor never repeat, and nothing changes for them. If they do, at a limit, at 0 while a pump is off,
or because a value is held, the other steps have all sizes, and none is frequent.

A frozen sensor repeats its last value although the system moves. Whether it is frozen is a two-state chain, which
enters with the probability `Gate.frozen` at every reading and stays with `STAY`. A frozen sensor repeats its last
reading for certain; one that works, where the forecast has moved, with at most the probability max(delta p, a) <= 1,
with delta the smallest step of the readings, p the density that the forecast gives to the values that are rounded to
the reading, and a the share of readings that repeated. So the probability pi that it is frozen is

    pi <- prior / (prior + (1 - prior) max(delta p, a)),    prior = frozen (1 - pi) + STAY pi

if the reading repeats, 0 if it does not, and the prior where the forecast has not moved: a plant at rest, and one whose
meter is too coarse to show a movement, repeat their readings too. The forecast has moved if it differs from the one
before by more than half of its own standard deviation and more than delta. A reading with pi above one half is refused.
A code that stays is refused in this way, however long.

Source: quantum^2 / 12 is Sheppard's (1898); the chain is a hidden Markov model; the rest is ours. Cost per sample: a
few comparisons.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import State, Step, exp, kernel

MOVED = 0.25
"""Share of the variance of the forecast by which the square of its change counts as a movement."""
STAY = 0.98
"""Probability per reading that a frozen sensor stays frozen."""
BELIEVED = -1.0
"""In place of the probability that a sensor is frozen, until the reading changes: it is a level that repeats."""
ENOUGH = 5.0
"""Number of repeats, and of steps of the size of the quantum, before they count."""


def no_repeats() -> Mapping[str, Any]:
    """Fields before the first reading."""
    return {
        "gate_before": np.nan, "gate_finest": np.inf, "gate_smallest": 0.0, "gate_steps": 0.0, "gate_repeats": 0.0,
        "gate_stuck": 0.0, "gate_forecast": np.nan, "floor": 0.0, "shift": 0.0,
    }  # fmt: skip


@kernel
def as_measured(s: State, l: int) -> float:
    """The output as it was measured."""
    return s.y[l] + s.shift[l]  # type: ignore[no-any-return]


@kernel
def same_reading(s: State, other: float, l: int) -> bool:
    """Whether the reading is another one but for rounding, also that of the shift; not if the other is NaN."""
    y = as_measured(s, l)
    return abs(y - other) <= ROUNDING * (abs(y) + abs(s.shift[l]))  # type: ignore[no-any-return]


def repeats_by_nature(share: float) -> Callable[[State, int], bool]:
    """``natural(s, l)``: whether so large a share of the readings repeat that a repeat is no sign of a code."""
    share = float(share)

    @kernel
    def natural(s: State, l: int) -> bool:
        repeats = s.gate_repeats[l]
        return (repeats >= ENOUGH) & (repeats >= share * (repeats + s.gate_steps[l]))  # type: ignore[no-any-return]

    return natural  # type: ignore[no-any-return]


def resolution(share: float) -> Step:
    """Learn from a reading that was accepted, and set the floor."""
    share = float(share)
    natural = repeats_by_nature(share)

    @kernel
    def resolve(s: State, l: int) -> None:
        if s.observed[l] > 0.0:
            step, finest = abs(as_measured(s, l) - s.gate_before[l]), s.gate_finest[l]
            if same_reading(s, s.gate_before[l], l):
                s.gate_repeats[l] += 1.0
            elif step > 0.0:  # NaN at the first reading
                s.gate_steps[l] += 1.0
                kept = s.gate_smallest[l] if step >= 0.75 * finest else 0.0
                s.gate_smallest[l] = kept + (1.0 if step < 1.5 * finest else 0.0)
                s.gate_finest[l] = min(step, finest)
            coarse = natural(s, l) & (s.gate_smallest[l] >= max(ENOUGH, share * s.gate_steps[l]))
            s.floor[l] = s.gate_finest[l] * s.gate_finest[l] / 12.0 if coarse else 0.0

    return resolve  # type: ignore[no-any-return]


def frozen_rule(enter: float) -> Callable[[State, float, int], bool]:
    """``frozen(s, v, l)``: whether the reading is one of a frozen sensor, given the variance v of its forecast."""
    enter = float(enter)

    @kernel
    def chance_of_repeat(s: State, v: float, l: int) -> float:
        """The probability at most that a sensor that works repeats its reading."""
        quantum, repeats = s.gate_finest[l], s.gate_repeats[l]
        off = max(abs(s.e[l]) - 0.5 * quantum, 0.0)
        density = exp(-0.5 * off * off / v) / np.sqrt(2.0 * np.pi * v)
        return min(max(repeats / (repeats + s.gate_steps[l]), quantum * density), 1.0)  # type: ignore[no-any-return]

    @kernel
    def frozen(s: State, v: float, l: int) -> bool:
        found, repeats = 0.0, same_reading(s, s.gate_before[l], l)
        if repeats & (s.gate_stuck[l] < 0.0):
            found = BELIEVED
        elif repeats & (s.gate_steps[l] >= 2.0 * ENOUGH):
            prior = enter * (1.0 - s.gate_stuck[l]) + STAY * s.gate_stuck[l]
            quantum, tells = s.gate_finest[l], (s.valid[l] > 0.0) & (v > 0.0) & (v < np.inf)
            moved = s.y_hat[l] + s.shift[l] - s.gate_forecast[l]
            tells &= moved * moved > max(MOVED * v, quantum * quantum)
            chance = chance_of_repeat(s, v, l) if tells else 1.0
            found = prior / (prior + (1.0 - prior) * chance)
        s.gate_stuck[l] = found
        s.gate_forecast[l] = s.y_hat[l] + s.shift[l] if s.valid[l] > 0.0 else s.gate_forecast[l]
        return found > 0.5

    return frozen  # type: ignore[no-any-return]
