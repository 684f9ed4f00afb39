"""Parts of pictures. matplotlib is imported here and nowhere else."""

from __future__ import annotations

from statistics import NormalDist
from typing import TYPE_CHECKING
from zoneinfo import ZoneInfo

import numpy as np

from driftfit.engine.kernel import Array
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
    return slice(min(burn_in(run.model.n), len(run) // 3), None)


def frame(axis: Axes, values: Array) -> None:
    """Set the view to the finite values and a margin."""
    shown = values[np.isfinite(values)]
    if shown.size and np.ptp(shown) > 0.0:
        margin = 0.08 * np.ptp(shown)
        axis.set_ylim(shown.min() - margin, shown.max() + margin)
