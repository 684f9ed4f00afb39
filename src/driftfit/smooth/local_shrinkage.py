"""Local shrinkage: each parameter is usually at rest, and moves as far as it must when it does.

    y_t = phi_t' theta_t + v_t,             v_t ~ N(0, r / weight_t),                     r ~ 1 / r
    theta_jt = theta_j,t-1 + w_jt,          w_jt ~ N(0, (sigma_j^2 + tau_j^2 kappa_t^2 lambda_jt^2) dt_t)
    sigma_j, tau_j ~ C+(0, s_j),  kappa_t ~ C+(0, 1),  lambda_jt ~ C+(0, 1),    s_j^2 = r_0 / (T^2 mean phi_j^2)

C+ is the half-Cauchy distribution. A walk of variance sigma_j^2 moves all the time. The rest is a horseshoe, whose peak
at 0 shrinks small moves and whose tail leaves jumps as they are: tau_j is the usual size of one parameter, kappa_t that
of all at one time, lambda_jt that of one at one time. s_j is the move that would be lost in the error of constant
parameters, whose residuals have the variance r_0.

A Gibbs sampler draws, in turn, (1) the path from its normal distribution, whose precision is banded: one Cholesky
factor; (2) the jumps among the moves, then theta_0, sigma and tau with the parts of the path in their units held, as a
regression, because a scale and a path that hardly moves determine one another; (3) the scales of the jumps, each an
inverse gamma given a number drawn beside it; (4) r.

Sources: Carvalho, Polson and Scott (2010) for the horseshoe; Kowal, Matteson and Ruppert (2019) for increments; Rue
(2001) for (1); Fruehwirth-Schnatter and Wagner (2010) for (2); Makalic and Schmidt (2016) for (3). Departures: the
scales of increments are independent over time (Kowal et al. let them persist), and a walk takes the place of that
persistence, without which the tail that suits a walk makes jumps of every outlier; kappa_t is added, since parameters
often jump together. Cost: draws * thin + burn_in sweeps of O(T n^2), about a third of a microsecond a sample and
parameter each.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from driftfit.bank.reduction import Hybrid
from driftfit.bank.results.events import Event
from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import Array
from driftfit.engine.settings import whole
from driftfit.run.program import progress as bar
from driftfit.run.result import Track
from driftfit.show.text import table_of
from driftfit.smooth.changes import dated
from driftfit.smooth.problem import walk_of
from driftfit.smooth.smoothed import Bands
from driftfit.smooth.solvers.walk import Walk, constants

if TYPE_CHECKING:
    from rich.table import Table

LEAST_MOVE = 1e-10
"""Least variance of a move, in variances of y that the noise explains: the factor keeps six digits of the path."""
WEAK = 1e3
"""Standard deviation of theta_0 about constant least squares, in those of y that each parameter alone would explain."""


class Sampled(NamedTuple):
    """Draws of a record with M instants and n parameters: ``theta`` and ``jumps``, the second part of w, both
    (K, M, n); ``effect`` (K, n), sum of weight_t (phi_jt (theta_jt - its mean))^2; ``r`` (K,)."""

    theta: Array
    jumps: Array
    effect: Array
    r: Array

    def at(self, opens: Array, ny: int) -> Sampled:
        """The same at each sample, given which of its rows begin an instant."""
        opens = np.append(True, opens[1:])
        new, of = opens[::ny], (np.cumsum(opens) - 1)[::ny]
        return self._replace(theta=self.theta[:, of], jumps=np.where(new[:, None], self.jumps[:, of], 0.0))


class Shrunk(Bands):
    """Parameters whose moves are shrunk one by one; every number is made from draws of the posterior.

    Attributes
    ----------
    theta, std : (T, n)
        Posterior mean and standard deviation.
    draws : (K, T, n)
        Paths drawn from the posterior.
    r : (K,)
        Noise variances drawn with them.
    shares : (K, n)
        Share of each parameter in what moving parameters explain of y: sum over t of weight_t (phi_jt (theta_jt - mean
        of theta_j))^2, divided by the sum over parameters; 1 / n where nothing moves.
    """

    def __init__(self, run: Track, sampled: Sampled) -> None:
        self.run, self.names, self.draws, self.r = run, run.names, sampled.theta, sampled.r
        self.theta, self.std = sampled.theta.mean(axis=0), sampled.theta.std(axis=0)
        total = sampled.effect.sum(axis=1, keepdims=True)
        self.shares = np.divide(sampled.effect, total, out=np.full_like(sampled.effect, 1.0 / len(self.names)),
                                where=total > 0.0)  # fmt: skip
        self._jumps = sampled.jumps

    def band(self, level: float = 0.95) -> tuple[Array, Array]:
        """(low, high), each (T, n): quantiles of the draws at each sample."""
        if not 0.0 < level < 1.0:
            raise ValueError(f"band: level must be between 0 and 1, such as 0.95; got {level!r}.")
        low, high = np.quantile(self.draws, [0.5 - level / 2.0, 0.5 + level / 2.0], axis=0)
        return low, high

    @cached_property
    def jumps(self) -> Array:
        """(T, n): probability that a parameter jumps by more than two standard deviations of its path at one sample.

        They are those in the middle of the record.
        """
        usual = np.median(self.std, axis=0)
        return np.asarray(np.mean(np.abs(self._jumps) > 2.0 * usual, axis=0))

    def events(self, threshold: float = 0.5) -> list[Event]:
        """The jumps of each parameter with dates, intervals and sizes, as `Track.events`; walks have none."""
        found: list[Event] = []
        for p, name in zip(self.jumps.T, self.names, strict=True):
            p, none, W = np.column_stack([1.0 - p, p]), np.ones((len(p), 1)), Hybrid.remembered
            found += dated(self.run, p, self._increment, none, ("none", name), threshold, W, [])
        return sorted(found, key=lambda event: event.span.date)

    def _increment(self, first: int, last: int) -> tuple[Array, Array]:
        moved = self.draws[:, last] - self.draws[:, max(first - 1, 0)]
        return moved.mean(axis=0), moved.std(axis=0)

    def __rich__(self) -> Table:
        """Where each parameter begins and ends, its share in what moves, with a 95 % interval, and its jumps."""
        shown = table_of("Local shrinkage", "parameter", "first", "last", "share of drift", "95 %", "jumps at")
        low, high = np.quantile(self.shares, [0.025, 0.975], axis=0)
        dates = {name: [str(event.date) for event in self.events() if event.name == name] for name in self.names}
        for j, name in enumerate(self.names):
            shown.add_row(
                name, *(f"{self.theta[t, j]:.4g}" for t in (0, -1)), f"{self.shares[:, j].mean():.2f}",
                f"{low[j]:.2f} .. {high[j]:.2f}", ", ".join(dates[name]) or "-",
            )  # fmt: skip
        return shown


def local_shrinkage(
    run: Track, draws: int = 500, *, thin: int = 2, burn_in: int = 500, seed: int = 0, progress: bool = False
) -> Shrunk:
    """Smooth a run with a horseshoe on the moves of its parameters.

    Parameters
    ----------
    run : Track
        A run of any tracker; only its regressors, outputs, weights and intervals of time are used.
    draws : int
        Paths to keep; quantiles of 95 % need some hundred.
    thin, burn_in : int
        One of so many sweeps is kept; so many come before the first.
    seed : int
        Of the draws.
    progress : bool
        Show a progress bar.

    Raises
    ------
    ValueError
        For counts below 1, or a run with a warm start.
    """
    for name, value in {"draws": draws, "thin": thin, "burn_in": burn_in}.items():
        whole("local_shrinkage", name, value, 1)
    if run.start is not None:
        raise ValueError("local_shrinkage: a run with a warm start has no whole record; track the record.")
    walk = walk_of(run.rows, constants(run.model.n))
    sampled = sample(walk, draws, thin, burn_in, np.random.default_rng(seed), progress)
    return Shrunk(run, sampled.at(walk.drift > 0.0, run.rows_per_instant))


class Data(NamedTuple):
    """A record by instant, about constant least squares and in units in which regressors X (N, n) have size 1.

    ``at`` (N,) is the instant of each row, of which there are M, with intervals ``dt`` (M - 1, 1) between them;
    ``gram`` (M, n, n + 1) sums weight x x' of the rows of each, entry (i, k) that of (i + k, i); ``cross`` (M, n) sums
    weight x y. ``weak`` is the precision of theta_0, whose mean is 0, and ``least`` the least noise variance.
    """

    X: Array
    y: Array
    weight: Array
    at: Array
    dt: Array
    gram: Array
    cross: Array
    weak: float
    least: float

    @classmethod
    def of(cls, walk: Walk, X: Array, y: Array) -> Data:
        """``X``, and the residuals ``y`` of a problem, whose rounding counts as noise where they have none."""
        opens = np.r_[True, walk.drift[1:] > 0.0]
        first, weight, n = np.flatnonzero(opens), walk.weight, X.shape[1]
        gram = np.zeros((len(first), n, n + 1))
        for k in range(n):
            gram[:, : n - k, k] = np.add.reduceat(weight[:, None] * X[:, k:] * X[:, : n - k], first)
        cross = np.add.reduceat((weight * y)[:, None] * X, first)
        power = max(float(weight @ (y * y)), ROUNDING**2 * float(weight @ walk.y**2)) / max(weight.sum(), 1.0) or 1.0
        dt = walk.drift[first[1:], None]
        return cls(X, y, weight, np.cumsum(opens) - 1, dt, gram, cross, 1.0 / (WEAK**2 * power), ROUNDING * power)


class Scales(NamedTuple):
    """Variances of the moves: squares of sigma and tau (2, n), of kappa (M - 1, 1) and lambda (M - 1, n), and the
    numbers drawn beside the last two."""

    sizes: Array
    kappa: Array
    lam: Array
    for_kappa: Array
    for_lam: Array

    @property
    def jumps(self) -> Array:
        """Variances of the jumps per interval, (M - 1, n)."""
        return np.asarray(self.sizes[1] * self.kappa * self.lam)

    def drawn(self, jumps: Array, rng: np.random.Generator) -> Scales:
        """Local scales given squared jumps (M - 1, n): C+(0, 1) squared is IG(1/2, g) with g ~ Gamma(1/2, 1)."""
        moved = jumps / (2.0 * self.sizes[1])
        common = self.for_kappa + (moved / self.lam).sum(axis=1, keepdims=True)
        kappa = common / rng.standard_gamma((1.0 + jumps.shape[1]) / 2.0, self.kappa.shape)
        lam = (self.for_lam + moved / kappa) / rng.standard_exponential(jumps.shape)
        beside = (rng.standard_exponential(one.shape) / (1.0 + 1.0 / one) for one in (kappa, lam))
        return Scales(self.sizes, kappa, lam, *beside)


def sample(walk: Walk, draws: int, thin: int, burn_in: int, rng: np.random.Generator, shown: bool) -> Sampled:
    """Draw paths of a problem."""
    n = walk.phi.shape[1]
    weight = walk.weight / max(walk.weight.sum(), np.finfo(float).tiny)
    size = np.sqrt(weight @ walk.phi**2)
    size[size == 0.0] = 1.0
    X = walk.phi / size
    root = np.sqrt(walk.weight)
    start = np.linalg.lstsq(X * root[:, None], walk.y * root, rcond=None)[0]
    data = Data.of(walk, X, walk.y - X @ start)
    M, N = len(data.cross), max(walk.used, 1)
    r = max(float(data.weight @ data.y**2) / N, data.least)
    unit = r / M**2
    scales = Scales(np.outer([r / M, unit], np.ones(n)), *(np.ones((M - 1, k)) for k in (1, n, 1, n)))
    kept = Sampled(*(np.zeros((draws, *shape)) for shape in ((M, n), (M, n), (n,), ())))
    with bar("Drawing paths", burn_in + draws * thin, shown) as advance:
        for sweep in range(burn_in + draws * thin):
            z = path_of(data, scales, r, rng)
            z, jumps, scales = rescaled(data, z, scales, r, unit, rng)
            scales = scales.drawn(jumps**2 / data.dt, rng)
            e = data.y - np.einsum("ti,ti->t", data.X, z[data.at])
            r = max(float(data.weight @ e**2) / 2.0 / rng.standard_gamma(N / 2.0), data.least)
            k, skipped = divmod(sweep - burn_in, thin)
            if k >= 0 and skipped == 0:
                about = z[data.at] - z.mean(axis=0)
                kept.theta[k], kept.r[k] = (z + start) / size, r
                kept.jumps[k, 1:], kept.effect[k] = jumps / size, data.weight @ (data.X * about) ** 2
            advance(1)
    return kept


def path_of(data: Data, scales: Scales, r: float, rng: np.random.Generator) -> Array:
    """(1) z (M, n) ~ N(P^-1 b, P^-1): with P = L L', z = L'^-1 (L^-1 b + a standard normal vector)."""
    from scipy.linalg import lapack  # takes longer to import than the rest of the package together

    M, n = data.cross.shape
    firm = 1.0 / np.maximum((scales.sizes[0] + scales.jumps) * data.dt, LEAST_MOVE * r)
    P = data.gram / r
    P[1:, :, 0] += firm
    P[:-1, :, 0] += firm
    P[:-1, :, n] = -firm
    P[0, :, 0] += data.weak
    factor = lapack.dpbtrf(P.reshape(M * n, n + 1).T, lower=1, overwrite_ab=1)[0]
    drawn = lapack.dtbtrs(factor, data.cross.reshape(-1, 1) / r, uplo="L")[0] + rng.standard_normal((M * n, 1))
    return np.asarray(lapack.dtbtrs(factor, drawn, uplo="L", trans="T")[0]).reshape(M, n)


def rescaled(
    data: Data, z: Array, scales: Scales, r: float, unit: float, rng: np.random.Generator
) -> tuple[Array, Array, Scales]:
    """(2) The jumps among the moves; theta_0, sigma and tau by a regression on x and on x times each part of the path,
    in units of its size. Returns the path, its jumps, and the scales.
    """
    n = z.shape[1]
    jumping, moves = scales.jumps, np.diff(z, axis=0)
    share = jumping / (jumping + scales.sizes[0])
    spread = np.sqrt(share * scales.sizes[0] * data.dt)
    jumps = share * moves + spread * rng.standard_normal(moves.shape)
    parts = np.zeros((2, *z.shape))
    np.cumsum([moves - jumps, jumps], axis=1, out=parts[:, 1:])
    parts /= np.sqrt(scales.sizes)[:, None]
    prior = (unit + scales.sizes) / 2.0 / rng.standard_exponential((2, n))  # of C+ as N(0, IG(1/2, unit / 2))
    A = np.hstack([data.X, *(data.X * part[data.at] for part in parts)])
    weighted = A * (data.weight / r)[:, None]
    root = np.linalg.cholesky(weighted.T @ A + np.diag(np.r_[np.full(n, data.weak), 1.0 / prior.ravel()]))
    drawn = np.linalg.solve(root, weighted.T @ data.y) + rng.standard_normal(3 * n)
    first, *factors = np.linalg.solve(root.T, drawn).reshape(3, n)
    sizes = np.maximum(np.square(factors), ROUNDING * unit)
    path = first + parts[0] * factors[0] + parts[1] * factors[1]
    return path, np.diff(parts[1], axis=0) * factors[1], scales._replace(sizes=sizes)
