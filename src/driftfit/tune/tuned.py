"""The result of tuning: settings, their intervals, and everything that was tried.

`Averaged` are estimates and bands that account for the uncertainty of estimated settings:

    p(theta_t | y) = integral p(theta_t | y, s) p(s | y) ds,      p(s | y) proportional to p(y | s) p(s)

over the settings s that `tune` estimates. Bands under the most likely settings alone are too narrow, above all where a
parameter hardly moves: its q is then estimated as zero in about every second record (Stock and Watson 1998). The prior
is flat in the standard deviation of the drift relative to that of the noise, which keeps q from piling up at zero
(Gelman 2006), and flat in the logarithm of r, of a memory, and of the scales and probabilities of a `Bank`, within the
range of the search.

The integral is a mean over draws from the posterior. They come from a differential evolution Markov chain (ter Braak
2006), which needs no adjustment: the 32 chains move along differences of each other, and their steps are evaluated
together, as lanes of one compiled run. If r has a closed form it is drawn from its inverse gamma posterior.

Cost: `STEPS` x 32 runs of the record in lanes, then a run and a smoother for each draw.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.engine.kernel import Array
from driftfit.engine.settings import whole
from driftfit.readings.left_out import LeftOut, remarks_of
from driftfit.run.live.conformal import quantile
from driftfit.run.result import Track
from driftfit.run.track import Decisions
from driftfit.show.axes import BLUE, RED, panels
from driftfit.show.text import Printed, facts, shortened, table_of
from driftfit.smooth.smoothed import Smoothed
from driftfit.trackers.base import Tracker
from driftfit.tune.lanes import score
from driftfit.tune.parametrisation import Knobs
from driftfit.tune.search import Criterion, Search, run_task

if TYPE_CHECKING:
    import polars
    from matplotlib.figure import Figure


CHAINS, STEPS = 32, 120
"""Chains, which are the lanes of a tile, and their steps; the first half is left out."""
APART, JITTER = 0.5, 1e-3
"""Decades between the chains at their start, and the random part of every step."""


@dataclass(frozen=True)
class Averaged(Printed):
    """Parameters averaged over settings; printing it shows what is known of the settings.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters.
    settings : dict of (D,)
        The draws, by name as in `Tuned.interval`.
    theta, std : (T, n)
        Estimates from the samples up to t, and their standard deviations. The settings come from the whole record.
    smoothed_theta, smoothed_std : (T, n)
        Estimates from the whole record; NotImplementedError for a tracker without a smoother.
    """

    names: tuple[str, ...]
    settings: dict[str, Array]
    runs: tuple[Track, ...]

    @property
    def theta(self) -> Array:
        return self._tracked[0]

    @property
    def std(self) -> Array:
        return self._tracked[1]

    @property
    def smoothed_theta(self) -> Array:
        return self._smoothed[0]

    @property
    def smoothed_std(self) -> Array:
        return self._smoothed[1]

    def band(self, level: float = 0.95, smoothed: bool = False) -> tuple[Array, Array]:
        """Lower and upper ends (T, n) of the bands of theta."""
        theta, std = self._smoothed if smoothed else self._tracked
        half = quantile(level) * std
        return theta - half, theta + half

    @cached_property
    def _tracked(self) -> tuple[Array, Array]:
        return _mixed([(run.theta, run.std) for run in self.runs])

    @cached_property
    def _smoothed(self) -> tuple[Array, Array]:
        paths = (Smoothed.of(run) for run in self.runs)
        return _mixed([(path.theta, path.std) for path in paths])

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield facts(("Draws", f"{len(self.runs)}"), ("Parameters", ", ".join(self.names)))
        table = table_of("Settings", "", "median", "[0.025", "0.975]")
        for name, draws in self.settings.items():
            low, middle, high = np.quantile(draws, [0.025, 0.5, 0.975])
            table.add_row(Text(name), *(f"{number:.4g}" for number in (middle, low, high)))
        yield table


def averaged(search: Search, draws: int, seed: int) -> Averaged:
    """See `Tuned.average`."""
    whole("average", "draws", draws, 2)
    criterion, knobs = search.f.objective, search.knobs
    if not isinstance(criterion, Criterion) or criterion.method != "ml":
        raise ValueError('average: settings are weighted by their likelihood; use tune(..., method="ml").')
    if len(criterion.task.records) > 1:
        raise ValueError("average: the settings are those of several records; average them for one record at a time.")
    rng = np.random.default_rng(seed)
    points = _draws(criterion, knobs, search.x, draws, rng)
    sigma2 = np.ones(draws)
    if knobs.profiled:
        scores = score(criterion.task, [knobs.run(x) for x in points])
        used = np.asarray(scores.used, dtype=float)
        sigma2 = scores.sigma2() * used / rng.chisquare(used)
    trackers = [knobs.build(x, float(r)) for x, r in zip(points, sigma2, strict=True)]
    runs = tuple(run for tracker in trackers for run in run_task(criterion.task, tracker))
    values = np.array([knobs.values(x) for x in points])
    settings = dict(zip(knobs.names, values.T, strict=True)) | ({"r": sigma2} if knobs.profiled else {})
    return Averaged(runs[0].names, settings, runs)


def _draws(f: Callable[[Array], Array], knobs: Knobs, best: Array, draws: int, rng: np.random.Generator) -> Array:
    """Draws (D, p) of the knobs from their posterior."""
    p, slope = len(best), np.zeros(len(best))
    for name, i in zip(knobs.names, knobs.owner, strict=True):  # a drift q = 10^x has a flat prior in 10^(x / 2)
        slope[i] = 0.5 * np.log(10.0) * (name.startswith("q") - float(name.startswith("mu")))
    start = np.clip(np.round(best, 1), knobs.low, knobs.high)  # the same whatever the last digits of the search
    at = _within(start + APART * rng.standard_normal((CHAINS, p)), knobs)
    now = at @ slope - f(at)
    kept = []
    for step in range(STEPS):
        others = np.array([rng.choice(np.delete(np.arange(CHAINS), k), 2, replace=False) for k in range(CHAINS)])
        size = 1.0 if step % 10 == 9 else 2.38 / np.sqrt(2.0 * p)  # with 1 a chain jumps from one peak to another
        proposed = _within(
            at + size * (at[others[:, 0]] - at[others[:, 1]]) + JITTER * rng.standard_normal((CHAINS, p)), knobs
        )
        then = proposed @ slope - f(proposed)
        taken = np.log(rng.random(CHAINS)) < then - now
        at, now = np.where(taken[:, None], proposed, at), np.where(taken, then, now)
        if step >= STEPS // 2:
            kept.append(at)
    every: Array = np.concatenate(kept)
    return np.asarray(every[np.linspace(0, len(every) - 1, draws).round().astype(int)])


def _within(points: Array, knobs: Knobs) -> Array:
    """Points reflected at the ends of the range."""
    span = knobs.high - knobs.low
    folded = np.mod(points - knobs.low, 2.0 * span)
    return np.asarray(knobs.low + np.minimum(folded, 2.0 * span - folded))


def _mixed(parts: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Mean and standard deviation of the mixture."""
    theta, std = (np.array(part) for part in zip(*parts, strict=True))
    return theta.mean(axis=0), np.sqrt((std**2).mean(axis=0) + theta.var(axis=0))


