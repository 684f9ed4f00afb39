"""A ladder of drift ratios as modes of a Markov chain, and the interaction that mixes their filters.

    c_j = sum_i mu_i T_ij
    m_j = sum_i (mu_i T_ij / c_j) m_i
    C_j = sum_i (mu_i T_ij / c_j) (C_i + (m_i - m_j)(m_i - m_j)')

T moves one rung up or down, and from every rung directly to the top, which is how a jump is detected. The top is the
rung of ratio 1: those above it are for noise that is small compared with the drift. A second ladder has learned weights
of the parameters (`driftfit.trackers.parts.modes.weights`), and the first, without them, makes it safe while they are
unknown or wrong: T leads across to it, and back through the bottom and by a jump. T never leads from the top directly
to the bottom: mixing the wide covariance of the top filter into the filter without drift costs more than anything else
when nothing changes (measured: 1.8 times the error of least squares instead of 1.15).

The top filter may also *leap*: if a move as large as the innovation, in directions 1 / c_i and up to LEAP standard
deviations of the output (times patience, `driftfit.trackers.parts.outlying_readings`), at this regressor and at one of
mean square c_i, explains the sample better by more than a factor 1 / RARE, its covariance grows by that move.

Source: Blom and Bar-Shalom (1988); the ladder and its transitions are ours. Cost per sample: O(K^2 n^2) for K modes,
vectorised over the destination modes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, kernel, log

LADDER = (0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.04, 0.2, 1.0, 30.0)
"""Drift ratios of the modes in which all parameters drift."""
LEARNED = LADDER[3:9]
"""Ratios of the ladder whose parameters have learned weights, and of groups."""
UP, DOWN, JUMP, BACK, ACROSS = 0.0005, 0.001, 0.0015, 0.1, 0.0005
"""Probabilities: to the rung above, to the one below, to the top, from a rung of its ratio to the one below, and from a
rung that all parameters climb to the same one with learned weights."""

TOP = LADDER.index(1.0)
"""The mode that detects jumps, and may leap; the rungs above it are for noise that is small compared with the drift."""
START = 0.25
"""Probability of no drift before the first sample."""
LEAP, RARE = 3.0, 0.02
"""Standard deviations of the output that a leap may reach, and its prior probability in the top mode."""


def ladders(n: int, groups: Any) -> tuple[Array, Array, Array]:
    """Ratios (n, K), transitions (K, K), and (K,) the ratios of the modes with learned weights, 0 for others."""
    rungs = [LADDER[1:], LEARNED, *(LEARNED for _ in groups or ())]
    masks = [np.ones(n), np.ones(n), *(np.isin(np.arange(n), group).astype(float) for group in groups or ())]
    ratio = [np.zeros(n)] + [rung * mask for ladder, mask in zip(rungs, masks, strict=True) for rung in ladder]
    K, foot = len(ratio), 1
    T, learned = np.zeros((K, K)), np.zeros(K)
    for which, ladder in enumerate(rungs):
        last = foot + len(ladder) - 1
        T[0, foot] += UP / (len(rungs) - 1) if which != 1 else 0.0
        for k, rung in enumerate(ladder, foot):
            if k < last:
                T[k, k + 1] += UP
            T[k, k - 1 if k > foot else 0] += BACK if rung == LADDER[TOP] else DOWN
            if which == 0 and rung in LEARNED:
                T[k, len(LADDER) + LEARNED.index(rung)] += ACROSS
            if which == 1:
                learned[k] = rung
        foot = last + 1
    T[np.arange(K) != TOP, TOP] += JUMP
    T[np.arange(K), np.arange(K)] += 1.0 - T.sum(axis=1)
    return np.array(ratio).T, T, learned


def filters(n: int, groups: Any) -> dict[str, Any]:
    """Fields of the K filters before the first sample: modes, means m, covariances C (lower triangle), scratch."""
    ratio, transition, learned = ladders(n, groups)
    K = len(transition)
    start = np.full(K, (1.0 - START) / (K - 1))
    start[0] = START
    return {
        "ratio": ratio,
        "transition": transition,
        "learned": learned,
        "mu": start,
        "prior": start,
        "mu_next": np.zeros(K),
        "share": np.zeros((K, K)),
        "row": np.zeros(K),
        "m": np.zeros((n, K)),
        "m_next": np.zeros((n, K)),
        "C": np.zeros((n, n, K)),
        "rare": 1.0,
        "leapt": 0.0,
        "gained": 0.0,
    }


@kernel
def mix(s: State, l: int) -> None:
    """Interaction: every filter continues from the mixture of its predecessors; mu becomes that of the next sample.

    Means are taken relative to that of the mixture, d, so that moments may be added before the mean is subtracted.
    """
    n, K = s.theta.shape[0], s.mu.shape[0]
    for j in range(K):
        s.prior[j, l] = 0.0
    for i in range(K):
        for j in range(K):
            s.share[i, j, l] = s.mu[i, l] * s.transition[i, j, l]
            s.prior[j, l] += s.share[i, j, l]
    for j in range(K):
        s.mu_next[j, l] = 1.0 / s.prior[j, l]
    for i in range(K):
        for j in range(K):
            s.share[i, j, l] *= s.mu_next[j, l]
    for a in range(n):
        for j in range(K):
            s.m[a, j, l] -= s.d[a, l]
            s.m_next[a, j, l] = 0.0
        for i in range(K):
            for j in range(K):
                s.m_next[a, j, l] += s.share[i, j, l] * s.m[a, i, l]
    for a in range(n):
        for b in range(a + 1):
            for j in range(K):
                s.C[a, b, j, l] += s.m[a, j, l] * s.m[b, j, l]
                s.row[j, l] = -s.m_next[a, j, l] * s.m_next[b, j, l]
            for i in range(K):
                for j in range(K):
                    s.row[j, l] += s.share[i, j, l] * s.C[a, b, i, l]
            for j in range(K):
                s.C[a, b, j, l] = s.row[j, l]
    for j in range(K):
        s.mu[j, l] = s.prior[j, l]
    for a in range(n):
        for j in range(K):
            s.m[a, j, l] = s.d[a, l] + s.m_next[a, j, l]


@kernel
def leap(s: State, l: int, noise: float) -> None:
    """Let the top filter explain the innovation by a jump of any size, if that is more likely."""
    most = LEAP * s.patience[l]
    square, v, unit = s.e_k[TOP, l] * s.e_k[TOP, l], s.h[TOP, l] + noise, 0.0
    for i in range(s.theta.shape[0]):
        own = s.ratio[i, TOP, l] / s.c[i, l] if s.c[i, l] > 0.0 else 0.0
        unit += own * s.white[i, l] * s.white[i, l]
    # a regressor near 0 says nothing about a move: none that would exceed the reach where regressors are as usual
    wide = max(v, min(square, most * most * s.spread[l] * min(1.0, unit)))
    better = 0.5 * square * (1.0 / v - 1.0 / wide) > 0.5 * log(wide / v) - log(RARE)
    s.rare[l], s.leapt[l], s.gained[l] = 1.0, 0.0, 0.0
    if better and unit > 0.0:
        s.rare[l], s.leapt[l], s.gained[l] = RARE, (wide - v) / unit, wide - v
        for i in range(s.theta.shape[0]):
            own = s.leapt[l] * s.ratio[i, TOP, l] / s.c[i, l] if s.c[i, l] > 0.0 else 0.0
            for a in range(i + 1):
                s.gain[a, TOP, l] += own * s.S[a, i, l] * s.white[i, l]
                for b in range(a + 1):
                    s.C[a, b, TOP, l] += own * s.S[a, i, l] * s.S[b, i, l]
        s.h[TOP, l] += s.gained[l]
