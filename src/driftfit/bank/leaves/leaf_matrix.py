"""Leaves of the hypothesis tree: the columns of one matrix, and their mixture.

A leaf is one history of events with its Gaussian N(m, C) and its weight. The rows of a column are

    log w, w, nu, S, code, age, code of sensors, code of changes, m (n), C (lower triangle), output lags

nu and S are those of the inverse gamma distribution of the noise variance if that is unknown; C is then in its units.
Codes contain the newest events as digits of a number, for the reduction. Histories are in a table of their own
(`driftfit.bank.machine.ancestry`). Leaves are adjacent along the last axis, over which loops are vectorised.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.bank.layout import tables
from driftfit.engine.kernel import Array, kernel, log, part, shared, sized
from driftfit.engine.simd import (
    WIDTH,
    exp_of,
    fill,
    load,
    minus,
    only,
    over,
    plus,
    reaches,
    row_sums,
    store,
    sum_of,
    times,
)

LOG, WEIGHT, NU, S, CODE, AGE, SENSORS, CHANGES, FIRST = range(9)
"""Rows of a leaf; the mean begins at FIRST."""


@shared
def normalise(B: Array, L: int) -> float:
    """Weights from their logarithms, with zeros after the last; returns the log of their sum, NaN if no leaf is
    possible.
    """
    top = -np.inf
    for l in range(L):
        top = B[LOG, l] if B[LOG, l] > top else top
    if not abs(top) < np.inf:
        return np.nan
    store(B, LOG, L, fill(-np.inf))
    sums = fill(0.0)
    for l in range(0, L, WIDTH):
        far = minus(load(B, LOG, l), fill(top))
        w = times(exp_of(far), reaches(far, fill(-700.0)))
        store(B, WEIGHT, l, w)
        sums = plus(sums, w)
    store(B, WEIGHT, L, fill(0.0))
    mass = sum_of(sums)
    gone = top + log(mass)
    each = 1.0 / mass
    for l in range(0, L, WIDTH):
        store(B, WEIGHT, l, times(load(B, WEIGHT, l), fill(each)))
        store(B, LOG, l, minus(load(B, LOG, l), fill(gone)))
    return float(gone)


@shared
def variance_factor(t: Any, X: Array, row: int, L: int) -> None:
    """The unit of C, in a row of X: 1, or the expected noise variance S / (nu - 2)."""
    B, unknown = t.leaves, t.unknown > 0
    for l in range(0, L, WIDTH):
        ratio = over(load(B, S, l), minus(load(B, NU, l), fill(2.0))) if unknown else fill(1.0)
        store(X, row, l, only(ratio, load(B, WEIGHT, l)))


@sized
def mixture(n: int, t: Any, L: int) -> None:
    """Mean and covariance (lower triangle) of all leaves: sum w m, sum w (C + d d'), d = m - mean."""
    B, X, theta, P = t.leaves, t.from_C, t.theta, t.cov
    variance_factor(t, X, n, L)
    parts, tri = n + 1, n * (n + 1) // 2
    for i in range(n):  # the mean, and d in the first rows of the scratch
        sums = fill(0.0)
        for l in range(0, L, WIDTH):
            sums = plus(sums, times(load(B, WEIGHT, l), load(B, FIRST + i, l)))
        store(X, parts + i, 0, sums)
    for i in range(0, n, WIDTH):
        store(X, parts + i, 0, row_sums(X, parts + i))
    for i in range(n):
        theta[i] = X[parts + (i & -WIDTH), i & (WIDTH - 1)]
        for l in range(0, L, WIDTH):
            store(X, i, l, minus(load(B, FIRST + i, l), fill(theta[i])))
    at = 0
    for i in range(n):  # the covariance, entry by entry of its lower triangle
        for j in range(i + 1):
            sums = fill(0.0)
            for l in range(0, L, WIDTH):
                inner = times(load(B, FIRST + n + at, l), load(X, n, l))
                sums = plus(sums, times(load(B, WEIGHT, l), plus(inner, times(load(X, i, l), load(X, j, l)))))
            store(X, parts + at, 0, sums)
            at += 1
    for at in range(0, tri, WIDTH):
        store(X, parts + at, 0, row_sums(X, parts + at))
    at = 0
    for i in range(n):
        for j in range(i + 1):
            P[i, j] = X[parts + (at & -WIDTH), at & (WIDTH - 1)]
            at += 1


@shared
def priors(t: Any, L: int, expanded: bool) -> None:
    """prior[e, l] = p(next event is e | leaf): one row for all, or the row of the chain for the leaf's last event.

    If histories are ``expanded``, the last event of a leaf is given by probabilities.
    """
    prior, row, P, event, H = t.prior, t.row, t.chain, t.event, len(t.row)
    history = tables(t)[0]
    if t.alike > 0:
        for e in range(H):
            for l in range(L):
                prior[e, l] = row[e]
        return
    for e in range(H):
        for l in range(L):
            prior[e, l] = 0.0
        if expanded:
            for last in range(H):
                if P[last, e] > 0.0:
                    for l in range(L):
                        prior[e, l] += P[last, e] * history[l, last]
        else:
            for l in range(L):
                prior[e, l] = P[event[l], e]


@shared
def later(prior: Array, L: int, P: Array, steps: int, X: Array) -> None:
    """Further steps of the chain of events; X has a row for each of them."""
    H = len(prior)
    for _ in range(steps):
        for e in range(H):
            for l in range(L):
                X[e, l] = 0.0
            for last in range(H):
                for l in range(L):
                    X[e, l] += P[last, e] * prior[last, l]
        for e in range(H):
            for l in range(L):
                prior[e, l] = X[e, l]


@shared
def standstill(prior: Array, a: int, b: int, Hm: int) -> None:
    """The prior when no time passes: sensors keep their shares; all changes except the first have probability 0."""
    for l in range(a, b):
        for j in range(Hm):
            share = 0.0
            for e in range(j, len(prior), Hm):
                share += prior[e, l]
                prior[e, l] = 0.0
            prior[j, l] = share


@shared
def increments(t: Any, time: float, each: float) -> None:
    """Q[i] = lower triangle of the covariance that change i adds in this interval.

    The first change takes ``time``, the others ``each``. Relative walks are in units of r / (mean square of phi_k);
    in the coordinates of the start, `walks` contain them.
    """
    walks, relative, c, Q = t.walks, t.relative_walks, t.c, t.Q
    unit = 1.0 if t.unknown > 0 else t.r
    for i in range(len(walks)):
        span = (time if i == 0 else each) * t.drift[i]
        for k in range(0, walks.shape[1], WIDTH):
            store(Q, i, k, times(load(walks, i, k), fill(span)))
        for k in range(relative.shape[1] if t.framed == 0 else 0):
            if relative[i, k] > 0.0 and c[k] > 0.0:
                Q[i, k * (k + 1) // 2 + k] += relative[i, k] * (unit / c[k]) * span


@kernel
def lag_row(t: Any) -> int:
    """The row of a leaf's newest output lag."""
    return FIRST + t.n + t.n * (t.n + 1) // 2  # type: ignore[no-any-return]


@part
def regressors(n: int, t: Any, B: Array, L: int, copies: int, phi: Array) -> None:
    """The regressor of every leaf: phi, in the first eight columns, or phi + R' d, where leaves have output lags of
    their own, which differ by d from those of the record.
    """
    z, rows, na, lags = t.z, t.lag_rows, t.output_lags, lag_row(t)
    for i in range(n):
        for l in range(0, copies * L if na > 0 else 1, WIDTH):
            store(z, i, l, fill(phi[i]))
        for k in range(na):
            of, own = rows[k, i], rows[k, n]
            for at in range(0, copies * L if of != 0.0 else 0, L):
                for l in range(L):
                    z[i, at + l] += of * (B[lags + k, l] - own)


@part
def spread(C: Array, z: Array, m: Array, L: int, n: int, na: int, g: Array, expected: Array) -> None:
    """g = C z, and the rows h = z' C z and y = z' m of ``expected``, for every leaf; C is a lower triangle."""
    for l in range(0, L, WIDTH):
        h, y, k = fill(0.0), fill(0.0), l if na > 0 else 0
        for i in range(n):
            zi, sums, row = load(z, i, k), fill(0.0), i * (i + 1) // 2
            for j in range(i + 1):
                sums = plus(sums, times(load(C, row + j, l), load(z, j, k)))
            for j in range(i + 1, n):
                sums = plus(sums, times(load(C, j * (j + 1) // 2 + i, l), load(z, j, k)))
            store(g, i, l, sums)
            h = plus(h, times(zi, sums))
            y = plus(y, times(zi, load(m, i, l)))
        store(expected, 0, l, h)
        store(expected, 1, l, y)
