"""Leaves: the columns of one matrix, and what all of them together say.

A leaf is one history of events with its Gaussian N(m, C) and its weight. Leaves lie side by side along the last axis,
which is what the compiler vectorises over; the rows of a column are

    log w, w, nu, S, code, age, code of sensors, code of changes, m (n), C (lower triangle), cleaned output lags

nu and S are those of the inverse gamma distribution of the noise variance where that is unknown, C then in its units.
Codes are the newest events as the digits of a number; what they are for is the reduction's business. What a leaf
remembers of its past floors, for the user and not for the recursion, are marginals of events in a table of their own,
which the children of a leaf share: block k of it has the joint events k floors back, and the probability of no change
since.

Everything here is compiled once for all sizes.
"""

from __future__ import annotations

import numpy as np

from driftfit.kernel import Array, core, exp, kernel, log

LOG, WEIGHT, NU, S, CODE, AGE, SENSORS, CHANGES, FIRST = range(9)
"""Rows of a leaf; the mean begins at FIRST."""


@kernel
def total(x: Array, count: int) -> float:
    """Sum of the first entries in four interleaved parts: a single chain of additions would be the longest part."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    whole = count // 4 * 4
    for l in range(0, whole, 4):
        a += x[l]
        b += x[l + 1]
        c += x[l + 2]
        d += x[l + 3]
    for l in range(whole, count):
        a += x[l]
    return (a + c) + (b + d)


@core
def normalise(B: Array, L: int) -> float:
    """Weights from their logarithms; returns log sum, or NaN where no leaf is possible."""
    top = -np.inf
    for l in range(L):
        top = max(top, B[LOG, l])
    if not abs(top) < np.inf:
        return np.nan
    for l in range(L):
        far = B[LOG, l] - top
        B[WEIGHT, l] = exp(far) if far > -700.0 else 0.0
    mass = total(B[WEIGHT], L)
    gone = top + log(mass)
    each = 1.0 / mass
    for l in range(L):
        B[WEIGHT, l] *= each
        B[LOG, l] -= gone
    return float(gone)


@core
def variance_factor(B: Array, L: int, unknown: bool, out: Array) -> None:
    """What C is in units of: 1, or the expected noise variance S / (nu - 2)."""
    for l in range(L):
        out[l] = B[S, l] / (B[NU, l] - 2.0) if unknown else 1.0


@core
def mixture(B: Array, L: int, n: int, unknown: bool, X: Array, theta: Array, P: Array) -> None:
    """Mean and covariance (lower triangle) of all leaves: sum w m, sum w (C + d d')."""
    C = FIRST + n
    w, factor, part = B[WEIGHT], X[n], X[n + 1]
    variance_factor(B, L, unknown, factor)
    for i in range(n):
        for l in range(L):
            part[l] = w[l] * B[FIRST + i, l]
        theta[i] = total(part, L)
        for l in range(L):
            X[i, l] = B[FIRST + i, l] - theta[i]
    at = C
    for i in range(n):
        for j in range(i + 1):
            for l in range(L):
                part[l] = w[l] * (B[at, l] * factor[l] + X[i, l] * X[j, l])
            P[i, j] = total(part, L)
            at += 1


@core
def priors(
    T: Array, event: Array, expanded: bool, first: bool, same: bool, L: int, P: Array, row: Array, prior: Array
) -> None:
    """prior[e, l] = p(next event is e | leaf): the same row for all, or the row of P for the leaf's last event."""
    H = len(row)
    if first or same:
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
                        prior[e, l] += P[last, e] * T[last, l]
        else:
            for l in range(L):
                prior[e, l] = P[event[l], e]


@core
def standstill(prior: Array, L: int, Hm: int) -> None:
    """No time passes, so nothing changes: the sensors keep their shares, all changes but the first have none."""
    for l in range(L):
        for j in range(Hm):
            share = 0.0
            for e in range(j, len(prior), Hm):
                share += prior[e, l]
                prior[e, l] = 0.0
            prior[j, l] = share


@core
def increments(
    Q: Array, sizes: Array, c: Array, r: float, unknown: bool, time: float, factors: Array, out: Array
) -> None:
    """out[i] = lower triangle of the covariance that change i adds in this interval."""
    n = sizes.shape[1]
    for i in range(len(Q)):
        span = time * factors[i]
        for k in range(Q.shape[1]):
            out[i, k] = Q[i, k] * span
        for k in range(n):
            unit = (1.0 if unknown else r) / c[k] if c[k] > 0.0 else 0.0
            out[i, k * (k + 1) // 2 + k] += sizes[i, k] * unit * span


@core
def regressors(phi: Array, B: Array, L: int, n: int, na: int, Z: Array) -> None:
    """The regressor of every leaf: phi, with the leaf's own output lags where it keeps some."""
    lags = FIRST + n + n * (n + 1) // 2
    for i in range(n):
        if i < na:
            for l in range(L):
                Z[i, l] = B[lags + i, l]
        else:
            for l in range(L):
                Z[i, l] = phi[i]


@core
def spread(C: Array, Z: Array, m: Array, L: int, g: Array, h: Array, y: Array) -> None:
    """g = C z, h = z' C z, y = z' m for every leaf; C is a lower triangle."""
    n = len(Z)
    for l in range(L):
        h[l] = 0.0
        y[l] = 0.0
    for i in range(n):
        for l in range(L):
            g[i, l] = 0.0
        for j in range(n):
            at = i * (i + 1) // 2 + j if j <= i else j * (j + 1) // 2 + i
            for l in range(L):
                g[i, l] += C[at, l] * Z[j, l]
        for l in range(L):
            h[l] += Z[i, l] * g[i, l]
            y[l] += Z[i, l] * m[i, l]


@core
def blur(B: Array, L: int, n: int, prior: Array, Hm: int, Q: Array, C: Array, m: Array, chance: Array) -> None:
    """Mean and covariance of every leaf if any walk may happen and no data come: C + sum p_i Q_i, to be exact."""
    at = FIRST + n
    for i in range(n):
        for l in range(L):
            m[i, l] = B[FIRST + i, l]
    for k in range(n * (n + 1) // 2):
        for l in range(L):
            C[k, l] = B[at + k, l]
    for c in range(len(Q)):
        for l in range(L):
            chance[l] = 0.0
        for j in range(Hm):
            for l in range(L):
                chance[l] += prior[c * Hm + j, l]
        for k in range(n * (n + 1) // 2):
            if Q[c, k] != 0.0:
                for l in range(L):
                    C[k, l] += chance[l] * Q[c, k]
