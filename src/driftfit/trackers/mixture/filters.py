"""A bank of Kalman filters that differ in how the parameters drift: forecast, correction and interaction.

    e_k = y - x' m_k,     g_k = C_k x,     h_k = x' g_k,     s_kj = h_k + v_kj
    p_kj  proportional to c_k nu_j t(e_k; s_kj)
    a_k = sum_j p_(j|k) / s_kj,    d_k = sum_j p_(j|k) (1 / s_kj - a_k)^2
    m_k   <- m_k + g_k a_k e_k,        C_k <- C_k - g_k g_k' (a_k - d_k e_k^2)

with c_k and nu_j the probabilities of mode k and of state j of the noise (`driftfit.trackers.mixture.states`), and
t the normal density, or Student's while the noise variance rests on few samples. Modes are merged by their moments
after every sample, c_j = sum_i mu_i T_ij. T moves a mode down its ladder, and leads from the whole bank to mode j with
the same small probability a_j, so that it costs O(K) instead of O(K^2):

    T_ij = a_j + down_i [j next below i],   the rest stays

The filters use coordinates z = M theta of their start, in which the regressor is x (`driftfit.trackers.forms
.coordinates`). A regressor in a direction that no earlier one has determined is used by all filters, and does not
change their probabilities.

Source: interacting multiple models are Blom and Bar-Shalom (1988); ladders and transitions are ours. Cost per sample:
O(K n^2) for K modes.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from driftfit.engine.kernel import Array, State, exp, kernel, log
from driftfit.trackers.forms.coordinates import in_units_of_theta, new_row
from driftfit.trackers.forms.covariance import LEFT
from driftfit.trackers.mixture.states import (
    AFTER,
    COMMON,
    DIRECTION,
    DOWN,
    DRIFT,
    ENDS,
    FIRST_ALONE,
    FIRST_LEARNED,
    FLOOR,
    JUMP,
    JUMPS,
    LARGE,
    OUTLYING,
    STATES,
    WEIGHT,
    sum_of_row,
    variance_in,
)

FAR = 9.0
"""Square of the mean of a regressor, in units of its variance, from which on it drifts about the mean."""
STILL = 1e-24
"""Variance of a column, as a share of its mean square, below which it counts as constant: it may be rounding."""
FADING, BEND = 0.05, 0.1
"""Slopes fade by this times the root of the ratio, and are corrected by that share of the gain."""
STUDENT = 60.0
"""Samples from which on Student's density is taken for normal."""
UNSURE = 3.0
"""The covariance that is reported is that of the mixture times 1 + this over the square root of the number of samples,
because the probabilities of the filters, and r, are estimates."""
LEAST = 1e-100
"""Probability that a mode is never below."""


def centring(fields: Mapping[str, Array], phi: Array) -> Array:
    """The matrix A (n, n) for which phi A are the regressors (N, n) less their means, where these are far from 0."""
    c, v, A = fields["c"], fields["variance"], np.eye(phi.shape[1])
    constant = (v <= STILL * c) & (fields["mean"] != 0.0)
    beside = (c > (1.0 + FAR) * v) & (v > STILL * c) & constant.any(axis=1)[:, None]
    for k in np.flatnonzero(constant[-1])[-1:]:
        mean = phi.mean(axis=0)
        A[k] = np.where(beside.any(axis=0), -mean / mean[k], A[k])
    return A


@partial(kernel, inline=False)
def walks(s: State, l: int) -> None:
    """The common drift and the learned one in the coordinates z, for a ratio of 1 and r = 1."""
    n, k = s.parameters[l], -1
    for a in range(n):
        k = a if (s.variance[a, l] <= STILL * s.c[a, l]) & (s.mean[a, l] != 0.0) else k
        s.away[1, a, l] = 0.0
        for b in range(a + 1):
            s.walk[0, a, b, l], s.walk[1, a, b, l] = 0.0, 0.0
    for i in range(n):
        root = 1.0 / np.sqrt(s.c[i, l]) if s.c[i, l] > 0.0 else 0.0
        own, v = s.sums[WEIGHT, i, l] * root * root, s.variance[i, l]
        beside = (k >= 0) & (i != k) & (s.c[i, l] > (1.0 + FAR) * v) & (v > STILL * s.c[i, l])
        unit = 1.0 / v if beside else 1.0 / s.c[i, l] if s.c[i, l] > 0.0 else 0.0
        for a in range((max(i, k) if beside else i) + 1):  # S is triangular
            s.away[0, a, l] = s.S[a, i, l] - (s.mean[i, l] / s.mean[k, l] * s.S[a, k, l] if beside else 0.0)
            s.away[1, a, l] += s.S[a, i, l] * s.sums[DIRECTION, i, l] * root
            for b in range(a + 1):
                s.walk[0, a, b, l] += unit * s.away[0, a, l] * s.away[0, b, l]
                s.walk[1, a, b, l] += own * s.S[a, i, l] * s.S[b, i, l]
    for a in range(n):
        for b in range(a + 1):
            s.walk[1, a, b, l] += FLOOR * s.walk[0, a, b, l] + s.away[1, a, l] * s.away[1, b, l]


