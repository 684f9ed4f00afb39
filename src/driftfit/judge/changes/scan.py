"""The best one and two breaks of a regression in autoregressive noise, and Nyblom's statistic, compiled.

    y_t = x_t' theta + sum over breaks b of x_t' delta_b [t >= b] + v_t,    v_t = sum a_l v_(t-l) + e_t / g_t
    Z, z = rows and outputs times g after whitening,  D_b = the same of x_t [t >= b],  A = Z' Z,  r = residuals of Z
    gain of breaks b, c, ..  =  s' M^-1 s,   s_b = D_b' r,   M_bc = D_b' D_c - D_b' Z A^-1 Z' D_c

A row of the first p after a break holds the lags of both segments. D_b differs from Z in these rows only, so that
D_b' D_c = Z' D_c for b < c at least p rows apart, and the matrices B_b = Z' D_b, Q_b = D_b' D_b give every set of
breaks exactly. Every number of breaks has its own autoregression: breaks and coefficients of the noise are improved in
turn, once from the noise of constants and once from white noise, since each explains the residuals that the other
leaves.

Source: Bai and Perron (1998) for the gain; Cochrane and Orcutt (1949) for the turns; Nyblom (1989), Hansen (1992).
Cost: O(N n^2) and O(c^2 n^3) for c cells, ten times in correlated noise.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array, Driver, shared
from driftfit.judge.changes.constants import (
    SINGULAR,
    SMALL,
    Found,
    Problem,
    Work,
    autoregression,
    constants,
    settle,
    whiten,
)
from driftfit.judge.statistics.robust import cholesky

CELLS = 32
"""Cells between which pairs of breaks are compared."""
PLACES = 400
"""Places at which a single break is compared, at most."""


@shared
def invert(work: Work) -> None:
    """The inverse of A from its factor G, and the residuals r."""
    n, N = work.theta.shape[0], work.Z.shape[0]
    for c in range(n):
        for i in range(n):
            total = 1.0 if i == c else 0.0
            for k in range(i):
                total -= work.G[i, k] * work.inverse[k, c]
            work.inverse[i, c] = total / work.G[i, i] if work.G[i, i] > 0.0 else 0.0
        for i in range(n - 1, -1, -1):
            total = work.inverse[i, c]
            for k in range(i + 1, n):
                total -= work.G[k, i] * work.inverse[k, c]
            work.inverse[i, c] = total / work.G[i, i] if work.G[i, i] > 0.0 else 0.0
    for t in range(N):
        work.r[t] = work.Z[t, n]
        for j in range(n):
            work.r[t] -= work.Z[t, j] * work.theta[j]


@shared
def later(X: Array, problem: Problem, a: Array, t: int, first: int, row: Array) -> None:
    """Row t of D_b, b = first."""
    for j in range(X.shape[1]):
        value = X[t, j]
        for i in range(a.shape[0]):
            if t - problem.lags[i] >= first:
                value -= a[i] * X[t - problem.lags[i], j]
        row[j] = value * problem.g[t]


@shared
def increments(X: Array, problem: Problem, a: Array, work: Work) -> None:
    """B, U = A^-1 B, Q less B' U, and s of every place, from the last to the first."""
    N, n, p = X.shape[0], X.shape[1], a.shape[0]
    order = problem.lags[p - 1] if p > 0 else 0
    R, end = work.R, N
    for i in range(n):
        work.sums[i] = 0.0
        for j in range(n):
            R[i, j] = 0.0
    for f in range(problem.places.shape[0] - 1, -1, -1):
        first = problem.places[f]
        whole = min(max(first + order, order), N)
        for t in range(whole, end):
            for i in range(n):
                work.sums[i] += work.Z[t, i] * work.r[t]
                for j in range(i + 1):
                    R[i, j] += work.Z[t, i] * work.Z[t, j]
        end = whole
        for i in range(n):
            work.s[f, i] = work.sums[i]
            for j in range(n):
                work.B[f, i, j] = work.Q[f, i, j] = R[max(i, j), min(i, j)]
        for t in range(max(first, order), whole):
            later(X, problem, a, t, first, work.row)
            for i in range(n):
                work.s[f, i] += work.row[i] * work.r[t]
                for j in range(n):
                    work.B[f, i, j] += work.Z[t, i] * work.row[j]
                    work.Q[f, i, j] += work.row[i] * work.row[j]
        for i in range(n):
            for j in range(n):
                total = 0.0
                for k in range(n):
                    total += work.inverse[i, k] * work.B[f, k, j]
                work.U[f, i, j] = total
        for i in range(n):
            for j in range(n):
                for k in range(n):
                    work.Q[f, i, j] -= work.B[f, k, i] * work.U[f, k, j]


