"""The frontier of flexible least squares: the trade-off between fit and movement over all mu.

    r_M^2(mu) = sum w_k (y_k - phi_k' theta_k)^2          r_D^2(mu) = sum |theta_{k+1} - theta_k|^2 / (dt d)

of the smoothed path (with ``differences=2`` r_D^2 is of its slope instead of theta). The curve is convex; r_M^2 does
not fall and r_D^2 does not rise with mu, and d r_M^2 / d r_D^2 = -mu exactly. It has no corner at which to choose mu:
in logarithms there is none because r_M^2 goes to 0 with mu, and on linear axes the bend depends on the scaling;
`tune` estimates mu.

Source: Kalaba and Tesfatsion (1989), who call it the residual efficiency frontier. Cost: one smoothing per point.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from driftfit.data.arguments import check_role
from driftfit.data.record import Reading, Record
from driftfit.engine.kernel import Array
from driftfit.judge.constant_fit import constant_outputs
from driftfit.models.base import Model
from driftfit.run.program import Program
from driftfit.run.result import Track, track_record
from driftfit.run.track import track
from driftfit.show.axes import BLUE, GREY, RED, panels
from driftfit.show.text import ByOutput, printing, some_rows, table_of
from driftfit.smooth.smoothed import Smoothed
from driftfit.trackers.fls import FLS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@printing
class Frontier(NamedTuple):
    """mu, measurement cost r_M^2 and dynamic cost r_D^2, (S,) each, sorted by mu; printing it shows a table."""

    mu: Array
    measurement: Array
    dynamic: Array

    def __rich__(self) -> Any:
        rows = some_rows(len(self.mu))
        table = table_of(f"Frontier, {len(rows)} of {len(self.mu)} weights", "mu", "measurement cost", "dynamic cost")
        for i in rows:
            table.add_row(*(f"{column[i]:.4g}" for column in self))
        return table

    def plot(self, ax: Any = None) -> Figure:
        """r_M^2 against r_D^2, and both against mu; a matplotlib figure. ``ax`` as for `Track.plot`."""
        figure, (left, right) = panels(ax, (9.0, 3.6), 2, 2)
        left.loglog(self.dynamic, self.measurement, color=BLUE, lw=1.3, marker="o", ms=2.5)
        for i in range(0, len(self.mu), max(len(self.mu) // 6, 1)):
            point = (self.dynamic[i], self.measurement[i])
            left.annotate(
                f"{self.mu[i]:.2g}", point, (-4, -10), textcoords="offset points", ha="right", fontsize=7, color=GREY
            )
        left.set_xlabel("dynamic cost r_D^2")
        left.set_ylabel("measurement cost r_M^2 (numbers: mu)")
        right.loglog(self.mu, self.measurement, color=BLUE, lw=1.3, label="measurement cost r_M^2")
        right.loglog(self.mu, self.dynamic, color=RED, lw=1.3, label="dynamic cost r_D^2")
        right.set_xlabel("mu")
        right.legend(fontsize=8, frameon=False)
        for axis in (left, right):
            axis.grid(alpha=0.25, lw=0.5)
        return figure


def frontier(
    model: Model, y: Any, u: Any = None, *, mu: Any = None, differences: int = 1, data: Any = None, **known: Any
) -> Frontier | ByOutput[Frontier]:
    """The two costs of the smoothed path for every mu.

    Parameters
    ----------
    model, y, u, data, and time, dt, weights, drift
        As for `track`: with ``data`` the others name its columns.
    mu : (S,) or None
        Weights, positive. None: four per decade, from 1e-4 to 1e5 (1e10 for second differences) times the mean of
        phi' phi.
    differences : 1 or 2
        As for `FLS`.

    Returns
    -------
    Frontier. A model with several outputs gives one for each, by name (if they share one theta, one for all).

    Raises
    ------
    ValueError
        If a mu is not positive, and for everything that `track` does not accept.
    """
    check_role("frontier", "model", model, Model)
    reading = Reading(**known)
    if len(model.outputs) > 1:
        runs = constant_outputs(model, y, u, reading, data)
        found = {name: _of(run.model, run.record, mu, differences) for name, (run,) in runs.items()}
        return found["rows"] if model.shared else ByOutput(found)
    run = track(model, FLS(1.0), y, u, reading, data=data)
    assert isinstance(run, Track)
    return _of(run.model, run.record, mu, differences)


def _of(model: Model, record: Record, mu: Any, differences: int) -> Frontier:
    """The frontier of one record."""
    if mu is None:
        walk = _path(model, FLS(1.0), record).walk
        used = walk.weight > 0.0
        power = float(np.mean(walk.weight[used] * np.sum(walk.phi[used] ** 2, axis=1))) if used.any() else 1.0
        mu = power * np.logspace(-4.0, 5.0 * differences, 17 + 20 * differences)
    weights = np.sort(np.atleast_1d(np.asarray(mu, dtype=float)))
    paths = [_path(model, FLS(float(m), differences=differences), record) for m in weights]
    return Frontier(weights, np.array([p.measurement_cost for p in paths]), np.array([_movement(p) for p in paths]))


def _path(model: Model, tracker: FLS, record: Record) -> Smoothed:
    """The smoothed path of a record."""
    return Smoothed.of(track_record(Program(model, tracker), record))


def _movement(path: Smoothed) -> float:
    """r_D^2 from the path itself, because the difference of J and r_M^2 has no accurate digits for large mu."""
    walk = path.walk
    steps = np.diff(path.slope if len(walk.trend) else path.theta, axis=0) ** 2
    factors = np.broadcast_to(
        walk.drift[1:, None] * (walk.drift_root[1:] ** 2 if len(walk.drift_root) else 1.0), steps.shape
    )
    return float(np.sum(np.divide(steps, factors, out=np.zeros_like(steps), where=factors > 0.0)))
