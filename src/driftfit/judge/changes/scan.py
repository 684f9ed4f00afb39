"""The best partitions of a regression in autoregressive noise, and Nyblom's statistic, compiled.

    y_t = x_t' theta_s + v_t,   v_t = sum a_l v_(t-l) + e_t / g_t         constant theta_s between two breaks
    Z, z = rows and outputs times g after whitening;  cost of rows i .. j = what constants leave of z_i .. z_j on Z

Sums of products of [Z, z] before each row give the cost of any segment. The best
partition with every number of breaks is found on cells (Bai and Perron, 2003, section 3; Jackson et al., 2005), and
each break then moves to the best row within a cell, given its neighbours. Every number of breaks has its own
autoregression: it is estimated from the residuals of a first partition, and a second one is made with it, once from the
noise of constants and once from white noise, since breaks and correlation explain the same residuals. After a break,
lags of the noise are those of the new segment; `driftfit.judge.changes.dates` allows for the old one.

Source: Bai and Perron (1998, 2003); Cochrane and Orcutt (1949) for the turns; Nyblom (1989), Hansen (1992).
Cost: O(N n^2) and O(c^2 n^3) for c cells, four times in correlated noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, shared, sized
from driftfit.judge.statistics.robust import SMALL, eliminate, solved

SINGULAR = 1e-9
"""Information below this share of that of the whole record is none."""
CELLS = 32
"""Cells at whose ends breaks are compared."""
ROUNDS = 5
"""Rounds of constants and their autoregression."""


class Problem(NamedTuple):
    """What stays the same in all draws from a record."""

    g: Array
    """(N,): roots of the weights."""
    lags: Array
    """(p,) of whole numbers, ascending: lags of the autoregression."""
    edges: Array
    """(m + 1,): rows that bound cells, from 0 to N."""
    sizes: Array
    """(2,): fewest rows of a segment; largest number of breaks."""
    floor: Array
    """(1,): smallest sum of squares, that of rounding."""


def problem_of(g: Array, lags: Array, fewest: int, most: int, floor: float = SMALL) -> Problem:
    """The problem of a record with up to ``most`` breaks."""
    cells = min(max(len(g) // 8, 4), CELLS)
    edges = len(g) * np.arange(cells + 1) // cells
    return Problem(g, lags, edges, np.array([fewest, most]), np.array([floor]))


class Work(NamedTuple):
    """Scratch space for N rows of n regressors, m cells, K breaks and p lags."""

    phi: Array
    X: Array
    y: Array
    Z: Array
    v: Array
    C: Array
    """(N + 1, n + 1, n + 1): sums of products of [Z, z] before every row, lower triangles; the first is 0."""
    G: Array
    M: Array
    H: Array
    cost: Array
    best: Array
    theta: Array
    sums: Array
    score: Array
    a: Array
    next: Array
    back: Array
    at: Array

    @classmethod
    def of(cls, N: int, n: int, problem: Problem) -> Work:
        """Empty space for one record."""
        p, K, m, k = len(problem.lags), int(problem.sizes[1]), len(problem.edges), n + 1
        shapes = (
            (N, n), (N, n), (N,), (N, k), (N,), (N + 1, k, k), (k, k), (k, k), (p + 1, p + 1), (m, m),
            (K + 1, m), (n,), (n,), (n,), (p,), (K + 1, p),
        )  # fmt: skip
        return cls._make([*map(np.zeros, shapes), np.zeros((K + 1, m), np.int64), np.zeros(K, np.int64)])


class Found(NamedTuple):
    """What `search` fills in for one record, for 0 .. K breaks."""

    rss: Array
    """(K + 1,): sums of squares; inf where there is no room."""
    at: Array
    """(K + 1, K): the rows at which they are."""
    ar: Array
    """(K + 1, p): their autoregressions."""
    theta: Array
    """(n,): constants."""
    L: Array
    """(1,): Nyblom's statistic."""

    @classmethod
    def of(cls, n: int, problem: Problem) -> Found:
        """Nothing found yet."""
        p, K = len(problem.lags), int(problem.sizes[1])
        at = np.zeros((K + 1, K), np.int64)
        return cls(np.full(K + 1, np.inf), at, np.zeros((K + 1, p)), np.zeros(n), np.zeros(1))


