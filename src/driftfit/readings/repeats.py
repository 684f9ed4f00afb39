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

from collections.abc import Callable
from typing import Any

import numpy as np

from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import State, exp, kernel

SHARE = 0.1
"""Share of the readings that repeat, and of the steps that are of the size of the quantum, from which on they count."""
ENOUGH = 3.0
"""How many of them there are before they count."""
MOVED = 0.25
"""Share of the variance of the forecast by which the square of its change counts as a movement."""
STAY = 0.98
"""Probability per reading that a frozen sensor stays frozen."""
BELIEVED = -1.0
"""In place of the probability that a sensor is frozen, until the reading changes: it is a level that repeats."""


def unread() -> dict[str, Any]:
    """Fields of `note_reading`: the last one, how often it has come again, the smallest step, and the shift of y."""
    return {"reading": np.nan, "alike": 0.0, "finest": np.inf, "shift": 0.0}


def unresolved() -> dict[str, Any]:
    """Fields of `resolve`: how many steps have the size of the smallest, how many steps and repeats there were."""
    return {**unread(), "smallest": 0.0, "steps": 0.0, "repeats": 0.0, "floor": 0.0}


@kernel
def measured(s: State, l: int) -> float:
    """The output as it was measured."""
    return s.y[l] + s.shift[l]  # type: ignore[no-any-return]


@kernel
def repeats_last(s: State, l: int, g: State, k: int) -> bool:
    """Whether the reading repeats the last one in all digits, but for the rounding of a shift."""
    y = measured(s, l)
    return abs(y - g.reading[k]) <= ROUNDING * (abs(y) + abs(s.shift[l]))  # type: ignore[no-any-return]


@kernel
def natural(g: State, k: int) -> bool:
    """Whether so large a share of the readings repeat that a repeat is no sign of a code."""
    repeats = g.repeats[k]
    return (repeats >= ENOUGH) & (repeats >= SHARE * (repeats + g.steps[k]))  # type: ignore[no-any-return]


@kernel
def note_reading(s: State, l: int, g: State, k: int) -> None:
    """Whether a reading repeats the last one, and the smallest step."""
    if s.observed[l] > 0.0:
        step, repeated = abs(measured(s, l) - g.reading[k]), repeats_last(s, l, g, k)
        g.alike[k] = g.alike[k] + 1.0 if repeated else 0.0
        g.finest[k] = step if (not repeated) & (step < g.finest[k]) else g.finest[k]  # NaN at the first reading
        g.reading[k] = measured(s, l)


@kernel
def resolve(s: State, l: int, g: State, k: int) -> None:
    """Learn from a reading that was accepted, and set the floor."""
    step, finest = abs(measured(s, l) - g.reading[k]), g.finest[k]
    note_reading(s, l, g, k)
    if s.observed[l] > 0.0:
        if g.alike[k] > 0.0:
            g.repeats[k] += 1.0
        elif step > 0.0:
            g.steps[k] += 1.0
            kept = g.smallest[k] if step >= 0.75 * finest else 0.0
            g.smallest[k] = kept + (1.0 if step < 1.5 * finest else 0.0)
    coarse = natural(g, k) & (g.smallest[k] >= max(ENOUGH, SHARE * g.steps[k]))
    s.floor[l] = g.finest[k] * g.finest[k] / 12.0 if coarse else 0.0


def frozen_rule(enter: float) -> Callable[[State, int, State, int, float], bool]:
    """``frozen(s, l, g, k, v)``: whether the sensor is frozen, given the variance v of the forecast."""
    enter = float(enter)

    @kernel
    def frozen(s: State, l: int, g: State, k: int, v: float) -> bool:
        found, repeats = 0.0, repeats_last(s, l, g, k)
        if repeats & (g.gate_stuck[k] < 0.0):
            found = BELIEVED
        elif repeats & (g.steps[k] >= 2.0 * ENOUGH):
            prior = enter * (1.0 - g.gate_stuck[k]) + STAY * g.gate_stuck[k]
            quantum, tells = g.finest[k], (s.valid[l] > 0.0) & (v > 0.0) & (v < np.inf)
            moved = s.y_hat[l] + s.shift[l] - g.gate_forecast[k]
            tells &= moved * moved > max(MOVED * v, quantum * quantum)
            chance = 1.0  # at most, that a sensor that works repeats its reading
            if tells:
                off, share = max(abs(s.e[l]) - 0.5 * quantum, 0.0), g.repeats[k] / (g.repeats[k] + g.steps[k])
                density = exp(-0.5 * off * off / v) / np.sqrt(2.0 * np.pi * v)
                chance = min(max(share, quantum * density), 1.0)
            found = prior / (prior + (1.0 - prior) * chance)
        g.gate_stuck[k] = found
        g.gate_forecast[k] = s.y_hat[l] + s.shift[l] if s.valid[l] > 0.0 else g.gate_forecast[k]
        return found > 0.5

    return frozen  # type: ignore[no-any-return]
