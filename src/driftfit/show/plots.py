"""Pictures of results. matplotlib is imported only here."""

from __future__ import annotations

from collections import Counter
from statistics import NormalDist
from typing import TYPE_CHECKING
from zoneinfo import ZoneInfo

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import near
from driftfit.show.summary import key_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from driftfit.run.fleet import Fleet
    from driftfit.run.outputs import Outputs
    from driftfit.run.result import Track
    from driftfit.smooth.piecewise import Segments
    from driftfit.smooth.smoothed import Smoothed

BLUE, RED, GREY = "#1f5fa8", "#c23b22", "#8a8a8a"


def new_figure(width: float, height: float) -> Figure:
    """An empty figure without a window, so that it needs no display and is freed like any object."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError('plots need matplotlib: pip install "driftfit[plot]"') from None
    return Figure(figsize=(width, height), layout="constrained")


def plot_track(run: Track, level: float = 0.95) -> Figure:
    """Parameters with bands, prediction against output, innovations with their band."""
    n = run.model.n
    columns = 1 if n <= 4 else 2 if n <= 12 else 4
    rows = -(-n // columns)
    figure = new_figure(9.0, 1.5 * rows + 4.2)
    grid = figure.add_gridspec(rows + 2, columns, height_ratios=[*[1.5] * rows, 2.3, 1.7])
    error = figure.add_subplot(grid[-1, :])
    signal = figure.add_subplot(grid[-2, :], sharex=error)
    signal.tick_params(labelbottom=False)
    for i in range(n):
        axis = figure.add_subplot(grid[i // columns, i % columns], sharex=error)
        axis.tick_params(labelbottom=columns > 1 and i + columns >= n)
        draw_parameter(axis, run, i, level)
    draw_prediction(signal, run)
    draw_innovation(error, run, level)
    error.set_xlabel(time_label(run))
    date_axis(error, run)
    figure.align_ylabels()
    return figure


def plot_fleet(fleet: Fleet, which: str | None = None, most: int = 12, level: float = 0.95) -> Figure:
    """One parameter of the series that moved most, one panel per series, all on one scale."""
    units = fleet.summary().units
    if which is None:
        which = Counter(unit.parameter for unit in units[:most]).most_common(1)[0][0]
    if which not in fleet.names:
        raise ValueError(f"plot: no parameter {which!r}; {near(which, fleet.names)}")
    i = fleet.names.index(which)
    shown = units[:most]
    columns = min(4, len(shown))
    rows = -(-len(shown) // columns)
    figure = new_figure(2.6 * columns + 0.6, 1.7 * rows + 0.6)
    axes = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
    views = []
    for axis, unit in zip(axes, shown, strict=False):
        run = fleet[unit.key]
        draw_parameter(axis, run, i, level)
        views.append(axis.get_ylim())
        axis.set_title(key_text(unit.key), fontsize=9)
        axis.tick_params(labelsize=8)
        axis.set_ylabel("")
        date_axis(axis, run)
    axes[0].set_ylim(min(low for low, _ in views), max(high for _, high in views))
    for axis in axes[len(shown) :]:
        axis.set_visible(False)
    figure.supylabel(f"{which}  {fleet[shown[0].key].units[i]}".strip(), fontsize=10)
    figure.supxlabel(time_label(fleet[shown[0].key]), fontsize=10)
    return figure


def named(name: str, unit: str) -> str:
    """A name with its unit, if it has one."""
    return f"{name} ({unit})" if unit else name


def time_label(run: Track) -> str:
    """The label of the time axis."""
    if run._time is None:
        return "sample"
    name = run.labels.time or "time"
    return named(name, run.labels.units.get(name, ""))


def date_axis(axis: Axes, run: Track) -> None:
    """Ticks at round dates in the time zone of the table; each part of the date is written once."""
    if run.time.dtype.kind != "M":
        return
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    zone = ZoneInfo(run.labels.zone) if run.labels.zone else None
    locator = AutoDateLocator(tz=zone, minticks=2, maxticks=6)
    axis.xaxis.set_major_locator(locator)
    axis.xaxis.set_major_formatter(ConciseDateFormatter(locator, tz=zone))


def draw_prediction(axis: Axes, run: Track) -> None:
    """The output, and its prediction one step ahead."""
    axis.plot(run.time, run.y, color=GREY, ls="", marker=".", ms=3.0, label="output")
    # before anything is known the prediction is theta0's, which means nothing
    known = np.where(np.isinf(run.innovation_std), np.nan, run.prediction)
    axis.plot(run.time, known, color=BLUE, lw=0.9, label="one-step prediction")
    frame(axis, np.concatenate([run.y, run.prediction[settled(run)]]))
    axis.set_ylabel(named(run.labels.y, run.labels.units.get(run.labels.y, "")))
    axis.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), fontsize=8, ncols=2, frameon=False)


def draw_innovation(axis: Axes, run: Track, level: float = 0.95) -> None:
    """Innovations and their band."""
    std = np.where(np.isfinite(run.innovation_std), run.innovation_std, np.nan)
    half = NormalDist().inv_cdf(0.5 + level / 2.0) * std
    axis.fill_between(run.time, -half, half, color=BLUE, alpha=0.15, lw=0)
    axis.plot(run.time, run.innovation, color=BLUE, lw=0.8)
    late = settled(run)
    frame(axis, np.concatenate([run.innovation[late], -half[late], half[late]]))
    axis.axhline(0.0, color=GREY, lw=0.6)
    axis.set_ylabel("innovation")


def draw_parameter(axis: Axes, run: Track, i: int, level: float = 0.95) -> None:
    """One parameter and its band; the view is that of the path after the start, where bands are wide."""
    low, high = run.band(level)
    low, high = low[:, i], high[:, i]
    known = np.isfinite(low) & np.isfinite(high)
    axis.fill_between(
        run.time, np.where(known, low, np.nan), np.where(known, high, np.nan), color=BLUE, alpha=0.2, lw=0
    )
    axis.plot(run.time, run.theta[:, i], color=BLUE, lw=1.3)
    axis.set_ylabel(f"{run.names[i]}\n{run.units[i]}".strip())
    late = settled(run)
    frame(axis, np.concatenate([run.theta[late, i], low[late], high[late]]))
    axis.grid(alpha=0.25, lw=0.5)


def settled(run: Track) -> slice:
    """The part of a run whose picture is not dominated by the start."""
    return slice(min(max(50, 5 * run.model.n), len(run) // 3), None)


def frame(axis: Axes, values: Array) -> None:
    """Set the view to the finite values and a margin."""
    shown = values[np.isfinite(values)]
    if shown.size and np.ptp(shown) > 0.0:
        margin = 0.08 * np.ptp(shown)
        axis.set_ylim(shown.min() - margin, shown.max() + margin)


def plot_smoothed(smoothed: Smoothed, level: float = 0.95) -> Figure:
    """Parameters with bands, smoothed over filtered."""
    n = len(smoothed.names)
    columns = 1 if n <= 4 else 2 if n <= 12 else 4
    rows = -(-n // columns)
    figure = new_figure(9.0, 1.7 * rows + 0.8)
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    low, high = smoothed.band(level)
    for i, axis in enumerate(axes):
        axis.set_visible(i < n)
        if i < n:
            known = np.isfinite(low[:, i]) & np.isfinite(high[:, i])
            axis.fill_between(smoothed.time, low[:, i], high[:, i], where=known, color=BLUE, alpha=0.2, lw=0)
            axis.plot(smoothed.time, smoothed.theta[:, i], color=BLUE, lw=1.4, label="smoothed")
            view = axis.get_ylim()
            axis.plot(smoothed.time, smoothed.run.theta[:, i], color=GREY, lw=0.8, zorder=1, label="filtered")
            axis.set_ylim(*view)
            axis.set_ylabel(smoothed.names[i])
            axis.grid(alpha=0.25, lw=0.5)
    axes[0].legend(loc="best", fontsize=8, ncols=2, frameon=False)
    axes[-1].set_xlabel("time" if smoothed.run._time is not None else "sample")
    return figure


def plot_segments(segments: Segments, level: float = 0.95) -> Figure:
    """Constant parameters with bands, segment by segment, over the tracked path."""
    run, n = segments.run, len(segments.names)
    figure = new_figure(9.0, 1.7 * n + 0.8)
    axes = figure.subplots(n, 1, sharex=True, squeeze=False).ravel()
    half = NormalDist().inv_cdf(0.5 + level / 2.0) * segments.std
    for i, axis in enumerate(axes):
        axis.plot(run.time, run.theta[:, i], color=GREY, lw=0.8, label="tracked")
        for k, (a, b) in enumerate(zip(segments.bounds[:-1], segments.bounds[1:], strict=True)):
            reach, value = run.time[[a, b - 1]], segments.theta[k, i]
            axis.plot(reach, [value, value], color=BLUE, lw=1.6, label="segment" if k == 0 else None)
            if np.isfinite(half[k, i]):
                axis.fill_between(reach, value - half[k, i], value + half[k, i], color=BLUE, alpha=0.2, lw=0)
        low, high = segments.theta[:, i] - half[:, i], segments.theta[:, i] + half[:, i]
        frame(axis, np.concatenate([low, high, run.theta[settled(run), i]]))
        axis.set_ylabel(segments.names[i])
        axis.grid(alpha=0.25, lw=0.5)
    axes[0].legend(loc="best", fontsize=8, ncols=2, frameon=False)
    axes[-1].set_xlabel(time_label(run))
    date_axis(axes[-1], run)
    return figure


def plot_outputs(run: Outputs, level: float = 0.95) -> Figure:
    """Parameters with bands, a row of pictures for each output."""
    rows, n = len(run.outputs), len(run.names[0])
    figure = new_figure(max(6.0, 2.6 * n), 1.8 * rows + 0.6)
    axes = figure.subplots(rows, n, sharex=True, squeeze=False)
    for row, one in zip(axes, run, strict=True):
        for i, axis in enumerate(row):
            draw_parameter(axis, one, i, level)
    return figure
