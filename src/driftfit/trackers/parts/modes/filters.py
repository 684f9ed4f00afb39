"""K random-walk filters in parallel: the update of each by a sample, and their mixture.

    e_k = y - x' m_k,     g_k = C_k x,     h_k = x' g_k,     s_kj = h_k + v_j
    p_kj  proportional to c_k nu_j N(e_k; 0, s_kj),
    a_k    = sum_j p_(j|k) / s_kj,     d_k = sum_j p_(j|k) (1 / s_kj - a_k)^2
    m_k   <- m_k + g_k a_k e_k,        C_k <- C_k - g_k g_k' (a_k - d_k e_k^2)

with v_j the noise of level j (`driftfit.trackers.parts.modes.noise_levels`), c and nu the probabilities of filters and
levels. An outlier's level is as wide as the innovation if that is larger than the level itself: its influence does not
grow with its distance. The filters use the coordinates z = M theta of their start, in which the regressor is x
(`driftfit.trackers.parts.coordinates`): any units, any offset, and directions without information. A regressor
in such a direction is used by all filters, and does not change their probabilities.

The log density of a sample given earlier ones is that of the predicted mixture,

    log sum_k c_k (sum_{j<J} nu_j N(e_k; 0, s_kj) + nu_J Cauchy(e_k; s_kJ^(1/2)))

The Cauchy distribution represents an outlier, since the level that fits each one best has no density that integrates
to 1. Cost per sample: O(K n^2 + K J) for K filters and J levels, and O(K n^3 / 6) for the drift.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from driftfit.engine.kernel import State, exp, kernel, log
from driftfit.trackers.parts.coarse.resolution import lasting
from driftfit.trackers.parts.coordinates import OUTGROWN, in_units_of_theta, new_row
from driftfit.trackers.parts.covariance import LEFT
from driftfit.trackers.parts.modes.drifts.about_means import drift_about
from driftfit.trackers.parts.modes.drifts.one_direction import drift_along
from driftfit.trackers.parts.modes.drifts.trend import bend_slopes, level_slopes, move_along
from driftfit.trackers.parts.modes.ladder import TOP, leap
from driftfit.trackers.parts.modes.noise_levels import OUTLIER, noise_at
from driftfit.trackers.parts.modes.rows import least_of_row, sum_of_row
from driftfit.trackers.parts.proportion import SURE

LEAST = 1e-100
"""Probability that a filter is never below."""
UNSURE = 4.5
"""The covariance that is reported is that of the mixture times 1 + this over the square root of the number of samples,
because the probabilities of the filters, and r, are estimates: without it, 95 % bands of random walks cover 81 to 93 %
within the first hundreds of samples."""


@partial(kernel, inline=False)
def wander(s: State, size: float, l: int) -> None:
    """Drift of all filters: ``size`` in units of their ratios over the scales of the regressors."""
    n = s.parameters[l]  # not the constant, with which the loop over filters would be repeated n^3 / 6 times
    for i in range(n):
        unit = size / s.c[i, l] if s.c[i, l] > 0.0 else 0.0
        for a in range(i + 1):
            for b in range(a + 1):
                moved = unit * s.S[a, i, l] * s.S[b, i, l]
                for k in range(s.modes[l]):
                    s.C[a, b, k, l] += s.ratio[i, k, l] * moved
    drift_along(s, size, l)
    drift_about(s, size, l)


@kernel
def predict(s: State, l: int) -> None:
    time = s.dt[l] * s.drift[l]
    if s.settled[l] > 0 and s.dt[l] > 0.0:
        for k in range(s.modes[l]):
            s.prior[k, l] = s.mu[k, l]
        wander(s, s.r[l] * time, l)
        move_along(s, s.dt[l] * min(s.drift[l], 1.0), l)


@partial(kernel, inline=False)
def project(s: State, l: int) -> None:
    """x' m, g and h of every filter."""
    n, K = s.theta.shape[0], s.modes[l]
    for k in range(K):
        s.e_k[k, l] = 0.0
        s.h_k[k, l] = 0.0
    for i in range(n):
        for k in range(K):
            s.e_k[k, l] += s.x[i, l] * s.m[i, k, l]
            s.gain[i, k, l] = 0.0
        for j in range(i + 1):
            for k in range(K):
                s.gain[i, k, l] += s.C[i, j, k, l] * s.x[j, l]
        for j in range(i + 1, n):
            for k in range(K):
                s.gain[i, k, l] += s.C[j, i, k, l] * s.x[j, l]
        for k in range(K):
            s.h_k[k, l] += s.x[i, l] * s.gain[i, k, l]
    for i in range(n):
        for k in range(K):  # below 0: an absurd sample left no digits of C, and no gain can be trusted
            s.gain[i, k, l] = s.gain[i, k, l] if s.h_k[k, l] >= 0.0 else 0.0
    for k in range(K):
        s.h_k[k, l] = max(s.h_k[k, l], 0.0)


