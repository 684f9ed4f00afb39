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
from typing import Any, NamedTuple

import numpy as np
import scipy

from driftfit.engine.kernel import Array, Driver, kernel, shared
from driftfit.engine.simd import (
    WIDTH,
    exp_of,
    fill,
    higher,
    load,
    lower,
    minus,
    only,
    over,
    plus,
    reaches,
    root,
    store,
    sum_of,
    times,
)
from driftfit.judge.statistics.robust import cholesky_of_eight

TIED = 1e-9
"""A variance below this share of the largest of the path is rounding."""
ERF = (0.3275911, 0.254829592, -0.284496736, 1.421413741, -1.453152027, 1.061405429)
DENSITY = 1.0 / math.sqrt(2.0 * math.pi)


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


def scanned(S: Array, cov: Array) -> Array:
    """Q, and 1 - rho if a or b moves by one position, (3, m + 1, W), valid for a < b <= m, of a path S (m, n)."""
    m, n = S.shape
    found = np.zeros((3, m + 1, m + 1 + WIDTH))
    _scan(Path.of(S, cov), *found, np.zeros(((n + 1) ** 2, WIDTH)), np.zeros((n + 1, WIDTH)))
    return found


@kernel
def _kappa(x: Any) -> Any:
    """x nu(sqrt(2 x)), at most 1, of each entry; the error function is that of Abramowitz and Stegun, 7.1.26."""
    half = root(times(higher(x, fill(1e-12)), fill(0.5)))
    bell = exp_of(times(fill(-0.5), times(half, half)))
    t = over(fill(1.0), plus(fill(1.0), times(half, fill(ERF[0] / math.sqrt(2.0)))))
    series = times(t, plus(fill(ERF[4]), times(t, fill(ERF[5]))))
    series = times(t, plus(fill(ERF[2]), times(t, plus(fill(ERF[3]), series))))
    inside = times(fill(0.5), minus(fill(1.0), times(times(t, plus(fill(ERF[1]), series)), bell)))
    nu = over(over(inside, half), plus(times(half, plus(fill(0.5), inside)), times(bell, fill(DENSITY))))
    return lower(times(higher(x, fill(0.0)), nu), fill(1.0))


@Driver
def _largest(Q: Array, left: Array, right: Array, at: Array, n: int, least: int, apart: bool, found: Array) -> None:
    """The largest Q of one break and of an interval, -1 without one, and the sum of its kappa: found (2, 2).

    Q of intervals that are not allowed becomes negative.
    """
    m = Q.shape[0] - 1
    found[:, 0] = -1.0
    for a in range(m):
        which = 0 if a == 0 else 1
        for b in range(Q.shape[1]):
            length = at[b] - at[a] if a < b < m else 0
            if length < least or length > at[m] - least:
                Q[a, b] = -1.0
                continue
            if apart:
                k = max(min(length, at[m] - length), least)
                Q[a, b] = (k - 0.5 * (n + 3)) * np.log1p(Q[a, b] / k)
            found[which, 0] = max(found[which, 0], Q[a, b])
    for a in range(m):
        which, total = 0 if a == 0 else 1, fill(0.0)
        c = fill(found[which, 0])
        for b in range(a + 1, m, WIDTH):
            kappa = _kappa(times(c, lower(load(right, a, b), fill(1.0))))
            if which == 1:
                kappa = times(kappa, _kappa(times(c, lower(load(left, a, b), fill(1.0)))))
            total = plus(total, times(kappa, reaches(load(Q, a, b), fill(0.0))))
        found[which, 1] += sum_of(total)


def suprema(S: Array, cov: Array, rows: Array, least: int, apart: bool) -> tuple[float, float]:
    """p-values of one break, and of an interval, for the path S (m, n) with covariance (m, n, m, n).

    ``rows`` (m,): rows up to each position, the last being all rows; ``least``: rows on each side, and in an interval
    and outside it. ``apart``: the covariance belongs to other residuals than those of the path. Then Q of an interval
    of k rows is Hotelling's T^2, which is far from chi-square for small k, and (k - (n + 3) / 2) log(1 + Q / k) is used
    (Bartlett, 1938). For the same residuals Q is at most k.
    """
    n, found = S.shape[1], np.zeros((2, 2))
    _largest(*scanned(S, cov), np.concatenate([[0], rows]), n, least, apart, found)
    single, double = (_chance(c, n, places) for c, places in found.tolist())
    return single, double


def _chance(c: float, n: int, places: float) -> float:
    """P(max Q > c) for chi-squares at so many independent places; NaN if there is none."""
    return float(min(1.0, scipy.special.gammaincc(0.5 * n, 0.5 * c) * max(1.0, places))) if c >= 0.0 else float("nan")


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
