"""K random-walk filters side by side: what each does with a sample, and what they say together.

    e_k = y - phi' m_k,     g_k = C_k phi,     h_k = phi' g_k,     s_kj = h_k + v_j
    p_kj  proportional to c_k nu_j N(e_k; 0, s_kj),
    a_k    = sum_j p_(j|k) / s_kj,     d_k = sum_j p_(j|k) (1 / s_kj - a_k)^2
    m_k   <- m_k + g_k a_k e_k,        C_k <- C_k - g_k g_k' (a_k - d_k e_k^2)

with v_j the noise of level j (`driftfit.trackers.parts.noise_levels`), c and nu the probabilities of filters and
levels. An outlier's level is as wide as the innovation where that is more than it would be: however far off, its
influence does not grow. Until the regressors have spanned all directions the filters are those of an exact diffuse
start (`driftfit.trackers.parts.diffuse`): a regressor outside the span is taken in by all of them, and says nothing
about which one is right. Cost per sample: O(K n^2 + K J) for K filters and J levels.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import State, exp, kernel
from driftfit.trackers.parts.diffuse import LEFT, SIZE, hand_over, take_in
from driftfit.trackers.parts.drift_ladder import TOP, leap
from driftfit.trackers.parts.noise_levels import OUTLIER
from driftfit.trackers.parts.resolution import lasting

WIDE = 1e10
"""Variance of the prediction in a direction of which nothing was known, beside all other variance of it."""

LEAST = 1e-100
"""Probability that a filter is never below."""


@kernel
def predict(s: State, l: int) -> None:
    time = s.dt[l] * s.drift[l]
    if s.settled[l] > 0 and s.dt[l] > 0.0:
        for k in range(s.mu.shape[0]):
            s.prior[k, l] = s.mu[k, l]
        for i in range(s.theta.shape[0]):
            unit = s.r[l] * time / s.c[i, l] if s.c[i, l] > 0.0 else 0.0
            for k in range(s.mu.shape[0]):
                s.C[i, i, k, l] += s.ratio[i, k, l] * unit


@kernel
def innovate(s: State, l: int) -> None:
    """Innovation of every filter, and prediction and variance of the mixture before the sample."""
    n, K, J = s.theta.shape[0], s.mu.shape[0], s.nu.shape[0]
    for k in range(K):
        s.e_k[k, l] = 0.0
        s.h[k, l] = 0.0
    for i in range(n):
        for k in range(K):
            s.e_k[k, l] += s.phi[i, l] * s.m[i, k, l]
            s.gain[i, k, l] = 0.0
        for j in range(i + 1):
            for k in range(K):
                s.gain[i, k, l] += s.C[i, j, k, l] * s.phi[j, l]
        for j in range(i + 1, n):
            for k in range(K):
                s.gain[i, k, l] += s.C[j, i, k, l] * s.phi[j, l]
        for k in range(K):
            s.h[k, l] += s.phi[i, l] * s.gain[i, k, l]
    mean = 0.0
    for k in range(K):
        mean += s.prior[k, l] * s.e_k[k, l]
    level = 0.0
    for j in range(J - 1):
        level += s.nu_prior[j, l] * max(s.level[j, l] * s.r[l], s.coarse[l])
    v = s.noise[l] * s.leverage[l] * level / (1.0 - OUTLIER)
    for k in range(K):
        v += s.prior[k, l] * (s.h[k, l] + (s.e_k[k, l] - mean) ** 2)
    for k in range(K):
        s.e_k[k, l] = s.y[l] - s.e_k[k, l]
    s.y_hat[l] = mean
    s.e[l] = s.y[l] - mean
    s.s[l] = v


@kernel
def weigh(s: State, l: int) -> None:
    """Joint probabilities of drift modes and noise levels after the sample."""
    K, J = s.mu.shape[0], s.nu.shape[0]
    nearest, factor = np.inf, s.noise[l] * s.leverage[l]
    more = lasting(s, l)
    leap(s, l, factor * max(s.r[l], s.coarse[l]))
    for j in range(J):
        noise = factor * max(s.level[j, l] * s.r[l], s.coarse[l]) + more
        widest = np.inf if j == J - 1 else 0.0
        for k in range(K):
            square = s.e_k[k, l] * s.e_k[k, l]
            v = s.h[k, l] + max(noise, min(square, widest))
            s.inverse[j, k, l] = 1.0 / v
            nearest = min(nearest, square / v)
    total = 0.0
    for j in range(J):
        for k in range(K):
            far = s.e_k[k, l] * s.e_k[k, l] * s.inverse[j, k, l] - nearest
            p = s.prior[k, l] * s.nu_prior[j, l] * np.sqrt(s.inverse[j, k, l]) * exp(-0.5 * far)
            p *= s.rare[l] if k == TOP else 1.0
            s.joint[j, k, l] = p
            total += p
    for k in range(K):
        s.mu[k, l] = 0.0
    for j in range(J):
        s.nu[j, l] = 0.0
        for k in range(K):
            s.joint[j, k, l] /= total
            s.nu[j, l] += s.joint[j, k, l]
            s.mu[k, l] += s.joint[j, k, l]
    for k in range(K):
        s.mu[k, l] = max(s.mu[k, l], LEAST)  # at 0 a mode that only such modes lead to would have no mixture at all
    s.odd[l] = s.nu[J - 1, l] + (s.mu[TOP, l] - s.joint[J - 1, TOP, l] if s.rare[l] < 1.0 else 0.0)
    # an outlier says nothing about the level: the chain keeps what it was
    for j in range(J - 1):
        s.nu[j, l] += s.nu[J - 1, l] * s.nu_prior[j, l] / (1.0 - OUTLIER)


@kernel
def update_filters(s: State, l: int) -> None:
    """Each filter takes the sample with its noise levels merged: one rank-one update."""
    n, K, J = s.theta.shape[0], s.mu.shape[0], s.nu.shape[0]
    for k in range(K):
        s.row[k, l] = 0.0
        s.mu_next[k, l] = 0.0
    for j in range(J):
        for k in range(K):
            share = s.joint[j, k, l] / max(s.mu[k, l], 1e-300)
            s.row[k, l] += share * s.inverse[j, k, l]
            s.mu_next[k, l] += share * s.inverse[j, k, l] * s.inverse[j, k, l]
    for k in range(K):
        a = s.row[k, l]
        spread = max(s.mu_next[k, l] - a * a, 0.0)
        s.h[k, l] = a - spread * s.e_k[k, l] * s.e_k[k, l]
        s.step[k, l] = a * s.e_k[k, l]
    for i in range(n):
        for k in range(K):
            s.m[i, k, l] += s.gain[i, k, l] * s.step[k, l]
        for j in range(i):
            for k in range(K):
                s.C[i, j, k, l] -= s.h[k, l] * s.gain[i, k, l] * s.gain[j, k, l]
        for k in range(K):
            left = s.C[i, i, k, l] - s.h[k, l] * s.gain[i, k, l] * s.gain[i, k, l]
            s.C[i, i, k, l] = max(left, LEFT * s.C[i, i, k, l])


@kernel
def mixture(s: State, l: int) -> None:
    """theta and its covariance from the filters; without a sample theta keeps its bits."""
    for i in range(s.theta.shape[0]):
        mean = 0.0
        for k in range(s.mu.shape[0]):
            mean += s.mu[k, l] * s.m[i, k, l]
        s.theta[i, l] = mean if s.ok[l] > 0.0 else s.theta[i, l]
        for j in range(i + 1):
            total = 0.0
            for k in range(s.mu.shape[0]):
                away = (s.m[i, k, l] - s.theta[i, l]) * (s.m[j, k, l] - s.theta[j, l])
                total += s.mu[k, l] * (s.C[i, j, k, l] + away)
            s.P[i, j, l] = total
        s.var[i, l] = s.P[i, i, l]


@kernel
def determined(s: State, l: int) -> bool:
    """Whether what the start has spanned is determined well enough for covariances to hold it."""
    worst = 0.0
    for i in range(s.theta.shape[0]):
        inflation = s.P[i, i, l] * s.work[SIZE, i, l] * s.work[SIZE, i, l]
        worst = max(worst, inflation if s.S[i, i, l] > 0.0 else 0.0)
    return worst <= s.worst[l]  # type: ignore[no-any-return]


@kernel
def enter_filters(s: State, l: int) -> bool:
    """Take the sample into the square root of the start, and a regressor outside its span into all filters.

    With N the vector of the free column that u = phi' N ends, C_k becomes C_k + w N N' before its correction, w so
    large that what was known before has no say. An infinite w would divide by u, which may be all but rounding.

    Returns whether the regressor was one.
    """
    n, K, v = s.theta.shape[0], s.mu.shape[0], s.s[l]
    for j in range(n):
        s.pivot[j, l] = 1.0 if s.S[j, j, l] == 0.0 else 0.0
        for i in range(j + 1):
            s.H[i, j, l] = s.R[i, j, l]
    take_in(s, l)
    hand_over(s, l)
    innovated(s, l)
    if s.s[l] < np.inf:
        s.s[l] = v
        return False
    noise = s.noise[l] * s.leverage[l] * max(s.r[l], s.coarse[l])
    for j in range(n):
        if s.ok[l] > 0.0 and s.pivot[j, l] > 0.0 and s.S[j, j, l] > 0.0:
            u, size = 0.0, 0.0
            for i in range(j + 1):
                u += s.phi[i, l] * s.H[i, j, l]
                size += abs(s.phi[i, l] * s.H[i, j, l])
            for k in range(K):
                wide = WIDE * (s.h[k, l] + noise) / (size * size)
                total = s.h[k, l] + wide * u * u + noise
                for a in range(n):
                    s.gain[a, k, l] += wide * u * s.H[a, j, l] if a <= j else 0.0
                    s.m[a, k, l] += s.gain[a, k, l] / total * s.e_k[k, l]
                    for b in range(a + 1):
                        s.C[a, b, k, l] += wide * s.H[a, j, l] * s.H[b, j, l] if a <= j else 0.0
                        s.C[a, b, k, l] -= s.gain[a, k, l] * s.gain[b, k, l] / total
                s.mu[k, l] = s.prior[k, l]
    return True


@kernel
def innovated(s: State, l: int) -> None:
    """The prediction of the mixture and the innovation, after the start has written its own."""
    mean = 0.0
    for k in range(s.mu.shape[0]):
        mean += s.prior[k, l] * (s.y[l] - s.e_k[k, l])
    s.y_hat[l] = mean
    s.e[l] = s.y[l] - mean


@kernel
def unseen_variance(s: State, l: int) -> None:
    """An infinite variance for what no sample has told apart yet."""
    n = s.theta.shape[0]
    for i in range(n):
        for j in range(i, n):
            if s.S[j, j, l] == 0.0 and s.R[i, j, l] != 0.0:
                s.var[i, l] = np.inf