@sized
def whiten(n: int, X: Array, y: Array, g: Array, lags: Array, a: Array, Z: Array) -> None:
    """Z (N, n + 1): rows and outputs after whitening, times g; the rows before the last lag are 0."""
    N, p = X.shape[0], lags.shape[0]
    first = lags[p - 1] if p > 0 else 0
    for t in range(N):
        for j in range(n + 1):
            Z[t, j] = 0.0 if t < first else X[t, j] if j < n else y[t]
        for i in range(p if t >= first else 0):
            before = t - lags[i]
            for j in range(n):
                Z[t, j] -= a[i] * X[before, j]
            Z[t, n] -= a[i] * y[before]
        for j in range(n + 1):
            Z[t, j] *= g[t]


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
    eliminate(H, p, 0.0)
    solved(H, a)


@shared
def remainder(X: Array, y: Array, first: int, last: int, work: Work) -> None:
    """v: what theta leaves of rows first .. last - 1."""
    for t in range(first, last):
        work.v[t] = y[t]
        for j in range(X.shape[1]):
            work.v[t] -= X[t, j] * work.theta[j]


@sized
def cumulate(n: int, Z: Array, C: Array) -> None:
    """C: sums of products of the rows of Z (N, n + 1) before every row."""
    for t in range(Z.shape[0]):
        for i in range(n + 1):
            for j in range(i + 1):
                C[t + 1, i, j] = C[t, i, j] + Z[t, i] * Z[t, j]


@sized
def cost(n: int, first: Array, last: Array, G: Array, least: float) -> float:
    """What n constants leave between two places with these sums before them; their factor is left in G. Information up
    to ``least`` is none."""
    for i in range(n + 1):
        for j in range(i + 1):
            G[i, j] = last[i, j] - first[i, j]
    return eliminate(G, n, least)  # type: ignore[no-any-return]


@shared
def settle(X: Array, y: Array, problem: Problem, a: Array, work: Work) -> float:
    """Constants and their autoregression in turn; returns the sum of squares."""
    rss, N, n = 0.0, X.shape[0], X.shape[1]
    for round in range(ROUNDS):
        whiten(n, X, y, problem.g, problem.lags, a, work.Z)
        cumulate(n, work.Z, work.C)
        rss = cost(n, work.C[0], work.C[N], work.G, 0.0)
        solved(work.G, work.theta)
        if a.shape[0] == 0:
            break
        if round < ROUNDS - 1:
            remainder(X, y, 0, N, work)
            autoregression(work.v, problem.g, problem.lags, work.H, a)
    return rss


@shared
def prepare(X: Array, problem: Problem, most: int, work: Work) -> float:
    """The best partitions of `whiten`'s rows on cells with up to ``most`` breaks; returns the information that is none.
    With the last of these only those of the whole record."""
    edges, m, n, least = problem.edges, work.cost.shape[0], X.shape[1], 0.0
    cumulate(n, work.Z, work.C)
    for i in range(n):
        least = max(least, SINGULAR * work.C[X.shape[0], i, i])
    for j in range(1, m):
        for i in range(j):
            used = (most > 1 or i == 0 or j == m - 1) and edges[j] - edges[i] >= problem.sizes[0]
            work.cost[i, j] = cost(n, work.C[edges[i]], work.C[edges[j]], work.G, least) if used else np.inf
        work.best[0, j] = work.cost[0, j]
    for count in range(1, most + 1):
        for j in range(1 if count < most else m - 1, m):
            work.best[count, j] = np.inf
            for i in range(1, j):
                value = work.best[count - 1, i] + work.cost[i, j]
                if value < work.best[count, j]:
                    work.best[count, j] = value
                    work.back[count, j] = i
    return least


@shared
def place(n: int, problem: Problem, count: int, work: Work, least: float) -> float:
    """The rows ``at`` that begin segments of so many breaks, moved within cells; returns the sum of squares, inf
    without room."""
    fewest, edges, at, C, G = problem.sizes[0], problem.edges, work.at, work.C, work.G
    m, N, reach, first, total = work.cost.shape[0] - 1, C.shape[0] - 1, edges[1] + 1, 0, 0.0
    if not work.best[count, m] < np.inf:
        return np.inf
    for k in range(count, 0, -1):
        m = work.back[k, m]
        at[k - 1] = edges[m]
    for move in range(2 * count):
        k = move if move < count else 2 * count - 1 - move
        begin, end = at[k - 1] if k > 0 else 0, at[k + 1] if k + 1 < count else N
        middle, most = at[k], np.inf
        for t in range(max(middle - reach, begin + fewest), min(middle + reach, end - fewest) + 1):
            value = cost(n, C[begin], C[t], G, least) + cost(n, C[t], C[end], G, least)
            if value < most:
                most = value
                at[k] = t
    for k in range(count + 1):
        last = at[k] if k < count else N
        total += cost(n, C[first], C[last], G, least)
        first = last
    return total


