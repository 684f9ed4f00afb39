"""Readings far outside the range of all earlier ones, judged before functions of them become regressors.

With an output block the present output is a regressor: the curve explains any reading, and a fault code has no larger
innovation than other samples. So the reading itself is compared with the range [low, high] of those that were accepted
so far, and counts as missing if

    max(y - high, low - y) > BEYOND p (1 + EXCUSED x) (1 + UNSURE / N^2) (high - low)

with N their number. The factor p is 1; with every such reading in a row it doubles if that is near the one before, as
on a new level, and in 16 readings if it repeats that in all digits or is far from it, as codes that come in runs. The
excuse x is 1 if the model predicts that the output leaves its range at this end, or the number of widths by which an
input left its own range lately, if that is more. Among the first `FIRST` readings only what is `FAR` widths away is
refused. Without an output block only trackers of the minimal parameters, which do not judge readings that are near,
need this.

Source: ours; see `driftfit.models.fault_codes` for the rule of models without a memory of this range. Cost: two
comparisons per sample.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array, part
from driftfit.models.fault_codes import ALIKE, LONGEST, QUICK, SLOWEST
from driftfit.models.hammerstein_wiener.step_memory import (
    INPUTS,
    LEAST_Y,
    MOST_Y,
    ODD,
    PATIENT,
    READINGS,
    REFUSED,
    RESPONDING,
    SPANS,
    US,
    Places,
)

BEYOND, FAR = 0.75, 100.0
"""Widths of the range beyond its end from which on a reading is strange; the same for the first readings."""
FIRST, FEWEST = 5.0, 3.0
"""Number of readings that have a range; the same for readings that are `FAR` beyond it."""
UNSURE = 30.0
"""Over the square of the number of readings: the share by which the range of few readings may be too narrow."""
ENOUGH = 10.0
"""Number of readings among which one that is far from all others is forgotten."""
EXCUSED = 10.0
"""Widths that are allowed for one of an input, or if the prediction is at the end of the range."""
LASTS, SLOWLY = 0.8, 0.25
"""Share of the excuse of an input that is left at the next sample; and widths by which its range grows with one."""


@part
def learn_range(m: Array, y: float) -> None:
    """Widen the range by an accepted reading."""
    m[READINGS, 0] += 1.0
    m[LEAST_Y, 0], m[MOST_Y, 0] = min(m[LEAST_Y, 0], y), max(m[MOST_Y, 0], y)


@part
def bound_range(m: Array, bottom: float, top: float) -> None:
    """Forget single readings beyond what all others allow, when there are enough others."""
    if m[READINGS, 0] >= ENOUGH:
        m[LEAST_Y, 0], m[MOST_Y, 0] = max(m[LEAST_Y, 0], bottom), min(m[MOST_Y, 0], top)


@part
def forget_inputs(m: Array) -> None:
    """At every sample: what an input did counts for less."""
    m[RESPONDING, 0] *= LASTS
    m[REFUSED, 0] = 0.0


@part
def watch_inputs(m: Array, p: Places) -> None:
    """Learn the ranges of the inputs, and by how many widths one left its own lately: before the reading is judged if
    it can respond at once, and otherwise after it."""
    grows = SLOWLY if m[READINGS, 0] >= ENOUGH else np.inf
    for i in range(p[INPUTS]):
        low, high = p[SPANS] + 2 * i, p[SPANS] + 2 * i + 1
        u = m[p[US] + i, 0]
        if abs(u) < LARGEST:
            away, wide = max(u - m[high, 0], m[low, 0] - u), m[high, 0] - m[low, 0]
            if m[READINGS, 0] >= FEWEST and away > m[RESPONDING, 0] * wide:
                m[RESPONDING, 0] = away / wide if wide > 0.0 else np.inf
            most = grows * wide if wide > 0.0 else np.inf  # a few codes do not make the next one ordinary
            m[low, 0], m[high, 0] = min(m[low, 0], max(u, m[low, 0] - most)), max(m[high, 0], min(u, m[high, 0] + most))


@part
def limit(m: Array, excuse: float) -> float:
    """Distance beyond the range from which on a reading is strange; inf while the range is not known."""
    readings, wide = m[READINGS, 0], m[MOST_Y, 0] - m[LEAST_Y, 0]
    if readings < FEWEST or not wide > 0.0:
        return np.inf
    few = BEYOND * (1.0 + UNSURE / (readings * readings)) * (1.0 + EXCUSED * excuse)
    return float((few if readings >= FIRST else FAR) * wide)


@part
def strange(m: Array, y: float) -> bool:
    """Whether a reading is so far from all before; p is 1 again after any other."""
    found = bool(max(y - m[MOST_Y, 0], m[LEAST_Y, 0] - y) > limit(m, m[RESPONDING, 0]))
    if not found:
        m[PATIENT, 0] = 1.0
    return found


@part
def refused(m: Array, y: float, y_hat: float) -> bool:
    """Whether a strange reading counts as missing, given its prediction, which may be NaN."""
    low, high = m[LEAST_Y, 0], m[MOST_Y, 0]
    away, apart = max(y - high, low - y), abs(y - m[ODD, 0])
    expected = 1.0 if (y > high and y_hat >= high) or (y < low and y_hat <= low) else 0.0
    near = apart > 0.0 and (apart < ALIKE * away or m[READINGS, 0] < FIRST)
    growth = QUICK if near else SLOWEST
    p = m[PATIENT, 0] * growth if m[PATIENT, 0] > 1.0 else 1.0
    refuse = bool(away > p * limit(m, max(m[RESPONDING, 0], expected)))
    m[ODD, 0], m[PATIENT, 0] = y, min(max(p, growth), LONGEST)
    m[REFUSED, 0] = 1.0 if refuse else 0.0
    return refuse