@partial(kernel, inline=False)
def wander(s: State, size: float, jump: float, l: int) -> None:
    """Drift of all filters by ``size`` times their ratios, and by ``jump`` where these are jumps."""
    n = s.parameters[l]
    walks(s, l)
    for k in range(s.modes[l]):
        s.row[k, l] = size * s.ratio[k, l] if s.ratio[k, l] < JUMPS else jump
    for a in range(n):
        for b in range(a + 1):
            for k in range(FIRST_LEARNED):
                s.C[a, b, k, l] += s.row[k, l] * s.walk[0, a, b, l]
            for k in range(FIRST_LEARNED, FIRST_ALONE):
                s.C[a, b, k, l] += s.row[k, l] * s.walk[1, a, b, l]
    for i in range(n):
        own = 1.0 / s.c[i, l] if s.c[i, l] > 0.0 else 0.0
        for a in range(i + 1 if s.alone[1, i, l] > 0 else 0):
            for b in range(a + 1):
                moved = own * s.S[a, i, l] * s.S[b, i, l]
                for k in range(s.alone[0, i, l], s.alone[1, i, l]):
                    s.C[a, b, k, l] += s.row[k, l] * moved


@kernel
def predict(s: State, l: int) -> None:
    """Drift and trends of the time since the last sample."""
    if s.settled[l] > 0 and s.dt[l] > 0.0:
        size = s.r[l] * s.dt[l] * s.drift[l]
        wander(s, size, JUMPS * size, l)
        time = s.dt[l] * min(s.drift[l], 1.0)
        for j in range(s.trend.shape[1]):
            k = len(COMMON) + j
            fading = 1.0 / (1.0 + FADING * np.sqrt(s.ratio[k, l]) * time)
            for i in range(s.parameters[l]):
                s.m[i, k, l] += time * s.trend[i, j, l]
                s.trend[i, j, l] *= fading


@partial(kernel, inline=False)
def project(s: State, l: int) -> None:
    """x' m, g and h of every filter."""
    n, K = s.parameters[l], s.modes[l]
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
    K = s.modes[l]
    project(s, l)
    for k in range(K):
        s.e_k[k, l] += s.explained[l]
        s.row[k, l] = s.mu[k, l] * s.e_k[k, l]
    mean = sum_of_row(s, l)
    for k in range(K):
        s.curve[k, l] = s.h_k[k, l] + (s.e_k[k, l] - mean) ** 2
        s.row[k, l] = s.mu[k, l] if s.ratio[k, l] >= JUMPS else 0.0
    jump = sum_of_row(s, l)
    for k in range(K):
        s.row[k, l] *= s.curve[k, l]
    wide = sum_of_row(s, l) / jump
    for k in range(K):
        s.row[k, l] = s.mu[k, l] * s.curve[k, l] if s.ratio[k, l] < JUMPS else 0.0
    usual, restless = sum_of_row(s, l) / (1.0 - jump), s.nu_prior[1, l] / (1.0 - s.nu_prior[OUTLYING, l])
    # geometric means, because the arithmetic one is that of rare large noise, or of rare jumps
    noise = variance_in(s, 0, l)
    noise = noise * exp(restless * log(variance_in(s, 1, l) / noise)) + s.vague[l]
    v = (noise + usual) * exp(jump * log((noise + wide) / (noise + usual)))
    for k in range(K):
        s.e_k[k, l] = s.y[l] - s.e_k[k, l]
    s.y_hat[l], s.e[l], s.s[l] = mean, s.y[l] - mean, v


@partial(kernel, inline=False)
def likelihoods(s: State, more: float, l: int) -> None:
    """joint[j, k] = c_k nu_j times the density, up to a factor. That of an outlier is never small, and needs no unit.

    ``more`` is added to the variance of the noise.
    """
    few = s.count[l]
    for j in range(STATES):
        noise = variance_in(s, j, l) + more
        widest = np.inf if j == OUTLYING else 0.0
        for k in range(s.modes[l]):
            square = s.e_k[k, l] * s.e_k[k, l]
            v = 1.0 / (s.h_k[k, l] + max(noise, min(square, widest)))
            far = square * v if few > STUDENT else (few + 1.0) * log(1.0 + square * v / few)
            s.inverse[j, k, l] = v
            s.joint[j, k, l] = s.mu[k, l] * s.nu_prior[j, l] * np.sqrt(v) * exp(-0.5 * far)


