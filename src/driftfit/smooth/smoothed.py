"""The smoothed path of a complete record, and statistics to judge it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import one_of
from driftfit.models.hammerstein_wiener.blocks import Blocks
from driftfit.run.live.conformal import quantile
from driftfit.run.result import Track
from driftfit.show.axes import BLUE, GREY, panels
from driftfit.show.text import Printed, path_table
from driftfit.smooth import exact, laws
from driftfit.smooth.problem import walk_of
from driftfit.smooth.solvers.walk import NONE, Path, Walk, ordered
from driftfit.use.blocks import blocks_of

PER_SAMPLE = ("theta", "var", "rank", "slope", "slope_var", "cov", "lag_cov")
"""Arrays of a path that outputs which share one theta have once for each instant."""
ALONE = 1e-12
"""Below this sqrt(1 - leverage) a sample alone determines a direction, and its leave-one-out residual is undefined."""

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Data(NamedTuple):
    """What is known of a problem before its solution takes its place."""

    used: int
    """Number of samples with a positive weight."""
    power: float
    """Sum of weight y^2."""
    r: float | None
    diffuse: bool

    @classmethod
    def of(cls, walk: Walk) -> Self:
        """The data of a problem."""
        power = float(np.einsum("t,t,t->", walk.weight, walk.y, walk.y)) if walk.r is None else np.nan
        return cls(walk.used, power, walk.r, walk.p0 is None)


class Fit(NamedTuple):
    """What residuals and leverages are made of, each (T,)."""

    weight: Array
    rho: Array
    c: Array


class Bands(Printed):
    """A path ``theta`` of parameters with ``names`` and ``std``, from the record of a run."""

    run: Track
    theta: Array
    std: Any
    names: Any

    def band(self, level: float = 0.95) -> tuple[Array, Array]:
        """(low, high), each (T, n): pointwise bands of theta at this level, under the tracker's own model."""
        half = quantile(level) * self.std
        return self.theta - half, self.theta + half

    def plot(self, level: float = 0.95, ax: Any = None) -> Figure:
        """Parameters with bands, over those of the run if they are the same; a matplotlib figure. ``ax`` as for
        `Track.plot`.
        """
        run, n, (low, high) = self.run, len(self.names), self.band(level)
        columns = 1 if n <= 4 else 2 if n <= 12 else 4
        rows = -(-n // columns)
        figure, axes = panels(ax, (9.0, 1.7 * rows + 0.8), n, columns, sharex=True)
        for i, axis in enumerate(axes):
            known = np.isfinite(low[:, i]) & np.isfinite(high[:, i])
            axis.fill_between(run.time, low[:, i], high[:, i], where=known, color=BLUE, alpha=0.2, lw=0)
            axis.plot(run.time, self.theta[:, i], color=BLUE, lw=1.4, label="smoothed")
            if self.names == run.names:
                view = axis.get_ylim()
                axis.plot(run.time, run.theta[:, i], color=GREY, lw=0.8, zorder=1, label="filtered")
                axis.set_ylim(*view)
            axis.set_ylabel(self.names[i])
            axis.grid(alpha=0.25, lw=0.5)
        axes[0].legend(loc="best", fontsize=8, ncols=2, frameon=False)
        axes[-1].set_xlabel("time" if run.timed else "sample")
        return figure


class Smoothed(Bands):
    """Parameters of a record, each estimated from the complete record.

    Attributes
    ----------
    theta, std : (T, n)
        Posterior mean and standard deviation; std is inf for parameters that the record does not determine.
    residual, loo : (T,)
        y - phi' theta; and the same with theta from all samples but this one. The first is *not* a measure of fit,
        because it is shrunk by 1 - leverage. NaN where there is no sample, and loo also where a sample alone determines
        a direction.
    leverage : (T,)
        Share of a sample in its own fit, in [0, 1].
    press, alone : float, int
        Weighted mean square of ``loo``, and the number of samples that it leaves out because they alone determine a
        direction.
    cost, measurement_cost, dynamic_cost : float
        The minimum of J, and its two parts: weighted squared residuals, and the rest.
    r : float
        Noise variance: the tracker's, or J / (N - rank) if it has none (J / N under a proper prior).
    rank : (T,) int
        Rank of the regressors up to each sample.
    method : "fast" or "safe"
        The method of the solver, which tests its own result.
    walk : Walk
        The problem that was solved.
    weight : (T,)
        Weights of the samples in it; 0 for those that were not used.

    Only theta, std and rank are kept. The first of residual, loo, leverage, press, alone and weight that is read
    solves the problem again, and keeps (T,) numbers for all of them; keep="fit" of `Track.smooth` has them at once.

    Of ny outputs that share one theta, rows of one instant are successive samples between which theta does not move:
    residual, loo, leverage and weight are (T, ny), and ``walk`` has the T ny rows.

    Bands are valid under the random-walk model and its drift; they do not account for a wrong drift.
    """

    def __init__(self, path: Path, data: Data, run: Track, walk: Walk | None = None, order_by: Any = None) -> None:
        """``walk``: the problem, if it is not the one that `walk_of` collects from the run; its path has rho and c."""
        self.run, self.order_by, self._walk, self._data = run, order_by, walk, data
        if walk is not None:
            self._fit = self._of_samples(walk.weight, path)
        self._path = path = self._of_instants(path)
        self.theta, self.rank, self.method = path.theta, path.rank, path.method
        self.cost, self.measurement_cost = path.cost, path.measurement_cost
        self.r = noise_variance(data, path) if data.r is None else data.r

    @classmethod
    def of(cls, run: Track, keep: str = "std", order_by: Any = None, undetermined: str = "min_norm") -> Smoothed:
        """Smooth a run."""
        if run.start is not None:
            raise ValueError("smooth: a run with a warm start cannot be smoothed; track the whole record.")
        one_of("smooth", "keep", keep, ("std", "fit", "cov"))
        one_of("smooth", "undetermined", undetermined, ("min_norm", "nan", "raise"))
        if order_by is not None and run.tracker.adapts:
            raise ValueError(
                f"smooth: order_by= needs a drift along that variable, and {run.tracker!r} estimates one in time. "
                "Use the tracker of tune(model, FLS(), y, u, order_by=..)."
            )
        if order_by is not None and run.rows_per_instant > 1:
            raise ValueError("smooth: order_by= would separate the rows of an instant; it needs a single output.")
        if getattr(run.tracker, "laws", None):
            if order_by is not None:
                raise ValueError("smooth: order_by= needs random walks, and laws hold in time; leave it out.")
            path, weight = laws.smooth(run.rows)
            smoothed = cls(path, Data(int(np.count_nonzero(weight)), np.nan, run.tracker.r, True), run)  # type: ignore[attr-defined]
            smoothed._fit = smoothed._of_samples(weight, path)
            return smoothed._determined(np.isinf(smoothed._path.var), undetermined, int(path.rank[-1]))
        walk = walk_of(run.rows, turned=True)
        data, slopes = Data.of(walk), len(walk.trend) > 0
        weight = walk.weight.copy() if keep != "std" else NONE
        path = solve(walk, keep, order_by, lambda: walk_of(run.rows, turned=True))
        del walk
        smoothed = cls(path, data, run, order_by=order_by)
        if keep != "std":
            smoothed._fit = smoothed._of_samples(weight, path)
        path = smoothed._path
        unknown = np.isinf(path.var)
        smoothed.std = smoothed._std(path.var)
        smoothed._path = path._replace(var=NONE, rho=NONE, c=NONE)
        return smoothed._determined(unknown, undetermined, len(run.names) * (2 if slopes else 1))

    def _determined(self, unknown: Array, undetermined: str, size: int) -> Smoothed:
        """This path, NaN or an error where the record does not determine parameters, ``unknown`` (T, n)."""
        if undetermined == "raise" and unknown.any():
            names = ", ".join(np.array(self.names)[np.any(unknown, axis=0)].tolist())
            raise ValueError(
                f"smooth: the record does not determine {names} (rank {self.rank.max()} of {size}); "
                'leave them out of the model, or take the solution nearest to theta0 with undetermined="min_norm".'
            )
        if undetermined == "nan":
            self.theta[unknown] = np.nan
        return self

    def __rich__(self) -> Any:
        return path_table(f"Smoothed by {self._data.used} samples", self.names, self.theta, self.std)

    @property
    def walk(self) -> Walk:
        """The problem that was solved; collected from the record again, as `smooth` did, if it was not given."""
        return walk_of(self.run.rows, turned=True) if self._walk is None else self._walk

    @cached_property
    def _fit(self) -> Fit:
        """What residuals and leverages are made of; the problem is solved again unless it was kept."""
        walk = self.walk
        return self._of_samples(walk.weight.copy(), solve(walk, "fit", self.order_by))

    def _of_samples(self, weight: Array, path: Path) -> Fit:
        """The same from a solution, with a column for each row of an instant if there are several."""
        ny = self.run.rows_per_instant
        return Fit(*(one.reshape(-1, ny) if ny > 1 else one for one in (weight, path.rho, path.c)))

    def _of_instants(self, path: Path) -> Path:
        """The path after the last row of each instant, between whose rows theta does not move."""
        ny = self.run.rows_per_instant
        last = {name: getattr(path, name)[ny - 1 :: ny] for name in PER_SAMPLE}
        return path._replace(**last) if ny > 1 else path

    @property
    def weight(self) -> Array:
        return self._fit.weight

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.run.names

    @property
    def time(self) -> Array:
        """The given times, or sample numbers."""
        return self.run.time

    @cached_property
    def std(self) -> Array:
        return self._std(self._path.var.copy())

    def _std(self, var: Array) -> Array:
        """Standard deviations from variances relative to the noise, in their place."""
        var *= self.r
        return np.sqrt(var, out=var)

    @property
    def slope(self) -> Array:
        """Change of theta per nominal interval, (T, n), if the slope is a random walk (``differences=2``)."""
        return self._of_slopes(self._path.slope)

    @cached_property
    def slope_std(self) -> Array:
        """Standard deviation of the slope, (T, n)."""
        return np.sqrt(self.r * self._of_slopes(self._path.slope_var))

    def _of_slopes(self, values: Array) -> Array:
        if not values.size:
            raise ValueError("slope: theta is a plain random walk here; use FLS(mu, differences=2).")
        return values

    @cached_property
    def leverage(self) -> Array:
        return np.asarray(1.0 - self._fit.c**2)

    @cached_property
    def residual(self) -> Array:
        return self._scaled(self._fit.rho * self._fit.c)

    @cached_property
    def loo(self) -> Array:
        c = np.where(self._fit.c > ALONE, self._fit.c, np.nan)
        return self._scaled(self._fit.rho / c)

    @cached_property
    def press(self) -> float:
        terms = self.weight * self.loo**2
        return float(np.nanmean(terms)) if np.isfinite(terms).any() else float("nan")

    @cached_property
    def alone(self) -> int:
        return int(np.count_nonzero((self.weight > 0.0) & np.isnan(self.loo)))

    def _scaled(self, values: Array) -> Array:
        """Values in units of y; NaN where there is no sample."""
        weight = np.where(self.weight > 0.0, self.weight, np.nan)
        return np.asarray(values / np.sqrt(weight))

    @property
    def dynamic_cost(self) -> float:
        return self.cost - self.measurement_cost

    def cov(self, t: int) -> Array:
        """Covariance (n, n) of theta at sample t; entries of undetermined parameters are inf on the diagonal."""
        cov: Array = self.r * self._covariances.cov[t]
        np.fill_diagonal(cov, self.std[t] ** 2)
        return cov

    def lag_cov(self, t: int) -> Array:
        """Covariance (n, n) of theta at samples t and t + 1, rows for t; t counts along ``order_by`` if given."""
        return np.asarray(self.r * self._covariances.lag_cov[t])

    def blocks(
        self, method: str = "svd-joint", input: str | None = None, output: str = "d1", at: float = 0.0
    ) -> Blocks:
        """Coefficients of the blocks of a `HammersteinWiener` model on the smoothed path, as `Track.blocks`."""

        def covariances() -> Array:
            cov: Array = self.r * self._covariances.cov
            np.einsum("tii->ti", cov)[:] = self.std**2
            return cov

        return blocks_of(self.run, method, input, output, at, (self.theta, covariances))

    @cached_property
    def _covariances(self) -> Path:
        """The path with its covariances; the problem is solved again unless they were kept."""
        return self._path if len(self._path.cov) else self._of_instants(solve(self.walk, "cov", self.order_by))


def solve(walk: Walk, keep: str, order_by: Any = None, rebuild: Callable[[], Walk] | None = None) -> Path:
    """The smoothed path in time order; with ``order_by`` theta is a random walk along that variable instead of time.

    ``rebuild`` as for `driftfit.smooth.exact.smooth`.
    """
    if order_by is None:
        return exact.smooth(walk, keep, rebuild)
    arranged, order = ordered(walk, order_by)
    path, back = exact.smooth(arranged, keep), np.argsort(order)
    slopes, fit = ("slope", "slope_var") if len(walk.trend) else (), ("rho", "c") if len(path.c) else ()
    in_time = {name: getattr(path, name)[back] for name in ("theta", "var", "rank", *fit, *slopes)}
    cov = path.cov[back] if len(path.cov) else path.cov
    nowhere = ~np.isfinite(np.asarray(order_by, float))
    in_time["theta"][nowhere] = in_time["var"][nowhere] = np.nan
    return path._replace(**in_time, cov=cov)


def noise_variance(data: Data, path: Path) -> float:
    """J / (N - rank); NaN, with a warning, if there are no degrees of freedom from which to estimate it."""
    free = data.used - (int(path.rank.max()) if data.diffuse else 0)
    if free <= 0 or path.cost <= 1e-28 * data.power:
        warnings.warn(
            f"smooth: {data.used} samples of rank {path.rank.max()} leave no residual from which to estimate the "
            "noise; the path has no bands.",
            RuntimeWarning,
            stacklevel=4,
        )
        return float("nan")
    return path.cost / free
