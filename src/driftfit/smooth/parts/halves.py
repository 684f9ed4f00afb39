"""The loops of the fast smoother: elimination from both ends of the record towards its middle, and back.

Half 0 runs from the first sample to the middle one, half 1 from the last sample to it, both in K steps: step k of half
0 is sample k, of half 1 sample 2 (K - 1) - k, which does not exist at k = 0 if the record has an even length. A step
eliminates the increments before its sample, counted from the end at which the half starts, and adds the sample; the
middle one is added by half 1 alone. Each half is a chain of operations that wait for each other, and the processor
works on both chains at once.

Only the information before every BLOCK-th step is kept, (2 n^2 + 4 n) / BLOCK numbers per step. The steps between are
eliminated again on the way back.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver, State, kernel

BLOCK = 64
"""Steps that are eliminated again at a time."""

SMALL = 1e-200
"""A product of pivots below this is replaced by its logarithm."""


class Samples(NamedTuple):
    """A problem as the loops take it."""

    phi: Array
    y: Array
    weight: Array
    drift: Array
    drift_root: Array
    """(T, n), or (1, n) of ones."""


class Found(NamedTuple):
    """What the loops write."""

    theta: Array
    var: Array
    rho: Array
    c: Array


@lru_cache
def workspace(n: int) -> Array:
    """Scratch space, to be copied: a record, so that the compiler knows n. The last axis is the half.

    ``known_z``, ``known_b`` and ``known`` are z, b and theta of a second problem, whose solution is the constant path
    ``truth``; ``error`` is the largest distance of the computed solution from it.
    """
    both = {"U": (n, n), "C": (n, n), "g": (n,), "v": (n,), "r": (n,), "f": (), "product": (), "a": (BLOCK, n, n)}
    both |= {"z": (n,), "known_z": (n,), "b": (BLOCK, n), "known_b": (BLOCK, n), "theta": (n,), "known": (n,)}
    fields: list[Any] = [(name, np.float64, (*shape, 2)) for name, shape in both.items()]
    fields += [(name, np.float64, (n,)) for name in ("q", "truth", "error")]
    return np.zeros(1, np.dtype(fields, align=True))


@kernel
def sample_of(T: int, K: int, h: int, k: int) -> int:
    """The sample of step k of a half, or T if there is none."""
    t = k if h == 0 else 2 * (K - 1) - k
    return T if (h == 0) & (k == K - 1) else min(t, T)


@kernel
def drifts(s: State, samples: Any, K: int, k: int) -> None:
    """Variances g of the increments before step k of both halves."""
    n, T = s.q.shape[0], samples.phi.shape[0]
    many = 1 if samples.drift_root.shape[0] > 1 else 0
    for h in range(2):
        before = k if h == 0 else 2 * (K - 1) - k + 1
        moved = 1.0 if (k > 0) & (before < T) else 0.0
        before = min(before, T - 1)
        for i in range(n):
            s.g[i, h] = moved * s.q[i] * samples.drift[before] * samples.drift_root[before * many, i] ** 2


@kernel
def pivot(s: State, i: int, row: int, h: int) -> float:
    """a and b of one increment of a half, and z without it; returns f."""
    n = s.q.shape[0]
    g, z, known = s.g[i, h], s.z[i, h], s.known_z[i, h]
    f = 1.0 / (1.0 + g * s.U[i, i, h])
    for j in range(n):
        s.r[j, h] = s.U[max(i, j), min(i, j), h]
        if j != i:
            v = -(g * s.r[j, h]) * f
            s.v[j, h] = v
            s.a[row, i, j, h] = v
            s.z[j, h] += v * z
            s.known_z[j, h] += v * known
    s.a[row, i, i, h] = f
    s.b[row, i, h] = g * f * z
    s.known_b[row, i, h] = g * f * known
    s.z[i, h] = f * z
    s.known_z[i, h] = f * known
    s.f[h] = f
    return f  # type: ignore[no-any-return]


@kernel
def add(s: State, samples: Any, t: int, h: int) -> None:
    """Add a sample to the information of a half."""
    n = s.q.shape[0]
    w, y, known = samples.weight[t], samples.y[t], 0.0
    for j in range(n):
        known += samples.phi[t, j] * s.truth[j]
    for j in range(n):
        p = w * samples.phi[t, j]
        for m in range(j + 1):
            s.U[j, m, h] += p * samples.phi[t, m]
        s.z[j, h] += p * y
        s.known_z[j, h] += p * known


@kernel
def step(s: State, samples: Any, K: int, k: int, row: int) -> float:
    """Step k of both halves; a and b of its increments go to a row of the scratch space. Returns the smallest f.

    Only the lower triangle of U is stored.
    """
    n, T = s.q.shape[0], samples.phi.shape[0]
    least = 1.0
    drifts(s, samples, K, k)
    for i in range(n):
        for h in range(2):
            least = min(least, pivot(s, i, row, h))
        for h in range(2):
            f = s.f[h]
            for j in range(n):
                if j != i:
                    for m in range(j + 1):
                        if m != i:
                            s.U[j, m, h] += s.v[j, h] * s.r[m, h]
            for j in range(n):
                s.U[max(i, j), min(i, j), h] = f * s.r[j, h]
    for h in range(2):
        t = sample_of(T, K, h, k)
        if t < T:
            add(s, samples, t, h)
    return least


@Driver
def inwards(work: Array, samples: Any, K: int, kept: Array) -> tuple[float, float]:
    """Run both halves to the middle; returns the smallest f and the sum of log f.

    The information before each block goes to ``kept`` (blocks, n + 2, n, 2).
    """
    s = work[0]
    n = s.q.shape[0]
    least, logs = 1.0, 0.0
    s.product[0] = s.product[1] = 1.0
    for k in range(K):
        if k % BLOCK == 0:
            for h in range(2):
                for j in range(n):
                    for m in range(n):
                        kept[k // BLOCK, j, m, h] = s.U[j, m, h]
                    kept[k // BLOCK, n, j, h] = s.z[j, h]
                    kept[k // BLOCK, n + 1, j, h] = s.known_z[j, h]
        least = min(least, step(s, samples, K, k, 0))
        for h in range(2):
            for i in range(n):
                s.product[h] *= s.a[0, i, i, h]
                if s.product[h] < SMALL:
                    logs += np.log(s.product[h])
                    s.product[h] = 1.0
    return least, logs + np.log(s.product[0]) + np.log(s.product[1])


@kernel
def again(s: State, samples: Any, K: int, kept: Array, block: int) -> None:
    """Eliminate the steps of a block again."""
    n, first = s.q.shape[0], block * BLOCK
    for h in range(2):
        for j in range(n):
            for m in range(n):
                s.U[j, m, h] = kept[block, j, m, h]
            s.z[j, h] = kept[block, n, j, h]
            s.known_z[j, h] = kept[block, n + 1, j, h]
    for k in range(first, min(first + BLOCK, K)):
        step(s, samples, K, k, k - first)


@kernel
def report(s: State, samples: Any, found: Any, t: int, h: int) -> float:
    """Store the results of a sample, and compare the known path with the truth; returns the cost of the sample."""
    n = s.q.shape[0]
    w, e, spread = samples.weight[t], samples.y[t], 0.0
    for j in range(n):
        total = 0.0
        for m in range(n):
            total += s.C[j, m, h] * samples.phi[t, m]
        spread += samples.phi[t, j] * total
        e -= samples.phi[t, j] * s.theta[j, h]
        found.theta[t, j] = s.theta[j, h]
        found.var[t, j] = s.C[j, j, h]
        s.error[j] = max(s.error[j], abs(s.known[j, h] - s.truth[j]))
    c = np.sqrt(1.0 - w * spread)
    found.c[t] = c
    found.rho[t] = np.sqrt(w) * e / c if w > 0.0 else np.nan
    return w * e * e  # type: ignore[no-any-return]


@kernel
def back(s: State, i: int, row: int, h: int) -> float:
    """theta and C of a half before an increment of its step; returns the cost of the increment."""
    n = s.q.shape[0]
    x, known, g = s.b[row, i, h], s.known_b[row, i, h], s.g[i, h]
    own = g * s.a[row, i, i, h]
    for j in range(n):
        total = 0.0
        for m in range(n):
            total += s.C[j, m, h] * s.a[row, i, m, h]
        s.v[j, h] = total
    for j in range(n):
        x += s.a[row, i, j, h] * s.theta[j, h]
        known += s.a[row, i, j, h] * s.known[j, h]
        own += s.a[row, i, j, h] * s.v[j, h]
    for j in range(n):
        s.C[i, j, h] = s.v[j, h]
        s.C[j, i, h] = s.v[j, h]
    s.C[i, i, h] = own
    increment = x - s.theta[i, h]
    s.theta[i, h], s.known[i, h] = x, known
    return increment * increment / g if g > 0.0 else 0.0


@Driver
def outwards(work: Array, samples: Any, K: int, kept: Array, found: Any) -> float:
    """Run both halves back from theta and C of the middle in the scratch space; returns the cost of the path."""
    s = work[0]
    n, T = s.q.shape[0], samples.phi.shape[0]
    cost = 0.0
    for block in range(kept.shape[0] - 1, -1, -1):
        again(s, samples, K, kept, block)
        for k in range(min((block + 1) * BLOCK, K) - 1, block * BLOCK - 1, -1):
            for h in range(2):
                t = sample_of(T, K, h, k)
                if t < T:
                    cost += report(s, samples, found, t, h)
            drifts(s, samples, K, k)
            for i in range(n - 1, -1, -1):
                for h in range(2):
                    cost += back(s, i, k - block * BLOCK, h)
    return cost
