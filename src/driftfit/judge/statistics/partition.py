"""The optimal partition of a record into segments with different coefficients, exactly, by dynamic programming.

    F(t) = min over s of  F(s) + C(s, t) + penalty,     C(s, t) = least sum of squares of the rows s .. t

C comes from a Cholesky factor of [phi, y]' [phi, y], summed block by block from s on, without differences of large
sums. For p rows after a break, rows whitened by an autoregression of order p belong to two segments; each of these rows
counts as one, whatever its value is.

A start s with F(s) + C(s, t) - p >= F(t) can never be the last break of a longer record and is dropped (as soon as
segments from t on are long enough to be allowed), so that the cost is O(T) if breaks occur regularly, and O(T^2) in the
number of blocks if there are none. Breaks can only be between blocks. Source: Killick, Fearnhead and Eckley (2012),
PELT.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver, shared
from driftfit.judge.statistics.robust import cholesky


def _sum(phi: Array, y: Array, ends: Array, p: Array, G: Array) -> None:
    """[phi, y]' [phi, y] of the blocks of rows that end at ``ends`` (m,), lower triangles: G (2, m, n + 1, n + 1).

    G[0] is the sum over all rows, G[1] that over the rows after the first p.
    """
    n = phi.shape[1]
    start = 0
    for b in range(ends.shape[0]):
        for t in range(start, ends[b]):
            for later in range(2 if t - start >= p[0] else 1):
                for i in range(n):
                    for j in range(i + 1):
                        G[later, b, i, j] += phi[t, i] * phi[t, j]
                    G[later, b, n, i] += phi[t, i] * y[t]
                G[later, b, n, n] += y[t] * y[t]
        start = ends[b]


@shared
def _cost(G: Array, ends: Array, s: int, t: int, p: int, total: Array, seen: Array, M: Array) -> float:
    """C(s, t), with one for each row after a break that belongs to two segments.

    The blocks up to t that are new are added to total[s] (k, k); seen[s] (2,) is up to where they have been, and the
    number of those rows.
    """
    k = M.shape[0]
    start = ends[s - 1] if s > 0 else 0
    for b in range(seen[s, 0], t):
        begin = ends[b - 1] if b > 0 else 0
        free = 0 if s == 0 else p - (begin - start)
        if free <= 0 or begin == start:
            block = G[1 if free > 0 else 0, b]
            for i in range(k):
                for j in range(i + 1):
                    total[s, i, j] += block[i, j]
            seen[s, 1] += max(0, min(free, ends[b] - begin))
        else:
            seen[s, 1] += ends[b] - begin
    seen[s, 0] = t
    for i in range(k):
        for j in range(i + 1):
            M[i, j] = total[s, i, j]
    return cholesky(M, k - 1) + seen[s, 1]  # type: ignore[no-any-return]


class Space(NamedTuple):
    """Scratch space, allocated outside of compiled code, in which an allocation takes seconds to compile."""

    total: Array
    """Sums of the blocks of every segment, (m, k, k)."""
    M: Array
    """Sums of the blocks of one segment, (k, k)."""
    seen: Array
    """See `_cost`, (m, 2)."""
    alive: Array
    """Starts that can be the last break, (m,)."""
    expired: Array
    """The end at which a start ceased to be one, or -1, (m,)."""
    value: Array
    """The total with each start, at the end where it was computed last, (m,)."""

    @classmethod
    def of(cls, m: int, k: int) -> Space:
        """Scratch space for m blocks of k columns."""
        seen = np.zeros((m, 2), np.int64)
        seen[:, 0] = np.arange(m)
        alive, expired, value = np.zeros(m, np.int64), np.full(m, -1), np.full(m, -np.inf)
        return cls(np.zeros((m, k, k)), np.zeros((k, k)), seen, alive, expired, value)


def _partition(G: Array, ends: Array, penalty: float, least: int, p: int, F: Array, last: Array, space: Space) -> None:
    """F (m + 1,), and the start of the last segment of the first t blocks, last (m + 1,).

    The cost of a segment never falls as it grows, so its value at an earlier end is a bound, and where that exceeds
    the best total so far it is not computed again.
    """
    total, M, seen, alive, expired, value = space
    count, chosen = 0, -1
    F[0] = -penalty
    for t in range(1, G.shape[1] + 1):
        end = ends[t - 1]
        if abs(F[t - 1]) < np.inf:
            alive[count] = t - 1
            count += 1
        best, bound = np.inf, np.inf
        if chosen >= 0:
            bound = value[chosen] = F[chosen] + _cost(G, ends, chosen, t, p, total, seen, M)
        for a in range(count):
            s = alive[a]
            start = ends[s - 1] if s > 0 else 0
            if end - start >= least and value[s] <= bound:
                if seen[s, 0] < t:
                    value[s] = F[s] + _cost(G, ends, s, t, p, total, seen, M)
                if value[s] < best:
                    best, bound, chosen = value[s], min(value[s], bound), s
        F[t] = best + penalty
        last[t] = chosen if best < np.inf else -1
        kept = 0
        for a in range(count):
            s = alive[a]
            if expired[s] < 0 and value[s] - p >= F[t]:
                expired[s] = end
            if expired[s] < 0 or end - expired[s] < least:
                alive[kept] = s
                kept += 1
        count = kept


_blocks = Driver(_sum)
_best = Driver(_partition)


def partition(phi: Array, y: Array, ends: Array, penalty: float, least: int, p: int = 0) -> Array:
    """First rows of the segments after the first, of y (N,) on phi (N, n), both in units of the noise.

    ``ends`` (m,) of whole numbers, the last of them N: where a segment may end. ``least``: rows in a segment. ``p``:
    order of the autoregression that made the rows white.
    """
    m, k = len(ends), phi.shape[1] + 1
    G, F, last = np.zeros((2, m, k, k)), np.empty(m + 1), np.zeros(m + 1, np.int64)
    ends, order = np.ascontiguousarray(ends, np.int64), np.array([p])
    _blocks(phi, y, ends, order, G)
    _best(G, ends, float(penalty), int(least), int(p), F, last, Space.of(m, k))
    breaks, t = [], m
    while last[t] > 0:
        t = int(last[t])
        breaks.append(int(ends[t - 1]))
    return np.array(breaks[::-1], np.int64)
