"""Segments and their noise, found together: an autoregression, a slowly changing level, and outliers.

    y_t = x_t' theta_s + v_t,   v_t = sum a_l v_(t-l) + c_t e_t,   weight_t = min(1, 3 / |e_t|)^2 / c_t^2

Breaks and correlation explain the same residuals. For each start, the white noise and the correlation of the residuals
of constants, the best partition on cells (Jackson et al., 2005) and the lags of the noise follow each other until they
stay; the pair with the smaller criterion counts. A break costs (n + 2) log N there (Zhang and Siegmund, 2007), a lag
log N, and a lag of a season 2 log of their number more (Chen and Chen, 2008). A gradual change of all parameters, on a
straight line, is tried beside the segments, since an autoregression takes it for noise. Weights limit what a row adds
to the sum of squares, at three levels from the fit of segments. Where residuals clearly grow with a regressor x, the
level is in proportion to sqrt(a + b x^2). Cost: O(N n^2) and O(c^2 n^3) for c cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from driftfit.engine.kernel import Array
from driftfit.judge.changes.recursion import searched
from driftfit.judge.changes.scan import SINGULAR, problem_of
from driftfit.judge.statistics.robust import ROUNDED, SMALL, Fit, deviation, invertible
from driftfit.judge.statistics.whiteness import loudest, ranks

NONE = np.zeros(0, np.int64)
HELD = 3.0
"""Levels of the noise from the fit at which a residual is limited."""
MEDIAN = 1.4826
"""The deviation of a Gaussian over the median of its size."""
FLOOR = 0.01
"""Smallest level of constants, as a share of the deviation of their residuals: half of them may be exact."""
ORDER = 6
"""Largest order of the autoregression; a season may add one further lag."""
SEASON = 24
ROUNDS = 4
CORNERS = 12
"""Cells at whose ends a gradual change may begin or end."""
MOST = 12
"""Largest number of breaks."""
WINDOWS = 12
"""Parts of a record, at most, whose noise may have a level of its own."""


class Noise(NamedTuple):
    """The noise of a record, and the segments that it was found with."""

    lags: Array
    """(p,): lags of the autoregression."""
    ar: Array
    """(p,)"""
    level: Array
    """(N,): standard deviation of white residuals."""
    g: Array
    """(N,): roots of the weights."""
    e: Array
    """(N,): white residuals of the segments or the gradual change, 0 in the first rows."""
    rows: Array
    """(N, q): the regressors of these."""
    fewest: int
    """Rows in the shortest segment that is searched."""
    ranks: Array
    """(N, n): those of the sizes of the regressors."""


def shortest(n: int, lags: Array, given: int | None = None) -> int:
    """Rows in the shortest segment that is searched, of n parameters: max(10, 4 n) unless they are given."""
    return max(max(10, 4 * n) if given is None else given, order_of(lags) + n + 1)


def order_of(lags: Array) -> int:
    """The last lag; 0 if there is none."""
    return int(lags[-1]) if len(lags) else 0


def complete(ok: Array, lags: Array) -> Array:
    """Indices of the rows that are ``ok`` (N,), as are all their lags."""
    at = np.flatnonzero(ok)
    at = at[at >= order_of(lags)]
    return np.asarray(at[ok[at[:, None] - lags].all(axis=1)])


def white_rows(X: Array, y: Array, lags: Array, ar: Array, g: Array) -> tuple[Array, Array]:
    """Rows X (N, ..) and outputs after whitening, times g (N,), without the first rows."""
    Z, z, first = X.copy(), y.copy(), order_of(lags)
    for lag, a in zip(lags, ar, strict=True):
        Z[lag:] -= a * X[:-lag]
        z[lag:] -= a * y[:-lag]
    return Z[first:] * g[first:, None], z[first:] * g[first:]


def split(X: Array, breaks: Array) -> Array:
    """Rows (N, (K + 1) n) of theta of the first segment and of what each break adds."""
    t = np.arange(len(X))[:, None]
    return np.hstack([X, *(X * (t >= b) for b in breaks)])


def coefficients(Z: Array, z: Array, share: Array | float = ROUNDED) -> Array:
    """Least squares (q,) of z (N,) on columns Z (N, q)."""
    return np.linalg.solve(invertible(Z.T @ Z, share), Z.T @ z)


def estimated(
    X: Array, y: Array, noise: tuple[Array, Array, Array], breaks: Array, rows: Array | None = None
) -> tuple[Array, float]:
    """theta of the segments (K + 1, n) and the sum of squares, for noise of (lags, ar, g).

    What the rows of a segment do not determine stays as in the one before; ``rows`` instead of those of `split`.
    """
    Z, z = white_rows(split(X, breaks) if rows is None else rows, y, *noise)
    n, K = X.shape[1], len(breaks)
    ridge = np.append(np.full(n, ROUNDED), np.full(K * n, SINGULAR))
    beta = coefficients(Z, z, ridge)
    r = z - Z @ beta
    return np.cumsum(beta.reshape(K + 1, n), axis=0), float(r @ r)


def left(Z: Array, z: Array, floor: float = SMALL) -> float:
    """Sum of squares of z (N,) that columns Z (N, q) do not explain, beyond rounding."""
    r = z - Z @ coefficients(Z, z)
    return max(float(r @ r), floor)


def noise_of(X: Array, y: Array, theta: Array, breaks: Array) -> Array:
    """v (N,): residuals of segments."""
    part = np.searchsorted(breaks, np.arange(len(y)), side="right")
    return np.asarray(y - np.einsum("tj,tj->t", X, theta[part]))


def regressed(v: Array, g: Array, lags: Array) -> Array:
    """Autoregression (p,) of v (N,)."""
    first = order_of(lags)
    past = np.column_stack([v[first - lag : len(v) - lag] for lag in lags]) if len(lags) else NONE
    w = g[first:]
    return coefficients(past * w[:, None], v[first:] * w) if len(lags) else np.zeros(0)


def lags_of(v: Array, most: int, ok: Array | None = None, season: int = SEASON) -> Array:
    """Lags of the autoregression of v (N,): those up to an order of least BIC, and one of a season if it is clear.
    Only rows are used that are ``ok`` (N,), as are all their lags."""
    ok = np.ones(len(v), bool) if ok is None else ok
    limit, longest = HELD * deviation(v[ok]), max(most, min(season, len(v) // 12))
    while len(at := complete(ok, np.arange(1, longest + 1))) <= 2 * longest and longest > 1:
        longest -= 1  # fewer lags are known of more rows
    if most < 1 or len(at) <= 2 * longest:
        return NONE
    v = np.clip(v, -limit, limit) if limit > 0.0 else v
    rows = v[at[:, None] - np.append(np.arange(1, longest + 1), 0)]
    R: Array = np.asarray(np.linalg.qr(rows, mode="r"))
    most, price = min(most, longest), np.log(len(at) + longest)
    left = np.maximum(np.cumsum(R[::-1, -1] ** 2)[::-1][: most + 1], SINGULAR * np.sum(R[:, -1] ** 2) + SMALL)
    order = int(np.argmin(len(at) * np.log(left) + price * np.arange(most + 1)))
    rest = R[order:, most:]  # what the first lags do not explain
    share = (rest[:, :-1].T @ rest[:, -1]) ** 2 / (np.sum(rest[:, :-1] ** 2, axis=0) * left[order] + SMALL)
    if longest > most and -len(at) * np.log1p(-min(share.max(), 1.0 - SINGULAR)) > price + 2.0 * np.log(longest - most):
        return np.append(np.arange(1, order + 1), most + 1 + int(np.argmax(share)))
    return np.arange(1, order + 1)


def level_of(e: Array, first: int) -> Array:
    """c (N,): the slowly changing level of white residuals e, in windows, whose residuals are limited at three medians;
    constant where windows differ by no more than chance."""
    N, sizes = len(e), np.abs(e[first:])
    m = max(3, min(WINDOWS, N // 20))
    least = 0.05 * max(deviation(e[first:]), 1e-3 * float(np.std(e[first:])), SMALL)
    windows = sizes[len(sizes) % m :].reshape(m, -1)
    limit = HELD * np.maximum(MEDIAN * np.median(windows, axis=1, keepdims=True), least)
    own = np.log(np.maximum(np.sqrt(np.mean(np.minimum(windows, limit) ** 2, axis=1)), least))
    chance = 0.6 * m / N  # variance of the logarithm of a deviation of N / m Gaussians
    share = max(0.0, 1.0 - 1.5 * chance / max(float(own.var()), chance))
    middle, place = float(np.median(own)), N - windows.shape[1] * (m - 0.5 - np.arange(m))
    return np.asarray(np.exp(middle + np.interp(np.arange(N), place, share * (own - middle))))


def rise(N: int, ends: tuple[int, int]) -> Array:
    """(N,): 0 up to the first end, 1 from the last one on."""
    return np.asarray(np.clip((np.arange(N) - ends[0]) / max(ends[1] - ends[0], 1), 0.0, 1.0))


def corners(N: int, most: int) -> Array:
    """Rows at the ends of so many cells, or fewer."""
    return np.unique(np.linspace(0, N - 1, min(most, N // 8) + 1).astype(int))


def ramp(X: Array, y: Array, noise: tuple[Array, Array, Array], moves: Sequence[int], places: Array) -> tuple[int, int]:
    """The ends of the best gradual change of some of the columns X (N, n), on a straight line between any two of some
    places, for noise of (lags, ar, g): a rise is the difference of two hinges."""
    N, J = len(y), len(moves)
    Z, z = white_rows(X, y, *noise)
    Q = np.linalg.qr(Z)[0]
    hinges = np.maximum(np.arange(N)[:, None] - places, 0.0)[:, :, None] * X[:, None, moves]
    white = white_rows(hinges.reshape(N, -1), y, *noise)[0]
    white -= Q @ (Q.T @ white)
    own = white.reshape(len(white), -1, J).transpose(1, 2, 0)  # corner by corner: too small for BLAS to start threads
    products, b = (own @ white).reshape(len(places), J, len(places), J), own @ z
    i, j = np.triu_indices(len(places), 1)
    A = products[i, :, i] - products[i, :, j] - products[j, :, i] + products[j, :, j]
    b, long = b[i] - b[j], places[j] - places[i]
    least = SINGULAR * np.sum(Z**2, axis=0).max() * long**2 + SMALL
    solution = np.linalg.solve(A + least[:, None, None] * np.eye(J), b[..., None])[..., 0]
    best = int(np.argmax(np.sum(b * solution, axis=1)))
    return int(places[i[best]]), int(places[j[best]])


def divided(
    X: Array, y: Array, lags: Array, g: Array, most: int, given: int | None = None
) -> tuple[Array, Array, float]:
    """(breaks, ar, criterion) of the best partition whose noise has these lags."""
    N, n = X.shape
    problem = problem_of(g, lags, shortest(n, lags, given), most)
    found, _ = searched(X, y, problem)
    criteria = N * np.log(found.rss) + (n + 2) * np.log(N) * np.arange(most + 1)
    K = int(np.argmin(criteria))
    return found.at[K, :K], found.ar[K], float(criteria[K])


def together(
    X: Array, y: Array, g: Array, order: int | None, most: int, given: int | None = None
) -> tuple[Array, Array, Array]:
    """(lags, ar, regressors of the path), chosen together: segments, or a gradual change; segments with the lags of an
    ``order`` if that is given."""
    N, n = X.shape
    theta, _ = estimated(X, y, (NONE, np.zeros(0), g), NONE)
    best: tuple[float, Array, Array, Array] | None = None  # criterion, lags, ar, rows
    tried: list[list[int]] = []
    orders = min(ORDER, N // 20)
    for lags in (lags_of((y - X @ theta[0]) * g, orders), NONE) if order is None else (np.arange(1, order + 1),):
        for _ in range(ROUNDS):
            if lags.tolist() in tried:
                break
            tried.append(lags.tolist())
            breaks, ar, criterion = divided(X, y, lags, g, most, given)
            criterion += len(lags) * np.log(N)
            if best is None or criterion < best[0]:
                best = criterion, lags, ar, split(X, breaks)
            theta, _ = estimated(X, y, (lags, ar, g), breaks)
            lags = lags_of(noise_of(X, y, theta, breaks) * g, orders) if order is None else lags
    assert best is not None
    if order is None:
        white = NONE, np.zeros(0), g
        rows = np.hstack([X, X * rise(N, ramp(X, y, white, range(n), corners(N, CORNERS)))[:, None]])
        v = y - rows @ coefficients(rows * g[:, None], y * g)
        lags = lags_of(v * g, orders)
        ar = regressed(v, g, lags)
        criterion = N * np.log(left(*white_rows(rows, y, lags, ar, g))) + (n + 2 + len(lags)) * np.log(N)
        if criterion < best[0]:
            best = criterion, lags, ar, rows
    return best[1:]


def weights(e: Array, level: Array) -> Array:
    """Roots of the weights of residuals e (N,): a row counts as a residual of three levels if its own is larger."""
    return np.asarray(HELD / np.maximum(np.abs(e) / level, HELD) / level)


def spread(e: Array, phi: Array, ranked: Array) -> Array:
    """(N,): sqrt(a + b x^2) of the regressor x of phi (N, n), whose `ranks` are known, with which residuals e (N,)
    grow, if they clearly do.

    The likelihood of Gaussian noise, by weighted least squares of squares that are limited at three deviations.
    """
    most = loudest(e, ranked)
    if most is None:
        return np.ones(len(e))
    A = np.column_stack([np.ones(len(e)), phi[:, most] ** 2 / np.mean(phi[:, most] ** 2)])
    square, size = e**2, np.full(len(e), np.mean(e**2))
    for _ in range(ROUNDS):
        limited = np.minimum(square, HELD**2 * np.maximum(size, square.mean()))
        a, b = scipy.optimize.nnls(A / size[:, None], limited / size)[0]
        size = np.maximum(A @ [a, b], SMALL + FLOOR**2 * square.mean())
    return np.asarray(np.sqrt(size / np.median(size)))


def noise(X: Array, y: Array, phi: Array, constants: Fit, order: int | None = None, fewest: int | None = None) -> Noise:
    """The noise of y (N,) on X (N, n), phi in a basis, whose constants are known; of some ``order`` if it is given."""
    N, n = X.shape
    most = max(0, min(MOST, N // shortest(n, NONE, fewest) - 1))
    e, ranked = constants.residual, ranks(phi)
    level = np.full(N, max(constants.scale, FLOOR * float(np.std(e)), SMALL))
    level *= spread(e / level, phi, ranked)
    g = weights(e, level)
    lags, ar, rows = together(X, y, g, order, most, fewest)
    first = order_of(lags)
    for _ in range(2):
        v = y - rows @ coefficients(*white_rows(rows, y, lags, ar, g))
        e = np.append(np.zeros(first), white_rows(v[:, None], v, lags, ar, np.ones(N))[1])
        size = spread(e, phi, ranked)
        level = size * level_of(e / size, first)
        g = weights(e, level)
    return Noise(lags, ar, level, g, e, rows, shortest(n, lags, fewest), ranked)
