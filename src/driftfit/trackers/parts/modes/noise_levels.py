"""Changing noise and outliers: levels f_j r of the noise variance are modes of a Markov chain.

The last level is for outliers: it has probability 0.02 at every sample and does not affect the other levels, which form
a persistent chain (stay, or one rung up or down). r itself adapts to changes that the levels do not explain,

    log r <- log r + (sum_j p_j (e^2 / s_j - 1) + sum_j nu_j log f_j) / memory

so the level in use moves towards 1. No level is below 1: noise that falls is followed by r alone. Where residuals are
not normal (coarse meters, misspecified models), some small ones in a row would otherwise be taken for a low level, and
the next ordinary one for an outlier or a jump of the parameters; on real records this made bands of 95 % cover 50 %.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, exp, kernel, log
from driftfit.trackers.parts.coarse.resolution import lasting, least_noise
from driftfit.trackers.parts.modes.rows import sum_of_row

LEVELS = (1.0, 4.0, 16.0, 100.0)
"""Noise levels in units of r; the last is the outlier's."""
STAY = 0.99
"""Probability that the level is the same at the next sample."""
OUTLIER = 0.02
"""Probability of an outlier."""
START = 0.7
"""Probability of the first level before the first sample; the others are equally likely."""
MEMORY = 70.0
"""Memory of r, in samples."""
IN_A_ROW, RISE = 4.0, 0.3
"""From the third outlier in a row on (`driftfit.trackers.parts.proportion`), log r rises by this with
each."""
MISFIT, SETTLED, EARLY = 0.5, 20.0, 140.0
"""Among the first `EARLY` samples, if the mean of e^2 / s, with a memory of `SETTLED`, is below `MISFIT`, r falls by as
much: drift at the start was taken for noise. Later it does not, see above."""
LEAST_SHARE = 1e-26
"""r is never below this share of the mean square of y, for rounding in the sums of a prediction."""


def any_level() -> dict[str, Any]:
    """Fields before the first sample."""
    J = len(LEVELS)
    return {
        "level": np.array(LEVELS),
        "log_level": np.log(LEVELS),
        "nu": np.array([START, *np.full(J - 2, (1.0 - START) / (J - 2)), 0.0]),
        "nu_prior": np.zeros(J),
        "outlier": 0.0,
        "fit": 1.0,
    }


def level_chain() -> Array:
    """Transitions of the ordinary levels: stay, or one rung up or down."""
    K = len(LEVELS) - 1
    T = STAY * np.eye(K)
    for j in range(K):
        for to in (max(j - 1, 0), min(j + 1, K - 1)):
            T[j, to] += 0.5 * (1.0 - STAY)
    return T


@kernel
def finest(s: State, l: int) -> float:
    """The lower bound of r."""
    return max(LEAST_SHARE * s.power[l], least_noise(s, l))  # type: ignore[no-any-return]


@kernel
def noise_at(s: State, level: float, l: int) -> float:
    """Variance of the noise of the sample at a level; its weight does not change errors of rounding."""
    return s.leverage[l] * max(s.noise[l] * level * s.r[l], s.coarse[l])  # type: ignore[no-any-return]


@kernel
def noise_prior(s: State, l: int) -> None:
    """The chain of noise levels: stay, or one rung up or down; the outlier level has its own fixed probability."""
    J = s.nu.shape[0]
    for j in range(J):
        s.nu_prior[j, l] = 0.0
    for j in range(J - 1):
        here = (1.0 - OUTLIER) * s.nu[j, l]
        s.nu_prior[j, l] += STAY * here
        s.nu_prior[max(j - 1, 0), l] += 0.5 * (1.0 - STAY) * here
        s.nu_prior[min(j + 1, J - 2), l] += 0.5 * (1.0 - STAY) * here
    s.nu_prior[J - 1, l] = OUTLIER


@partial(kernel, inline=False)
def learn_noise(s: State, l: int) -> None:
    """r follows the part of the innovations that the ordinary levels do not explain, and moves towards the level in
    use.
    """
    K, J = s.modes[l], s.nu.shape[0]
    level = 0.0
    more = lasting(s, l)
    for k in range(K):
        s.row[k, l] = 0.0
    for j in range(J - 1):
        for k in range(K):
            square = s.e_k[k, l] * s.e_k[k, l] * s.inverse[j, k, l]
            s.row[k, l] += s.joint[j, k, l] * (square / (1.0 - more * s.inverse[j, k, l]) - 1.0)
        level += s.nu[j, l] * s.log_level[j, l]
    surprise = sum_of_row(s, l)
    ordinary = 0.0
    for j in range(J - 1):
        for k in range(K):
            s.row[k, l] = s.joint[j, k, l]
        ordinary += sum_of_row(s, l)
    s.count[l] += 1.0
    s.fit[l] += (surprise + ordinary * (1.0 - s.fit[l])) / SETTLED
    step = 1.0 / min(s.count[l] + 1.0, MEMORY)
    move = step * (surprise + level)
    if s.widening[l] > IN_A_ROW:
        move += RISE * s.outlier[l]
    fall = log(max(s.fit[l], 1e-6) / MISFIT) / SETTLED if (s.fit[l] < MISFIT) & (s.count[l] < EARLY) else 0.0
    s.fit[l] *= exp(-fall)
    s.r[l] = max(s.r[l] * exp(min(1.0, max(-1.0, move)) + fall), finest(s, l))
