"""One test of constancy, from records that the model of constants draws itself.

    y*_t = x*_t' theta + v*_t,   v*_t = sum a_l v*_(t-l) + s_t e_t,   s_t = -1 or 1,   x* with the lags of y*

e are the residuals of the segments, over one less their leverage (MacKinnon and White, 1985): residuals of constants
would count a change as noise. Where they pass through dynamics they are limited at three levels. theta and a are those
of constants, less the bias that the same draws show (Kilian, 1998), with no root beyond 1. For every draw everything is
estimated again, and three statistics are computed: Nyblom's, which sees a slow drift, the gain of one break, a step,
and the gain of two, a temporary change. p is that of the smallest of their p-values among those of the draws, beyond
the largest draws by their exponential tail.

Source: Wu (1986) and Liu (1988) for wild residuals; Hansen (2000) for fixed regressors, Goncalves and Kilian (2004) for
the recursion. Besag and Clifford (1991) for the end. Cost: `DRAWS`
searches, fewer if p is clearly large or small.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.changes.fit import HELD, Noise, coefficients, noise, order_of, white_rows
from driftfit.judge.changes.recursion import Recursion, Results, draw, searched
from driftfit.judge.changes.scan import Found, Problem, Work, problem_of
from driftfit.judge.statistics.robust import SMALL, Basis, Fit, invertible

DRAWS = (19, 39, 79, 199)
"""Draws after which it is decided whether there are more."""
CLEAR = 10.0
"""Draws beyond the statistic from which on p is known well enough (Besag and Clifford, 1991)."""
SURE = 1e-4
"""p below which the last draws would change no decision; results print no smaller one."""
BIASED = 40
"""Draws of constants from which their bias comes."""
UNIT = 0.9999
"""Largest root of the noise."""
ROUNDING = 1e-15
"""Standard deviation of rounding, as a share of the outputs."""
LOST = 1e-7
"""Share of the sum of squares of constants that differences of sums may lose."""


class Lags(NamedTuple):
    """Which columns of a regression are earlier outputs of it."""

    columns: Array
    """(k,)"""
    source: Array
    """(N, k): the row whose output they are; negative where it is none of these rows."""
    ratio: Array
    """(N, k): what they are times that output."""

    @property
    def delays(self) -> Array:
        """(k,): by how many rows each is earlier."""
        last = len(self.source) - 1 - np.argmax(self.source[::-1] >= 0, axis=0)
        return np.asarray(last - self.source[last, np.arange(len(last))])

    def only(self, rows: Array, columns: Sequence[int]) -> Lags:
        """Those of some rows and columns, given by their indices."""
        place = np.full(len(self.source) + 1, -1)
        place[rows] = np.arange(len(rows))
        kept = [i for i, j in enumerate(self.columns) if j in columns]
        new = np.array([list(columns).index(self.columns[i]) for i in kept], np.int64)
        source = place[self.source[rows][:, kept]]
        return Lags(new, np.ascontiguousarray(source), np.ascontiguousarray(self.ratio[rows][:, kept]))


class Tested(NamedTuple):
    """A test of constancy."""

    p: float
    p_each: Array
    """(3,): of Nyblom's statistic, of one break, of two."""
    L: float
    """Nyblom's statistic."""
    gains: Array
    """(R, 2): gains of one and of two breaks of the draws."""
    ar: Array
    """(p,): the autoregression of constants."""
    theta: Array
    """(n,): constants, in units of the model."""
    root: float
    """`Draws.root`"""


class Model(NamedTuple):
    """A regression, its orthonormal basis, the outputs that are its regressors, and its noise."""

    phi: Array
    y: Array
    """(N,), less phi offset."""
    offset: Array
    """(n,): constants, so that sums of squares are those of the noise."""
    X: Array
    basis: Array
    """(n, n): X = phi basis."""
    lags: Lags
    root: Array
    """(N,): what each row was multiplied by."""
    noise: Noise
    floor: float
    """Smallest sum of squares that is more than rounding."""


