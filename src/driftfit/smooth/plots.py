"""Pictures of smoothed paths and of segments."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.run.result import Track
from driftfit.show.axes import BLUE, GREY, date_axis, frame, panels, settled, time_label

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_smoothed(run: Track, theta: Array, low: Array, high: Array, ax: Any = None) -> Figure:
    """Parameters with bands, smoothed over filtered."""
    n = len(run.names)
    columns = 1 if n <= 4 else 2 if n <= 12 else 4
    rows = -(-n // columns)
    figure, axes = panels(ax, (9.0, 1.7 * rows + 0.8), n, columns, sharex=True)
    for i, axis in enumerate(axes):
        known = np.isfinite(low[:, i]) & np.isfinite(high[:, i])
        axis.fill_between(run.time, low[:, i], high[:, i], where=known, color=BLUE, alpha=0.2, lw=0)
        axis.plot(run.time, theta[:, i], color=BLUE, lw=1.4, label="smoothed")
        view = axis.get_ylim()
        axis.plot(run.time, run.theta[:, i], color=GREY, lw=0.8, zorder=1, label="filtered")
        axis.set_ylim(*view)
        axis.set_ylabel(run.names[i])
        axis.grid(alpha=0.25, lw=0.5)
    axes[0].legend(loc="best", fontsize=8, ncols=2, frameon=False)
    axes[-1].set_xlabel("time" if run.timed else "sample")
    return figure


def plot_segments(run: Track, bounds: Sequence[int], theta: Array, std: Array, level: float, ax: Any = None) -> Figure:
    """Constant parameters with bands, segment by segment, over the tracked path."""
    n = len(run.names)
    figure, axes = panels(ax, (9.0, 1.7 * n + 0.8), n, sharex=True)
    half = NormalDist().inv_cdf(0.5 + level / 2.0) * std
    for i, axis in enumerate(axes):
        axis.plot(run.time, run.theta[:, i], color=GREY, lw=0.8, label="tracked")
        for k, (a, b) in enumerate(pairwise(bounds)):
            reach, value = run.time[[a, b - 1]], theta[k, i]
            axis.plot(reach, [value, value], color=BLUE, lw=1.6, label="segment" if k == 0 else None)
            if np.isfinite(half[k, i]):
                axis.fill_between(reach, value - half[k, i], value + half[k, i], color=BLUE, alpha=0.2, lw=0)
        low, high = theta[:, i] - half[:, i], theta[:, i] + half[:, i]
        frame(axis, np.concatenate([low, high, run.theta[settled(run), i]]))
        axis.set_ylabel(run.names[i])
        axis.grid(alpha=0.25, lw=0.5)
    axes[0].legend(loc="best", fontsize=8, ncols=2, frameon=False)
    axes[-1].set_xlabel(time_label(run))
    date_axis(axes[-1], run)
    return figure
