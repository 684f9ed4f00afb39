"""The optimal partition of a record into segments with different coefficients, exactly, by dynamic programming.

    F(t) = min over s of  F(s) + C(s, t) + penalty,     C(s, t) = least sum of squares of the rows s .. t

C comes from a Cholesky factor of [phi, y]' [phi, y], summed block by block from s on, without differences of large
sums. For p rows after a break, rows whitened by an autoregression of order p belong to two segments; each of these rows
counts as one, whatever its value is.

Breaks can only be between blocks. Cost: that of adding each block to all segments that contain it, eight starts at a
time, O(m^2 n^2) for m blocks; C itself is computed for those starts that may be best. Source: Jackson et al. (2005).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver, shared
from driftfit.engine.simd import WIDTH, load, plus, store
from driftfit.judge.statistics.robust import cholesky_of_eight


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


class Space(NamedTuple):
    """Scratch space, allocated outside of compiled code, in which an allocation takes seconds to compile.

    Starts are in columns, up to a multiple of eight.
    """

    total: Array
    """Sums of the blocks of the segment that begins at each start, (k k, m): entry (i, j) in row k i + j."""
    M: Array
    """The sums of eight starts, (k k, 8)."""
    rows: Array
    """Rows after each start that belong to two segments, (1, m)."""
    F: Array
    """F of each start, (1, m)."""
    value: Array
    """The total with each start, at the end where it was computed last, (1, m)."""

    @classmethod
    def of(cls, m: int, k: int) -> Space:
        """Scratch space for m blocks of k columns."""
        m += -m % WIDTH
        F, value = np.full((2, 1, m), -np.inf)  # below what they may be, until they are known
        return cls(np.zeros((k * k, m)), np.zeros((k * k, WIDTH)), np.zeros((1, m)), F, value)


@shared
def _extend(G: Array, ends: Array, t: int, p: int, k: int, space: Space) -> None:
    """Add block t - 1 to the segments from every start, the last of which begins with it.

    In a segment after a break, each of its first p rows counts as one, whatever its value is, and so does each row of a
    later block that begins among them.
    """
    begin, settled = ends[t - 2] if t > 1 else 0, t
    while settled > 1 and begin - ends[settled - 2] < p:
        settled -= 1  # starts less than p rows before the block
    for i in range(k):
        for j in range(i + 1):
            block = G[0, t - 1, i, j]
            for s in range(settled):
                space.total[k * i + j, s] += block
    for s in range(settled, t - 1):
        space.rows[0, s] += ends[t - 1] - begin
    if settled < t:
        for i in range(k):
            for j in range(i + 1):
                space.total[k * i + j, t - 1] += G[1, t - 1, i, j]
        space.rows[0, t - 1] += min(p, ends[t - 1] - begin)


@shared
def _costs(space: Space, first: int, k: int) -> None:
    """F(s) + C(s, t) of the eight starts from ``first`` on."""
    total, M, rows, F, value = space
    for i in range(k):
        for j in range(i + 1):
            store(M, k * i + j, 0, load(total, k * i + j, first))
    cholesky_of_eight(M, k - 1)
    cost = plus(load(M, k * k - 1, 0), load(rows, 0, first))
    store(value, 0, first, plus(load(F, 0, first), cost))


def _partition(G: Array, ends: Array, penalty: float, least: int, p: int, F: Array, last: Array, space: Space) -> None:
    """F (m + 1,), and the start of the last segment of the first t blocks, last (m + 1,).

    The cost of a segment never falls as it grows, so its value at an earlier end is a bound, and where that exceeds
    the best total so far it is not computed again.
    """
    k, value = G.shape[2], space.value
    count, chosen = 0, -1
    F[0] = -penalty
    for t in range(1, G.shape[1] + 1):
        space.F[0, t - 1] = F[t - 1]
        _extend(G, ends, t, p, k, space)
        while count < t and ends[t - 1] - (ends[count - 1] if count > 0 else 0) >= least:
            count += 1  # starts of segments that are long enough
        best = np.inf
        if chosen >= 0:
            _costs(space, chosen - chosen % WIDTH, k)
            best = value[0, chosen]
        for first in range(0, count, WIDTH):
            nearest = np.inf
            for s in range(first, min(first + WIDTH, count)):
                nearest = min(nearest, value[0, s])
            if nearest <= best:
                _costs(space, first, k)
                for s in range(first, min(first + WIDTH, count)):
                    if value[0, s] < best:
                        best, chosen = value[0, s], s
        F[t] = best + penalty
        last[t] = chosen if best < np.inf else -1


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
