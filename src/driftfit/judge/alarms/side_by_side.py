"""The statistics of simulated records, eight records side by side in SIMD vectors.

The statistics of `driftfit.run.live.likelihood_ratio` and `driftfit.run.live.likelihood_ratio`, for records in
which every sample can be used: all eight then take the same branches, so that each operation on a number becomes one on
a vector. Only what the limits need is computed, not which parameter moved, by how much and when. A matrix (rows, 8) has
a column for each record.

Source and notation: `driftfit.run.live.likelihood_ratio`. Cost: less than a seventh of eight records one by one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.drivers import SMALLEST
from driftfit.engine.kernel import Array, Driver, kernel, part
from driftfit.engine.simd import (
    WIDTH,
    exp_of,
    fill,
    higher,
    load,
    log_of,
    lower,
    minus,
    only,
    over,
    plus,
    reaches,
    root,
    store,
    times,
)
from driftfit.run.live.reference_model import (
    BLOCKS,
    BOUND,
    CONSTANT,
    EVEN,
    FLAT,
    KAPPA,
    LEVELS,
    LITTLE,
    LONGEST,
    NORMAL,
    SHIFT,
    SHORT,
    SHORTER,
    K,
    V,
)

ONE, JOINT, NOISE = range(3)
"""Entries of the statistics of a window."""
LOWEST = -1e300


class SimulatedRecords(NamedTuple):
    """R simulated records of T samples: what was estimated from the reference of each, and its whitened scores."""

    cov: Array
    """(R, n, n)"""
    numbers: Array
    """(R, k): `Frozen.numbers`."""
    phi: Array
    """(R, T, n)"""
    g: Array
    """(R, T)"""
    slopes: Array
    """(R, n, 2): `through_zero` of every regressor that is centred, 0 for others; (R, 0, 2) if none is."""


class Models(NamedTuple):
    """What was estimated from the references of eight records: as in `SimulatedRecords`, all (rows, 8)."""

    cov: Array
    numbers: Array
    slopes: Array


class Work(NamedTuple):
    """Scratch of the routine for n parameters, all (rows, 8)."""

    sums: Array
    """Sums over the blocks of every level: S, Q and the lower triangle of G of each block."""
    total: Array
    """The sums of a window."""
    V: Array
    """V of a window, then its Cholesky factor."""
    G: Array
    inverse: Array
    """Reciprocals of the diagonal of the factor, 0 where there is no direction left."""
    z: Array
    row: Array
    level: Array
    """`row` of the constant, of which a slope through zero has a part."""
    last: Array
    """The statistics of the last window of each length."""


def statistics_of(records: SimulatedRecords, cusum: bool, begin: int = 0) -> Array:
    """(R, T - begin, c) of the records, without the first samples: "one", "parameters", "noise"; or with ``cusum``
    those of n parameters and the noise. Every column is contiguous in time.
    """
    R, T, n = records.phi.shape
    made = np.empty((n + 1 if cusum else 3, R, T - begin))
    for first in range(0, R, WIDTH):
        lanes = np.minimum(np.arange(first, first + WIDTH), R - 1)  # the last record fills the vector
        phi = np.ascontiguousarray(records.phi[lanes].transpose(1, 2, 0)).reshape(T * n, WIDTH)
        g, cov = np.ascontiguousarray(records.g[lanes].T), records.cov[lanes].reshape(WIDTH, n * n)
        out = np.empty((T, len(made), WIDTH))
        numbers, slopes = records.numbers[lanes].T, records.slopes[lanes].reshape(WIDTH, -1).T
        model = Models(*(np.ascontiguousarray(one) for one in (cov.T, numbers, slopes)))
        if cusum:
            _cusums(phi, g, model, np.zeros((2 * (n + 1) + len(slopes), WIDTH)), out.reshape(-1, WIDTH))
        else:
            _ratios(phi, g, model, work(n), begin, out.reshape(-1, WIDTH))
        made[:, first : first + WIDTH] = out[begin:].transpose(1, 2, 0)[:, : R - first]
    return np.moveaxis(made, 0, -1)


def work(n: int) -> Work:
    """The scratch before the first sample."""
    size = n + 1 + n * (n + 1) // 2
    rows = (LEVELS * BLOCKS * size, size, n * n, n * n, n, n, n, n, 3 * 2 * LEVELS)
    made = Work(*(np.zeros((count, WIDTH)) for count in rows))
    made.last[:] = LOWEST
    return made


@kernel
def _deviate(ratio: Any, shape: Any) -> Any:
    """A gamma variable of this shape over its mean as a normal deviate (Wilson and Hilferty 1931)."""
    logs = log_of(higher(ratio, fill(SMALLEST)))
    cube_root = only(exp_of(over(logs, fill(3.0))), ratio)
    middle = minus(fill(1.0), over(fill(1.0), times(fill(9.0), shape)))
    return times(times(minus(cube_root, middle), fill(3.0)), root(shape))


@part
def _enter(sums: Array, phi: Array, g: Array, t: int, n: int) -> int:
    """Add sample t as a block of level 0, and every block that it completes; returns the rows of a block."""
    size, count = n + 1 + n * (n + 1) // 2, t + 1
    at, score = (count % BLOCKS) * size, load(g, t, 0)
    below = at + n + 1
    for i in range(n):
        own = load(phi, t * n + i, 0)
        store(sums, at + i, 0, times(own, score))
        for j in range(i + 1):
            store(sums, below, 0, times(own, load(phi, t * n + j, 0)))
            below += 1
    store(sums, at + n, 0, times(score, score))
    for level in range(1, LEVELS):
        if count % (1 << level) != 0:
            break
        b = count >> level
        into = (level * BLOCKS + b % BLOCKS) * size
        first = ((level - 1) * BLOCKS + (2 * b - 1) % BLOCKS) * size
        second = ((level - 1) * BLOCKS + (2 * b) % BLOCKS) * size
        for i in range(size):
            store(sums, into + i, 0, plus(load(sums, first + i, 0), load(sums, second + i, 0)))
    return size


@part
def _variance(w: Work, n: int, model: Models) -> None:
    """V = v G + k^2 G C G of the sums of a window, the lower triangle, and G."""
    v, k, at = load(model.numbers, V, 0), load(model.numbers, K, 0), n + 1
    square = times(k, k)
    for i in range(n):
        for j in range(i + 1):
            store(w.G, i * n + j, 0, load(w.total, at, 0))
            store(w.G, j * n + i, 0, load(w.total, at, 0))
            at += 1
    for i in range(n):
        for j in range(n):
            value = fill(0.0)
            for m in range(n):
                value = plus(value, times(load(w.G, i * n + m, 0), load(model.cov, m * n + j, 0)))
            store(w.row, j, 0, value)
        for j in range(i + 1):
            value = fill(0.0)
            for m in range(n):
                value = plus(value, times(load(w.row, m, 0), load(w.G, m * n + j, 0)))
            store(w.V, i * n + j, 0, plus(times(v, load(w.G, i * n + j, 0)), times(square, value)))


@part
def _factor(w: Work, n: int) -> None:
    """Cholesky factor of V in place, and the reciprocals of its diagonal."""
    for j in range(n):
        own = load(w.V, j * n + j, 0)
        pivot = own
        for m in range(j):
            entry = load(w.V, j * n + m, 0)
            pivot = minus(pivot, times(entry, entry))
        some = minus(pivot, times(fill(FLAT), own))
        store(w.inverse, j, 0, only(over(fill(1.0), root(higher(pivot, fill(SMALLEST)))), some))
        for i in range(j + 1, n):
            value = load(w.V, i * n + j, 0)
            for m in range(j):
                value = minus(value, times(load(w.V, i * n + m, 0), load(w.V, j * n + m, 0)))
            store(w.V, i * n + j, 0, times(value, load(w.inverse, j, 0)))


@part
def _solved(n: int, w: Work, j: int, row: Array) -> None:
    """row = F^-1 G e_j, where V = F F'."""
    for i in range(n):
        value = load(w.G, j * n + i, 0)
        for m in range(i):
            value = minus(value, times(load(w.V, i * n + m, 0), load(row, m, 0)))
        store(row, i, 0, times(value, load(w.inverse, i, 0)))


