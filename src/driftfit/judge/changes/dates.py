"""How many breaks there are, when, and the parameters between them.

    log L(t) = -(N - q) / 2 log rss(t)        a break at t, the others where they are, q coefficients

The number grows from none while one further break, or a pair, gains more than draws of constants do. Each date is the
most likely one given its neighbours, among all rows between them, and its interval the shortest that holds 95 % of the
likelihood. Parameters are weighted least squares of all rows of a segment, by the rows of
`driftfit.judge.changes.scan`. Their covariance is White's, of residuals over one less their leverage (MacKinnon and
White, 1985), plus what they vary by while a date moves within its likelihood.

Source: Bai and Perron (1998); Yao (1987) for the likelihood of a date; White (1980). Cost: O(N n^2 + N K^3 n^3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.changes.constants import SINGULAR, SMALL, Work
from driftfit.judge.changes.fit import (
    MOST,
    estimated,
    noise_of,
    order_of,
    partitions,
    regressed,
    split,
    white_rows,
)
from driftfit.judge.changes.null import Draws, Model, Tested, gains, price, problem_of, radius
from driftfit.judge.changes.scan import prepared
from driftfit.judge.statistics.robust import orthonormal

LEVEL = 0.95
"""Share of the likelihood in the interval of a date."""
SHARE = 5.0
"""A further break has the level of the test divided by this."""
SWEEPS = 4
DATES = 20_000
"""Places, at most, at which the likelihood of a date is computed."""
RANK = 1e-12
"""Smallest singular value that counts, as a share of the largest."""
LEVERAGE = 0.1
"""Smallest share of a residual that its own row is taken to leave."""
MOVED = 40
"""Dates within an interval, at most, for which the parameters are computed again."""


class Exact:
    """Sums of squares with breaks at any of some places, for one autoregression."""

    def __init__(self, model: Model, places: Array, ar: Array) -> None:
        N, n = model.X.shape
        self.model, self.places, self.ar = model, places, ar
        problem = problem_of(model, np.zeros((0, n)))._replace(places=places)
        self.work, rss = Work.of(N, n, problem), np.zeros(1)
        prepared(model.X, model.y, problem, ar, self.work, rss)
        self.rss, self.theta = float(rss[0]), self.work.theta.copy()
        self.least = SINGULAR * float(np.abs(np.einsum("tj,tj->j", self.work.Z, self.work.Z)[:n]).max()) + SMALL

    def _system(self, at: Array) -> tuple[Array, Array]:
        """M (.., K n, K n) and s (.., K n) of breaks at places at (.., K)."""
        work, n, K = self.work, self.model.X.shape[1], at.shape[-1]
        M = np.zeros((*at.shape[:-1], K, n, K, n))
        for k in range(K):
            M[..., k, :, k, :] = work.Q[at[..., k]]
            for m in range(k + 1, K):
                b, c = at[..., k], at[..., m]
                own = work.B[c] - np.swapaxes(work.B[b], -1, -2) @ work.U[c]
                M[..., k, :, m, :], M[..., m, :, k, :] = own, np.swapaxes(own, -1, -2)
        M = M.reshape(*at.shape[:-1], K * n, K * n)
        return M + self.least * np.eye(K * n), work.s[at].reshape(*at.shape[:-1], K * n)

    def of(self, at: Array) -> Array:
        """Sums of squares (..) with breaks at places at (.., K)."""
        M, s = self._system(at)
        left = self.rss - np.sum(s * np.linalg.solve(M, s[..., None])[..., 0], axis=-1)
        return np.asarray(np.maximum(left, self.model.floor))

    def profile(self, at: Array, k: int, gap: int) -> tuple[int, Array]:
        """The first place, and the sums of squares with break k there and at those after it, up to its neighbours."""
        N, place, work, n = len(self.model.y), self.places, self.work, self.model.X.shape[1]
        low = (place[at[k - 1]] if k else 0) + gap
        high = (place[at[k + 1]] if k + 1 < len(at) else N) - gap
        first, last = (int(one) for one in np.searchsorted(place, [low, high + 1]))
        if last <= first:
            first, last = int(at[k]), int(at[k]) + 1
        own = slice(first, last)
        M, s, taken = work.Q[own] + self.least * np.eye(n), work.s[own], 0.0
        others = np.delete(at, k)
        if len(others):
            A, t = self._system(others)
            ties = np.concatenate([
                work.B[own] - work.U[b].T @ work.B[own] if j < k
                else np.swapaxes(work.B[b] - np.swapaxes(work.B[own], 1, 2) @ work.U[b], 1, 2)
                for j, b in enumerate(others)
            ], axis=1)  # fmt: skip
            solved = np.linalg.solve(A, ties)
            M, s = M - np.swapaxes(ties, 1, 2) @ solved, s - np.swapaxes(solved, 1, 2) @ t
            taken = float(t @ np.linalg.solve(A, t))
        left = self.rss - taken - np.sum(s * np.linalg.solve(M, s[..., None])[..., 0], axis=-1)
        return first, np.asarray(np.maximum(left, self.model.floor))

    def settled(self, at: Array, gap: int) -> Array:
        """Places, each the best given its neighbours."""
        at = at.copy()
        for _ in range(SWEEPS):
            before = at.copy()
            for k in range(len(at)):
                first, rss = self.profile(at, k, gap)
                at[k] = first + int(np.argmin(rss))
            if (at == before).all():
                break
        return at

    def thetas(self, at: Array) -> Array:
        """Parameters of the segments (.., K + 1, n) in the basis."""
        M, s = self._system(at)
        K, n = at.shape[-1], self.model.X.shape[1]
        delta = np.linalg.solve(M, s[..., None]).reshape(*at.shape[:-1], K, n)
        start = self.theta - np.einsum("...kij,...kj->...i", self.work.U[at], delta)
        return np.cumsum(np.concatenate([start[..., None, :], delta], axis=-2), axis=-2)


class Dated(NamedTuple):
    """Segments with constant parameters."""

    breaks: Array
    """(K,): rows that begin a segment."""
    spans: Array
    """(K, 2): first and last row of the interval of each."""
    theta: Array
    """(K + 1, n), in units of the model."""
    std: Array
    """(K + 1, n): standard errors; inf where the rows of a segment do not determine a parameter."""
    moved: Array
    """(K + 1, n): what theta varies by while a date moves, a variance."""
    ar: Array
    """(p,)"""
    rss: float
    prices: tuple[float, float]
    """What a further break, and a pair, must gain."""


def stepwise(gain: Array, prices: tuple[float, float]) -> int:
    """The number of breaks, of gains (K + 1,) of 0 .. K breaks over none: one more, two or three while they pay."""
    K, (one, two) = 0, prices
    needed = (one, two, one + two)
    while True:
        for more, least in enumerate(needed, 1):
            if K + more < len(gain) and gain[K + more] - gain[K] > max(least, 0.0):
                K += more
                break
        else:
            return K


def places_of(N: int) -> Array:
    """Rows at which the likelihood of a date is computed: all of N, or `DATES` of them."""
    return np.arange(N) if N <= DATES else np.linspace(0, N - 1, DATES).astype(np.int64)


Partition = tuple[float, Array, Array]
"""Sum of squares, breaks, autoregression."""


def refined(model: Model, start: Array, breaks: Array) -> Partition:
    """A partition on cells with its own autoregression, and dates that are the best given each other."""
    X, y, lags, g = model.X, model.y, model.noise.lags, model.noise.g
    if len(lags):
        start = regressed(noise_of(X, y, estimated(X, y, (lags, start, g), breaks)[0], breaks), g, lags)
    places = places_of(len(y))
    exact = Exact(model, places, start)
    at = exact.settled(np.minimum(np.searchsorted(places, breaks), len(places) - 1), model.noise.fewest)
    return float(exact.of(at)), places[at], start


def numbered(found: list[Partition], prices: tuple[float, float], N: int, least: int) -> int:
    """The number of breaks that pay, ``least`` or more."""
    gain = N * np.log(found[0][0] / np.array([one[0] for one in found]))
    return stepwise(gain, prices) or min(least, len(found) - 1)


def counted(model: Model, test: Tested, draws: Draws, level: float) -> tuple[Array, Array, tuple[float, float]]:
    """(breaks, autoregression, prices), given that constants are rejected."""
    X, y, noise = model.X, model.y, model.noise
    N = len(y)
    found: list[Partition] = [
        (float(test.rss[k]), test.breaks[k], test.ar[k]) for k in range(3) if np.isfinite(test.rss[k])
    ]
    found[1:] = [min(one, refined(model, one[2], one[1]), key=lambda each: each[0]) for one in found[1:]]
    first = 1 if test.p_each[:2].min() <= test.p_each[2] else 2
    prices = (price(test.gains[:, 0], level / SHARE), price(test.gains[:, 1], level / SHARE))
    most = max(0, min(MOST, N // noise.fewest - 1))
    starts = [test.ar[len(found) - 1], noise.ar] if len(noise.lags) else [noise.ar]
    lists = [partitions(X, y, (noise.lags, start, noise.g), most, noise.fewest) for start in starts]
    for K in range(3, most + 1):
        if len(lists[0]) <= K or numbered(found, prices, N, first) + 3 < K:
            break
        tried = (refined(model, start, own[K]) for start, own in zip(starts, lists, strict=True) if len(own) > K)
        found.append(min(tried, key=lambda one: one[0]))
    K = numbered(found, prices, N, first)
    if K and (len(noise.lags) or len(model.lags.columns)):  # changes made the dynamics of constants too slow
        _, breaks, ar = found[K]
        theta, _ = estimated(X, y, (noise.lags, ar, noise.g), breaks)
        mean = model.basis @ (np.diff(np.concatenate([[0], breaks, [N]])) / N @ theta)
        if max(radius(ar, noise.lags), draws.of_outputs(mean)) < 1.0:
            rss = draws.of(mean, ar, len(test.gains), True).rss
            again = gains(rss[np.isfinite(rss[:, 0])], N)
            prices = (price(again[:, 0], level / SHARE), price(again[:, 1], level / SHARE))
            K = numbered(found, prices, N, first)
    return found[K][1], found[K][2], prices


def shortest_interval(weight: Array, level: float) -> tuple[int, int]:
    """First and last place of the shortest interval with this share of the weights (m,)."""
    total = np.concatenate([[0.0], np.cumsum(weight / weight.sum())])
    last = np.searchsorted(total, total[:-1] + level * (1.0 - 1e-12))
    inside = np.flatnonzero(last < len(total))
    best = inside[np.argmin(last[inside] - inside)] if len(inside) else 0
    return int(best), int(min(last[best], len(weight)) - 1)


def dated(
    model: Model, breaks: Array, ar: Array, prices: tuple[float, float], level: float = LEVEL, settled: bool = False
) -> Dated:
    """Dates at full resolution, unless they are ``settled``, with their intervals, and the parameters of segments."""
    X, y, noise = model.X, model.y, model.noise
    N, n = X.shape
    K, first = len(breaks), order_of(noise.lags)
    gap, spans = noise.fewest, np.zeros((K, 2), np.int64)
    moved = np.zeros((K + 1, n))
    if K:
        places = np.union1d(places_of(N), breaks)
        at = np.searchsorted(places, breaks)
        for _ in range(0 if settled else 2 if len(ar) else 1):
            exact = Exact(model, places, ar)
            at = exact.settled(at, gap)
            if len(ar):
                theta, _ = estimated(X, y, (noise.lags, ar, noise.g), places[at])
                ar = regressed(noise_of(X, y, theta, places[at]), noise.g, noise.lags)
        exact = Exact(model, places, ar)
        breaks = places[at]
        for k in range(K):
            low, rss = exact.profile(at, k, max(n + 1, first + 1, 3))
            loglik = -0.5 * max(N - (K + 1) * n - first, 5) * np.log(rss / rss.min())
            weight = np.exp(loglik) / np.exp(loglik).sum()
            inside = low + np.array(shortest_interval(weight, level))
            spans[k] = places[[min(inside[0], at[k]), max(inside[1], at[k])]]
            moved[k : k + 2] += _moved(exact, at, k, low, weight)[k : k + 2]
    parts = (noise.lags, ar, noise.g)
    edges = [(0, N), *_certain(breaks, spans, N, n)]
    known = [_directions(model, a, b) for a, b in edges]
    rows = np.hstack([part @ one for part, one in zip(np.split(split(X, breaks), K + 1, axis=1), known, strict=True)])
    theta, left = estimated(X, y, parts, breaks, rows)
    std = _errors(model, rows, parts, moved)
    unknown = [
        undetermined(model.phi[a:b]) for a, b in _certain(np.append(0, breaks), np.vstack([[[0, 0]], spans]), N, n)
    ]
    std[np.array(unknown)] = np.inf
    return Dated(breaks, spans, theta @ model.basis.T, std, moved, ar, left, prices)


def _moved(exact: Exact, at: Array, k: int, low: int, weight: Array) -> Array:
    """Variances (K + 1, n) of the parameters while date k moves, in units of the model."""
    likely = np.flatnonzero(weight > 1e-3 * weight.max())
    likely = likely[np.unique(np.linspace(0, len(likely) - 1, min(MOVED, len(likely))).astype(int))]
    many = np.tile(at, (len(likely), 1))
    many[:, k] = low + likely
    theta = exact.thetas(many) @ exact.model.basis.T
    share = weight[likely] / weight[likely].sum()
    mean = np.einsum("m,mkj->kj", share, theta)
    return np.asarray(np.einsum("m,mkj->kj", share, (theta - mean) ** 2))


def covariance(Z: Array, z: Array) -> tuple[Array, Array]:
    """Shortest least squares of z (N,) on Z (N, q); its covariance, from residuals over one less their leverage."""
    inverse = np.linalg.pinv(Z, rcond=RANK)
    beta = inverse @ z
    e = (z - Z @ beta) / np.maximum(1.0 - np.einsum("tj,jt->t", Z, inverse), LEVERAGE)
    return beta, np.asarray((inverse * e**2) @ inverse.T)


def _errors(model: Model, rows: Array, parts: tuple[Array, Array, Array], moved: Array) -> Array:
    """Standard errors of the parameters (K + 1, n), in units of the model."""
    K, n = len(moved) - 1, model.X.shape[1]
    _, V = covariance(*white_rows(rows, model.y, *parts))
    total = np.kron(np.tril(np.ones((K + 1, K + 1))), model.basis)
    own = np.einsum("ij,jk,ik->i", total, V, total).reshape(K + 1, n)
    return np.asarray(np.sqrt(np.maximum(own + moved, 0.0)))


def _certain(starts: Array, spans: Array, N: int, n: int) -> list[tuple[int, int]]:
    """Rows that certainly belong to the segments from ``starts`` on, or all of a segment that has too few of them."""
    found = []
    for k, start in enumerate(starts):
        stop = int(starts[k + 1]) if k + 1 < len(starts) else N
        sure = int(spans[k, 1]), int(spans[k + 1, 0]) if k + 1 < len(starts) else N
        found.append(sure if sure[1] - sure[0] > n else (int(start), stop))
    return found


def _directions(model: Model, first: int, last: int) -> Array:
    """The projector (n, n), in the basis, on changes of what rows first .. last determine."""
    n = model.X.shape[1]
    basis = orthonormal(model.phi[first:last])
    size, directions = np.linalg.svd(basis.R)[1:]
    kept = directions[size > basis.negligible]
    if len(kept) == n:
        return np.eye(n)
    scale = orthonormal(model.phi).size
    own = kept * (basis.size / scale)
    return _projector(np.linalg.solve(model.basis, (np.linalg.qr(own.T)[0]) / scale[:, None]))


def _projector(W: Array) -> Array:
    Q = np.linalg.qr(W)[0]
    return np.asarray(Q @ Q.T)


COMPONENT = 1e-6
"""Smallest component, in units of the regressors, that a direction has in a parameter."""


def undetermined(phi: Array) -> Array:
    """Which parameters (n,) have a component in a direction that rows phi (N, n) do not vary in."""
    basis = orthonormal(phi)
    _, size, directions = np.linalg.svd(basis.R)
    rank = int(np.sum(size > basis.negligible))
    return np.asarray(np.linalg.norm(directions[rank:], axis=0) > COMPONENT)
