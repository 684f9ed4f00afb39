"""The resolution of the readings: the step of a coarse meter, estimated from readings that repeat.

Readings of an integer meter, a counter or a converter of few bits are accurate to half a step, and where they are
constant, residuals are zero although nothing was measured exactly. A noise variance learned from those residuals
collapses, and bands and likelihood with it. Therefore

    quantum    the smallest step between two consecutive readings, if steps of its size (up to one and a half) are a
               tenth of all steps, and a tenth of the readings repeat the previous one; or else the grid
    grid       the size of most steps, where all others are either larger, or far smaller: readings of whole litres that
               were interpolated or converted are 30.9995, 31 and 31.0002
    coarse     quantum^2 / 12, the variance of the rounding error; 0 if readings are not coarse
    fresh      whether a residual carries information about the noise: not that of a reading that repeats the previous
               one, as long as the quantum is unknown

and no tracker takes its noise variance to be below ``coarse``. That of a sample is r / w with its weight w; the least r
is therefore ``coarse`` times the mean weight of the readings. A bank also treats readings that repeat as one rounding
error observed several times (`lasting`). Readings of a fine sensor never repeat, and nothing changes for
them. If they do repeat, at a limit, at 0 while a pump is off, or because a value is held, the other steps have all
sizes, and no step is frequent. A fine sensor that follows an input of a few levels has large steps and small ones, too:
a grid needs three levels, mostly steps from one to the next, more of them than small ones, and innovations that show
the rounding: machines that are switched one by one have equal steps, too, but inputs explain them. A model that
subtracts a shift from y (`driftfit.models.linearised`) writes it into the field ``shift``: the reading is y + shift.

Source: quantum^2 / 12 is Sheppard's (1898); the rest is ours. Cost per sample: a few comparisons.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, kernel
from driftfit.readings.repeats import as_measured, same_reading

SHARE = 0.1
"""Share of the readings that repeat, and of the steps that are about as small as the least, for a quantum."""
ENOUGH = 3.0
"""Number of steps of the size of the quantum, and of repeated readings, before it is accepted."""
JITTER = 1.0 / 32.0
"""Steps below this share of the grid are no steps of it."""
RARE = 10.0
"""Of so many steps of the grid one may be smaller, such as that of a reading half-way between two."""
MOSTLY, LEVELS = 2.5, 1.75
"""Least ratio of steps of the grid to larger ones; least range of the readings in units of the grid."""
ROUNDED = 0.01
"""Least mean square of the innovations after steps of the grid, in units of its square; that of rounding is 1/12."""
LONGEST = 4.0
"""At most so many repeated readings in a row count."""


def unresolved() -> dict[str, Any]:
    """Fields before the first reading."""
    return {
        "reading": np.nan, "quantum": np.inf, "finest": np.inf, "smallest": 0.0, "steps": 0.0, "repeats": 0.0,
        "grid": np.inf, "of_grid": 0.0, "moved_by": 0.0, "rounded": 0.0, "within": 0.0, "jitter": 0.0, "beyond": 0.0,
        "lowest": np.inf, "highest": -np.inf, "coarse": 0.0, "fresh": 1.0, "alike": 0.0, "shift": 0.0,
        "mean_weight": 1.0, "used_readings": 0.0,
    }  # fmt: skip


@kernel
def learn_grid(s: State, y: float, step: float, moved: float, l: int) -> None:
    """Count a step among those of the grid, smaller and larger ones; ``moved`` is 0 if there is none.

    ``rounded`` sums e^2 / grid^2 of the samples with such a step; e is still that of the sample before.
    """
    grid = s.grid[l]
    share = s.e[l] / grid
    rounded = s.rounded[l] + (min(share * share, 1.0) if (s.moved_by[l] > 0.0) & (abs(share) >= 0.0) else 0.0)
    tiny, within, beyond = step < JITTER * grid, step < 0.75 * grid, step >= 1.5 * grid
    jitter, between = s.jitter[l] + (moved if tiny else 0.0), s.within[l] + (moved if within & (not tiny) else 0.0)
    larger, near = s.beyond[l] + (moved if beyond else 0.0), (step >= 0.75 * grid) & (not beyond)
    of_grid = s.of_grid[l] + (moved if near else 0.0)
    other = (moved > 0.0) & ((max(larger, RARE * between) > of_grid) | (grid == np.inf))
    s.grid[l], s.of_grid[l], s.jitter[l] = step if other else grid, 1.0 if other else of_grid, 0.0 if other else jitter
    s.within[l], s.beyond[l] = 0.0 if other else between, 0.0 if other else larger
    s.moved_by[l], s.rounded[l] = 0.0 if other else (moved if near else 0.0), 0.0 if other else rounded
    s.lowest[l] = min(s.lowest[l], y) if s.observed[l] > 0.0 else s.lowest[l]
    s.highest[l] = max(s.highest[l], y) if s.observed[l] > 0.0 else s.highest[l]


@kernel
def resolve(s: State, l: int) -> None:
    """Process a reading."""
    y, observed, finest = as_measured(s, l), s.observed[l], s.finest[l]
    step = abs(y - s.reading[l])  # NaN at the first reading, which neither moves nor repeats
    repeated = observed if same_reading(s, s.reading[l], l) else 0.0
    moved = observed - repeated if step >= 0.0 else 0.0
    near = moved if step < 1.5 * finest else 0.0
    s.smallest[l] = near + (s.smallest[l] if (moved == 0.0) | (step >= 0.75 * finest) else 0.0)
    s.finest[l] = step if (moved > 0.0) & (step < finest) else finest
    s.steps[l] += moved
    s.repeats[l] += repeated
    if s.repeats[l] >= ENOUGH:  # readings of a fine sensor do not repeat
        learn_grid(s, y, step, moved, l)
    frequent, repeat = max(ENOUGH, SHARE * s.steps[l]), s.repeats[l] >= max(ENOUGH, SHARE * (s.steps[l] + s.repeats[l]))
    # steps before the present candidate are not of its size: half of all steps that are no jitter must be
    most = s.of_grid[l] >= max(max(frequent, 0.5 * (s.steps[l] - s.jitter[l])), max(s.jitter[l], MOSTLY * s.beyond[l]))
    apart = s.highest[l] - s.lowest[l] >= LEVELS * s.grid[l]
    explained = s.rounded[l] < ROUNDED * (s.of_grid[l] - 1.0)
    on_grid = repeat & most & apart & (s.grid[l] > 1.5 * s.finest[l]) & (not explained)
    coarse = on_grid | (repeat & (s.smallest[l] >= frequent))
    s.quantum[l] = s.grid[l] if on_grid else s.finest[l]
    s.coarse[l] = s.quantum[l] * s.quantum[l] / 12.0 if coarse else 0.0
    s.reading[l] = y if observed > 0.0 else s.reading[l]
    s.used_readings[l] += s.ok[l]
    s.mean_weight[l] += s.ok[l] * (1.0 / s.noise[l] - s.mean_weight[l]) / max(s.used_readings[l], 1.0)
    lasts = observed if on_grid & (step < JITTER * s.grid[l]) else repeated
    s.alike[l] = min(s.alike[l] + 1.0, LONGEST) * lasts if observed > 0.0 else s.alike[l]
    s.fresh[l] = 0.0 if (repeated > 0.0) & (not coarse) else 1.0


@kernel
def least_noise(s: State, l: int) -> float:
    """The least r, in units of the noise factor of a sample."""
    return s.coarse[l] * s.mean_weight[l]  # type: ignore[no-any-return]


@kernel
def lasting(s: State, l: int) -> float:
    """The variance that a repeated reading adds to its noise: k in a row share one error of rounding.

    With coarse (k + 1)^2 instead of coarse, a run of repeated readings counts no more than two readings.
    """
    return s.coarse[l] * s.alike[l] * (s.alike[l] + 2.0)  # type: ignore[no-any-return]


@kernel
def learn_resolved_scale(s: State, l: int) -> None:
    """Count the innovation; s.s becomes a variance with the scale known before this sample, and s.scale is updated."""
    counted = s.ok[l] * s.fresh[l]
    s.squares[l] += counted * s.e[l] * s.e[l] / s.s[l]
    s.count[l] += counted
    s.s[l] *= s.scale[l]
    scale, least = s.squares[l] / s.count[l], least_noise(s, l)
    s.scale[l] = least if least > scale else scale  # NaN is kept


def resolution(lane: Mapping[str, Array]) -> tuple[tuple[str, str], ...]:
    """Its remark in a summary: nothing if the resolution is fine."""
    if not lane["coarse"] > 0.0:
        return ()
    share = float(lane["repeats"] / (lane["repeats"] + lane["steps"]))
    return (
        (
            "Resolution",
            f"steps of {float(lane['quantum']):.4g}, {share:.0%} of the readings repeat: the noise variance is taken "
            f"to be at least {float(lane['coarse']):.3g}",
        ),
    )