@shared
def residuals(X: Array, y: Array, count: int, work: Work, least: float) -> None:
    """v (N,) of the segments between ``at``."""
    first = 0
    for k in range(count + 1):
        last = work.at[k] if k < count else X.shape[0]
        cost(X.shape[1], work.C[first], work.C[last], work.G, least)
        solved(work.G, work.theta)
        remainder(X, y, first, last, work)
        first = last


@shared
def keep(n: int, problem: Problem, count: int, work: Work, a: Array, least: float, found: Found) -> bool:
    """Remember breaks that are better than those found before; whether there is room for any."""
    rss = max(place(n, problem, count, work, least), problem.floor[0])
    if rss < found.rss[count]:
        found.rss[count] = rss
        for b in range(count):
            found.at[count, b] = work.at[b]
        for i in range(a.shape[0]):
            found.ar[count, i] = a[i]
    return rss < np.inf  # type: ignore[no-any-return]


@sized
def sums(n: int, Z: Array, theta: Array, S: Array, score: Array, V: Array, M: Array) -> None:
    """V, M (n, n), lower triangles: moments of the scores of constants theta (n,), and of the sums S (n,) of these."""
    for i in range(n):
        S[i] = 0.0
        for j in range(i + 1):
            V[i, j] = M[i, j] = 0.0
    for t in range(Z.shape[0]):
        r = Z[t, n]
        for j in range(n):
            r -= Z[t, j] * theta[j]
        for i in range(n):
            score[i] = Z[t, i] * r
            S[i] += score[i]
            for j in range(i + 1):
                V[i, j] += score[i] * score[j]
                M[i, j] += S[i] * S[j]


@shared
def nyblom(work: Work) -> float:
    """sum S_t' V^-1 S_t / N of all scores, V their moments."""
    N, n, V, M, score, L = work.Z.shape[0], work.theta.shape[0], work.G, work.M, work.score, 0.0
    sums(n, work.Z, work.theta, work.sums, score, V, M)
    for i in range(n):
        V[i, i] += SINGULAR * V[i, i] + SMALL
    eliminate(V, n, 0.0)
    # the trace of V^-1 M, column by column of M
    for j in range(n):
        for i in range(n):
            V[n, i] = M[i, j] if i >= j else M[j, i]
            for k in range(i):
                V[n, i] -= V[i, k] * V[n, k] * V[k, k]
        solved(V, score)
        L += score[j] / N
    return L


@shared
def search(X: Array, y: Array, problem: Problem, work: Work, found: Found) -> None:
    """Everything of one record: constants, Nyblom's statistic, the best partition with every number of breaks."""
    p, K, a = found.ar.shape[1], problem.sizes[1], work.a
    for count in range(K + 1):
        found.rss[count] = np.inf
    for i in range(p):
        a[i] = 0.0
    found.rss[0] = max(settle(X, y, problem, a, work), problem.floor[0])
    for i in range(X.shape[1]):
        found.theta[i] = work.theta[i]
    for i in range(p):
        found.ar[0, i] = a[i]
    found.L[0] = nyblom(work)
    for start in range(2 if p > 0 else 1):
        for i in range(p):
            a[i] = found.ar[0, i] if start == 0 else 0.0
        if start > 0:
            whiten(X.shape[1], X, y, problem.g, problem.lags, a, work.Z)
        least, room = prepare(X, problem, K, work), K
        for count in range(1, K + 1):
            if not keep(X.shape[1], problem, count, work, a, least, found):
                room = count - 1
                break
            if p > 0:
                residuals(X, y, count, work, least)
                autoregression(work.v, problem.g, problem.lags, work.H, work.next[count])
        for count in range(1, room + 1 if p > 0 else 1):
            whiten(X.shape[1], X, y, problem.g, problem.lags, work.next[count], work.Z)
            least = prepare(X, problem, count, work)
            keep(X.shape[1], problem, count, work, work.next[count], least, found)