@partial(kernel, inline=False)
def innovate(s: State, l: int) -> None:
    """Innovation of every filter, and prediction and variance of the mixture before the sample."""
    K, J = s.modes[l], s.nu.shape[0]
    project(s, l)
    for k in range(K):
        s.e_k[k, l] += s.explained[l]
        s.row[k, l] = s.prior[k, l] * s.e_k[k, l]
    mean = sum_of_row(s, l)
    level = 0.0
    for j in range(J - 1):
        level += s.nu_prior[j, l] * noise_at(s, s.level[j, l], l)
    for k in range(K):
        s.row[k, l] = s.prior[k, l] * (s.h_k[k, l] + (s.e_k[k, l] - mean) ** 2)
    v = level / (1.0 - OUTLIER) + sum_of_row(s, l)
    for k in range(K):
        s.e_k[k, l] = s.y[l] - s.e_k[k, l]
    s.y_hat[l] = mean
    s.e[l] = s.y[l] - mean
    s.s[l] = v


@kernel
def too_broad(s: State, l: int) -> bool:
    """Whether this is an outlier that the filter which took another one for a jump predicts no better than the density
    of outliers does (`driftfit.trackers.parts.modes.drifts.after_outlier`)."""
    outlying = noise_at(s, s.level[s.nu.shape[0] - 1, l], l)
    return (s.e[l] * s.e[l] > SURE * SURE * s.s[l]) & (s.h_k[s.modes[l] - 2, l] > outlying)  # type: ignore[no-any-return]


@partial(kernel, inline=False)
def likelihoods(s: State, l: int) -> float:
    """joint[j, k] = c_k nu_j N(e_k; 0, s_kj) exp(nearest / 2) (2 pi)^(1/2); returns nearest."""
    K, J = s.modes[l], s.nu.shape[0]
    more = lasting(s, l)
    leap(s, l, noise_at(s, 1.0, l))
    for k in range(K):
        s.row[k, l] = np.inf
    for j in range(J):
        noise = noise_at(s, s.level[j, l], l) + more
        widest = np.inf if j == J - 1 else 0.0
        for k in range(K):
            square = s.e_k[k, l] * s.e_k[k, l]
            v = s.h_k[k, l] + max(noise, min(square, widest))
            s.inverse[j, k, l] = 1.0 / v
            s.row[k, l] = min(s.row[k, l], square / v)
    nearest, broad = least_of_row(s, l), K - 2 if too_broad(s, l) else -1
    for j in range(J):
        for k in range(K):
            far = s.e_k[k, l] * s.e_k[k, l] * s.inverse[j, k, l] - nearest
            p = s.prior[k, l] * s.nu_prior[j, l] * np.sqrt(s.inverse[j, k, l]) * exp(-0.5 * far)
            s.joint[j, k, l] = p * (s.rare[l] if k == TOP else OUTLIER if k == broad else 1.0)
    return nearest  # type: ignore[no-any-return]


