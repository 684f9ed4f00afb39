"""Constants of a regression and the autoregression of its noise, compiled, and the arrays of a scan.

    y_t = x_t' theta + v_t,    v_t = sum a_l v_(t-l) + e_t / g_t

Source: Cochrane and Orcutt (1949): coefficients and autoregression in turn. Cost: O(N (n^2 + p^2)) a turn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, shared
from driftfit.judge.statistics.robust import cholesky, solved

SINGULAR = 1e-9
"""Information below this share of that of the whole record is none."""
SMALL = 1e-300
"""Added to a diagonal, so that it can be inverted."""


class Problem(NamedTuple):
    """What stays the same in all draws from a record."""

    g: Array
    """(N,): roots of the weights."""
    lags: Array
    """(p,) of whole numbers, ascending: lags of the autoregression."""
    places: Array
    """(F,): where there may be a break; every ``stride`` of them bounds a cell."""
    paths: Array
    """(m, n): combinations of scores for which Nyblom's statistic is returned beside that of all."""
    sizes: Array
    """(4,): stride; fewest rows of a segment; rounds of the fit of constants; largest number of breaks, 1 or 2."""
    floor: Array
    """(1,): smallest sum of squares, that of rounding."""


class Work(NamedTuple):
    """Scratch space for N rows of n regressors, F places and p lags."""

    Z: Array
    v: Array
    r: Array
    G: Array
    inverse: Array
    B: Array
    Q: Array
    U: Array
    s: Array
    M: Array
    H: Array
    R: Array
    row: Array
    theta: Array
    delta: Array
    a: Array
    sums: Array
    at: Array

    @classmethod
    def of(cls, N: int, n: int, problem: Problem) -> Work:
        """Empty space for one record."""
        F, p = len(problem.places), len(problem.lags)
        shapes = (
            (N, n + 1), (N,), (N,), (n + 1, n + 1), (n, n), (F, n, n), (F, n, n), (F, n, n), (F, n),
            (n + 1, n + 1), (p + 1, p + 1), (n, n), (n,), (n,), (2 * n,), (p,), (n + 1,),
        )  # fmt: skip
        return cls._make([*(np.zeros(shape) for shape in shapes), np.zeros(2, np.int64)])


class Found(NamedTuple):
    """What `search` fills in for one record."""

    rss: Array
    """(3,): sum of squares with no, one and two breaks; inf where there is no room."""
    at: Array
    """(3, 2): their places, as indices."""
    ar: Array
    """(3, p): their autoregressions."""
    theta: Array
    """(n,): constants."""
    L: Array
    """(1 + m,): Nyblom's statistics."""

    @classmethod
    def of(cls, n: int, problem: Problem) -> Found:
        """Nothing found yet."""
        p = len(problem.lags)
        L = np.zeros(1 + len(problem.paths))
        return cls(np.full(3, np.inf), np.zeros((3, 2), np.int64), np.zeros((3, p)), np.zeros(n), L)


@shared
def whiten(X: Array, y: Array, g: Array, lags: Array, a: Array, Z: Array) -> None:
    """Z (N, n + 1): rows and outputs after whitening, times g; the rows before the last lag are 0."""
    N, n, p = X.shape[0], X.shape[1], lags.shape[0]
    first = lags[p - 1] if p > 0 else 0
    for t in range(N):
        for j in range(n + 1):
            Z[t, j] = 0.0
        if t < first:
            continue
        for j in range(n):
            value = X[t, j]
            for i in range(p):
                value -= a[i] * X[t - lags[i], j]
            Z[t, j] = value * g[t]
        value = y[t]
        for i in range(p):
            value -= a[i] * y[t - lags[i]]
        Z[t, n] = value * g[t]


@shared
def constants(Z: Array, G: Array, theta: Array) -> float:
    """theta (n,) of least squares of rows Z (N, n + 1); returns the sum of squares and leaves the factor in G."""
    N, n = Z.shape[0], theta.shape[0]
    for i in range(n + 1):
        for j in range(i + 1):
            total = 0.0
            for t in range(N):
                total += Z[t, i] * Z[t, j]
            G[i, j] = total
    rss: float = cholesky(G, n)
    solved(G, theta)
    return rss


@shared
def autoregression(v: Array, g: Array, lags: Array, H: Array, a: Array) -> None:
    """Weighted least squares of v (N,) on its lags: a (p,)."""
    p = lags.shape[0]
    for i in range(p + 1):
        for j in range(i + 1):
            H[i, j] = 0.0
    for t in range(lags[p - 1], v.shape[0]):
        w = g[t] * g[t]
        for i in range(p + 1):
            left = w * (v[t] if i == p else v[t - lags[i]])
            for j in range(i + 1):
                H[i, j] += left * (v[t] if j == p else v[t - lags[j]])
    for i in range(p):
        H[i, i] += SINGULAR * H[i, i] + SMALL
    cholesky(H, p)
    solved(H, a)


@shared
def settle(X: Array, y: Array, problem: Problem, rounds: int, a: Array, work: Work) -> float:
    """Constants and their autoregression in turn; returns the sum of squares."""
    rss = 0.0
    for round in range(rounds):
        whiten(X, y, problem.g, problem.lags, a, work.Z)
        rss = constants(work.Z, work.G, work.theta)
        if a.shape[0] == 0:
            break
        if round < rounds - 1:
            for t in range(X.shape[0]):
                work.v[t] = y[t]
                for j in range(X.shape[1]):
                    work.v[t] -= X[t, j] * work.theta[j]
            autoregression(work.v, problem.g, problem.lags, work.H, a)
    return rss
