"""Modes of the drift and states of the noise: their tables, what is learned of the noise, and the smoother of both.

Modes are rows of the table of `AdaptiveKalman`. Noise has one of three states, told apart by the samples:

    quiet      variance r, the mean of E(v^2 | y) with a memory of `MEMORY` samples that are no outliers
    restless   variance f: log f follows log E(v^2 | y, not quiet) with a memory of `QUICK` samples that are not quiet
    outlier    of any size: variance max(30 r, e^2), with a probability that is learned

With p the joint probabilities of modes and states, E(v^2 | y) = sum p (r - r^2 / s + (r e / s)^2), exactly; a noise
variance that is learned so needs no bounds. Equal readings in a row repeat one error of rounding: the j-th has
(j - 1) min(step^2 / 12, r) more noise, step being the smallest change of the readings, and r is learned from readings
that changed. A meter so fine that readings never repeat has no such noise, and neither has a plant without noise whose
readings repeat because it rests.

The smoother (`driftfit.smooth.unknown_drift`) is given the noise and the course of the drift over time,

    q_t    = r_t times the mean of sum_k mu_k rho_k for rho_k < 1 over the next `MEMORY` samples
    1 / r_t = sum_j nu_tj / v_tj

with mu the probabilities of the modes after a sample, which follow a drift with a delay, and nu_tj those of the states
of the noise, on regressors and outputs from which coloured noise was taken. Before the filters start nothing drifts.

Source: the moments of a noise given the data are those of an EM step, Shumway and Stoffer (1982); step^2 / 12 is
Sheppard's (1898). The modes and the rule for repeats are ours. Cost per sample: O(K).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, exp, kernel, log
from driftfit.readings.repeats import unread

COMMON = (0.0, 1e-4, 1e-3, 1e-2, 0.04, 0.2, 1.0, 1000.0)
JUMPS = max(COMMON)
TREND = (1e-3, 1e-2, 0.1)
LEARNED = (1e-3, 1e-2, 0.1, 1.0)
ALONE, GROUP = (0.003, 0.05, 1.0, JUMPS), (1e-3, 1e-2, 0.1, 1.0, JUMPS)
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
FIRST_LEARNED = len(COMMON) + len(TREND)
FIRST_ALONE = FIRST_LEARNED + len(LEARNED)
"""Where the ladders begin."""
ASSUMED, SLOPE, WEIGHT, DIRECTION, SCORE, SHIFT, A, B, M, N, T, V = range(12)
"""Rows (n,) of the estimation: the diagonal of P, the right side, q, a, u, N k; then those of the sums of squares, of
B, of M, of N and of two scratch matrices by turns."""
OUTLYING, STATES = 2, 3
"""The last state of the noise, and their number."""
OUTLIER, RARITY, OFTEN = 0.035, 50.0, 1000.0
"""Probability of an outlier before the first sample, samples that this counts for, and memory of those since."""
STAY, CALM = 0.995, 0.98
"""Probabilities that quiet noise stays quiet, and that restless noise stays restless."""
QUIET = 0.8
"""Probability of quiet noise before the first sample."""
MEMORY, QUICK = 70.0, 2.0
"""Memories of r and f, in samples."""
LEAST_RESTLESS, LARGE = 6.0, 30.0
"""Least f and the variance of outliers at least, in units of r."""
LEAST_SHARE = 1e-26
"""r is never below this share of the mean square of y, for rounding in the sums of a prediction."""


def table(n: int, groups: Any) -> dict[str, Array]:
    """The modes as arrays (K,): ``ratio``; the ``ladder``, -3 common, -2 trend, -1 learned, or the number of a group;
    probabilities ``arrive`` from the whole bank; and ``start``, before the first sample. And ``alone`` (2, n): the
    first mode of the ladder in which a parameter drifts without all others, and the one after the last.
    """
    each = [[i] for i in range(n)] if groups is None and 1 < n <= MOST_ALONE else list(groups or ())
    ladders = [(-3, COMMON), (-2, TREND), (-1, LEARNED)]
    ladders += [(g, ALONE if groups is None else GROUP) for g in range(len(each))]
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
    """Fields of the K filters before the first sample: their modes, means m, covariances C (lower triangle)."""
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
    }


def any_noise() -> dict[str, Any]:
    """Fields before the first sample."""
    return {
        "nu": np.array([QUIET, 1.0 - QUIET, 0.0]), "nu_prior": np.array([0.0, 0.0, OUTLIER]), "restless": 1.0,
        "drift_rate": 0.0, "usual_noise": 1.0, "astray": 0.0,
        **unread(),
    }  # fmt: skip


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
def noise_prior(s: State, l: int) -> None:
    """Probabilities of the states before the sample."""
    usual = 1.0 - s.nu_prior[OUTLYING, l]
    s.nu_prior[0, l] = usual * (STAY * s.nu[0, l] + (1.0 - CALM) * s.nu[1, l])
    s.nu_prior[1, l] = usual * ((1.0 - STAY) * s.nu[0, l] + CALM * s.nu[1, l])


@kernel
def repeated_rounding(s: State, l: int) -> float:
    """Variance that a repeated reading adds to its noise."""
    return s.alike[l] * min(s.finest[l] * s.finest[l] / 12.0, s.noise[l] * s.r[l])  # type: ignore[no-any-return]


@partial(kernel, inline=False)
def learn_noise(s: State, l: int) -> None:
    """r and f from the moments of the noise of this sample."""
    K, more = s.modes[l], s.vague[l] + repeated_rounding(s, l)
    usual = s.nu[0, l] / (variance_in(s, 0, l) + more) + s.nu[1, l] / (variance_in(s, 1, l) + more)
    far = max(variance_in(s, OUTLYING, l), s.e[l] * s.e[l]) + more
    s.usual_noise[l] = 1.0 / (s.noise[l] * ((1.0 - s.nu[OUTLYING, l]) * usual + s.nu[OUTLYING, l] / far))
    if s.alike[l] > 0.0:
        return
    ordinary, wild = 0.0, 0.0
    for j in range(STATES):
        least = variance_in(s, j, l)
        widest = np.inf if j == OUTLYING else 0.0
        for k in range(K):
            e2, v = s.e_k[k, l] * s.e_k[k, l], s.inverse[j, k, l]
            own = max(least, min(e2, widest))
            s.row[k, l] = s.joint[j, k, l] * (own * (1.0 - own * v) + own * v * own * v * e2)
        moment = sum_of_row(s, l) / s.noise[l]
        ordinary += moment if j < OUTLYING else 0.0
        wild += moment if j > 0 else 0.0
    s.count[l] += 1.0
    # s.nu counts an outlier for the states that were expected
    away = 1.0 - s.nu[0, l] + s.nu[OUTLYING, l] * s.nu_prior[0, l] / (1.0 - s.nu_prior[OUTLYING, l])
    f = variance_in(s, 1, l) / s.noise[l]
    s.restless[l] = f * exp(away / QUICK * log(wild / (away * f))) if (away > 0.0) & (wild > 0.0) else f
    s.nu_prior[OUTLYING, l] += (s.nu[OUTLYING, l] - s.nu_prior[OUTLYING, l]) / (RARITY + min(s.count[l], OFTEN))
    move = (ordinary / s.r[l] - (1.0 - s.nu[OUTLYING, l])) / min(s.count[l] + 1.0, MEMORY)
    s.r[l] = max(s.r[l] * exp(min(1.0, max(-1.0, move))), least_noise(s, l))


SMOOTHER_FIELDS = ("drift_rate", "usual_noise", "white", "explained", "settled", "mean", "variance", "c")
"""Fields that are stored at every sample."""


@kernel
def store_for_smoother(o: State, s: State, l: int) -> None:
    """Store the fields of the smoother."""
    for i in range(s.c.shape[0]):
        o.white[i, l], o.mean[i, l], o.variance[i, l], o.c[i, l] = (
            s.white[i, l],
            s.mean[i, l],
            s.variance[i, l],
            s.c[i, l],
        )
    o.drift_rate[l], o.usual_noise[l] = s.drift_rate[l], s.usual_noise[l]
    o.explained[l], o.settled[l] = s.explained[l], s.settled[l]


def drift_ahead(rate: Array) -> Array:
    """The mean of the rate (T,) over the next `MEMORY` samples."""
    total, now = np.append(0.0, np.cumsum(rate)), np.arange(len(rate))
    until = np.minimum(now + int(MEMORY), len(rate))
    return np.asarray((total[until] - total[now]) / (until - now))
