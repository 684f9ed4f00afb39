"""First-floor approximation: the mixture over the oldest event becomes one density, and the tree is grown again.

    C' = C + sum_i w_i Q_i,   w_i the prior p_i, or the posterior p(c_i | data)

The components of the first floor share their mean, so with prior weights this is one Kalman filter with
Q = sum p_i Q_i. With posterior weights the samples that gave them are filtered again and so count twice; merging leaves
(GPB) uses each once and is better. It is included for comparison. One sensor, independent events.
"""

from __future__ import annotations

from typing import Any

from driftfit.bank.layout import tables
from driftfit.bank.leaves.leaf_matrix import CODE, FIRST, LOG, WEIGHT, increments, normalise
from driftfit.bank.machine.grow import grow
from driftfit.bank.reducing.selection import DEPTH, PRIOR
from driftfit.engine.kernel import shared

Y, NOISE, TIME = 0, 1, 2
"""Columns of a stored sample before its regressor."""


@shared
def refilter(t: Any, L: int) -> int:
    """Update the root by the oldest stored sample, and grow the tree of the others again; returns the number of its
    leaves, which are parents.
    """
    A, B, Q, root, samples, prior, row = t.parents, t.leaves, t.Q, t.root, t.samples, t.prior, t.row
    H, D, weight = len(row), int(t.reduction[DEPTH]), t.scratch[0]
    top, by_prior = float(H) ** (D - 1), t.reduction[PRIOR] > 0.0
    for e in range(H):
        weight[e] = row[e] if by_prior else 0.0
    if not by_prior:
        for l in range(L):
            weight[int(B[CODE, l] // top)] += B[WEIGHT, l]
    increments(t, samples[0, TIME], samples[0, TIME])
    for k in range(t.n * (t.n + 1) // 2):
        for e in range(H):
            root[FIRST + t.n + k, 0] += weight[e] * Q[e, k]
    for e in range(H):  # the change is in the root: the oldest sample is one of no change and no increment
        prior[e, 0] = 0.0
        for k in range(Q.shape[1]):
            Q[e, k] = 0.0
    prior[0, 0] = 1.0
    for k in range(len(root)):
        A[k, 0] = root[k, 0]
    A[LOG, 0] = 0.0
    L, one = min(D, 1), samples[0]
    grow(t, L, False, one[TIME + 1 :], one[Y], one[Y], one[NOISE])
    for k in range(len(root)):
        root[k, 0] = A[k, 0] = B[k, 0]
    root[LOG, 0] = A[LOG, 0] = A[CODE, 0] = 0.0
    for at in range(1, D):
        for e in range(H):
            for l in range(L):
                prior[e, l] = row[e]
        increments(t, samples[at, TIME], samples[at, TIME])
        one = samples[at]
        L = grow(t, L, False, one[TIME + 1 :], one[Y], one[Y], one[NOISE])
        normalise(B, L)
        for k in range(len(root)):
            for l in range(L):
                A[k, l] = B[k, l]
    for at in range(1, D):
        for k in range(samples.shape[1]):
            samples[at - 1, k] = samples[at, k]
    return L


@shared
def histories(t: Any, L: int) -> None:
    """Write the histories of the new tree, which has D - 1 levels."""
    A, D, H, Hm = t.parents, int(t.reduction[DEPTH]), len(t.initial), len(t.sensors)
    T = tables(t)[0]
    block, width = H + 1, T.shape[1]
    for l in range(L):
        for at in range(width):
            T[l, at] = 0.0
        code, quiet = int(A[CODE, l]), 1.0
        for k in range(min(D - 1, width // block)):
            e = code % H
            code //= H
            quiet *= 1.0 if e < Hm else 0.0
            T[l, k * block + e], T[l, k * block + H] = 1.0, quiet