def modelled(
    phi: Array, basis: Basis, y: Array, constants: Fit, lags: Lags | None = None, root: Array | None = None,
    order: int | None = None, fewest: int | None = None,
) -> Model:  # fmt: skip
    """The regression of y (N,) on phi (N, n), of which basis and constants are known, with its noise.

    ``lags``: which columns are earlier outputs; None if none is. ``root`` (N,): what rows were multiplied by; None for
    1. ``order``: that of the autoregression of the noise; None estimates it. ``fewest``: rows in a segment.
    """
    N = len(y)
    lags = Lags(np.zeros(0, np.int64), np.zeros((N, 0), np.int64), np.zeros((N, 0))) if lags is None else lags
    root = np.ones(N) if root is None else root
    X, R, size = basis
    inverse = np.linalg.inv(R) / size[:, None]
    offset = inverse @ (X.T @ y / N)
    rounding = ROUNDING * np.abs(y)
    phi, y, inverse = (np.ascontiguousarray(one) for one in (phi, y - phi @ offset, inverse))
    found = noise(X, y, phi, constants, order, fewest)
    r = (y - X @ coefficients(X * found.g[:, None], y * found.g)) * found.g
    floor = float(np.sum((rounding * found.g) ** 2) + LOST * (r @ r)) + SMALL
    return Model(phi, y, offset, X, inverse, lags, root, found, floor)


def radius(a: Array, lags: Array) -> float:
    """Largest root of an autoregression with these lags."""
    p = order_of(lags)
    if not p:
        return 0.0
    if p == 1:
        return float(abs(a[0]))
    companion = np.eye(p, k=-1)
    companion[0, lags - 1] = a
    return float(np.abs(np.linalg.eigvals(companion)).max())


