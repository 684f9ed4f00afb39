"""Filters whose parameters drift about the mean regressors: changes of a gain at an operating point.

Beside an intercept, a gain that changes where the input is far from 0 leaves the output at the mean input as it is: in
y = a + g (u - m) the intercept is a - g m, and moves with g. Drifts of g and the intercept that are independent would
move y by m for each unit by which that change moves it at u = m + 1, and in units of the mean square of u the drift of
g is (m^2 + v) / v times too small. With m_i and v_i the mean and the variance of regressor i, k the constant column and
p its value, the covariance of these filters therefore grows by

    sum_{i != k} ratio r / v_i d_i d_i' + ratio r / c_k e_k e_k',     d_i = e_i - (m_i / p) e_k

    m_i <- m_i + (phi_i - m_i) / w,     v_i <- v_i + ((phi_i - m_i) (phi_i - m_i^new) / noise - v_i) / w

with w the number of samples on which regressor i has moved, at most `MEMORY`. An input without mean and the same input
with an offset of any size thus have the same drift. Without a constant column these filters are those of the common
ladder (`driftfit.trackers.parts.modes.ladder`).

Source: ours. Cost per sample: O(n^3 / 2), and O(n^2 / 2) for each filter.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, kernel
from driftfit.trackers.parts.excitation import DULL, LARGE, MEMORY
from driftfit.trackers.parts.proportion import FIRST

ABOUT = (1e-3, 1e-2, 0.1, 1.0)
"""Drift ratios of the filters."""
STILL = 1e-24
"""Variance of a column, as a share of its mean square, below which it counts as constant: it may be rounding."""


def no_means(n: int, first: int) -> dict[str, Any]:
    """Fields before the first sample; ``first`` is the first of these filters, if n > 1."""
    return {
        "about": np.array(ABOUT if n > 1 else ()),
        "first_about": first,
        "mean": np.zeros(n),
        "variance": np.zeros(n),
        "phi_before": np.zeros(n),
        "steps_taken": np.zeros(n),
        "constant": -1,
        "away": np.zeros(n),
        "about_drift": np.zeros((n, n)),
    }


@kernel
def learn_means(s: State, l: int) -> None:
    """Update means and variances of the regressors that have moved since the sample before, and ``s.constant``, the
    last column that is constant and not 0, or -1.
    """
    constant = -1
    for i in range(s.theta.shape[0]):
        step = s.phi[i, l] - s.phi_before[i, l]
        moved = (s.steps_taken[i, l] < 1.0) | (step * step > DULL * s.variance[i, l] * s.noise[l])
        used = s.ok[l] if moved else 0.0
        s.steps_taken[i, l] += used
        share = used / min(max(s.steps_taken[i, l], 1.0), MEMORY)
        off = s.phi[i, l] - s.mean[i, l]
        s.mean[i, l] += share * off
        square = off * (s.phi[i, l] - s.mean[i, l]) / s.noise[l]
        most = LARGE * s.variance[i, l] if s.steps_taken[i, l] > FIRST else np.inf
        s.variance[i, l] += share * (min(square, most) - s.variance[i, l])
        s.phi_before[i, l] = s.phi[i, l] if s.ok[l] > 0.0 else s.phi_before[i, l]
        constant = i if (s.variance[i, l] <= STILL * s.c[i, l]) & (s.mean[i, l] != 0.0) else constant
    s.constant[l] = constant


@partial(kernel, inline=False)
def drift_about(s: State, size: float, l: int) -> None:
    """Drift about the means: ``size`` in units of the ratios over the variances of the regressors."""
    n, k = s.parameters[l] if s.about.shape[0] > 0 else 0, s.constant[l]
    for a in range(n):
        for b in range(a + 1):
            s.about_drift[a, b, l] = 0.0
    for i in range(n):
        beside = (k >= 0) & (i != k)
        own = s.variance[i, l] if beside else s.c[i, l]
        rows = max(i, k) + 1 if own > STILL * s.c[i, l] else 0  # S is triangular
        for a in range(rows):
            s.away[a, l] = s.S[a, i, l] - (s.mean[i, l] / s.mean[k, l] * s.S[a, k, l] if beside else 0.0)
            for b in range(a + 1):
                s.about_drift[a, b, l] += s.away[a, l] * s.away[b, l] / own
    for a in range(n):
        for b in range(a + 1):
            for j in range(s.about.shape[0]):
                s.C[a, b, s.first_about[l] + j, l] += size * s.about[j, l] * s.about_drift[a, b, l]


def centring(phi: Array, constant: int) -> Array:
    """A (n, n), for which phi A are the regressors phi (N, n) less their means, beside the constant column; the
    identity if there is none, -1.
    """
    A = np.eye(phi.shape[1])
    if constant >= 0:
        mean = phi.mean(axis=0)
        A[constant] = -mean / mean[constant]
        A[constant, constant] = 1.0
    return A
