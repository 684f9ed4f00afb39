"""Tests for a date, or an interval, at which a score path changed too much: suprema of Wald-type statistics.

    Q(a, b) = (S_b - S_a)' Var(S_b - S_a)^-1 (S_b - S_a)          chi-square with n degrees of freedom for constants
    one break      c = max over b of Q(0, b)                      the path is tied at both ends: before b against after
    an interval    c = max over a < b of Q(a, b)                  within against outside

    P(max Q > c) = P(chi2_n > c) sum kappa_b,  or  sum kappa_a kappa_b,      kappa = x nu(sqrt(2 x)),  x = c (1 - rho)

rho is the correlation of Q's Gaussian vector with that of the next position, from the covariance of the path, so the
null distribution is that of the record. nu corrects for the distance between positions: kappa is 1 if neighbours are
independent, which is Bonferroni's bound, and less if they are correlated. The mean square of a path (Nyblom and Hansen)
averages a short change away; the supremum does not, and grows with the square of its size.

Source: Andrews (1993) for the supremum; Siegmund (1985), Yao (1993) for its tail on a grid. Departures: covariances
of the record instead of those of a stationary one. Cost: O(m^2 n^3) for m positions.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy

from driftfit.engine.kernel import Array, Driver, shared
from driftfit.engine.simd import WIDTH, fill, load, minus, only, over, plus, store, times
from driftfit.judge.statistics.robust import cholesky_of_eight

TIED = 1e-9
"""A variance below this share of the largest of the path is rounding."""


class Path(NamedTuple):
    """A path of n components at m + 1 positions, the first of them 0, in columns with room for a vector (W in all)."""

    S: Array
    """(n, W)"""
    cov: Array
    """Cov(S_ai, S_bj) in row n i + j and column a W + b, (n n, (m + 1) W)."""
    var: Array
    """Var(S_b), (n n, W)."""
    step: Array
    """Var(S_b - S_(b-1)), (n n, W)."""

    @classmethod
    def of(cls, S: Array, cov: Array) -> Path:
        """The path S (m, n) with its covariance (m, n, m, n)."""
        (m, n), W = S.shape, len(S) + 1 + WIDTH
        path, full = np.zeros((n, W)), np.zeros((n, n, m + 1, W))
        path[:, 1 : m + 1], full[:, :, 1:, 1 : m + 1] = S.T, cov.transpose(1, 3, 0, 2)
        at = np.arange(m + 1)
        var, step = np.zeros((2, n, n, W))
        var[:, :, at] = full[:, :, at, at]
        both = full[:, :, at[:-1], at[1:]]
        step[:, :, at[1:]] = var[:, :, at[1:]] + var[:, :, at[:-1]] - both - both.swapaxes(0, 1)
        return cls(path, full.reshape(n * n, -1), var.reshape(n * n, W), step.reshape(n * n, W))


@shared
def _changes(path: Path, a: int, b: int, M: Array) -> None:
    """[Var(S_b - S_a), S_b - S_a] of the positions b .. b + 7, entry (i, j) in row (n + 1) i + j.

    A component whose change has no variance (a regressor of the fit ties the path to zero there) does not count: the
    quotient would be that of two rounding errors.
    """
    S, cov, var, _ = path
    n, W = S.shape
    k = n + 1
    for i in range(n):
        for j in range(i + 1):
            both = plus(load(cov, n * i + j, a * W + b), load(cov, n * j + i, a * W + b))
            alone = plus(load(var, n * i + j, b), fill(var[n * i + j, a]))
            store(M, k * i + j, 0, minus(alone, both))
        store(M, k * n + i, 0, minus(load(S, i, b), fill(S[i, a])))
    store(M, k * n + n, 0, fill(0.0))
    for i in range(n):
        largest = 0.0
        for t in range(W):
            largest = max(largest, var[n * i + i, t])
        some = minus(load(M, k * i + i, 0), fill(TIED * largest))
        for j in range(k):
            row = k * max(i, j) + min(i, j)
            store(M, row, 0, only(load(M, row, 0), some))


@shared
def _share(M: Array, z: Array, step: Array, at: int, each: bool) -> None:
    """The trace of Var(S_b - S_a)^-1 times the variance of a step, into the last row of z (n + 1, 8).

    ``each``: the steps to the positions at .. at + 7; otherwise that to ``at``.
    """
    n = z.shape[0] - 1
    k, total = n + 1, fill(0.0)
    for j in range(n):
        for i in range(n):
            value = load(step, n * i + j, at) if each else fill(step[n * i + j, at])
            for l in range(i):
                value = minus(value, times(load(M, k * i + l, 0), load(z, l, 0)))
            store(z, i, 0, only(over(value, load(M, k * i + i, 0)), load(M, k * i + i, 0)))
        for i in range(n - 1, j - 1, -1):
            value = load(z, i, 0)
            for l in range(i + 1, n):
                value = minus(value, times(load(M, k * l + i, 0), load(z, l, 0)))
            store(z, i, 0, only(over(value, load(M, k * i + i, 0)), load(M, k * i + i, 0)))
        total = plus(total, load(z, j, 0))
    store(z, n, 0, total)


@Driver
def _scan(path: Path, Q: Array, left: Array, right: Array, M: Array, z: Array) -> None:
    """Q, and 1 - rho if a or b moves by one position, (m + 1, W) each, valid for b > a; M, z: scratch."""
    n, m = path.S.shape[0], Q.shape[0] - 1
    half = fill(0.5 / n)
    for a in range(m):
        for b in range(a + 1, m + 1, WIDTH):
            _changes(path, a, b, M)
            cholesky_of_eight(M, n)
            total = fill(0.0)
            for i in range(n):
                total = plus(total, times(load(M, (n + 1) * n + i, 0), load(M, (n + 1) * n + i, 0)))
            store(Q, a, b, total)
            _share(M, z, path.step, a + 1, False)
            store(left, a, b, times(half, load(z, n, 0)))
            _share(M, z, path.step, b, True)
            store(right, a, b, times(half, load(z, n, 0)))


def scanned(S: Array, cov: Array) -> tuple[Array, Array, Array]:
    """Q, and 1 - rho if a or b moves by one position, (m + 1, m + 1) each for b > a, of a path S (m, n)."""
    m, n = S.shape
    found = np.zeros((3, m + 1, m + 1 + WIDTH))
    _scan(Path.of(S, cov), *found, np.zeros(((n + 1) ** 2, WIDTH)), np.zeros((n + 1, WIDTH)))
    Q, left, right = found[:, :, : m + 1]
    return Q, left, right


def suprema(S: Array, cov: Array, rows: Array, least: int, apart: bool) -> tuple[float, float]:
    """p-values of one break, and of an interval, for the path S (m, n) with covariance (m, n, m, n).

    ``rows`` (m,): rows up to each position, the last being all rows; ``least``: rows on each side, and in an interval
    and outside it. ``apart``: the covariance belongs to other residuals than those of the path. Then Q of an interval
    of k rows is Hotelling's T^2, which is far from chi-square for small k, and (k - (n + 3) / 2) log(1 + Q / k) is used
    (Bartlett, 1938). For the same residuals Q is at most k.
    """
    m, n = S.shape
    Q, left, right = scanned(S, cov)
    at = np.concatenate([[0], rows])
    length = at[None, :] - at[:, None]
    allowed = (length >= least) & (length <= rows[-1] - least)
    if apart:
        k = np.maximum(np.minimum(length, rows[-1] - length), least)
        Q = (k - 0.5 * (n + 3)) * np.log1p(Q / k)
    single, double = allowed.copy(), allowed
    single[1:] = False
    double[0] = double[:, m] = False
    single[:, m] = False
    return _tail(Q[single], n, right[single]), _tail(Q[double], n, left[double], right[double])


def _tail(Q: Array, n: int, *moved: Array) -> float:
    """P(max Q > its largest) for chi-squares with 1 - rho = moved between neighbours."""
    if not Q.size:
        return float("nan")
    c = float(Q.max())
    places = np.ones(len(Q))
    for one in moved:
        places *= _kappa(c * np.minimum(one, 1.0))
    return float(min(1.0, scipy.special.gammaincc(0.5 * n, 0.5 * c) * max(1.0, places.sum())))


def _kappa(x: Array) -> Array:
    """x nu(sqrt(2 x))."""
    half = np.sqrt(np.maximum(x, 1e-12) / 2.0)
    density = np.exp(-0.5 * half * half) / np.sqrt(2.0 * np.pi)
    above = scipy.special.ndtr(half)
    nu = (above - 0.5) / half / (half * above + density)
    kappa: Array = np.minimum(1.0, np.maximum(x, 0.0) * nu)
    return kappa


def together(mean: float, *suprema: float) -> float:
    """Combine tests of one record into one p-value, however they depend on each other: Liu and Xie (2020).

    The mean square has half of the weight, and the suprema share the rest. p-values above one half count as one half:
    those of suprema are bounds without meaning there.
    """
    weights = (0.5, *[0.5 / len(suprema)] * len(suprema))
    known = [(w, min(max(p, 1e-12), 0.5)) for w, p in zip(weights, (mean, *suprema), strict=True) if math.isfinite(p)]
    if not known:
        return float("nan")
    # tan loses the small p-values
    total = sum(w * (1.0 / (p * math.pi) if p < 1e-6 else math.tan((0.5 - p) * math.pi)) for w, p in known)
    total /= sum(w for w, _ in known)
    return 1.0 / (total * math.pi) if total > 1e6 else 0.5 - math.atan(total) / math.pi