METHODS = {
    "ml": "maximum likelihood",
    "h-step": "h-step prediction error",
    "loo": "leave-one-out error",
    "gcv": "generalised cross-validation",
}
"""The criteria, in words."""


@dataclass(frozen=True)
class Tuned(Printed):
    """The result of `tune`; printing it shows the estimates with their intervals.

    Attributes
    ----------
    tracker : Tracker
        The tracker with all its settings, ready for `track` and `Live`.
    method : str
        The criterion.
    loglik : float
        Log-likelihood of the record under ``tracker``: ``track(model, tuned.tracker, y, u).loglik``, with several
        records their sum; NaN for trackers without a variance.
    used : int
        Samples in this likelihood: those with a density given earlier samples.
    settings, unknown : int
        Number of settings that were estimated, the noise variance included, and of parameters whose start is unknown.
    noise : float
        Estimated noise variance; unreliable if ``at_bound`` is not empty.
    at_bound : tuple of str
        Settings that ended at a bound of the search, or at zero; empty if the optimum is inside.
    interval : dict of (low, high)
        By name of setting, the interval of the likelihood at ``level``: where its profile has fallen by half the
        chi-square quantile. NaN for other methods.
    level : float
        The level of the intervals.
    left_out : LeftOut, or a mapping from keys to LeftOut
        What a gate left out for all settings; give it to `track` as ``gate=``. Empty without a gate.
    """

    tracker: Tracker
    method: str
    loglik: float
    used: int
    settings: int
    unknown: int
    noise: float
    at_bound: tuple[str, ...]
    interval: dict[str, tuple[float, float]]
    level: float
    left_out: LeftOut | Decisions
    _search: Search = field(repr=False, compare=False)

    @property
    def table(self) -> polars.DataFrame:
        """Every setting that was tried and its criterion, best first: log-likelihood, or mean square.

        For `RLS` and `FLS` the likelihood is the maximum over the noise variance.
        """
        import polars

        points, values = self._search.tried()
        settings = np.array([self._search.knobs.values(x) for x in points])
        columns = dict(zip(self._search.knobs.names, settings.T, strict=True))
        name = {"ml": "loglik", "h-step": "mean_square"}.get(self.method, self.method)
        return polars.DataFrame({**columns, name: self._criterion(values)})

    @property
    def aic(self) -> float:
        """Akaike's criterion, -2 loglik + 2 (settings + unknown)."""
        return -2.0 * self.loglik + 2.0 * (self.settings + self.unknown)

    @property
    def bic(self) -> float:
        """Schwarz's criterion, -2 loglik + (settings + unknown) log N, N the used samples and the unknown starts."""
        return -2.0 * self.loglik + float(np.log(self.used + self.unknown)) * (self.settings + self.unknown)

    @property
    def chosen(self) -> dict[str, float]:
        """The estimates by name of setting as in ``interval``; drifts are relative to the noise variance."""
        names, values = self._search.knobs.names, self._search.knobs.values(self._search.x)
        return {name: float(value) for name, value in zip(names, values, strict=True)}

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield facts(
            ("Tracker", shortened(repr(self.tracker))),
            ("Criterion", METHODS[self.method]),
            ("Log-likelihood", f"{self.loglik:.6g} of {self.used} samples" if np.isfinite(self.loglik) else ""),
            ("AIC, BIC", f"{self.aic:.6g}, {self.bic:.6g}" if np.isfinite(self.loglik) else ""),
            ("Noise variance", f"{self.noise:.4g}"),
            *remarks_of(self.left_out),
        )
        ends = (f"[{0.5 - self.level / 2:.3g}", f"{0.5 + self.level / 2:.3g}]")
        table = table_of("Settings", "", "estimate", *ends)
        found = self.chosen | ({"r": self.noise} if "r" in self.interval else {})
        for name, value in found.items():
            table.add_row(Text(name), *(f"{number:.4g}" for number in (value, *self.interval[name])))
        yield table
        if self.at_bound:
            yield Text(f" at zero or at a bound of the search: {', '.join(self.at_bound)}")

    def _criterion(self, values: Array) -> Array:
        """Values of the objective converted to the criterion."""
        return -values if self.method == "ml" else np.exp(values)

    def curves(self) -> list[tuple[str, Array, Array]]:
        """(name, values of the setting, criterion) along each knob, for `plot`."""
        curves = []
        for i in range(len(self._search.x)):
            points, values = self._search.sweep(i)
            entry = int(np.flatnonzero(self._search.knobs.owner == i)[0])
            settings = np.array([self._search.knobs.values(x)[entry] for x in points])
            curves.append((self._search.knobs.names[entry], settings, self._criterion(values)))
        return curves

    def average(self, draws: int = 64, seed: int = 0) -> Averaged:
        """Estimates and bands averaged over the settings that the record allows, weighted by their likelihood.

        ``draws`` settings are drawn from their posterior with the generator ``seed``. The
        bands are wider than those under the best settings alone, and cover where these do not. ValueError for another
        method than "ml", and for settings of several records.
        """
        return averaged(self._search, draws, seed)

    def plot(self, ax: Any = None) -> Figure:
        """The criterion along each setting, with the others optimised if it is a likelihood; a matplotlib figure.

        ``ax`` as for `Track.plot`.
        """
        curves = self.curves()
        columns = min(len(curves), 2)
        figure, axes = panels(ax, (4.6 * columns, 3.2 * -(-len(curves) // 2)), len(curves), columns)
        for panel, (name, values, criterion) in zip(axes, curves, strict=True):
            memory = name == "forgetting"
            axis = (lambda v: 1.0 / (1.0 - np.asarray(v))) if memory else np.asarray
            best = self.chosen[name]
            with np.errstate(divide="ignore"):
                panel.semilogx(axis(values), criterion, color=BLUE, lw=1.3)
                low, high = (float(axis(end)) for end in self.interval[name])
                panel.axvspan(max(low, axis(values).min()), min(high, axis(values).max()), color=BLUE, alpha=0.15, lw=0)
                if 0.0 < axis(best) < np.inf:
                    panel.axvline(float(axis(best)), color=RED, lw=1.0)
            if self.method == "ml":  # far from the optimum a likelihood falls by hundreds; only the top matters
                panel.set_ylim(criterion.max() - 12.0, criterion.max() + 1.0)
            panel.set_xlabel("memory 1 / (1 - forgetting)" if memory else name)
            panel.set_ylabel({"ml": "log-likelihood", "h-step": "mean square"}.get(self.method, self.method))
            panel.grid(alpha=0.25, lw=0.5)
        return figure
