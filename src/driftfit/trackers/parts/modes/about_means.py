"""Filters whose parameters drift about the mean regressors: changes of gain at an operating point.

Beside an intercept, a gain that changes where the input is far from 0 leaves the output at the mean input as it is:
y = a + g (u - m) has the intercept a - g m, which moves with g. Independent drifts of g and the intercept would move y
by m times as much as the change of the gain shows in u - m, so their scale, the mean square of u, makes the drift of g
(m^2 + v) / v times too small. With m_i and v_i the mean and the variance of regressor i, k the constant column, and p
its value, these filters therefore drift by

    sum_{i != k} ratio r / v_i d_i d_i' + ratio r / c_k e_k e_k',     d_i = e_i - (m_i / p) e_k

    m_i <- m_i + (phi_i - m_i) / w,     v_i <- v_i + ((phi_i - m_i)^2 / noise - v_i) / w

with w and c those of `driftfit.trackers.parts.excitation`. Inputs of mean 0, or the same ones with any offset beside an
intercept, then have the same drift. Without a constant column these filters do not drift.

Source: ours. Cost per sample: O(n^3 / 2), and O(n^2) for each filter.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import State, kernel

ABOUT = (1e-3, 1e-2, 0.1, 1.0)
"""Drift ratios of the filters."""
MEMORY, FIRST, LARGE, DULL = 50.0, 20.0, 25.0, 1e-4


def no_means(n: int, first: int) -> dict[str, Any]:
    """Fields before the first sample; ``first`` is the first of these filters, if n > 1."""
    return {
        "about": np.array(ABOUT if n > 1 else ()),
        "first_about": first,
        "centre": np.zeros(n),
        "variance": np.zeros(n),
        "last_phi": np.zeros(n),
        "moves_seen": np.zeros(n),
        "about_drift": np.zeros((n, n)),
        "away_from": np.zeros(n),
    }


@kernel
def learn_means(s: State, l: int) -> None:
    """Update means and variances of the regressors that have moved since the sample before."""
    for i in range(s.parameters[l]):
        moved = s.phi[i, l] - s.last_phi[i, l]
        fresh = (s.moves_seen[i, l] < 1.0) | (moved * moved > DULL * s.variance[i, l])
        used = s.ok[l] if fresh else 0.0
        s.moves_seen[i, l] += used
        weight = used / min(max(s.moves_seen[i, l], 1.0), MEMORY)
        away = s.phi[i, l] - s.centre[i, l]
        s.centre[i, l] += weight * away
        square = away * (s.phi[i, l] - s.centre[i, l]) / s.noise[l]
        most = LARGE * s.variance[i, l] if s.moves_seen[i, l] > FIRST else np.inf
        s.variance[i, l] += weight * (min(square, most) - s.variance[i, l])
        s.last_phi[i, l] = s.phi[i, l] if s.ok[l] > 0.0 else s.last_phi[i, l]


@kernel
def constant_column(s: State, l: int) -> int:
    """The last column that is constant and not 0, or -1."""
    found = -1
    for i in range(s.parameters[l]):
        found = i if (s.centre[i, l] != 0.0) & (s.variance[i, l] == 0.0) else found
    return found


@partial(kernel, inline=False)
def drift_about(s: State, size: float, l: int) -> None:
    """Drift about the means: ``size`` in units of the ratios over the variances of the regressors."""
    n, k = s.parameters[l], constant_column(s, l)
    if s.about.shape[0] == 0:
        return
    for a in range(n):
        for b in range(a + 1):
            s.about_drift[a, b, l] = 0.0
    for i in range(n):
        own = s.variance[i, l] if (k >= 0) & (i != k) else s.c[i, l]
        share = s.centre[i, l] / s.centre[k, l] if (k >= 0) & (i != k) else 0.0
        if own > 0.0:
            for a in range(n):
                s.away_from[a, l] = s.S[a, i, l] - share * s.S[a, k, l]
            for a in range(n):
                for b in range(a + 1):
                    s.about_drift[a, b, l] += s.away_from[a, l] * s.away_from[b, l] / own
    for a in range(n):
        for b in range(a + 1):
            for j in range(s.about.shape[0]):
                s.C[a, b, s.first_about[l] + j, l] += size * s.about[j, l] * s.about_drift[a, b, l]
