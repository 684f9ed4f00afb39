"""A ladder of drift ratios as modes of a Markov chain, and the interaction that mixes their filters.

    c_j = sum_i mu_i T_ij
    m_j = sum_i (mu_i T_ij / c_j) m_i
    C_j = sum_i (mu_i T_ij / c_j) (C_i + (m_i - m_j)(m_i - m_j)')

T moves one rung up or down, and from every rung directly to the top, which is how a jump is detected. It never leads
from the top directly to the bottom: mixing the wide covariance of the top filter into the filter without drift costs
more than anything else when nothing changes (measured: 1.8 times the error of least squares instead of 1.15).

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

LADDER = (0.0, 1e-5, 1e-4, 1e-3, 1e-2, 3e-2, 1e-1, 3e-1, 1.0)
UP, DOWN, JUMP, BACK = 0.0005, 0.002, 0.0015, 0.1
"""Probabilities: to the rung above, to the one below, to the top, and from the top to the rung below it."""


TOP = len(LADDER) - 1
"""The mode at the top of the ladder that all parameters climb."""
LEAP, RARE = 3.0, 0.02
"""Standard deviations of the output that a leap may reach, and its prior probability in the top mode."""


def ladders(n: int, groups: Any) -> tuple[Array, Array]:
    """Ratios (n, K) and transitions (K, K): one ladder for all parameters, and one more for every group."""
    masks = [np.ones(n), *(np.isin(np.arange(n), group).astype(float) for group in groups or ())]
    ratios = [np.zeros(n)] + [rung * mask for mask in masks for rung in LADDER[1:]]
    K, rungs = len(ratios), len(LADDER) - 1
    T = np.zeros((K, K))
    for ladder in range(len(masks)):
        foot = 1 + ladder * rungs
        top = foot + rungs - 1
        T[0, foot] += UP / len(masks)
        for k in range(foot, top):
            T[k, k + 1] += UP
            T[k, k - 1 if k > foot else 0] += DOWN
        T[top, top - 1] += BACK
    T[np.arange(K) != rungs, rungs] += JUMP
    T[np.arange(K), np.arange(K)] += 1.0 - T.sum(axis=1)
    return np.array(ratios).T, T


def filters(n: int, groups: Any) -> dict[str, Any]:
    """Fields of the K filters before the first sample: modes, means m, covariances C (lower triangle), scratch."""
    ratio, transition = ladders(n, groups)
    K = len(transition)
    return {
        "ratio": ratio,
        "transition": transition,
        "mu": np.full(K, 1.0 / K),
        "prior": np.full(K, 1.0 / K),
        "mu_next": np.zeros(K),
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
    """Interaction: every filter continues from the mixture of its predecessors; mu becomes that of the next sample."""
    n, K = s.theta.shape[0], s.mu.shape[0]
    for j in range(K):
        s.prior[j, l] = 0.0
    for i in range(K):
        for j in range(K):
            s.prior[j, l] += s.mu[i, l] * s.transition[i, j, l]
    for j in range(K):
        s.mu_next[j, l] = 1.0 / s.prior[j, l]
    for a in range(n):
        for j in range(K):
            s.m_next[a, j, l] = 0.0
        for i in range(K):
            for j in range(K):
                s.m_next[a, j, l] += s.mu[i, l] * s.transition[i, j, l] * s.mu_next[j, l] * s.m[a, i, l]
    for a in range(n):
        for b in range(a + 1):
            for j in range(K):
                s.row[j, l] = 0.0
            for i in range(K):
                for j in range(K):
                    share = s.mu[i, l] * s.transition[i, j, l] * s.mu_next[j, l]
                    spread = (s.m[a, i, l] - s.m_next[a, j, l]) * (s.m[b, i, l] - s.m_next[b, j, l])
                    s.row[j, l] += share * (s.C[a, b, i, l] + spread)
            for j in range(K):
                s.C[a, b, j, l] = s.row[j, l]
    for j in range(K):
        s.mu[j, l] = s.prior[j, l]
    for a in range(n):
        for j in range(K):
            s.m[a, j, l] = s.m_next[a, j, l]


@kernel
def leap(s: State, l: int, noise: float) -> None:
    """Let the top filter explain the innovation by a move of any necessary size, if that is more likely."""
    most = LEAP * s.patience[l]
    square, v, unit = s.e_k[TOP, l] * s.e_k[TOP, l], s.h[TOP, l] + noise, 0.0
    for i in range(s.theta.shape[0]):
        own = s.ratio[i, TOP, l] / s.c[i, l] if s.c[i, l] > 0.0 else 0.0
        unit += own * s.phi[i, l] * s.phi[i, l]
    # a regressor near 0 says nothing about a move: none that would exceed the reach where regressors are as usual
    wide = max(v, min(square, most * most * s.spread[l] * min(1.0, unit)))
    better = 0.5 * square * (1.0 / v - 1.0 / wide) > 0.5 * log(wide / v) - log(RARE)
    s.rare[l], s.leapt[l], s.gained[l] = 1.0, 0.0, 0.0
    if better and unit > 0.0:
        s.rare[l], s.leapt[l], s.gained[l] = RARE, (wide - v) / unit, wide - v
        for i in range(s.theta.shape[0]):
            own = s.leapt[l] * s.ratio[i, TOP, l] / s.c[i, l] if s.c[i, l] > 0.0 else 0.0
            for a in range(i + 1):
                s.gain[a, TOP, l] += own * s.S[a, i, l] * s.phi[i, l]
                for b in range(a + 1):
                    s.C[a, b, TOP, l] += own * s.S[a, i, l] * s.S[b, i, l]
        s.h[TOP, l] += s.gained[l]
