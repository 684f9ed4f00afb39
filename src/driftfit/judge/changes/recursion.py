"""Records that a model of constants draws itself, and what is found in each, compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver, shared, sized
from driftfit.judge.changes.scan import Found, Problem, Work, search, settle


class Recursion(NamedTuple):
    """How a record of a model makes the next one: its lags of the output are those of the drawn outputs."""

    phi: Array
    """(N, n): the regressors, in units of the model."""
    basis: Array
    """(n, n): phi basis is orthonormal."""
    columns: Array
    """(k,): columns of phi that are lags of the output."""
    source: Array
    """(N, k): the row whose output they are; negative where it is none of these rows."""
    ratio: Array
    """(N, k): what they are times that output."""
    theta: Array
    """(n,): constants, in units of the model."""
    ar: Array
    """(p,)"""
    start: Array
    """(N,): noise of the first rows, as many as the autoregression has lags."""
    e: Array
    """(N,): white residuals, whose signs are work."""


@shared
def simulate(way: Recursion, lags: Array, signs: Array, v: Array, phi: Array, y: Array) -> None:
    """Outputs y (N,) and their regressors phi (N, n) of one draw of signs (N,)."""
    N, n = phi.shape
    p, k = lags.shape[0], way.columns.shape[0]
    first = lags[p - 1] if p > 0 else 0
    for t in range(N):
        v[t] = way.start[t] if t < first else way.e[t] * signs[t]
        if t >= first:
            for i in range(p):
                v[t] += way.ar[i] * v[t - lags[i]]
        y[t] = v[t]
        for j in range(n):
            phi[t, j] = way.phi[t, j]
        for i in range(k):
            if way.source[t, i] >= 0:
                phi[t, way.columns[i]] = way.ratio[t, i] * y[way.source[t, i]]
        for j in range(n):
            y[t] += phi[t, j] * way.theta[j]


@sized
def turned(n: int, phi: Array, basis: Array, X: Array) -> None:
    """X (N, n) = phi basis."""
    for t in range(phi.shape[0]):
        for j in range(n):
            X[t, j] = 0.0
            for i in range(n):
                X[t, j] += phi[t, i] * basis[i, j]


class Results(NamedTuple):
    """What is found in R draws; sums of squares, Nyblom's statistic, or constants and their autoregressions."""

    rss: Array
    """(R, 3)"""
    L: Array
    """(R,)"""
    theta: Array
    """(R, n), in the basis, less those that were drawn from."""
    ar: Array
    """(R, p)"""


@Driver
def draw(
    way: Recursion, signs: Array, problem: Problem, whole: int, work: Work, found: Found, results: Results
) -> None:
    """Results of all draws of signs (R, N); only constants and their autoregression unless ``whole``.

    Without draws, the record in ``work`` is searched: by the same call, because it takes seconds to compile.
    """
    (N, n), R = work.X.shape, signs.shape[0]
    for d in range(max(R, 1)):
        if R > 0:
            simulate(way, problem.lags, signs[d], work.v, work.phi, work.y)
            turned(n, work.phi, way.basis, work.X)
            for t in range(N):
                work.y[t] = work.v[t]  # without what constants explain, which may be far larger
        if whole > 0:
            search(work.X, work.y, problem, work, found)
            for count in range(3 if R > 0 else 0):
                results.rss[d, count] = found.rss[count]
            if R > 0:
                results.L[d] = found.L[0]
            continue
        for i in range(results.ar.shape[1]):
            results.ar[d, i] = 0.0
        settle(work.X, work.y, problem, results.ar[d], work)
        for j in range(n):
            results.theta[d, j] = work.theta[j]


def searched(X: Array, y: Array, problem: Problem) -> tuple[Found, Work]:
    """What `search` finds in one record."""
    N, n = X.shape
    rows, row, whole = np.zeros((0, 0)), np.zeros(0), np.zeros((0, 0), np.int64)
    found, work = Found.of(n, problem), Work.of(N, n, problem)._replace(X=X, y=y)
    none = Recursion(rows, rows, whole.ravel(), whole, rows, row, row, row, row), Results(rows, row, rows, rows)
    draw(none[0], rows, problem, 1, work, found, none[1])
    return found, work


@Driver
def play(way: Recursion, lags: Array, signs: Array, v: Array, phi: Array, y: Array) -> None:
    simulate(way, lags, signs, v, phi, y)
