"""Noise of one of three kinds, told apart by what it does to the samples, and rounding that repeats.

    quiet      variance r, the mean of E(e^2 | y) with a memory of `MEMORY` samples
    restless   variance f, the same with a memory of `QUICK`
    outlier    of any size: variance max(100 r, e^2), with a fixed probability

v being the noise of a sample and p the joint probabilities of modes and kinds, E(v^2 | y) = sum p (r - r^2 / s + (r e /
s)^2), exactly; a noise variance that is learned so needs no bounds. Equal readings in a row repeat one error of
rounding: the j-th has (j - 1) min(step^2 / 12, r) more noise, step being the smallest change of the readings, and r is
learned from readings that changed. A meter so fine that readings never repeat has no such noise, and neither has a
plant without noise whose readings repeat because it rests.

Source: the moments of a noise given the data are those of an EM step, Shumway and Stoffer (1982); step^2 / 12 is
Sheppard's (1898); the kinds and the rule for repeats are ours. Cost per sample: O(K).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import State, exp, kernel
from driftfit.trackers.parts.mixture.rows import sum_of_row

STATES = 3
OUTLIER, RARITY, FADE = 0.035, 50.0, 0.999
"""Probability of an outlier before the first sample, samples that this counts for, and fading of those since."""
STAY, CALM = 0.985, 0.95
"""Probabilities that quiet noise stays quiet, and that restless noise stays restless."""
QUIET = 0.8
"""Probability of quiet noise before the first sample."""
MEMORY, QUICK = 70.0, 10.0
"""Memories of r and f, in samples."""
LEAST_RESTLESS, LARGE, WILDEST = 6.0, 100.0, 1e8
"""Least f, the variance of outliers at least, and the largest f, in units of r."""
LEAST_SHARE = 1e-26
"""r is never below this share of the mean square of y, for rounding in the sums of a prediction."""


def any_noise() -> dict[str, Any]:
    """Fields before the first sample."""
    return {
        "nu": np.array([QUIET, 1.0 - QUIET, 0.0]), "nu_prior": np.zeros(STATES), "restless": 1.0, "outlier": 0.0,
        "precision": 0.0, "certainty": 0.0, "outliers": 0.0, "watched": 0.0, "outlying": OUTLIER,
        "finest": np.inf, "reading": np.nan, "repeats": 0.0,
    }  # fmt: skip


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
    usual = 1.0 - s.outlying[l]
    s.nu_prior[0, l] = usual * (STAY * s.nu[0, l] + (1.0 - CALM) * s.nu[1, l])
    s.nu_prior[1, l] = usual * ((1.0 - STAY) * s.nu[0, l] + CALM * s.nu[1, l])
    s.nu_prior[2, l] = s.outlying[l]


@kernel
def note_reading(s: State, l: int) -> None:
    """Count readings that repeat, and find the smallest step between two."""
    if s.observed[l] > 0.0:
        y = s.y[l] + s.shift[l]
        step = abs(y - s.reading[l])  # NaN at the first reading
        if step <= ROUNDING * (abs(y) + abs(s.shift[l])):
            s.repeats[l] += 1.0
        else:
            s.finest[l] = step if step < s.finest[l] else s.finest[l]
            s.repeats[l] = 0.0
        s.reading[l] = y


@kernel
def repeated_rounding(s: State, l: int) -> float:
    """Variance that a repeated reading adds to its noise."""
    share = s.finest[l] * s.finest[l] / 12.0
    return s.repeats[l] * min(share, s.noise[l] * s.r[l]) if s.repeats[l] > 0.0 else 0.0


@partial(kernel, inline=False)
def learn_noise(s: State, l: int) -> None:
    """r and f from the moments of the noise of this sample."""
    K, more = s.modes[l], s.vague[l] + repeated_rounding(s, l)
    usual = s.nu[0, l] / (variance_in(s, 0, l) + more) + s.nu[1, l] / (variance_in(s, 1, l) + more)
    far = max(variance_in(s, STATES - 1, l), s.e[l] * s.e[l]) + more
    s.certainty[l] = s.noise[l] * ((1.0 - s.outlier[l]) * usual + s.outlier[l] / far)
    if s.repeats[l] > 0.0:
        return
    ordinary, share, every = 0.0, 0.0, 0.0
    for j in range(STATES):
        least = variance_in(s, j, l)
        widest = np.inf if j == STATES - 1 else 0.0
        for k in range(K):
            e2, v = s.e_k[k, l] * s.e_k[k, l], s.inverse[j, k, l]
            own = max(least, min(e2, widest))
            s.row[k, l] = s.joint[j, k, l] * (own * (1.0 - own * v) + own * v * own * v * e2)
        moment = sum_of_row(s, l) / s.noise[l]
        every += moment
        if j < STATES - 1:
            for k in range(K):
                s.row[k, l] = s.joint[j, k, l]
            share += sum_of_row(s, l)
            ordinary += moment
    s.count[l] += 1.0
    s.outliers[l] = FADE * s.outliers[l] + s.outlier[l]
    s.watched[l] = FADE * s.watched[l] + 1.0
    s.outlying[l] = (OUTLIER * RARITY + s.outliers[l]) / (RARITY + s.watched[l])
    move = (ordinary / s.r[l] - share) / min(s.count[l] + 1.0, MEMORY)
    s.r[l] = max(s.r[l] * exp(min(1.0, max(-1.0, move))), least_noise(s, l))
    s.restless[l] += (min(every, WILDEST * s.r[l]) - s.restless[l]) / QUICK
