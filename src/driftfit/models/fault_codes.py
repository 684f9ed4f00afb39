"""Readings out of all proportion to those before, for models whose prediction is not linear in theta.

A linear model recovers from a reading of 9999 where the output is near 10, as its tracker forgets. A prediction that
bends may not: the reading takes the estimate to where the gradient is wrong or zero, and no later sample brings it
back. Therefore such a model counts a reading as missing if

    (y - m)^2 > (REACH p)^2 v    and    (y - y')^2 > (REACH p)^2 v    and    (y - y_hat)^2 > (REACH p)^2 v

with m and v the mean and variance of the readings so far, y' the last one that was accepted, and y_hat the prediction
if there is one. p is 1, and doubles with every strange reading near the one before: readings that keep coming are a
change of level. A reading that repeats the last one to the last bit says nothing new, and does not double it, and one
far from it doubles it in 16: fault codes come in runs, some of them with either sign.

The first readings are accepted unchecked, because there is nothing to compare them with; ``limits=`` of `track` and
`Live` gives the range of a sensor. Inputs are not judged: a large one may be a test.

`absurd` judges a whole record instead, for warnings and searches.

Source: the rule of `driftfit.trackers.parts.faults.outlying_readings`, which judges sooner, because its tracker knows
the variance of the noise. Cost per sample: a few comparisons.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array

REACH = 30.0
"""Standard deviations of the readings beyond which one is strange."""
FIRST = 10.0
"""Readings that are accepted unchecked."""
MEMORY = 1000.0
"""Memory of their mean and variance, in readings."""
QUICK, SLOWEST = 2.0, 2.0 ** (1.0 / 16.0)
"""Growth of p for readings that persist, and for values that jump."""
ALIKE = 0.25
"""A reading persists if it differs from the last one by less than this share of its distance from m."""
LONGEST = 1e12
"""Upper bound of p."""

ABSURD, GAP, FEWEST = 300.0, 10.0, 20
"""Usual deviations from the median beyond which a value may be a fault code, how many times further than the others it
must then be, and the number of values that this judgement needs."""

UNJUDGED: Mapping[str, Any] = {
    "usual": 0.0, "usual_spread": 0.0, "judged": 0.0, "accepted": np.nan, "raw": np.nan, "forbearance": 1.0,
    "refused": 0.0,
}  # fmt: skip
"""m; v; the number of readings in them; y'; the last reading of all; p; how many were refused."""


def absurd(x: Array) -> Array:
    """The values of a signal (T,) that are `ABSURD` times its usual deviation from its median, by sample; often empty.

    The usual deviation is the median one of those that are not zero, so that a signal may rest most of the time. That
    of rain is some tenths of a millimetre, so a storm is as far as a code; but only a code is `GAP` times further than
    whatever is nearer than it.
    """
    known = np.isfinite(x)
    away = np.abs(np.where(known, x, np.nan) - (np.median(x[known]) if known.any() else 0.0))
    moving = np.sort(away[known & (away > 0.0)])
    if len(moving) < FEWEST:
        return np.empty(0, int)
    beyond = moving[1:][(moving[1:] > ABSURD * float(np.median(moving))) & (moving[1:] > GAP * moving[:-1])]
    return np.flatnonzero(known & (away >= beyond.min(initial=np.inf)))
