"""The loops of the fast smoother: elimination from both ends of the record towards its middle, and back.

Half 0 runs from the first sample to the middle one, half 1 from the last sample to it, both in K steps: step k of half
0 is sample k, of half 1 sample 2 (K - 1) - k, which does not exist at k = 0 if the record has an even length. A step
eliminates the increments before its sample, counted from the end at which the half starts, and adds the sample; the
middle one is added by half 1 alone. The halves are the two entries of SIMD vectors (`driftfit.engine.simd.pair`), so
that every operation is done for both at once.

Only the information before every BLOCK-th step is kept, (2 n^2 + 4 n) / BLOCK numbers per step. The steps between are
eliminated again on the way back.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver, State, kernel, part
from driftfit.engine.simd import entry, higher, lower, minus, only, over, pair, plus, put_pair, times, two
from driftfit.smooth.solvers.walk import DRIFT, WEIGHT, Y

BLOCK = 64
"""Steps that are eliminated again at a time."""

SMALL = 1e-200
"""A product of pivots below this is replaced by its logarithm."""

LEVERAGE = 1e-5
"""Smallest 1 - h: below it 1 - h has lost more than five digits."""


class Samples(NamedTuple):
    """A problem as the loops take it; rows contiguous."""

    phi: Array
    signals: Array
    """(T, 3 or more), see `driftfit.smooth.solvers.walk.Walk`."""
    drift_root: Array
    """(T, n), or (1, n) of ones."""


class Found(NamedTuple):
    """What the loops write; rows contiguous.

    ``theta`` may be the signals of the problem, and ``var`` its regressors: on the way back, a sample is read for the
    last time just before its results are written.
    """

    theta: Array
    """(T, n or more), of which the first n columns are written."""
    var: Array
    """(T, n)"""
    rho: Array
    """(T,), or empty, as ``c``."""
    c: Array


@lru_cache
def workspace(n: int) -> Array:
    """Scratch space, to be copied: a record, so that the compiler knows n. The last axis is the half.

    ``known_z``, ``known_b`` and ``known`` are z, b and theta of a second problem, whose solution is the constant path
    ``truth``; ``error`` is the largest distance of the computed solution from it.
    """
    both = {"U": (n, n), "C": (n, n), "g": (n,), "v": (n,), "r": (n,), "p": (n,), "product": (1,), "a": (BLOCK, n, n)}
    both |= {"z": (n,), "known_z": (n,), "b": (BLOCK, n), "known_b": (BLOCK, n), "theta": (n,), "known": (n,)}
    both |= {"q": (n,), "truth": (n,), "error": (n,)}
    return np.zeros(1, np.dtype([(name, np.float64, (*shape, 2)) for name, shape in both.items()], align=True))


@kernel
def same(x: float) -> Any:
    """A number for both halves."""
    return two(x, x)


@kernel
def sample_of(T: int, K: int, h: int, k: int) -> int:
    """The sample of step k of a half, or T if there is none."""
    t = k if h == 0 else 2 * (K - 1) - k
    return T if (h == 0) & (k == K - 1) else min(t, T)


@kernel
def drifts(s: State, samples: Any, K: int, k: int) -> None:
    """Variances g of the increments before step k of both halves.

    That before the first sample changes nothing if the start is diffuse, because U is zero there.
    """
    n, T = s.q.shape[0], samples.phi.shape[0]
    many = 1 if samples.drift_root.shape[0] > 1 else 0
    after = 2 * (K - 1) - k + 1
    moved = two(1.0, 1.0 if (k > 0) & (after < T) else 0.0)
    after = min(after, T - 1)
    first = min(k, T - 1)
    drift = two(samples.signals[first, DRIFT], samples.signals[after, DRIFT])
    for i in range(n):
        root = two(samples.drift_root[first * many, i], samples.drift_root[after * many, i])
        put_pair(s.g, i, times(times(times(moved, pair(s.q, i)), drift), times(root, root)))


@kernel
def pivot(s: State, i: int, row: int) -> Any:
    """Eliminate increment i of a step; a and b go to a row of the scratch space, if it is not negative. Returns f.

    Only the lower triangle of U is stored.
    """
    n = s.q.shape[0]
    g, z, known = pair(s.g, i), pair(s.z, i), pair(s.known_z, i)
    f = over(same(1.0), plus(same(1.0), times(g, pair(s.U, i * n + i))))
    less = times(same(-1.0), g)
    for j in range(n):
        r = pair(s.U, max(i, j) * n + min(i, j))
        put_pair(s.r, j, r)
        put_pair(s.v, j, f if j == i else times(times(less, r), f))
    for j in range(n):
        if j != i:
            v = pair(s.v, j)
            put_pair(s.z, j, plus(pair(s.z, j), times(v, z)))
            put_pair(s.known_z, j, plus(pair(s.known_z, j), times(v, known)))
            for m in range(j + 1):
                if m != i:
                    put_pair(s.U, j * n + m, plus(pair(s.U, j * n + m), times(v, pair(s.r, m))))
    for j in range(n):
        put_pair(s.U, max(i, j) * n + min(i, j), times(f, pair(s.r, j)))
    put_pair(s.z, i, times(f, z))
    put_pair(s.known_z, i, times(f, known))
    if row >= 0:
        for j in range(n):
            put_pair(s.a, (row * n + i) * n + j, pair(s.v, j))
        gain = times(g, f)
        put_pair(s.b, row * n + i, times(gain, z))
        put_pair(s.known_b, row * n + i, times(gain, known))
    return f


@kernel
def regressors(s: State, samples: Any, first: int, last: int) -> None:
    """p, the regressors of a sample of each half."""
    for j in range(s.q.shape[0]):
        put_pair(s.p, j, two(samples.phi[first, j], samples.phi[last, j]))


@kernel
def add(s: State, samples: Any, K: int, k: int) -> None:
    """Add the samples of a step to the information of both halves."""
    n, T = s.q.shape[0], samples.phi.shape[0]
    one, other = sample_of(T, K, 0, k), sample_of(T, K, 1, k)
    first, last = min(one, T - 1), min(other, T - 1)
    regressors(s, samples, first, last)
    w = two(samples.signals[first, WEIGHT] if one < T else 0.0, samples.signals[last, WEIGHT] if other < T else 0.0)
    y, known = two(samples.signals[first, Y], samples.signals[last, Y]), same(0.0)
    for j in range(n):
        known = plus(known, times(pair(s.p, j), pair(s.truth, j)))
    for j in range(n):
        p = times(w, pair(s.p, j))
        for m in range(j + 1):
            put_pair(s.U, j * n + m, plus(pair(s.U, j * n + m), times(p, pair(s.p, m))))
        put_pair(s.z, j, plus(pair(s.z, j), times(p, y)))
        put_pair(s.known_z, j, plus(pair(s.known_z, j), times(p, known)))


@Driver
def inwards(work: Array, samples: Any, K: int, kept: Array) -> tuple[float, float]:
    """Run both halves to the middle; returns the smallest f and the sum of log f.

    The information before each block goes to ``kept`` (blocks, n + 2, n, 2).
    """
    s = work[0]
    n = s.q.shape[0]
    least, logs = same(1.0), 0.0
    put_pair(s.product, 0, same(1.0))
    for k in range(K):
        if k % BLOCK == 0:
            for h in range(2):
                for j in range(n):
                    for m in range(n):
                        kept[k // BLOCK, j, m, h] = s.U[j, m, h]
                    kept[k // BLOCK, n, j, h] = s.z[j, h]
                    kept[k // BLOCK, n + 1, j, h] = s.known_z[j, h]
        drifts(s, samples, K, k)
        for i in range(n):
            f = pivot(s, i, -1)
            least = lower(f, least)
            put_pair(s.product, 0, times(pair(s.product, 0), f))
            if min(s.product[0, 0], s.product[0, 1]) < SMALL:
                logs += np.log(s.product[0, 0]) + np.log(s.product[0, 1])
                put_pair(s.product, 0, same(1.0))
        add(s, samples, K, k)
    return min(entry(least, 0), entry(least, 1)), logs + np.log(s.product[0, 0]) + np.log(s.product[0, 1])


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
        drifts(s, samples, K, k)
        for i in range(n):
            pivot(s, i, k - first)
        add(s, samples, K, k)


@part  # a kernel would count references to the arrays of `found` for every sample, which takes longer than the rest
def report(s: State, samples: Any, found: Any, t: int, h: int, spread: float, e: float) -> tuple[float, float, int]:
    """Store the results of a sample, of which phi' C phi and y - phi' theta are given.

    Returns the cost of the sample, phi' C phi, and 1 if 1 - h is too small or a variance is not positive, else 0.
    """
    n, doubtful = s.q.shape[0], 0
    w = samples.signals[t, WEIGHT]
    for j in range(n):
        found.theta[t, j] = s.theta[j, h]
        found.var[t, j] = s.C[j, j, h]
        doubtful = doubtful if s.C[j, j, h] > 0.0 else 1
    rest = 1.0 - w * spread
    if found.c.shape[0] > 0:
        c = np.sqrt(rest)
        found.c[t] = c
        found.rho[t] = np.sqrt(w) * e / c if w > 0.0 else np.nan
    return w * e * e, spread if w > 0.0 else 0.0, doubtful if rest > LEVERAGE else 1


@kernel
def errors(s: State, samples: Any, first: int, last: int) -> tuple[Any, Any]:
    """phi' C phi and y - phi' theta of a sample of each half; compares the known path with the truth."""
    n = s.q.shape[0]
    regressors(s, samples, first, last)
    e, spread = two(samples.signals[first, Y], samples.signals[last, Y]), same(0.0)
    for j in range(n):
        total = same(0.0)
        for m in range(n):
            total = plus(total, times(pair(s.C, j * n + m), pair(s.p, m)))
        spread = plus(spread, times(pair(s.p, j), total))
        e = minus(e, times(pair(s.p, j), pair(s.theta, j)))
        away = minus(pair(s.known, j), pair(s.truth, j))
        put_pair(s.error, j, higher(higher(away, times(same(-1.0), away)), pair(s.error, j)))
    return spread, e


@kernel
def back(s: State, i: int, row: int) -> Any:
    """theta and C before an increment of a step; returns the cost of the increment."""
    n = s.q.shape[0]
    x, known, g = pair(s.b, row * n + i), pair(s.known_b, row * n + i), pair(s.g, i)
    own = times(g, pair(s.a, (row * n + i) * n + i))
    for j in range(n):
        total = same(0.0)
        for m in range(n):
            total = plus(total, times(pair(s.C, j * n + m), pair(s.a, (row * n + i) * n + m)))
        put_pair(s.v, j, total)
    for j in range(n):
        a = pair(s.a, (row * n + i) * n + j)
        x = plus(x, times(a, pair(s.theta, j)))
        known = plus(known, times(a, pair(s.known, j)))
        own = plus(own, times(a, pair(s.v, j)))
    for j in range(n):
        put_pair(s.C, i * n + j, pair(s.v, j))
        put_pair(s.C, j * n + i, pair(s.v, j))
    put_pair(s.C, i * n + i, own)
    increment = minus(x, pair(s.theta, i))
    put_pair(s.theta, i, x)
    put_pair(s.known, i, known)
    return only(over(times(increment, increment), g), g)


@Driver
def outwards(work: Array, samples: Any, K: int, kept: Array, found: Any) -> tuple[float, float, float, int]:
    """Run both halves back from theta and C of the middle in the scratch space.

    Returns the cost and the part of it that is measured, the sum of phi' C phi over the used samples, and the number of
    samples of which 1 - h is too small, or a variance is not positive.
    """
    s = work[0]
    n, T = s.q.shape[0], samples.phi.shape[0]
    moved, measured, spread, doubtful = same(0.0), 0.0, 0.0, 0
    for block in range(kept.shape[0] - 1, -1, -1):
        again(s, samples, K, kept, block)
        for k in range(min((block + 1) * BLOCK, K) - 1, block * BLOCK - 1, -1):
            drifts(s, samples, K, k)  # before the results take the place of the sample
            one, other = sample_of(T, K, 0, k), sample_of(T, K, 1, k)
            wide, e = errors(s, samples, min(one, T - 1), min(other, T - 1))
            for h in range(2):
                t = one if h == 0 else other
                if t < T:
                    own, share, doubt = report(s, samples, found, t, h, entry(wide, h), entry(e, h))
                    measured += own
                    spread += share
                    doubtful += doubt
            for i in range(n - 1, -1, -1):
                moved = plus(moved, back(s, i, k - block * BLOCK))
    return measured + entry(moved, 0) + entry(moved, 1), measured, spread, doubtful
