"""Pictures of runs, of many runs and of pages; `driftfit.show.axes` draws their parts."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

from driftfit.engine.settings import near
from driftfit.run.fleet import Fleet, Outputs
from driftfit.run.result import Track
from driftfit.show.axes import date_axis, draw_innovation, draw_parameter, draw_prediction, panels, time_label
from driftfit.show.summary import summarise_fleet
from driftfit.show.text import key_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_track(run: Track, level: float = 0.95, ax: Any = None) -> Figure:
    """Parameters with bands, prediction against output, innovations with their band."""
    n = len(run.names)
    columns = 1 if n <= 4 else 2 if n <= 12 else 4
    rows = -(-n // columns)
    heights = [*[1.5] * rows, 2.3, 1.7]
    figure, axes = panels(ax, (9.0, 1.5 * rows + 4.2), n + 2, columns, sharex=True, heights=heights, wide=2)
    for i, axis in enumerate(axes[:n]):
        draw_parameter(axis, run, i, level)
    draw_prediction(axes[-2], run)
    draw_innovation(axes[-1], run, level)
    axes[-1].set_xlabel(time_label(run))
    date_axis(axes[-1], run)
    figure.align_ylabels(axes)
    return figure


def plot_parameters(run: Track) -> Figure:
    """The parameters with their bands, for a page."""
    n = len(run.names)
    columns = 1 if n <= 3 else 2
    figure, axes = panels(None, (9.5, 1.55 * -(-n // columns) + 0.5), n, columns, sharex=True)
    for i, axis in enumerate(axes):
        draw_parameter(axis, run, i)
        date_axis(axis, run)
    for axis in axes[-columns:]:
        axis.set_xlabel(time_label(run))
    return figure


def plot_signals(run: Track) -> Figure:
    """The output with its prediction, and the innovations, for a page."""
    figure, (signal, error) = panels(None, (9.5, 4.6), 2, sharex=True, heights=[2.0, 1.3])
    draw_prediction(signal, run)
    draw_innovation(error, run)
    error.set_xlabel(time_label(run))
    date_axis(error, run)
    return figure


def plot_fleet(fleet: Fleet, which: str | None = None, most: int = 12, level: float = 0.95, ax: Any = None) -> Figure:
    """One parameter of the results that moved most and have it, one panel per result, all on one scale."""
    units = summarise_fleet(fleet).units
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
    figure, axes = panels(ax, (2.6 * columns + 0.6, 1.7 * rows + 0.6), len(shown), columns, sharey=True)
    views = []
    for i, (axis, (key, run)) in enumerate(zip(axes, shown, strict=True)):
        draw_parameter(axis, run, run.names.index(which), level)
        views.append(axis.get_ylim())
        axis.set_title(key_text(key), fontsize=9)
        axis.tick_params(labelsize=8)
        axis.set_ylabel("" if i % columns else f"{which}  {run.units[run.names.index(which)]}".strip(), fontsize=9)
        axis.set_xlabel(time_label(run) if i + columns >= len(shown) else "", fontsize=9)
        date_axis(axis, run)
    axes[0].set_ylim(min(low for low, _ in views), max(high for _, high in views))
    return figure


def plot_outputs(run: Outputs, level: float = 0.95, ax: Any = None) -> Figure:
    """Parameters with bands, a row of pictures for each output."""
    rows, n = len(run.outputs), len(run.names[0])
    figure, axes = panels(ax, (max(6.0, 2.6 * n), 1.8 * rows + 0.6), rows * n, n, sharex=True)
    for k, one in enumerate(run.values()):
        for i, axis in enumerate(axes[k * n : (k + 1) * n]):
            draw_parameter(axis, one, i, level)
    return figure