@kernel
def as_predicted(s: State, nearest: float, l: int) -> None:
    """Add the density without an outlier to the scratch row of each filter, where ``joint`` has another."""
    K, J = s.modes[l], s.nu.shape[0]
    for j in range(J - 1):
        noise = noise_at(s, s.level[j, l], l)
        for k in range(K):
            v = s.h_k[k, l] - (s.gained[l] if k == TOP else 0.0) + noise
            far = s.e_k[k, l] * s.e_k[k, l] / v - nearest
            s.row[k, l] += s.prior[k, l] * s.nu_prior[j, l] / np.sqrt(v) * exp(-0.5 * far)


@partial(kernel, inline=False)
def predictive_density(s: State, nearest: float, l: int) -> None:
    """The log density of the sample under its prediction: without a leap, with the noise of a reading that does not
    repeat, and with a tail that integrates to 1."""
    K, J = s.modes[l], s.nu.shape[0]
    noise = noise_at(s, s.level[J - 1, l], l)
    for k in range(K):
        v = s.h_k[k, l] - (s.gained[l] if k == TOP else 0.0) + noise
        s.row[k, l] = s.prior[k, l] * s.nu_prior[J - 1, l] * np.sqrt(v) / (v + s.e_k[k, l] * s.e_k[k, l])
    outlier = sum_of_row(s, l)
    for k in range(K):
        s.row[k, l] = 0.0
    if s.rare[l] < 1.0 or lasting(s, l) > 0.0:
        as_predicted(s, nearest, l)
    else:
        for j in range(J - 1):
            for k in range(K):
                s.row[k, l] += s.joint[j, k, l]
    ordinary = sum_of_row(s, l)
    tail = log(outlier / np.pi)
    body = log(ordinary / np.sqrt(2.0 * np.pi)) - 0.5 * nearest if ordinary > 0.0 else -np.inf
    s.density[l] = tail + log(1.0 + exp(body - tail)) if body < tail else body + log(1.0 + exp(tail - body))


@partial(kernel, inline=False)
def weigh(s: State, l: int) -> None:
    """Joint probabilities of drift modes and noise levels after the sample, and its density before it."""
    K, J = s.modes[l], s.nu.shape[0]
    nearest = likelihoods(s, l)
    predictive_density(s, nearest, l)
    for k in range(K):
        s.row[k, l] = 0.0
    for j in range(J):
        for k in range(K):
            s.row[k, l] += s.joint[j, k, l]
    share = 1.0 / sum_of_row(s, l)
    for k in range(K):
        # at 0 a mode that only such modes lead to would have no mixture at all
        s.mu[k, l] = max(s.row[k, l] * share, LEAST)
    for j in range(J):
        for k in range(K):
            s.joint[j, k, l] *= share
            s.row[k, l] = s.joint[j, k, l]
        s.nu[j, l] = sum_of_row(s, l)
    s.outlier[l] = s.nu[J - 1, l] + (s.mu[TOP, l] - s.joint[J - 1, TOP, l] if s.rare[l] < 1.0 else 0.0)
    # an outlier says nothing about the level: the chain keeps its state
    for j in range(J - 1):
        s.nu[j, l] += s.nu[J - 1, l] * s.nu_prior[j, l] / (1.0 - OUTLIER)


@partial(kernel, inline=False)
def absorb(s: State, l: int) -> None:
    """The rank-one update: m + g step, C - h g g'."""
    n, K = s.theta.shape[0], s.modes[l]
    for i in range(n):
        for k in range(K):
            s.m[i, k, l] += s.gain[i, k, l] * s.step[k, l]
        for j in range(i):
            for k in range(K):
                s.C[i, j, k, l] -= s.h_k[k, l] * s.gain[i, k, l] * s.gain[j, k, l]
        for k in range(K):
            left = s.C[i, i, k, l] - s.h_k[k, l] * s.gain[i, k, l] * s.gain[i, k, l]
            s.C[i, i, k, l] = max(left, LEFT * s.C[i, i, k, l])


