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

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.changes.fit import MOST, estimated, noise_of, order_of, regressed, split, white_rows
from driftfit.judge.changes.null import DRAWS, Draws, Model, Tested, price
from driftfit.judge.changes.recursion import searched
from driftfit.judge.changes.scan import SINGULAR
from driftfit.judge.statistics.robust import SMALL, orthonormal

LEVEL = 0.95
"""Share of the likelihood in the interval of a date."""
SHARE = 5.0
"""A further break has the level of the test divided by this."""
SWEEPS = 4
RANK = 1e-12
"""Smallest singular value that counts, as a share of the largest."""
LEVERAGE = 0.1
"""Smallest share of a residual that its own row is taken to leave."""


def profile(model: Model, ar: Array, breaks: Array, k: int, gap: int) -> tuple[Array, Array, Array]:
    """Break k at every place (m,) up to its neighbours, less ``gap`` rows: the places, the sums of squares (m,) of the
    segments beside it, and their parameters (m, 2, n) in the basis. Rows of two segments have the lags of both."""
    X, lags, g = model.X, model.noise.lags, model.noise.g
    (N, n), first = X.shape, order_of(lags)
    low, high = breaks[k - 1] if k else 0, breaks[k + 1] if k + 1 < len(breaks) else N
    place = np.union1d(np.arange(low + gap, high - gap + 1), breaks[k])
    Z = np.column_stack(white_rows(X[low:high], model.y[low:high], lags, ar, g[low:high]))
    sums = np.cumsum(np.concatenate([np.zeros((1, n + 1, n + 1)), Z[:, :, None] * Z[:, None, :]]), axis=0)
    at, G = place - low - first, np.zeros((len(place), 2 * n + 1, 2 * n + 1))
    for side, own in ((slice(0, n), sums[at]), (slice(n, 2 * n), sums[-1] - sums[at + first])):
        G[:, side, side], G[:, -1, side] = own[:, :n, :n], own[:, n, :n]
        G[:, -1, -1] += own[:, n, n]
    for i in range(first):
        t = place + i
        later = X[t] - sum(a * X[t - lag] for lag, a in zip(lags, ar, strict=True) if lag <= i)
        later *= g[t, None]
        row = np.hstack([Z[at + i, :n] - later, later, Z[at + i, n:]])
        G += row[:, :, None] * row[:, None, :]
    least = SINGULAR * float(np.sum((X * g[:, None]) ** 2, axis=0).max()) + SMALL
    theta = np.linalg.solve(G[:, :-1, :-1] + least * np.eye(2 * n), G[:, -1, :-1, None])[..., 0]
    rss = G[:, -1, -1] - np.sum(G[:, -1, :-1] * theta, axis=1)
    return place, np.maximum(rss, model.floor), theta.reshape(len(place), 2, n)


def settled(model: Model, ar: Array, breaks: Array, gap: int) -> Array:
    """Dates, each the best given its neighbours."""
    breaks = breaks.copy()
    for _ in range(SWEEPS):
        before = breaks.copy()
        for k in range(len(breaks)):
            place, rss, _ = profile(model, ar, breaks, k, gap)
            breaks[k] = place[int(np.argmin(rss))]
        if (breaks == before).all():
            break
    return breaks


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
    K, needed = 0, np.maximum([*prices, sum(prices)], 0.0)
    while (pays := gain[K + 1 :][: len(needed)] - gain[K] > needed[: len(gain) - K - 1]).any():
        K += int(np.argmax(pays)) + 1
    return K