@part
def _explained(n: int, w: Work, row: Array) -> Any:
    """The square of the statistic of a change along ``row``."""
    own, score = fill(0.0), fill(0.0)
    for i in range(n):
        value = load(row, i, 0)
        own = plus(own, times(value, value))
        score = plus(score, times(value, load(w.z, i, 0)))
    return only(over(times(score, score), own), own)


@part(sizes=(2, 3, 4))
def _compare(n: int, w: Work, length: int, model: Models, at: int) -> None:
    """The statistics of a window of ``length`` samples into rows at .. at + 2 of ``last``."""
    numbers = model.numbers
    _variance(w, n, model)
    _factor(w, n)
    square, rank = fill(0.0), fill(0.0)
    for i in range(n):
        value = load(w.total, i, 0)
        for m in range(i):
            value = minus(value, times(load(w.V, i * n + m, 0), load(w.z, m, 0)))
        value = times(value, load(w.inverse, i, 0))
        store(w.z, i, 0, value)
        square = plus(square, times(value, value))
        rank = plus(rank, only(fill(1.0), load(w.inverse, i, 0)))
    rank = higher(rank, fill(1.0))
    store(w.last, at + JOINT, 0, _deviate(over(square, rank), times(fill(0.5), rank)))
    best = fill(0.0)
    centred = model.slopes.shape[0] > 0
    if centred:
        _solved(n, w, int(numbers[CONSTANT, 0]), w.level)
    for j in range(n):
        _solved(n, w, j, w.row)
        best = higher(_explained(n, w, w.row), best)
        if centred:
            a, b = load(model.slopes, 2 * j, 0), load(model.slopes, 2 * j + 1, 0)
            for i in range(n):
                store(w.row, i, 0, plus(times(a, load(w.row, i, 0)), times(b, load(w.level, i, 0))))
            best = higher(_explained(n, w, w.row), best)
    store(w.last, at + ONE, 0, root(best))
    v, samples = load(numbers, V, 0), fill(float(length))
    ratio = over(load(w.total, n, 0), times(samples, v))
    deviate = _deviate(ratio, over(times(samples, times(v, v)), load(numbers, KAPPA, 0)))
    size = higher(deviate, minus(fill(0.0), deviate))
    noise = over(size, root(plus(fill(1.0), over(samples, load(numbers, NORMAL, 0)))))
    store(w.last, at + NOISE, 0, only(noise, reaches(load(numbers, LONGEST, 0), samples)))


