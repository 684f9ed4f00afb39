"""Parts of pictures. matplotlib is imported here and nowhere else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zoneinfo import ZoneInfo

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.run.live.conformal import quantile
from driftfit.run.result import Track, burn_in

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


BLUE, RED, GREY = "#1f5fa8", "#c23b22", "#8a8a8a"


def new_figure(width: float, height: float) -> Figure:
    """An empty figure without a window, so that it needs no display and is freed like any object."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError('plots need matplotlib: pip install "driftfit[plot]"') from None
    return Figure(figsize=(width, height), layout="constrained")


def check_picture(path: Path) -> None:
    """ValueError for the ending of a name in which no picture can be written."""
    ending, canvas = path.suffix.lower(), new_figure(1.0, 1.0).canvas
    if ending and ending[1:] not in canvas.get_supported_filetypes():
        raise ValueError(f"{path}: pictures are written to .png, .pdf, .svg, by the ending of the name.")


def panels(
    ax: Any, size: tuple[float, float], count: int = 1, columns: int = 1, *, sharex: bool = False,
    sharey: bool = False, heights: Sequence[float] | None = None, wide: int = 0,
) -> tuple[Figure, list[Axes]]:  # fmt: skip
    """The figure of a picture and its ``count`` panels, row by row.

    ``ax`` is what users pass: None for a new figure of this size in inches; axes, whose place the panels share (a
    single panel is the axes themselves); or as many axes as the picture has panels. Each of the last ``wide`` panels
    has a row. ValueError for another number of axes.
    """
    if ax is not None:
        given = list(np.ravel(ax))
        if len(given) == count:
            return given[0].figure, given
        if len(given) != 1:
            raise ValueError(f"plot: ax= must be one axes, or {count} of them, one for each panel; got {len(given)}.")
    narrow = count - wide
    rows = -(-narrow // columns)
    figure, grid = _grid(ax, size, rows + wide, columns, heights)
    axes: list[Axes] = []
    for i in range(count):
        cell = grid[divmod(i, columns)] if i < narrow else grid[rows + i - narrow, :]
        first = axes[0] if axes else None
        axes.append(figure.add_subplot(cell, sharex=first if sharex else None, sharey=first if sharey else None))
        below = i + columns < narrow or (i < narrow and wide and columns == 1) or narrow <= i < count - 1
        axes[-1].tick_params(labelbottom=not (sharex and below), labelleft=not (sharey and i % columns))
    return figure, axes


def _grid(ax: Any, size: tuple[float, float], rows: int, columns: int, heights: Sequence[float] | None) -> Any:
    """(figure, grid of cells): in a new figure, or in the place of the axes, which are hidden."""
    if ax is None:
        figure = new_figure(*size)
        return figure, figure.add_gridspec(rows, columns, height_ratios=heights)
    (axes,) = np.ravel(ax)
    axes.set_axis_off()
    spec = axes.get_subplotspec()
    if spec is not None:
        return axes.figure, spec.subgridspec(rows, columns, height_ratios=heights)
    box = axes.get_position()
    edges = {"left": box.x0, "right": box.x1, "bottom": box.y0, "top": box.y1}
    return axes.figure, axes.figure.add_gridspec(rows, columns, height_ratios=heights, **edges)


def named(name: str, unit: str) -> str:
    """A name with its unit, if it has one."""
    return f"{name} ({unit})" if unit else name


def time_label(run: Track) -> str:
    """The label of the time axis."""
    if not run.timed:
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
    # the first predictions come from theta0 alone and mean nothing
    known = np.where(np.isinf(run.innovation_std), np.nan, run.prediction)
    axis.plot(run.time, known, color=BLUE, lw=0.9, label="one-step prediction")
    frame(axis, np.concatenate([run.y, run.prediction[settled(run)]]))
    axis.set_ylabel(named(run.labels.y, run.labels.units.get(run.labels.y, "")))
    axis.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), fontsize=8, ncols=2, frameon=False)


def draw_innovation(axis: Axes, run: Track, level: float = 0.95) -> None:
    """Innovations and their band."""
    std = np.where(np.isfinite(run.innovation_std), run.innovation_std, np.nan)
    half = quantile(level) * std
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
    return slice(min(burn_in(run.model.n), len(run) // 3), None)


def frame(axis: Axes, values: Array) -> None:
    """Set the view to the finite values and a margin."""
    shown = values[np.isfinite(values)]
    if shown.size and np.ptp(shown) > 0.0:
        margin = 0.08 * np.ptp(shown)
        axis.set_ylim(shown.min() - margin, shown.max() + margin)
