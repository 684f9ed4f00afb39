"""A bank of Kalman filters that differ in how the parameters drift, and states of the noise: forecast, correction and
interaction.

    e_k = y - x' m_k,     g_k = C_k x,     h_k = x' g_k,     s_kj = h_k + v_j
    p_kj  proportional to c_k nu_j t(e_k; s_kj)
    a_k = sum_j p_(j|k) / s_kj,    d_k = sum_j p_(j|k) (1 / s_kj - a_k)^2
    m_k   <- m_k + g_k a_k e_k,        C_k <- C_k - g_k g_k' (a_k - d_k e_k^2)

with c_k the probability of mode k, a row of the table of `AdaptiveKalman`, and t the normal density, or Student's while
the noise variance rests on few samples. The noise has one of three states, with probabilities nu_j:

    quiet      variance r
    restless   variance f
    outlier    of any size: variance max(30 r, e^2)

Equal readings in a row repeat one error of rounding: the j-th has (j - 1) min(step^2 / 12, r) more noise, step being
the smallest change of the readings. A meter so fine that readings never repeat has no such noise, and neither has a
plant without noise whose readings repeat because it rests.

Modes are merged by their moments after every sample, c_j = sum_i mu_i T_ij. T moves a mode down its ladder, and leads
from the whole bank to mode j with the same small probability a_j, so that it costs O(K) instead of O(K^2):

    T_ij = a_j + down_i [j next below i],   the rest stays

The filters use coordinates z = M theta of their start, in which the regressor is x (`driftfit.trackers.forms
.coordinates`). A regressor in a direction that no earlier one has determined is used by all filters, and does not
change their probabilities.

Source: interacting multiple models are Blom and Bar-Shalom (1988); step^2 / 12 is Sheppard's (1898). Ladders,
transitions and the rule for repeats are ours. Cost per sample: O(K n^2) for K modes.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, exp, kernel, log
from driftfit.readings.repeats import unread
from driftfit.trackers.forms.coordinates import in_units_of_theta, new_row
from driftfit.trackers.forms.covariance import LEFT

COMMON = (0.0, 1e-4, 1e-3, 1e-2, 0.04, 0.2, 1.0, 1000.0)
JUMPS = max(COMMON)
TREND = (1e-3, 1e-2, 0.1)
LEARNED = (1e-3, 1e-2, 0.1, 1.0)
ALONE = (0.003, 0.05, 1.0, JUMPS)
"""Drift ratios of the ladders; that of jumps lasts for a few samples."""
FLOOR = 0.002
"""Share of the common drift in the learned one."""
MOST_ALONE = 8
"""Number of parameters up to which each has a ladder of its own."""
JUMP, DRIFT = 2e-3, 6e-4
"""Probabilities, from the whole bank: into all modes with ratios of 1 and more, and into all others."""
DOWN, AFTER, ENDS = 1e-3, 0.05, 0.5
"""Probabilities of the next smaller ratio of a ladder: of that from ratios of 1 and more, and from jumps."""
AT_REST, ALL, SELDOM = 0.3, 0.45, 0.02
"""Probabilities before the first sample: of no drift at least, of the other common ratios, and the share of jumps in
these and those of the other ladders."""
ALONG = len(COMMON)
FIRST_LEARNED = ALONG + len(TREND)
FIRST_ALONE = FIRST_LEARNED + len(LEARNED)
"""Where the ladders begin."""
ASSUMED, SLOPE, WEIGHT, DIRECTION, SCORE, SHIFT, A, B, M, N, T, V = range(12)
"""Rows (n,) of the estimation: the diagonal of P, the right side, q, a, u, N k; then those of the sums of squares, of
B, of M, of N and of two scratch matrices by turns."""
OUTLYING, STATES = 2, 3
"""The last state of the noise, and their number."""
OUTLIER = 0.035
"""Probability of an outlier before the first sample."""
STAY, CALM = 0.995, 0.98
"""Probabilities that quiet noise stays quiet, and that restless noise stays restless."""
QUIET = 0.8
"""Probability of quiet noise before the first sample."""
LEAST_RESTLESS, LARGE = 6.0, 30.0
"""Least f and the variance of outliers at least, in units of r."""
LEAST_SHARE = 1e-26
"""r is never below this share of the mean square of y, for rounding in the sums of a prediction."""

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


def table(n: int, groups: Any) -> dict[str, Array]:
    """The modes as arrays (K,): ``ratio``; the ``ladder``, -3 common, -2 trend, -1 learned, or the number of a group;
    probabilities ``arrive`` from the whole bank; and ``start``, before the first sample. And ``alone`` (2, n): the
    first mode of the ladder in which a parameter drifts without all others, and the one after the last.
    """
    each = [[i] for i in range(n)] if groups is None and 1 < n <= MOST_ALONE else list(groups or ())
    ladders = [(-3, COMMON), (-2, TREND), (-1, LEARNED)]
    ladders += [(g, ALONE) for g in range(len(each))]
    ratio = np.array([rho for _, ladder in ladders for rho in ladder])
    of = np.array([which for which, ladder in ladders for _ in ladder])
    jump, alone = ratio >= 1.0, of >= 0
    arrive = np.where(jump, JUMP, DRIFT / np.sum(~jump))
    for kind, share in ((alone, 0.5), (~alone, 0.5 if each else 1.0)):
        arrive[jump & kind] *= share / max(int(np.sum(jump & kind)), 1)
    start = np.where(of == -3, ALL / (len(COMMON) - 1), (1.0 - AT_REST - ALL) / np.sum(of != -3))
    start[ratio >= 1.0] *= SELDOM
    start[0] = 1.0 - start[1:].sum()
    alone = np.zeros((2, n), int)
    for g, members in enumerate(each):
        alone[:, list(members)] = np.flatnonzero(of == g)[[0, -1], None] + [[0], [1]]
    return {"ratio": ratio, "ladder": of, "arrive": arrive, "start": start, "alone": alone}


def bank(n: int, groups: Any) -> dict[str, Any]:
    """Fields of the K filters before the first sample: their modes, means m, covariances C (lower triangle); and of the
    noise. f is 0 until the filters start.
    """
    modes = table(n, groups)
    K = len(modes["ratio"])
    return {
        "modes": K,
        "parameters": n,
        **{name: modes[name] for name in ("ratio", "arrive", "alone")},
        "mu": modes["start"],
        "m": np.zeros((n, K)),
        "C": np.zeros((n, n, K)),
        "trend": np.zeros((n, len(TREND))),
        "walk": np.zeros((2, n, n)),
        "Z": np.zeros((n, n)),
        "away": np.zeros((2, n)),
        **{name: np.zeros(K) for name in ("e_k", "h_k", "step", "curve")},
        "gain": np.zeros((n, K)),
        "inverse": np.zeros((STATES, K)),
        "joint": np.zeros((STATES, K)),
        "row": np.zeros(K + 8),
        "nu": np.array([QUIET, 1.0 - QUIET, 0.0]),
        "nu_prior": np.array([0.0, 0.0, OUTLIER]),
        "restless": 0.0,
        "drift_rate": 0.0,
        "usual_noise": 1.0,
        **unread(),
    }


@partial(kernel, inline=False)
def sum_of_row(s: State, l: int) -> float:
    """Sum of the scratch row over the filters: in eight chains, none of which waits for the others."""
    K = s.modes[l]
    for k in range(K, K + 8):
        s.row[k, l] = 0.0
    a, b, c, d, e, f, g, h = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(0, K, 8):
        a += s.row[k, l]
        b += s.row[k + 1, l]
        c += s.row[k + 2, l]
        d += s.row[k + 3, l]
        e += s.row[k + 4, l]
        f += s.row[k + 5, l]
        g += s.row[k + 6, l]
        h += s.row[k + 7, l]
    return ((a + b) + (c + d)) + ((e + f) + (g + h))


@kernel
def least_noise(s: State, l: int) -> float:
    """The lower bound of r."""
    return LEAST_SHARE * s.power[l]  # type: ignore[no-any-return]


@kernel
def variance_in(s: State, j: int, l: int) -> float:
    """Variance of the noise of the sample in a state, for an outlier at least."""
    r = s.r[l] if j == 0 else max(s.restless[l], LEAST_RESTLESS * s.r[l]) if j == 1 else LARGE * s.r[l]
    return s.noise[l] * r  # type: ignore[no-any-return]


@kernel
def repeated_rounding(s: State, l: int) -> float:
    """Variance that a repeated reading adds to its noise."""
    return s.alike[l] * min(s.finest[l] * s.finest[l] / 12.0, s.noise[l] * s.r[l])  # type: ignore[no-any-return]


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
def wander(s: State, l: int) -> None:
    """C_k += row_k Q_k for every mode."""
    n = s.parameters[l]
    walks(s, l)
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
    if s.restless[l] > 0.0 and s.dt[l] > 0.0:
        size = s.r[l] * s.dt[l] * s.drift[l]
        for k in range(s.modes[l]):
            s.row[k, l] = size * s.ratio[k, l]
        wander(s, l)
        time = s.dt[l] * min(s.drift[l], 1.0)
        for j in range(s.trend.shape[1]):
            k = ALONG + j
            for i in range(s.parameters[l]):
                s.m[i, k, l] += time * s.trend[i, j, l]
                s.trend[i, j, l] /= 1.0 + FADING * np.sqrt(s.ratio[k, l]) * time


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
    size = min(s.power[l], s.e[l] * s.e[l] / s.noise[l]) - JUMPS * s.r[l]
    leaps = (size > 0.0) & (s.e[l] * s.e[l] > LARGE * s.s[l]) & (s.dt[l] * s.drift[l] > 0.0)
    if leaps:
        for k in range(K):
            s.row[k, l] = size if s.ratio[k, l] == JUMPS else 0.0
        wander(s, l)
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
        k = ALONG + j
        for i in range(s.parameters[l]):
            s.trend[i, j, l] += BEND * np.sqrt(s.ratio[k, l]) * s.step[k, l] * s.gain[i, k, l]


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
    for k in range(K):
        s.row[k, l] = s.mu[k, l] * (s.ratio[k, l] if s.ratio[k, l] < 1.0 else 0.0)
        s.curve[k, l] = s.mu[k, l] if s.ok[l] > 0.0 or s.ratio[k, l] < JUMPS else max(s.mu[k, l] - s.arrive[k, l], 0.0)
    s.drift_rate[l] = s.r[l] * sum_of_row(s, l)
    if (s.ok[l] == 0.0) & (s.dt[l] == 0.0):
        return
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
            s.trend[a, j, l] *= s.step[ALONG + j, l]