@shared
def factored(M: Array, k: int, least: float) -> float:
    """The factor of M (k + 1, k + 1), in place, whose last row is s; returns s' M^-1 s. Directions below ``least`` are
    left out."""
    found = 0.0
    for j in range(k):
        pivot = M[j, j]
        for i in range(j):
            pivot -= M[j, i] * M[j, i]
        root = np.sqrt(pivot) if pivot > least else 0.0
        M[j, j] = root
        for r in range(j + 1, k + 1):
            total = M[r, j]
            for i in range(j):
                total -= M[r, i] * M[j, i]
            M[r, j] = total / root if root > 0.0 else 0.0
        found += M[k, j] * M[k, j]
    return found


@shared
def alone(work: Work, b: int, least: float) -> float:
    """What a break at place b explains; its factor stays in M."""
    n = work.row.shape[0]
    for i in range(n):
        work.M[n, i] = work.s[b, i]
        for j in range(i + 1):
            work.M[i, j] = work.Q[b, i, j]
    return factored(work.M, n, least)  # type: ignore[no-any-return]


@shared
def beside(work: Work, b: int, c: int, least: float) -> float:
    """What a break at c explains beside that at b < c, whose factor is in M; its own goes to G, and what ties the two
    to R."""
    n, M, G, R = work.row.shape[0], work.M, work.G, work.R
    for j in range(n):
        for i in range(n):
            total = work.B[c, i, j]
            for k in range(n):
                total -= work.U[b, k, i] * work.B[c, k, j]
            for k in range(i):
                total -= M[i, k] * R[k, j]
            R[i, j] = total / M[i, i] if M[i, i] > 0.0 else 0.0
    for i in range(n):
        total = work.s[c, i]
        for k in range(n):
            total -= R[k, i] * M[n, k]
        G[n, i] = total
        for j in range(i + 1):
            total = work.Q[c, i, j]
            for k in range(n):
                total -= R[k, i] * R[k, j]
            G[i, j] = total
    return factored(G, n, least)  # type: ignore[no-any-return]


@shared
def least_information(work: Work) -> float:
    """Information that counts as none."""
    most = 0.0
    for i in range(work.row.shape[0]):
        total = 0.0
        for t in range(work.Z.shape[0]):
            total += work.Z[t, i] * work.Z[t, i]
        most = max(most, total)
    return SINGULAR * most


@shared
def room(problem: Problem, N: int, b: int, c: int) -> bool:
    """Whether segments between places b < c are long enough."""
    fewest, first, last = problem.sizes[1], problem.places[b], problem.places[c]
    return first >= fewest and N - last >= fewest and (b == c or last - first >= fewest)


@shared
def best(problem: Problem, count: int, N: int, work: Work) -> float:
    """What the best one or two breaks explain, and their places in ``at``; negative where there is no room.

    Two are compared at the bounds of cells, and then moved to the best places within a cell, one after the other.
    """
    stride, F, most, at = problem.sizes[0], problem.places.shape[0], -1.0, work.at
    least = least_information(work)
    for b in range(0, F, 1 if count == 1 else stride):
        if not room(problem, N, b, b):
            continue
        first = alone(work, b, least)
        if count == 1:
            if first > most:
                most = first
                at[0] = b
            continue
        for c in range(b + stride, F, stride):
            if room(problem, N, b, c):
                value = first + beside(work, b, c, least)
                if value > most:
                    most = value
                    at[0] = b
                    at[1] = c
    if count == 1 or most < 0.0:
        return most
    for moved in (1, 0, 1, 0):
        old, other = at[moved], at[1 - moved]
        for f in range(max(old - stride, 0), min(old + stride + 1, F)):
            b, c = (other, f) if moved == 1 else (f, other)
            if b < c and room(problem, N, b, c):
                value = alone(work, b, least) + beside(work, b, c, least)
                if value > most:
                    most = value
                    at[moved] = f
    return most


@shared
def residuals(X: Array, y: Array, problem: Problem, count: int, work: Work) -> None:
    """v (N,) of the segments between the places ``at``."""
    N, n = X.shape
    at, M, G, R, least = work.at, work.M, work.G, work.R, least_information(work)
    alone(work, at[0], least)
    if count == 2:
        beside(work, at[0], at[1], least)
        for i in range(n - 1, -1, -1):
            total = G[n, i]
            for j in range(i + 1, n):
                total -= G[j, i] * work.delta[n + j]
            work.delta[n + i] = total / G[i, i] if G[i, i] > 0.0 else 0.0
    for i in range(n - 1, -1, -1):
        total = M[n, i]
        if count == 2:
            for j in range(n):
                total -= R[i, j] * work.delta[n + j]
        for j in range(i + 1, n):
            total -= M[j, i] * work.delta[j]
        work.delta[i] = total / M[i, i] if M[i, i] > 0.0 else 0.0
    for i in range(n):
        work.row[i] = work.theta[i]
        for b in range(count):
            for j in range(n):
                work.row[i] -= work.U[at[b], i, j] * work.delta[b * n + j]
    for t in range(N):
        work.v[t] = y[t]
        for i in range(n):
            value = work.row[i]
            for b in range(count):
                if t >= problem.places[at[b]]:
                    value += work.delta[b * n + i]
            work.v[t] -= X[t, i] * value


