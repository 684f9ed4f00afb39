"""Filters that follow a trend: their means move by a slope in every interval of time.

    m <- m + tau b,     b <- b (1 - beta f tau / w^(1/2))     in an interval of tau nominal ones
    b <- b + beta / w^(1/2) g a e,     beta = rho^(1/2) / 2        at a sample, w the mean interval between samples

with g a e the correction of the mean (`driftfit.trackers.parts.modes.filters`), rho the drift ratio of the filter, and
b its slope per nominal interval in the coordinates of the filters. A filter of ratio rho whose samples are w intervals
apart has in the long run the gain alpha = (rho w)^(1/2) in each parameter, and an integrated random walk for which
alpha is the best gain has alpha^2 / 2 as that of its change between samples. Both have the same variance alpha r / c,
so the covariance of a random walk with this ratio is also that of a filter that follows the trend, and no parameter is
added. Where the drift is known to be less than usual, so is tau.

Slopes fade, faster in directions that are no longer excited, since there the straight line would go on for ever. These
are the ones in which C has grown since samples corrected it: with d the mean of C_ii over samples, each weighted by the
share of C_ii that it removes,

    f_i = FADING + LOST (1 - min(1, GROWN d_i / C_ii))

The C_ii depend on the order of the regressors, from which the coordinates are made: the only place where it matters.

In one long interval b becomes b / (1 + x)^2, and m moves by tau b / (1 + x), with x = beta f tau / (2 w^(1/2)).

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
GROWN = 1.3
"""Growth of C_ii that is not a loss of excitation: that between samples of ordinary regressors."""
SPACING, LONGEST, SHORTEST = 30.0, 4.0, 1e-9
"""Memory of the mean interval between samples, in samples; a gap counts as at most this many mean intervals; and the
smallest mean, in nominal intervals."""


def no_trend(n: int, first: int) -> dict[str, Any]:
    """Fields before the first sample; ``first`` is the first filter that follows a trend."""
    return {
        "slopes": np.zeros((n, len(TREND))),
        "corrected": np.zeros((n, len(TREND))),
        "apart": 1.0,
        "waited": 0.0,
        "bend": 0.5 * np.sqrt(TREND),
        "trend": first,
    }


@kernel
def bend_slopes(s: State, l: int) -> None:
    """Correct the slopes as the means will be corrected, while C is still that before the sample."""
    apart = s.apart[l]
    s.apart[l] += (min(s.waited[l], LONGEST * apart) - apart) / min(s.count[l] + 1.0, SPACING)
    s.waited[l] = 0.0
    share = 1.0 / np.sqrt(max(s.apart[l], SHORTEST))
    for i in range(s.slopes.shape[0]):
        for j in range(s.slopes.shape[1]):
            k = s.trend[l] + j
            before = max(s.C[i, i, k, l], 1e-300)
            removed = min(1.0, max(s.h_k[k, l] * s.gain[i, k, l] * s.gain[i, k, l] / before, 0.0))
            s.corrected[i, j, l] += min(1.0, 2.0 * removed) * (before - s.corrected[i, j, l])
            s.slopes[i, j, l] += s.bend[j, l] * share * s.gain[i, k, l] * s.step[k, l]


@kernel
def move_along(s: State, time: float, l: int) -> None:
    """Every filter that follows a trend moves by its slope for ``time`` nominal intervals; C includes their drift."""
    s.waited[l] += time
    memory = time / np.sqrt(max(s.apart[l], SHORTEST))
    for i in range(s.slopes.shape[0]):
        for j in range(s.slopes.shape[1]):
            k = s.trend[l] + j
            fading = FADING + LOST * (1.0 - min(1.0, GROWN * s.corrected[i, j, l] / max(s.C[i, i, k, l], 1e-300)))
            left = 1.0 / (1.0 + 0.5 * s.bend[j, l] * fading * memory)
            s.m[i, k, l] += s.slopes[i, j, l] * time * left
            s.slopes[i, j, l] *= left * left


@kernel
def level_slopes(s: State, i: int, l: int) -> None:
    """Forget the slopes of a coordinate that has a new meaning."""
    for j in range(s.slopes.shape[1]):
        s.slopes[i, j, l], s.corrected[i, j, l] = 0.0, 0.0