class Draws:
    """Records that a model of constants draws, and what is found in them."""

    constants: tuple[Array, Array]
    """theta and its autoregression, less their bias."""

    def __init__(self, model: Model, problem: Problem, held: Array) -> None:
        N, n = model.X.shape
        self.model, self.problem, self.e = model, problem, held
        self.work, self.found = Work.of(N, n, problem), Found.of(n, problem)
        self.rng = np.random.default_rng(0)

    def of(self, theta: Array, ar: Array, count: int, whole: bool) -> Results:
        """Draws from constants theta (n,) in units of the model; only constants of them unless ``whole``."""
        model, problem = self.model, self.problem
        n = model.X.shape[1]
        way = Recursion(
            model.phi, model.basis, *model.lags, theta + model.offset, ar, model.y - model.phi @ theta, self.e
        )  # fmt: skip
        signs = self.rng.integers(0, 2, (count, len(model.y))) * 2.0 - 1.0
        results = Results(
            np.full((count, 3), np.inf), np.zeros(count), np.zeros((count, n)), np.zeros((count, len(ar))),
        )  # fmt: skip
        draw(way, signs, problem, int(whole), self.work, self.found, results)
        return results

    def gains(self, theta: Array, ar: Array, count: int) -> Array:
        """Gains (R, 2) of one and of two breaks in such draws."""
        rss = self.of(theta, ar, count, True).rss
        return gains(rss[np.isfinite(rss[:, 0])], len(self.model.y))

    def unbiased(self, theta: Array, ar: Array) -> tuple[Array, Array]:
        """Constants and their autoregression without the bias of the dynamics, as far as they remain stable."""
        if not len(self.model.lags.columns) and not len(ar):
            return theta, ar
        drawn = self.of(theta, ar, BIASED, False)
        half = slice((BIASED - 1) // 2, BIASED // 2 + 1)  # the median
        shift = np.sort(drawn.theta @ self.model.basis.T, axis=0)[half].mean(axis=0)
        turn = np.sort(drawn.ar, axis=0)[half].mean(axis=0) - ar
        if not (np.isfinite(shift).all() and np.isfinite(turn).all()):
            return theta, ar
        for share in np.linspace(1.0, 0.0, 21):
            moved, less = theta - share * shift, ar - share * turn
            if self.root(moved, less) <= UNIT:
                return moved, less
        return theta, ar

    def root(self, theta: Array, ar: Array) -> float:
        """Largest root of the dynamics: of the lags of the output, and of the noise."""
        back = self.model.lags
        lags = back.delays
        own = (theta + self.model.offset)[back.columns][np.argsort(lags)]
        return max(radius(own, np.sort(lags)), radius(ar, self.problem.lags))


def p_of(x: Array, drawn: Array) -> Array:
    """p-values (k,) of x (k,) among draws (R, k): ranks, beyond the largest draws by an exponential tail."""
    R, ordered = len(drawn), np.sort(drawn, axis=0)
    top = ordered[-max(10, R // 10) :]
    mean = np.maximum((top - top[0]).sum(axis=0) / (len(top) - 1), SMALL)
    tail = len(top) / (R + 1) * np.exp(-np.maximum(x - top[0], 0.0) / mean)
    return np.asarray(np.where(x <= ordered[-6], (1 + np.sum(drawn >= x, axis=0)) / (R + 1), tail))


def price(drawn: Array, level: float) -> float:
    """What draws (R,) exceed with probability ``level``, which may be below 1 / R."""
    R = len(drawn)
    top = np.sort(drawn)[-max(10, R // 10) :]
    return float(top[0] + np.mean(top[1:] - top[0]) * np.log(len(top) / (R + 1) / level))


def smallest(x: Array, drawn: Array) -> tuple[float, Array]:
    """p-value of the smallest of the p-values of statistics x (k,) among those of draws (R, k), and each of them."""
    R = len(drawn)
    ranks = np.argsort(np.argsort(-drawn, axis=0), axis=0) + 1
    least = (ranks / (R + 1.0)).min(axis=1)
    each = p_of(x, drawn)
    p = float(each.min())
    few = 6.0 / (R + 1)
    if p >= few:
        return float((1 + np.sum(least <= p)) / (R + 1)), each
    return float(p / few * (1 + np.sum(least <= few)) / (R + 1)), each


def tested(model: Model) -> tuple[Tested, Draws]:
    """The test of constancy, and the draws for further ones."""
    N, noise = len(model.y), model.noise
    first = order_of(noise.lags)
    problem = problem_of(noise.g, noise.lags, noise.fewest, 2, model.floor)
    found, _ = searched(model.X, model.y, problem)
    held = noise.e.copy()
    Z, _ = white_rows(noise.rows, model.y, noise.lags, noise.ar, noise.g)
    held[first:] /= np.maximum(1.0 - np.sum(Z.T * np.linalg.solve(invertible(Z.T @ Z), Z.T), axis=0), 0.1)
    if first or len(model.lags.columns):  # an outlier of the output would be one of the dynamics
        held = np.clip(held, -HELD * noise.level, HELD * noise.level)
    draws = Draws(model, problem, held)
    theta, ar = draws.constants = draws.unbiased(model.basis @ found.theta, found.ar[0])
    x = np.append(found.L[0], gains(found.rss[None], N)[0])
    R = np.zeros((0, 3))
    for count in np.diff(DRAWS, prepend=0):
        drawn = draws.of(theta, ar, int(count), True)
        fine = np.isfinite(drawn.L) & np.isfinite(drawn.rss[:, 0])
        R = np.vstack([R, np.column_stack([drawn.L, gains(drawn.rss, N)])[fine]])
        p, each = smallest(x, R)
        if p * len(R) > CLEAR or (p < SURE and len(R) >= DRAWS[1] - DRAWS[0]):
            break
    own, root = model.basis @ found.theta, draws.root(theta, ar)
    return Tested(p, each, float(found.L[0]), R[:, 1:], found.ar[0], own, root), draws


def gains(rss: Array, N: int) -> Array:
    """N log(rss_0 / rss_k), k = 1, 2, of sums of squares (R, 3); 0 where there is no room."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(np.isfinite(rss[:, 1:]), N * np.log(rss[:, :1] / rss[:, 1:]), 0.0)
