"""The supremum of F over all dates, near the ends too, with its null distribution by a wild bootstrap.

    F_b = S_b' (A_b - A_b A_T^-1 A_b)^-1 S_b                 S_b, A_b: scores and information of the rows before b
    S*_b = sum_{s <= b} phi_s psi*_s - A_b A_T^-1 sum_s phi_s psi*_s
    psi*_s = +- psi_s;  near the ends +- c_s psi_r / c_r with a random row r      c_s: level of the noise

p is the share of the bootstrapped paths with a larger supremum: of DRAWS, or of those until ABOVE are larger. It is at
least ABOVE / DRAWS then, and below that it is the same number as without stopping early. A covariance that is estimated
from a few rows at the end of a record is useless there, so the tests of `driftfit.judge.statistics.supremum` leave the
ends out. F takes the variance of the noise from the whole record, and random signs keep the variance of every row. Near
the ends the residuals themselves would count the change as noise. Every row there is a date, and about MIDDLE between.

For scores without correlation and records of at least LEAST rows: with fewer rows, random signs represent the tails too
poorly.

Source: Hansen (2000), a fixed-regressor bootstrap; Liu (1988) for signs; Besag and Clifford (1991) for sequential
p-values. Departure: the ends. Eight paths are drawn side by side. Cost: O(DRAWS (N n + MIDDLE n^2)), without
a change a fifth of that.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver, kernel, shared
from driftfit.engine.simd import WIDTH, fill, higher, load, minus, plus, store, times
from driftfit.judge.statistics.noise import HELD
from driftfit.judge.statistics.robust import cholesky

DRAWS, ABOVE = 399, 20
LEAST = 300
MIDDLE, END = 40, 30
"""Dates between the ends, and rows at each end that are all dates."""


SCRAMBLE = np.uint64(0x2545F4914F6CDD1D)


@kernel
def _next(state: Any) -> Any:
    """The next of the random numbers, by xorshift; the high bits of its product with SCRAMBLE are used for signs."""
    state ^= state << np.uint64(13)
    state ^= state >> np.uint64(7)
    state ^= state << np.uint64(17)
    return state


SIGNS = np.where((np.arange(256)[:, None] >> np.arange(WIDTH)) & 1, 1.0, -1.0)
"""The signs that a byte decides, (256, 8)."""


class Dates(NamedTuple):
    """The dates and what F needs at each."""

    rows: Array
    """(m,): rows before each."""
    factors: Array
    """(m, n, n): Cholesky factor of M_b = A_b - A_b A_T^-1 A_b, with reciprocals on the diagonal, 0 if it is flat."""
    shares: Array
    """(m, n, n): A_b A_T^-1."""


@partial(shared, arrays=True)
def _played(X: Array, psi: Array, c: Array, dates: Dates, signs: Array, state: Any, S: Array) -> Any:
    """Eight paths at the dates and, last, at the end, S ((m + 1) n, 8); returns the state of the random numbers."""
    (N, n), m, at = X.shape, dates.rows.shape[0], 0
    drawn = np.empty((1, WIDTH))
    for i in range(n):
        store(S, m * n + i, 0, fill(0.0))
    for t in range(N):
        if at < m and dates.rows[at] == t:
            for i in range(n):
                store(S, at * n + i, 0, load(S, m * n + i, 0))
            at += 1
        state = _next(state)
        signed = times(load(signs, int((state * SCRAMBLE) >> np.uint64(56)), 0), fill(psi[t]))
        if t < END or t >= N - END:
            for l in range(WIDTH):
                state = _next(state)
                r = int((state >> np.uint64(33)) % np.uint64(N))
                drawn[0, l] = psi[r] * c[t] / c[r]
            signed = times(load(signs, int((state * SCRAMBLE) >> np.uint64(56)), 0), load(drawn, 0, 0))
        for i in range(n):
            store(S, m * n + i, 0, plus(load(S, m * n + i, 0), times(fill(X[t, i]), signed)))
    return state


@shared
def _observed(X: Array, psi: Array, inverse: Array, dates: Dates, A: Array, S: Array) -> None:
    """The factors and shares at the dates, and the observed path, eight times, in S; inverse: A_T^-1, A (n, n): 0."""
    (N, n), m, at = X.shape, dates.rows.shape[0], 0
    for i in range(n):
        store(S, m * n + i, 0, fill(0.0))
    for t in range(N):
        if at < m and dates.rows[at] == t:
            share, M = dates.shares[at], dates.factors[at]
            for i in range(n):
                store(S, at * n + i, 0, load(S, m * n + i, 0))
                for j in range(n):
                    share[i, j] = 0.0
                    for l in range(n):
                        share[i, j] += A[i, l] * inverse[l, j]
            for i in range(n):
                for j in range(i + 1):
                    M[i, j] = A[i, j]
                    for l in range(n):
                        M[i, j] -= share[i, l] * A[l, j]
            cholesky(M, n)
            for i in range(n):
                M[i, i] = 1.0 / M[i, i] if M[i, i] > 0.0 else 0.0
            at += 1
        for i in range(n):
            store(S, m * n + i, 0, plus(load(S, m * n + i, 0), fill(X[t, i] * psi[t])))
            for j in range(n):
                A[i, j] += X[t, i] * X[t, j]


@shared
def _largest(dates: Dates, S: Array, z: Array) -> None:
    """The suprema of F of eight paths into row n of z (n + 1, 8)."""
    m, n = dates.rows.shape[0], z.shape[0] - 1
    store(z, n, 0, fill(0.0))
    for b in range(m):
        # S*_b = S_b - A_b A_T^-1 S_T, and its quadratic form F_b
        total = fill(0.0)
        for i in range(n):
            value = load(S, b * n + i, 0)
            for j in range(n):
                value = minus(value, times(fill(dates.shares[b, i, j]), load(S, m * n + j, 0)))
            for j in range(i):
                value = minus(value, times(fill(dates.factors[b, i, j]), load(z, j, 0)))
            value = times(value, fill(dates.factors[b, i, i]))
            store(z, i, 0, value)
            total = plus(total, times(value, value))
        store(z, n, 0, higher(total, load(z, n, 0)))


@Driver
def _p_value(X: Array, psi: Array, c: Array, inverse: Array, dates: Dates, signs: Array, S: Array, z: Array) -> float:
    """The share of the draws; inverse: A_T^-1, S, z: scratch."""
    n = X.shape[1]
    _observed(X, psi, inverse, dates, np.zeros((n, n)), S)
    _largest(dates, S, z)
    found, above = z[n, 0], 0
    state = np.uint64(88172645463325252)
    for first in range(0, DRAWS, WIDTH):
        state = _played(X, psi, c, dates, signs, state, S)
        _largest(dates, S, z)
        # sequential: stop as soon as enough draws exceed the observed supremum
        for draw in range(first, min(first + WIDTH, DRAWS)):
            above += 1 if z[n, draw - first] >= found else 0
            if above == ABOVE:
                return above / (draw + 1)
    return (above + 1) / (DRAWS + 1)


def wild_supremum(X: Array, residual: Array, level: Array) -> float:
    """p-value of one break at any date of rows X (N, n); NaN for too few of them.

    residual (N,): of constants; it is limited to three levels of the noise (N,), which leaves a short change more
    weight than the bound of the other tests does.
    """
    N, n = X.shape
    if N < LEAST:
        return float("nan")
    psi, edge = np.clip(residual, -HELD * level, HELD * level), np.arange(n + 2, END + n)
    rows = np.unique(np.concatenate([edge, np.linspace(END + n, N - END - n, MIDDLE).astype(int), N - edge]))
    m, inverse = len(rows), np.ascontiguousarray(np.linalg.inv(X.T @ X))
    dates, scratch = Dates(rows, *np.empty((2, m, n, n))), (np.empty(((m + 1) * n, WIDTH)), np.empty((n + 1, WIDTH)))
    return float(_p_value(np.ascontiguousarray(X), psi, level, inverse, dates, SIGNS, *scratch))
