"""First-floor approximation: the mixture over the oldest event becomes one density, and the tree is grown again.

    C' = C + sum_i w_i Q_i,   w_i the prior p_i, or the posterior p(c_i | data)

The components of the first floor share their mean, so with prior weights this is one Kalman filter with
Q = sum p_i Q_i. With posterior weights the samples that gave them are filtered again and so count twice; merging leaves
(GPB) uses each once and is better. It is here to show that. One sensor, independent events.
"""

from __future__ import annotations

import math

from driftfit.engine.kernel import Array, shared
from driftfit.trackers.bank.leaves.leaves import CODE, FIRST, LOG, WEIGHT, increments, normalise, ready
from driftfit.trackers.bank.machine.grow import grow

Y, NOISE, TIME = 0, 1, 2
"""Columns of a stored sample before its regressor."""


@shared
def widen(root: Array, n: int, weight: Array, Q: Array, X: Array) -> None:
    """C + sum w_i Q_i of the root; X is spare."""
    for k in range(n * (n + 1) // 2):
        for e in range(len(Q)):
            root[FIRST + n + k, 0] += weight[e] * Q[e, k]


@shared
def refilter(
    root: Array, samples: Array, D: int, B: Array, L: int, A: Array, by_prior: bool, Q: Array, sizes: Array, c: Array,
    r: float, unknown: bool, fade: float, least: float, factors: Array, maps: Array, places: Array, sensors: Array,
    row: Array, bases: Array, parent: Array, event: Array, prior: Array, na: int, own: bool, Qt: Array, X: Array,
) -> int:  # fmt: skip
    """Take the oldest of D samples into the root, and grow the tree of the others; returns its leaves, in A."""
    H, n = len(row), places.shape[1]
    tri = n * (n + 1) // 2
    weight = X[0]
    top = float(H) ** (D - 1)
    for e in range(H):
        weight[e] = row[e] if by_prior else 0.0
    if not by_prior:
        for l in range(L):
            weight[int(B[CODE, l] // top)] += B[WEIGHT, l]
    increments(Q, sizes, c, r, unknown, samples[0, TIME], samples[0, TIME], factors, Qt)
    ready(Qt, n)
    widen(root, n, weight, Qt, X[1:])
    for e in range(H):
        prior[e, 0] = 0.0
    prior[0, 0] = 1.0
    for e in range(H):
        for k in range(tri):
            Qt[e, k] = 0.0
    root[LOG, 0] = 0.0
    L = min(D, 1)
    floor(
        root, L, B, samples[0], r, unknown, fade, least, na, Qt, maps, places, sensors, prior, own, bases, parent,
        event, X,
    )  # fmt: skip
    for k in range(len(root)):
        root[k, 0] = B[k, 0]
        A[k, 0] = B[k, 0]
    root[LOG, 0], A[LOG, 0], A[CODE, 0] = 0.0, 0.0, 0.0
    for at in range(1, D):
        for e in range(H):
            for l in range(L):
                prior[e, l] = row[e]
        increments(Q, sizes, c, r, unknown, samples[at, TIME], samples[at, TIME], factors, Qt)
        ready(Qt, n)
        L = floor(
            A, L, B, samples[at], r, unknown, fade, least, na, Qt, maps, places, sensors, prior, own, bases, parent,
            event, X,
        )  # fmt: skip
        normalise(B, L)
        for k in range(len(root)):
            for l in range(L):
                A[k, l] = B[k, l]
    for at in range(1, D):
        for k in range(samples.shape[1]):
            samples[at - 1, k] = samples[at, k]
    return L


@shared
def histories(A: Array, L: int, D: int, H: int, Hm: int, T: Array) -> None:
    """The table of the past for the leaves of the new tree: what happened in the D - 1 floors that it has."""
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


@shared
def floor(
    A: Array, K: int, B: Array, sample: Array, r: float, unknown: bool, fade: float, least: float, na: int, Q: Array,
    maps: Array, places: Array, sensors: Array, prior: Array, own: bool, bases: Array, parent: Array, event: Array,
    X: Array,
) -> int:  # fmt: skip
    return int(
        grow(
            A, K, B, sample[TIME + 1 :], sample[Y], sample[Y], sample[NOISE], r, unknown, fade, least, math.inf, na, Q,
            maps, places, sensors, prior, own, not own, bases, parent, event, 0, X,
        )
    )  # fmt: skip
