"""The breaks of a record in correlated noise: the autoregression is estimated again for each set that is compared.

    N log sigma^2(breaks),   sigma^2 = min over a, theta of segments of mean (v_t - sum_k a_k v_(t-k))^2
    v_t = y_t - phi_t' theta_(segment of t)

Jumps of the coefficients and correlation of the noise explain the same residuals. `driftfit.judge.statistics.noise`
alternates between the two, and stays with the explanation that it began with. Here it proposes breaks, beginning with
little, with much and with intermediate correlation. Of the proposed breaks, single ones and neighbouring pairs are
removed while log sigma^2 with a new autoregression increases by less than the thresholds of
`driftfit.judge.segments.thresholds`; what remains is dated again. The p rows after a break, which contain coefficients
of two segments, are used here: in correlated noise they contain a large part of the information on a break.

A removal is compared on the rows between the neighbours of what is removed. Their products of v at the lags of a are
added to those of the rest of the record.

Source: Chakar, Lebarbier, Levy-Leduc and Robin (2017) for the model. Cost: O(N (n^2 + p)) per round of removals.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver
from driftfit.judge.segments.thresholds import thresholds
from driftfit.judge.statistics.break_dates import add, dated, whiten
from driftfit.judge.statistics.noise import Noise, Search, whitened
from driftfit.judge.statistics.partition import partition
from driftfit.judge.statistics.robust import cholesky, deviation, solved

PROPOSED = 0.5
"""Breaks are proposed at this share of the threshold of one."""
STEPS = 100
REACH = 12
LEVEL = 0.95
SPREAD = 1.36
"""Variance of the logarithm of a median absolute value, times the number of Gaussian values."""
REFITS = 2


def _products(X: Array, y: Array, ar: Array, breaks: Array, lags: Array, C: Array) -> None:
    """Sums of v_(t-i) v_(t-j), rows from p on, i and j in ``lags`` (m,): lower triangle of C (m, m).

    theta of the segments between ``breaks`` is the least-squares one given a.
    """
    N, n, p, K = X.shape[0], X.shape[1], ar.shape[0], breaks.shape[0] + 1
    M, row, theta = np.zeros((K * n + 1, K * n + 1)), np.zeros(K * n + 1), np.zeros(K * n)
    for t in range(p, N):
        whiten(X, y, ar, t, breaks, row)
        add(M, row, 1.0)
    cholesky(M, K * n)
    solved(M, theta)
    v, k = np.zeros(N), 0
    for t in range(N):
        while k < K - 1 and t >= breaks[k]:
            k += 1
        v[t] = y[t]
        for i in range(n):
            v[t] -= X[t, i] * theta[k * n + i]
    for t in range(p, N):
        for i in range(lags.shape[0]):
            for j in range(i + 1):
                C[i, j] += v[t - lags[i]] * v[t - lags[j]]


_run = Driver(_products)


class _State(NamedTuple):
    """Sum of squares, autoregression (p,), and products of v of a set of breaks."""

    rss: float
    ar: Array
    C: Array


class _Kept(NamedTuple):
    """Breaks, their autoregression, and N log sigma^2 with a price of the breaks."""

    total: float
    breaks: list[int]
    ar: Array


class _Record:
    """Rows in units of the noise level, and the lags of the autoregression."""

    def __init__(self, X: Array, y: Array, lags: Array, least: int) -> None:
        self.X, self.y, self.least = np.ascontiguousarray(X), np.ascontiguousarray(y), least
        self.lags, self.p = np.concatenate([[0], lags]), int(lags[-1])

    def products(self, a: int, b: int, breaks: list[int], ar: Array) -> Array:
        """Products of v at pairs of lags over the rows a .. b, (m, m)."""
        C = np.zeros((len(self.lags), len(self.lags)))
        if b - a > self.p:
            _run(self.X[a:b], self.y[a:b], ar, np.array(breaks, np.int64) - a, self.lags, C)
        return C + np.tril(C, -1).T

    def minimum(self, C: Array) -> tuple[float, Array]:
        """Least sum of squares of v_t - sum a_k v_(t-k), and a (p,)."""
        found = np.linalg.lstsq(C[1:, 1:], C[1:, 0], rcond=1e-10)[0]
        ar = np.zeros(self.p)
        ar[self.lags[1:] - 1] = found
        return float(C[0, 0] - C[0, 1:] @ found), ar

    def state(self, breaks: list[int], ar: Array) -> _State:
        ar = np.concatenate([ar, np.zeros(self.p - len(ar))])
        for _ in range(REFITS):
            C = self.products(0, len(self.y), breaks, ar)
            rss, ar = self.minimum(C)
        return _State(rss, ar, C)

    def change(self, edges: list[int], added: tuple[int, ...], removed: int, now: _State) -> float:
        """Increase of N log sigma^2 if the segment that begins at edges[0] is divided at ``added``.

        ``removed`` breaks after edges[0] are removed first. Only the rows up to the break that follows are compared.
        """
        a, b, N = edges[0], edges[removed + 1], len(self.y)
        own, ar = self.products(a, b, edges[1 : removed + 1], now.ar), now.ar
        rest = now.C - own
        for _ in range(REFITS):
            after, ar = self.minimum(rest + self.products(a, b, list(added), ar))
        return float(N * np.log(after / now.rss)) if after > 0.0 and now.rss > 0.0 else 0.0

    def dated(self, breaks: list[int], now: _State) -> list[int]:
        if len(breaks) > REACH:
            return breaks  # their dates hardly depend on which others there are
        size = np.sqrt(now.rss / len(self.y))
        return dated(self.X / size, self.y / size, now.ar, breaks, self.least, LEVEL)[0]

    def improved(self, breaks: list[int], ar: Array, candidates: list[int], one: float, two: float) -> _Kept:
        """Add and remove breaks while that is more likely.

        A pair is added if it gains ``two`` and no single break gains ``one``. A single one is removed if it loses less
        than two - one, so that a break never comes back.
        """
        for _ in range(STEPS):
            now = self.state(breaks, ar)
            breaks = self.dated(breaks, now)
            now = self.state(breaks, now.ar)
            ar, edges = now.ar, [0, *breaks, len(self.y)]
            options = [
                (self.change(edges[k:], (), count, now) - price, breaks[:k] + breaks[k + count :])
                for count, price in ((1, two - one), (2, two))
                for k in range(len(breaks) - count + 1)
            ]
            for count, price in ((1, one), (2, two)):
                if min(options, default=(0.0,))[0] < 0.0:
                    break
                options = [
                    (self.change(edges[k:], added, 0, now) + price, breaks[:k] + list(added) + breaks[k:])
                    for k in range(len(edges) - 1)
                    for added in self.places(candidates, edges[k], edges[k + 1], count)
                ]
            best = min(options, default=(0.0, breaks))
            if best[0] >= 0.0:
                break
            breaks = best[1]
        pairs, single = divmod(len(breaks), 2)
        return _Kept(len(self.y) * np.log(now.rss) + two * pairs + one * single, breaks, ar)

    def places(self, candidates: list[int], a: int, b: int, count: int) -> list[tuple[int, ...]]:
        """``count`` candidates in a .. b that leave segments long enough; pairs are at most REACH candidates apart."""
        inside = [c for c in candidates if self.least <= c - a and self.least <= b - c]
        if count == 1:
            return [(c,) for c in inside]
        return [(c, d) for i, c in enumerate(inside) for d in inside[i + 1 : i + 1 + REACH] if d - c >= self.least]


def _level(search: Search, found: Noise) -> Array:
    """c (N,): level of the noise, from white residuals, and constant unless windows differ by more than chance.

    The level of correlated noise within a window varies far more than that of as many independent values. A season
    longer than the windows leaves none of them whole.
    """
    starts, ends = search.spans
    w = whitened(search.Q[:, :0], found.near, found.ar)[1][len(found.ar) :]
    overall = deviation(found.near)
    if starts[-1] >= len(w):
        return np.full(len(search.c), overall)
    sizes = np.array([deviation(w[a : max(b - len(found.ar), a + 1)]) for a, b in zip(starts, ends, strict=True)])
    if len(sizes) < 3 or not (sizes > 0.0).all():
        return np.full(len(search.c), overall)
    level = np.log(sizes)
    chance = SPREAD / (ends[0] - starts[0])
    share = max(0.0, 1.0 - 1.5 * chance / max(float(np.var(level)), chance))
    centre = float(np.median(level))
    around: Array = np.interp(np.arange(len(search.c)), 0.5 * (starts + ends), level) - centre
    found_level: Array = overall * np.exp(share * around)
    return found_level


def jointly(search: Search, found: Noise, others: tuple[Array, ...], quiet: float) -> Noise:
    """The breaks and the noise found, or those of the exact likelihood; ``others``: autoregressions to begin with."""
    if not len(found.ar):
        return found
    starts = (found.ar, *others)
    lags = np.unique(np.concatenate([np.flatnonzero(a) for a in starts])) + 1
    N, n = search.Q.shape
    search = search._replace(c=_level(search, found))
    X, z = search.Q / search.c[:, None], found.held / search.c
    record = _Record(X, z, lags, search.least)
    candidates = set(found.breaks.tolist())
    one, two = thresholds(N, n, search.least, quiet, tuple(found.ar))
    for ar in starts:
        rows, values = whitened(X, z, ar)
        size = search.size(found.near, ar)
        proposed = partition(rows / size, values / size, search.grid, PROPOSED * one, search.least, len(ar))
        state = record.state(proposed.tolist(), ar)
        candidates |= set(record.dated(proposed.tolist(), state))
    begin = [found.breaks.tolist()]
    if begin[0] and len(candidates) <= REACH:  # with many breaks, nearly all of those found remain
        begin.append([])
    best = min(
        (record.improved(breaks, found.ar, sorted(candidates), one, two) for breaks in begin),
        key=lambda one: one.total,
    )
    return search.described(np.array(best.breaks, np.int64), whitened(X, z, best.ar)[0], best.ar)