@partial(kernel, inline=False)
def predictive_density(s: State, l: int) -> None:
    """The log density of the sample under its prediction, with a Cauchy tail for outliers, which integrates to 1."""
    K, few = s.modes[l], s.count[l]
    noise = variance_in(s, OUTLYING, l) + s.vague[l]
    for k in range(K):
        v = s.h_k[k, l] + noise
        s.row[k, l] = s.mu[k, l] * s.nu_prior[OUTLYING, l] * np.sqrt(v) / (v + s.e_k[k, l] * s.e_k[k, l])
    tail = log(sum_of_row(s, l) / np.pi)
    for k in range(K):
        s.row[k, l] = s.joint[0, k, l] + s.joint[1, k, l]
    x = 0.25 / few if few <= STUDENT else 0.0
    body = sum_of_row(s, l) * (1.0 - x + 0.5 * x * x) / np.sqrt(2.0 * np.pi)
    body = log(body) if body > 0.0 else -np.inf
    s.density[l] = tail + log(1.0 + exp(body - tail)) if body < tail else body + log(1.0 + exp(tail - body))


@partial(kernel, inline=False)
def weigh(s: State, more: float, l: int) -> None:
    """Joint probabilities of modes and states of the noise after the sample, and its density before it.

    ``more`` is the variance of rounding that repeats; ``s.vague`` is that of lags that the model doubts.
    """
    K = s.modes[l]
    likelihoods(s, s.vague[l], l)
    predictive_density(s, l)
    square = s.e[l] * s.e[l] / s.noise[l]
    size = min(max(s.power[l], s.astray[l]), square) - JUMPS * s.r[l]
    leaps = (size > 0.0) & (s.e[l] * s.e[l] > LARGE * s.s[l]) & (s.dt[l] * s.drift[l] > 0.0)
    if leaps:
        wander(s, 0.0, size, l)
        project(s, l)
        for k in range(K):
            s.e_k[k, l] = s.y[l] - s.explained[l] - s.e_k[k, l]
    if leaps or more > 0.0:
        likelihoods(s, s.vague[l] + more, l)
    for k in range(K):
        s.row[k, l] = s.joint[0, k, l] + s.joint[1, k, l] + s.joint[2, k, l]
    share = 1.0 / sum_of_row(s, l)
    for k in range(K):
        # at 0 a mode that only such modes lead to would have no mixture at all
        s.mu[k, l] = max(s.row[k, l] * share, LEAST)
    for j in range(STATES):
        for k in range(K):
            s.joint[j, k, l] *= share
            s.row[k, l] = s.joint[j, k, l]
        s.nu[j, l] = sum_of_row(s, l)
    s.astray[l] = s.nu[OUTLYING, l] * square
    # an outlier says nothing about the state of ordinary noise
    for j in range(OUTLYING):
        s.nu[j, l] += s.nu[OUTLYING, l] * s.nu_prior[j, l] / (1.0 - s.nu_prior[OUTLYING, l])


@partial(kernel, inline=False)
def absorb(s: State, l: int) -> None:
    """The rank-one update: m + g step, C - curve g g'."""
    n, K = s.parameters[l], s.modes[l]
    for i in range(n):
        for k in range(K):
            s.m[i, k, l] += s.gain[i, k, l] * s.step[k, l]
        for j in range(i):
            for k in range(K):
                s.C[i, j, k, l] -= s.curve[k, l] * s.gain[i, k, l] * s.gain[j, k, l]
        for k in range(K):
            left = s.C[i, i, k, l] - s.curve[k, l] * s.gain[i, k, l] * s.gain[i, k, l]
            s.C[i, i, k, l] = max(left, LEFT * s.C[i, i, k, l])


@partial(kernel, inline=False)
def update_filters(s: State, l: int) -> None:
    """Each filter takes the sample with the states of its noise merged."""
    for k in range(s.modes[l]):
        p, q, o = s.joint[0, k, l], s.joint[1, k, l], s.joint[2, k, l]
        u, v, w = s.inverse[0, k, l], s.inverse[1, k, l], s.inverse[2, k, l]
        part = 1.0 / s.mu[k, l]
        a = part * (p * u + q * v + o * w)
        spread = max(part * (p * u * u + q * v * v + o * w * w) - a * a, 0.0)
        s.step[k, l] = a * s.e_k[k, l]
        s.curve[k, l] = a - spread * s.e_k[k, l] * s.e_k[k, l]
    absorb(s, l)
    for j in range(s.trend.shape[1]):
        k = len(COMMON) + j
        share = BEND * np.sqrt(s.ratio[k, l]) * s.step[k, l]
        for i in range(s.parameters[l]):
            s.trend[i, j, l] += share * s.gain[i, k, l]