@kernel
def update_filters(s: State, l: int) -> None:
    """Each filter takes the sample with its noise levels merged: one rank-one update."""
    K, J = s.modes[l], s.nu.shape[0]
    for k in range(K):
        s.weighted[k, l] = 0.0
        s.mu_next[k, l] = 0.0
    for j in range(J):
        for k in range(K):
            share = s.joint[j, k, l] / max(s.mu[k, l], 1e-300)
            s.weighted[k, l] += share * s.inverse[j, k, l]
            s.mu_next[k, l] += share * s.inverse[j, k, l] * s.inverse[j, k, l]
    for k in range(K):
        a = s.weighted[k, l]
        spread = max(s.mu_next[k, l] - a * a, 0.0)
        s.h_k[k, l] = a - spread * s.e_k[k, l] * s.e_k[k, l]
        s.step[k, l] = a * s.e_k[k, l]
    bend_slopes(s, l)
    absorb(s, l)


@kernel
def outgrown(s: State, l: int) -> int:
    """The first coordinate about which this sample has `OUTGROWN` times the information of all earlier ones, or -1."""
    others = noise_at(s, 1.0, l)
    for j in range(s.theta.shape[0]):
        own = s.x[j, l] * s.x[j, l] * s.C[j, j, 0, l]
        if own > OUTGROWN * others:
            return j
        others += own
    return -1


@partial(kernel, short=True)
def enter_filters(s: State, j: int, l: int) -> None:
    """Row j of M becomes the rest of phi. The other coordinates take the sample as always, unless nothing was known of
    z_j; then z_j = y - sum_{i<j} x_i z_i - v, which is correlated with them also by v.
    """
    n, K, fresh = s.theta.shape[0], s.modes[l], s.S[j, j, l] == 0.0
    noise = noise_at(s, 1.0, l)
    for k in range(K):
        s.h_k[k, l] = 0.0 if fresh or s.h_k[k, l] == 0.0 else 1.0 / (s.h_k[k, l] + noise)
        s.step[k, l] = s.h_k[k, l] * s.e_k[k, l]
        s.mu[k, l] = s.prior[k, l]
    absorb(s, l)
    sign = new_row(s, s.white, j, l)
    level_slopes(s, j, l)
    for i in range(j, n):
        s.x[i, l] = 0.0
    for k in range(K):
        left = noise * s.h_k[k, l]  # r / s, the share of the innovation that is noise
        mean, own = s.y[l] - s.explained[l] - left * s.e_k[k, l], noise * (1.0 - left)
        for i in range(n):
            mean -= s.x[i, l] * s.m[i, k, l]
            if i != j:
                row = left * s.gain[i, k, l]
                for b in range(j):
                    row -= s.x[b, l] * s.C[max(i, b), min(i, b), k, l]
                own -= s.x[i, l] * (row + left * s.gain[i, k, l])
                s.C[max(i, j), min(i, j), k, l] = sign * row
        s.m[j, k, l] = sign * mean
        s.C[j, j, k, l] = own
    s.density[l] = -0.5 * (log(2.0 * np.pi * s.s[l]) + s.e[l] * s.e[l] / s.s[l])


@partial(kernel, inline=False)
def mixture(s: State, l: int) -> None:
    """Mean d of the filters, and the covariance of theta that is reported; without a sample d keeps its bits."""
    n, K = s.theta.shape[0], s.modes[l]
    for i in range(n):
        for k in range(K):
            s.row[k, l] = s.mu[k, l] * s.m[i, k, l]
        mean = sum_of_row(s, l)
        s.d[i, l] = mean if s.ok[l] > 0.0 else s.d[i, l]
        for j in range(i + 1):
            for k in range(K):
                away = (s.m[i, k, l] - s.d[i, l]) * (s.m[j, k, l] - s.d[j, l])
                s.row[k, l] = s.mu[k, l] * (s.C[i, j, k, l] + away)
            s.Z[i, j, l] = sum_of_row(s, l)
            s.P[i, j, l] = s.Z[i, j, l]
    in_units_of_theta(s, l)
    wide = 1.0 + UNSURE / np.sqrt(max(s.count[l], 1.0))
    for i in range(n):
        for j in range(i + 1):
            s.P[i, j, l] *= wide
        s.var[i, l] = s.P[i, i, l]