def counted(model: Model, test: Tested, draws: Draws, level: float) -> tuple[Array, Array, tuple[float, float]]:
    """(breaks, autoregression, prices), given that constants are rejected."""
    noise, N = model.noise, len(model.y)
    most = max(2, min(MOST, N // noise.fewest - 1))
    found, _ = searched(model.X, model.y, draws.problem._replace(sizes=np.array([noise.fewest, most])))
    room = int(np.isfinite(found.rss).sum())
    gain = N * np.log(found.rss[0] / found.rss[:room])
    first = min(1 if test.p_each[:2].min() <= test.p_each[2] else 2, room - 1)

    def number(drawn: Array) -> tuple[int, tuple[float, float]]:
        """The number and its prices, from gains (R, 2) in draws of constants."""
        one, two = (price(each, level / SHARE) for each in drawn.T)
        return stepwise(gain, (one, two)) or first, (one, two)

    dynamic, more = len(noise.lags) or len(model.lags.columns), DRAWS[-1] - len(test.gains)
    if not dynamic and more > 0:
        test = test._replace(gains=np.vstack([test.gains, draws.gains(*draws.constants, more)]))
    K, prices = number(test.gains)
    if K and dynamic:  # changes made the dynamics of constants too slow
        breaks, ar = found.at[K, :K], found.ar[K]
        theta, _ = estimated(model.X, model.y, (noise.lags, ar, noise.g), breaks)
        mean = model.basis @ (np.diff(np.concatenate([[0], breaks, [N]])) / N @ theta)
        if draws.root(mean, ar) < 1.0:
            K, prices = number(draws.gains(mean, ar, DRAWS[-1]))
    return found.at[K, :K], found.ar[K], prices


def shortest_interval(weight: Array, level: float) -> tuple[int, int]:
    """First and last place of the shortest interval with this share of the weights (m,)."""
    total = np.concatenate([[0.0], np.cumsum(weight / weight.sum())])
    last = np.searchsorted(total, total[:-1] + level * (1.0 - 1e-12))
    inside = np.flatnonzero(last < len(total))
    best = inside[np.argmin(last[inside] - inside)] if len(inside) else 0
    return int(best), int(min(last[best], len(weight)) - 1)


def dated(
    model: Model, breaks: Array, ar: Array, prices: tuple[float, float], level: float = LEVEL, final: bool = False
) -> Dated:
    """Dates at full resolution, unless they are ``final``, with their intervals, and the parameters of segments."""
    X, y, noise = model.X, model.y, model.noise
    N, n = X.shape
    K, first = len(breaks), order_of(noise.lags)
    gap, spans = noise.fewest, np.zeros((K, 2), np.int64)
    moved = np.zeros((K + 1, n))
    for _ in range(0 if final or not K else 2 if len(ar) else 1):
        breaks = settled(model, ar, breaks, gap)
        if len(ar):
            theta, _ = estimated(X, y, (noise.lags, ar, noise.g), breaks)
            ar = regressed(noise_of(X, y, theta, breaks), noise.g, noise.lags)
    parts = (noise.lags, ar, noise.g)
    whole = estimated(X, y, parts, breaks)[1] if K else 0.0
    for k in range(K):
        place, rss, theta = profile(model, ar, breaks, k, max(n + 1, first + 1, 3))
        rss += max(whole - rss[place == breaks[k]][0], 0.0)
        loglik = -0.5 * max(N - (K + 1) * n - first, 5) * np.log(rss / rss.min())
        weight = np.exp(loglik) / np.exp(loglik).sum()
        inside = place[list(shortest_interval(weight, level))]
        spans[k] = min(inside[0], breaks[k]), max(inside[1], breaks[k])
        theta = theta @ model.basis.T
        moved[k : k + 2] += np.einsum("m,mkj->kj", weight, (theta - np.einsum("m,mkj->kj", weight, theta)) ** 2)
    found = []
    for k, (start, stop) in enumerate(pairwise([0, *breaks, N]) if K else ()):  # rows that certainly belong to it
        sure = spans[k - 1, 1] if k else 0, spans[k, 0] if k < K else N
        low, high = sure if sure[1] - sure[0] > n else (start, stop)  # or all of a segment that has too few of them
        found.append(informed(model.phi[low:high]))
    later = zip(np.split(split(X, breaks), K + 1, axis=1)[1:], found[1:], strict=True)
    rows = np.hstack([X, *(part @ _projector(model, directions) for part, (_, directions) in later)])
    theta, left = estimated(X, y, parts, breaks, rows)
    std = _errors(model, rows, parts, moved)
    for k, (unknown, _) in enumerate(found):
        std[k, unknown] = np.inf
    return Dated(breaks, spans, theta @ model.basis.T, std, moved, ar, left, prices)


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


COMPONENT = 1e-6
"""Smallest component, in units of the regressors, that a direction has in a parameter."""


def informed(phi: Array) -> tuple[Array, Array]:
    """Which parameters (n,) have a component in a direction that rows phi (N, n) do not vary in, and the directions
    (r, n) of the coefficients of the combinations that they do vary in."""
    basis = orthonormal(phi)
    size, directions = np.linalg.svd(basis.R)[1:]
    rank = int(np.sum(size > basis.negligible))
    return np.linalg.norm(directions[rank:], axis=0) > COMPONENT, directions[:rank] * basis.size


def _projector(model: Model, directions: Array) -> Array:
    """The projector (n, n), in the basis, on changes of what rows of these directions determine."""
    if len(directions) == model.X.shape[1]:
        return np.eye(model.X.shape[1])
    scale = orthonormal(model.phi).size
    own = np.linalg.qr((directions / scale).T)[0]
    Q = np.linalg.qr(np.linalg.solve(model.basis, own / scale[:, None]))[0]
    return np.asarray(Q @ Q.T)