@partial(kernel, short=True)
def enter_filters(s: State, j: int, l: int) -> None:
    """Row j of M becomes the rest of phi, and z_j = y - sum_{i<j} x_i z_i - v, of which nothing was known."""
    n, K = s.parameters[l], s.modes[l]
    noise = variance_in(s, 0, l) + s.vague[l]
    sign = new_row(s, s.white, j, l)
    for t in range(s.trend.shape[1]):
        s.trend[j, t, l] = 0.0
    for k in range(K):
        for i in range(n):
            s.C[max(i, j), min(i, j), k, l] = -sign * s.gain[i, k, l]
        s.m[j, k, l] = sign * s.e_k[k, l]
        s.C[j, j, k, l] = s.h_k[k, l] + noise
    s.density[l] = -0.5 * (log(2.0 * np.pi * s.s[l]) + s.e[l] * s.e[l] / s.s[l])


@partial(kernel, inline=False)
def mixture(s: State, l: int) -> None:
    """Mean d and reported covariance of the filters; without a sample d keeps its bits, and no large jump begins."""
    n, K = s.parameters[l], s.modes[l]
    if (s.ok[l] == 0.0) & (s.dt[l] == 0.0):
        return
    for k in range(K):
        s.row[k, l] = s.mu[k, l] * (s.ratio[k, l] if s.ratio[k, l] < 1.0 else 0.0)
        s.curve[k, l] = s.mu[k, l] if s.ok[l] > 0.0 or s.ratio[k, l] < JUMPS else max(s.mu[k, l] - s.arrive[k, l], 0.0)
    s.drift_rate[l] = s.r[l] * sum_of_row(s, l)
    for i in range(n):
        for k in range(K):
            s.row[k, l] = s.mu[k, l] * s.m[i, k, l]
        mean = sum_of_row(s, l)
        s.d[i, l] = mean if s.ok[l] > 0.0 else s.d[i, l]
        for j in range(i + 1):
            for k in range(K):
                away = (s.m[i, k, l] - s.d[i, l]) * (s.m[j, k, l] - s.d[j, l])
                s.row[k, l] = s.curve[k, l] * (s.C[i, j, k, l] + away)
            s.Z[i, j, l] = sum_of_row(s, l)
            s.P[i, j, l] = s.Z[i, j, l]
    in_units_of_theta(s, l)
    wide = 1.0 + UNSURE / np.sqrt(max(s.count[l], 1.0))
    for i in range(n):
        for j in range(i + 1):
            s.P[i, j, l] *= wide
        s.var[i, l] = s.P[i, i, l]


@partial(kernel, inline=False)
def mix(s: State, l: int) -> None:
    """Interaction: every filter continues from itself, from the one above it on its ladder, and from the whole bank.

    Means are taken relative to that of the mixture, d, so that moments may be added before the mean is subtracted.
    """
    n, K = s.parameters[l], s.modes[l]
    for k in range(K):
        down = ENDS if s.ratio[k, l] >= JUMPS else AFTER if s.ratio[k, l] >= 1.0 else DOWN
        s.row[k, l] = s.mu[k, l] * down if s.ratio[max(k - 1, 0), l] < s.ratio[k, l] else 0.0  # the lowest stays
    s.row[K, l] = 0.0
    for k in range(K):
        above, stays = s.row[k + 1, l], (1.0 - JUMP - DRIFT) * s.mu[k, l] - s.row[k, l]
        s.mu[k, l] = stays + above + s.arrive[k, l]
        s.step[k, l], s.curve[k, l] = stays / s.mu[k, l], above / s.mu[k, l]
    s.row[K, l] = 0.0
    for a in range(n):
        for k in range(K):
            s.row[k, l] = s.m[a, k, l] - s.d[a, l]
        for k in range(K):
            s.m[a, k, l] = s.row[k, l]
            s.gain[a, k, l] = s.step[k, l] * s.row[k, l] + s.curve[k, l] * s.row[k + 1, l]
        for b in range(a + 1):
            for k in range(K):
                s.row[k, l] = s.C[a, b, k, l] + s.m[a, k, l] * s.m[b, k, l]
            for k in range(K):
                near = s.step[k, l] * s.row[k, l] + s.curve[k, l] * s.row[k + 1, l]
                far = (1.0 - s.step[k, l] - s.curve[k, l]) * s.Z[a, b, l]
                s.C[a, b, k, l] = near + (far - s.gain[a, k, l] * s.gain[b, k, l])
    for a in range(n):
        for k in range(K):
            s.m[a, k, l] = s.d[a, l] + s.gain[a, k, l]
        for j in range(s.trend.shape[1]):
            s.trend[a, j, l] *= s.step[len(COMMON) + j, l]
