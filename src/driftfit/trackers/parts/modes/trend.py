"""Filters that follow a trend: their means move by a slope at every sample that corrects them.

    m <- m + b,      b <- b + beta (g a e - f b),      beta = rho^(1/2) / 2

with g a e the correction of the mean (`driftfit.trackers.parts.modes.filters`), rho the drift ratio of the filter, and
b its slope in the coordinates of the filters. A filter of ratio rho has in the long run the gain alpha = rho^(1/2) in
each parameter, and an integrated random walk for which alpha is the best gain has beta = alpha^2 / 2 as that of its
slope. Both have the same variance alpha r / c, so the covariance of a random walk with this ratio is also that of a
filter that follows the trend, and no parameter is added.

Slopes fade, faster in directions that are no longer excited, since there the straight line would go on for ever. These
are the ones in which C has grown since samples corrected it: with d the mean of C_ii over samples, each weighted by the
share of C_ii that it removes,

    f_i = FADING + LOST (1 - min(1, d_i / C_ii))

Source: gains of the filter with position and slope are Kalata's (1984), for small gains; correcting the slopes of
regression parameters with them is ours. Cost per sample: O(n).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import State, kernel

TREND = (1e-3, 1e-2, 0.1)
"""Drift ratios of the filters that follow a trend."""
FADING, LOST = 0.1, 2.0
"""Shares of its own correction by which a slope fades, with and without excitation."""


def no_trend(n: int, first: int) -> dict[str, Any]:
    """Fields before the first sample; ``first`` is the first filter that follows a trend."""
    return {
        "slopes": np.zeros((n, len(TREND))),
        "corrected": np.zeros((n, len(TREND))),
        "bend": 0.5 * np.sqrt(TREND),
        "trend": first,
    }


@kernel
def bend_slopes(s: State, l: int) -> None:
    """Correct the slopes as the means will be corrected, while C is still that before the sample."""
    for i in range(s.slopes.shape[0]):
        for j in range(s.slopes.shape[1]):
            k = s.trend[l] + j
            before = max(s.C[i, i, k, l], 1e-300)
            removed = min(1.0, max(s.h[k, l] * s.gain[i, k, l] * s.gain[i, k, l] / before, 0.0))
            s.corrected[i, j, l] += min(1.0, 2.0 * removed) * (before - s.corrected[i, j, l])
            fading = FADING + LOST * (1.0 - min(1.0, s.corrected[i, j, l] / before))
            step = s.gain[i, k, l] * s.step[k, l]
            s.slopes[i, j, l] += s.bend[j, l] * (step - fading * s.slopes[i, j, l])


@kernel
def move_along(s: State, l: int) -> None:
    """Every filter that follows a trend moves by its slope, in the coordinates that the sample corrected."""
    for i in range(s.slopes.shape[0]):
        for j in range(s.slopes.shape[1]):
            k = s.trend[l] + j
            s.m[i, k, l] += s.slopes[i, j, l] if s.gain[i, k, l] != 0.0 else 0.0


@kernel
def level_slopes(s: State, i: int, l: int) -> None:
    """Forget the slopes of a coordinate that has a new meaning."""
    for j in range(s.slopes.shape[1]):
        s.slopes[i, j, l], s.corrected[i, j, l] = 0.0, 0.0
