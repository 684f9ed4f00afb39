"""The result of tuning: settings, their intervals, and everything that was tried."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.engine.kernel import Array
from driftfit.readings.left_out import LeftOut, remarks_of
from driftfit.run.track import Decisions
from driftfit.show.axes import BLUE, RED, panels
from driftfit.show.text import Printed, facts, shortened, table_of
from driftfit.trackers.base import Tracker
from driftfit.tune.averaged import Averaged, averaged
from driftfit.tune.search import Search

if TYPE_CHECKING:
    import polars
    from matplotlib.figure import Figure


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
    def chosen(self) -> dict[str, float]:
        """The estimates by name of setting as in ``interval``; drifts are relative to the noise variance."""
        names, values = self._search.knobs.names, self._search.knobs.values(self._search.x)
        return {name: float(value) for name, value in zip(names, values, strict=True)}

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield facts(
            ("Tracker", shortened(repr(self.tracker))),
            ("Criterion", METHODS[self.method]),
            *([("Log-likelihood", f"{self.loglik:.6g} of {self.used} samples")] if np.isfinite(self.loglik) else []),
            ("Noise variance", f"{self.noise:.4g}"),
            *remarks_of([self.left_out] if isinstance(self.left_out, LeftOut) else self.left_out.values()),
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

        ``draws`` settings are drawn from their posterior (`driftfit.tune.averaged`) with the generator ``seed``. The
        bands are wider than those under the best settings alone, and cover where these do not. ValueError for another
        method than "ml", and for settings of several records.
        """
        return averaged(self._search, draws, seed)

    def plot(self, ax: Any = None) -> Figure:
        """The criterion along each setting, with the others optimised if it is a likelihood; a matplotlib figure.

        ``ax`` as for `Track.plot`.
        """
        return _plot(self, ax)


def _plot(tuned: Tuned, ax: Any) -> Figure:
    """One panel per knob: the criterion over its range, the chosen value, and its interval."""
    curves = tuned.curves()
    columns = min(len(curves), 2)
    figure, axes = panels(ax, (4.6 * columns, 3.2 * -(-len(curves) // 2)), len(curves), columns)
    for panel, (name, values, criterion) in zip(axes, curves, strict=True):
        memory = name == "forgetting"
        axis = (lambda v: 1.0 / (1.0 - np.asarray(v))) if memory else np.asarray
        best = tuned.chosen[name]
        with np.errstate(divide="ignore"):
            panel.semilogx(axis(values), criterion, color=BLUE, lw=1.3)
            low, high = (float(axis(end)) for end in tuned.interval[name])
            panel.axvspan(max(low, axis(values).min()), min(high, axis(values).max()), color=BLUE, alpha=0.15, lw=0)
            if 0.0 < axis(best) < np.inf:
                panel.axvline(float(axis(best)), color=RED, lw=1.0)
        if tuned.method == "ml":  # far from the optimum a likelihood falls by hundreds; only the top matters
            panel.set_ylim(criterion.max() - 12.0, criterion.max() + 1.0)
        panel.set_xlabel("memory 1 / (1 - forgetting)" if memory else name)
        panel.set_ylabel({"ml": "log-likelihood", "h-step": "mean square"}.get(tuned.method, tuned.method))
        panel.grid(alpha=0.25, lw=0.5)
    return figure
