"""Pictures of results. matplotlib is imported only here."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from driftfit.engine.settings import near
from driftfit.run.fleet import Fleet
from driftfit.run.outputs import Outputs
from driftfit.run.result import Track
from driftfit.show.fleet_summary import summarise
from driftfit.show.parts.axes import date_axis, draw_innovation, draw_parameter, draw_prediction, new_figure, time_label
from driftfit.show.parts.text import key_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
    """One parameter of the results that moved most and have it, one panel per result, all on one scale."""
    units = summarise(fleet).units
    if not units:
        raise ValueError("plot: no series has a result to draw; fleet.failed has the reasons.")
    if which is None:
        which = Counter(unit.parameter for unit in units[:most]).most_common(1)[0][0]
    if which not in fleet.names:
        raise ValueError(f"plot: no parameter {which!r}; {near(which, fleet.names)}")
    runs = dict(fleet.items())
    shown = [(unit.key, run) for unit in units if which in (run := runs[unit.key]).names][:most]
    columns = min(4, len(shown))
    rows = -(-len(shown) // columns)
    figure = new_figure(2.6 * columns + 0.6, 1.7 * rows + 0.6)
    axes = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
    views = []
    for axis, (key, run) in zip(axes, shown, strict=False):
        draw_parameter(axis, run, run.names.index(which), level)
        views.append(axis.get_ylim())
        axis.set_title(key_text(key), fontsize=9)
        axis.tick_params(labelsize=8)
        axis.set_ylabel("")
        date_axis(axis, run)
    axes[0].set_ylim(min(low for low, _ in views), max(high for _, high in views))
    for axis in axes[len(shown) :]:
        axis.set_visible(False)
    first = shown[0][1]
    figure.supylabel(f"{which}  {first.units[first.names.index(which)]}".strip(), fontsize=10)
    figure.supxlabel(time_label(first), fontsize=10)
    return figure


def plot_outputs(run: Outputs, level: float = 0.95) -> Figure:
    """Parameters with bands, a row of pictures for each output."""
    rows, n = len(run.outputs), len(run.names[0])
    figure = new_figure(max(6.0, 2.6 * n), 1.8 * rows + 0.6)
    axes = figure.subplots(rows, n, sharex=True, squeeze=False)
    for row, one in zip(axes, run.values(), strict=True):
        for i, axis in enumerate(row):
            draw_parameter(axis, one, i, level)
    return figure