@Driver
def _ratios(phi: Array, g: Array, model: Models, w: Work, begin: int, out: Array) -> None:
    """The windowed ratios of phi (T n, 8) and g (T, 8) into out (3 T, 8), right from sample ``begin`` on."""
    n = phi.shape[0] // g.shape[0]
    for t in range(g.shape[0]):
        count, size = t + 1, _enter(w.sums, phi, g, t, n)
        for level in range(LEVELS):
            b = count >> level
            if count % (1 << level) != 0 or b < SHORT:
                break
            if t + (1 << level) <= begin:
                continue  # the next window of this level ends before any statistic counts
            for i in range(size):
                store(w.total, i, 0, fill(0.0))
            for kind in range(2):
                blocks, begin = (SHORT, 0) if kind == 0 else (BLOCKS, SHORT)
                if b < blocks:
                    break
                for back in range(begin, blocks):
                    first = (level * BLOCKS + (b - back) % BLOCKS) * size
                    for i in range(size):
                        store(w.total, i, 0, plus(load(w.total, i, 0), load(w.sums, first + i, 0)))
                _compare(n, w, blocks << level, model, 3 * (2 * level + kind))
        for i in range(3):
            value = fill(0.0)
            for window in range(2 * LEVELS):
                z = higher(load(w.last, 3 * window + i, 0), fill(0.0))
                less = times(load(model.numbers, EVEN, 0), fill(2.0 * SHORTER[window]))
                value = higher(minus(times(z, z), less), value)
            store(out, 3 * t + i, 0, root(value))


@part
def _climb(cusum: Array, j: int, z: Any, mean: Any, var: Any, power: Any) -> Any:
    """One step of the CUSUM up and down in row j; returns the larger one."""
    half, drift = times(times(fill(0.5), times(mean, mean)), power), times(mean, z)
    up = plus(load(cusum, 2 * j, 0), over(minus(drift, half), var))
    down = plus(load(cusum, 2 * j + 1, 0), over(minus(minus(fill(0.0), drift), half), var))
    up, down = higher(up, fill(0.0)), higher(down, fill(0.0))
    store(cusum, 2 * j, 0, up)
    store(cusum, 2 * j + 1, 0, down)
    return higher(up, down)


@Driver
def _cusums(phi: Array, g: Array, model: Models, cusum: Array, out: Array) -> None:
    """The CUSUM of n parameters and of the noise, of phi (T n, 8) and g (T, 8), into out (T (n + 1), 8)."""
    n = phi.shape[0] // g.shape[0]
    k, v, kappa = load(model.numbers, K, 0), load(model.numbers, V, 0), load(model.numbers, KAPPA, 0)
    constant = int(model.numbers[CONSTANT, 0]) if model.slopes.shape[0] > 0 else 0
    for t in range(g.shape[0]):
        score, shift = load(g, t, 0), times(fill(SHIFT), k)
        for j in range(n):
            own = lower(higher(load(phi, t * n + j, 0), fill(-BOUND)), fill(BOUND))
            most = _climb(cusum, j, times(own, score), shift, v, times(own, own))
            if model.slopes.shape[0] > 0:
                a, b = load(model.slopes, 2 * j, 0), load(model.slopes, 2 * j + 1, 0)
                own = plus(times(a, load(phi, t * n + j, 0)), times(b, load(phi, t * n + constant, 0)))
                own = lower(higher(own, fill(-BOUND)), fill(BOUND))
                own = only(own, minus(a, fill(LITTLE)))
                most = higher(_climb(cusum, n + 1 + j, times(own, score), shift, v, times(own, own)), most)
            store(out, t * (n + 1) + j, 0, root(times(fill(2.0), most)))
        z, shift = minus(times(score, score), v), times(fill(SHIFT), v)
        most = _climb(cusum, n, z, shift, kappa, fill(1.0))
        store(out, t * (n + 1) + n, 0, root(times(fill(2.0), most)))
