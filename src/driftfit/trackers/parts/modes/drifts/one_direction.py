"""Filters whose parameters drift together, in one direction v that is learned from the scores of the smoother.

Where one cause moves several parameters, their drift has the covariance rho v v'. With r and N the scores and their
information from the backward pass of `driftfit.trackers.parts.modes.weights`, P the drift covariance that the mixture
assumes, and Q the true one,

    E(r r' - N + N P N) = N Q N

so sums of the left side, B, and of N, M, that fade from block to block determine v as the leading eigenvector of

    M^-1 (B + M) v = lambda v,    P = diag(p) + a v v'

which has no negative eigenvalues. N P N is computed once for each block, with its mean N. Every pass makes `STEPS`
iterations from the direction of the pass before, the first one from r. Until then, and for a share `BESIDE` of the
ratio afterwards, because v is an estimate, these filters drift in all directions alike. v is in units of 1 / c^(1/2),
and of length 1.

Source: r and N are Koopman and Shephard's (1992); the direction is ours. Cost per sample: O(n^2), and O(n^3) for each
block of samples.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, kernel, shared

ALONG = (1e-3, 6e-3, 0.03, 0.2)
"""Drift ratios of the filters that drift in one direction."""
BESIDE = 0.03
"""Share of the ratio that each parameter drifts independently of the others."""
STEPS = 4
"""Iterations for the eigenvector in a pass."""
TINY = 1e-300
"""Added to what is divided by."""
DEPENDENT = 1e-10
"""Least pivot of M relative to its diagonal: below it, the regressors did not determine the direction."""

DIRECTION, IMAGE, ASSUMED, TIME, B, M, FACTOR = range(7)
"""Rows (n,): v, its image, a and the intervals of the block (first entries); then the rows of B, of M, and of N of the
block, later the Cholesky factor of M, by turns."""


def no_direction(n: int, first: int) -> dict[str, Any]:
    """Fields before the first sample; ``first`` is the first filter that drifts in one direction, if n > 1."""
    return {
        "along": np.array(ALONG if n > 1 else ()),
        "first_along": first,
        "direction": np.zeros(n),
        "turned": np.zeros(n),
        "moments": np.zeros((B + 3 * n, n)),
    }


@shared
def add_block(p: Array, t: Array) -> None:
    """Add N P N of the block to B, and N to M, and factorise M, with zeros for directions without information."""
    n = t.shape[1]
    for i in range(n):
        t[IMAGE, i] = 0.0
        for j in range(n):
            t[IMAGE, i] += t[FACTOR + 3 * i, j] * t[DIRECTION, j]
    for i in range(n):
        for j in range(n):
            total = t[ASSUMED, 0] * t[IMAGE, i] * t[IMAGE, j]
            for k in range(n):
                total += t[FACTOR + 3 * i, k] * p[k] * t[FACTOR + 3 * k, j]
            t[B + 3 * i, j] += total / (t[TIME, 0] + TINY)
            t[M + 3 * i, j] += t[FACTOR + 3 * i, j]
    for j in range(n):
        for i in range(j, n):
            left = t[M + 3 * i, j]
            for k in range(j):
                left -= t[FACTOR + 3 * i, k] * t[FACTOR + 3 * j, k]
            if i == j:
                t[FACTOR + 3 * j, j] = np.sqrt(left) if left > DEPENDENT * t[M + 3 * j, j] else 0.0
            else:
                t[FACTOR + 3 * i, j] = left / t[FACTOR + 3 * j, j] if t[FACTOR + 3 * j, j] > 0.0 else 0.0


@shared
def turn(r: Array, t: Array) -> None:
    """Iterate for the leading eigenvector, from the last direction, or from r if there is none yet."""
    n = t.shape[1]
    size = 0.0
    for i in range(n):
        size += abs(t[DIRECTION, i])
        t[IMAGE, i] = r[i]
    for step in range(STEPS):
        for i in range(n):  # (B + M) v, and half of its division by M
            if (size > 0.0) | (step > 0):
                t[IMAGE, i] = 0.0
                for j in range(n):
                    t[IMAGE, i] += (t[B + 3 * i, j] + t[M + 3 * i, j]) * t[DIRECTION, j]
            for k in range(i):
                t[IMAGE, i] -= t[FACTOR + 3 * i, k] * t[IMAGE, k]
            t[IMAGE, i] = t[IMAGE, i] / t[FACTOR + 3 * i, i] if t[FACTOR + 3 * i, i] > 0.0 else 0.0
        square = 0.0
        for back in range(n):
            i = n - 1 - back
            for k in range(i + 1, n):
                t[IMAGE, i] -= t[FACTOR + 3 * k, i] * t[IMAGE, k]
            t[IMAGE, i] = t[IMAGE, i] / t[FACTOR + 3 * i, i] if t[FACTOR + 3 * i, i] > 0.0 else 0.0
        for i in range(n):
            square += t[IMAGE, i] * t[IMAGE, i]
        for i in range(n):
            t[DIRECTION, i] = t[IMAGE, i] / np.sqrt(square + TINY)


@kernel
def drift_along(s: State, size: float, l: int) -> None:
    """Drift in the direction: ``size`` in units of the ratios over the scales of the regressors."""
    n = s.parameters[l]
    for a in range(n):
        total = 0.0
        for i in range(a, n):
            total += s.S[a, i, l] * (s.direction[i, l] / np.sqrt(s.c[i, l]) if s.c[i, l] > 0.0 else 0.0)
        s.turned[a, l] = total
    for a in range(n):
        for b in range(a + 1):
            moved = size * s.turned[a, l] * s.turned[b, l]
            for j in range(s.along.shape[0]):
                s.C[a, b, s.first_along[l] + j, l] += s.along[j, l] * moved


@kernel
def assume_along(s: State, l: int) -> None:
    """a, from the mean probabilities of the filters."""
    a = 0.0
    for j in range(s.along.shape[0]):
        a += s.mean_prior[s.first_along[l] + j, l] * s.along[j, l]
    s.moments[ASSUMED, 0, l] = a


@kernel
def take_direction(s: State, l: int) -> None:
    """The direction of the last pass becomes that of the filters."""
    for i in range(s.parameters[l]):
        s.direction[i, l] = s.moments[DIRECTION, i, l]
        for j in range(s.along.shape[0]):
            s.ratio[i, s.first_along[l] + j, l] = BESIDE * s.along[j, l]