@shared
def prepare(X: Array, y: Array, problem: Problem, a: Array, work: Work) -> float:
    """All that `gain` needs, for the noise a; returns the sum of squares of constants."""
    whiten(X, y, problem.g, problem.lags, a, work.Z)
    rss: float = constants(work.Z, work.G, work.theta)
    invert(work)
    increments(X, problem, a, work)
    return rss


@shared
def keep(rss: float, count: int, at: Array, a: Array, found: Found) -> None:
    """Remember breaks that are better than those found before."""
    if rss < found.rss[count]:
        found.rss[count] = rss
        for b in range(count):
            found.at[count, b] = at[b]
        for i in range(a.shape[0]):
            found.ar[count, i] = a[i]


@shared
def nyblom(problem: Problem, work: Work, L: Array) -> None:
    """L = sum S_t' V^-1 S_t / N of all scores, V their moments, and sum (w' S_t)^2 / (N w' V w) of every path w."""
    N, n = work.Z.shape[0], work.theta.shape[0]
    for k in range(L.shape[0]):
        L[k] = 0.0
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for t in range(N):
                total += work.Z[t, i] * work.Z[t, j] * work.r[t] * work.r[t]
            work.R[i, j] = work.R[j, i] = total
    for k in range(1, L.shape[0]):
        for i in range(n):
            for j in range(n):
                L[k] += problem.paths[k - 1, i] * problem.paths[k - 1, j] * work.R[i, j]
        L[k] = -max(L[k], SMALL)  # the denominator, until the sum is known
    for i in range(n):
        work.sums[i] = 0.0
        work.delta[i] = 0.0
        work.G[i, i] = work.R[i, i] + SINGULAR * work.R[i, i] + SMALL
        for j in range(i):
            work.G[i, j] = work.R[i, j]
    cholesky(work.G, n)
    for k in range(1, L.shape[0]):
        for i in range(n):
            work.row[i] = 0.0
        total = 0.0
        for t in range(N):
            value = 0.0
            for i in range(n):
                work.row[i] += work.Z[t, i] * work.r[t]
                value += problem.paths[k - 1, i] * work.row[i]
            total += value * value
        L[k] = -total / (N * L[k])
    for t in range(N):
        for i in range(n):
            work.sums[i] += work.Z[t, i] * work.r[t]
        for i in range(n):
            value = work.sums[i]
            for j in range(i):
                value -= work.G[i, j] * work.delta[j]
            work.delta[i] = value / work.G[i, i] if work.G[i, i] > 0.0 else 0.0
            L[0] += work.delta[i] * work.delta[i] / N


@shared
def search(X: Array, y: Array, problem: Problem, work: Work, found: Found) -> None:
    """Everything of one record: constants, Nyblom's statistics, the best one and two breaks."""
    N, n = X.shape
    p, a = found.ar.shape[1], work.a
    for count in range(3):
        found.rss[count] = np.inf
    for i in range(p):
        a[i] = 0.0
    found.rss[0] = max(settle(X, y, problem, problem.sizes[2], a, work), problem.floor[0])
    for i in range(n):
        found.theta[i] = work.theta[i]
    for i in range(p):
        found.ar[0, i] = a[i]
    invert(work)
    nyblom(problem, work, found.L)
    for start in range(2 if p > 0 else 1):
        for count in range(1, problem.sizes[3] + 1):
            for turn in range(2 if p > 0 else 1):
                if turn == 0:
                    for i in range(p):
                        a[i] = found.ar[0, i] if start == 0 else 0.0
                if turn > 0 or count == 1 or p > 0:
                    rss = prepare(X, y, problem, a, work)
                value = best(problem, count, N, work)
                if value < 0.0:
                    break
                keep(max(rss - value, problem.floor[0]), count, work.at, a, found)
                if turn == 0 and p > 0:
                    residuals(X, y, problem, count, work)
                    autoregression(work.v, problem.g, problem.lags, work.H, a)


def _once(X: Array, y: Array, problem: Problem, work: Work, found: Found) -> None:
    search(X, y, problem, work, found)


def _prepared(X: Array, y: Array, problem: Problem, a: Array, work: Work, rss: Array) -> None:
    rss[0] = prepare(X, y, problem, a, work)


searched, prepared = Driver(_once), Driver(_prepared)
