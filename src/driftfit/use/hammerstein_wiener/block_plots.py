"""Plots of blocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from driftfit.show.axes import date_axis, frame, panels, settled, time_label
from driftfit.use.hammerstein_wiener.run_blocks import blocks_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from driftfit.run.result import Track

POINTS = 200


def plot_blocks(run: Track, method: str = "svd-joint", times: Sequence[int] | None = None, ax: Any = None) -> Figure:
    """The curves of the inputs and the output at samples ``times`` (four by default), and a, b, c, d over time."""
    from matplotlib import colormaps

    found = blocks_of(run, method)
    T, m = len(run), found.model.m
    chosen = [T // 4, T // 2, 3 * T // 4, T - 1] if times is None else [range(T)[t] for t in times]
    colours = colormaps["viridis"](np.linspace(0.0, 0.85, len(chosen)))
    heights = [1.4] * (m // 2 + 1) + [1.0] * (-(-(m + 5) // 2) - m // 2 - 1)
    figure, axes = panels(ax, (9.0, 2.2 * len(heights)), m + 5, 2, heights=heights)
    curves, below = axes[: m + 1], axes[m + 1 :]
    *lefts, right = curves
    y = _points(run.y)
    for t, colour in zip(chosen, colours, strict=True):
        label = run.time_text(t) if run.timed else f"sample {t}"
        for i, left in enumerate(lefts):
            u = _points(run.u[:, i])
            left.plot(u, found.input_curve(u, t, i), color=colour, lw=1.3, label=label)
        right.plot(found.output_curve(y, t), y, color=colour, lw=1.3)
    for i, left in enumerate(lefts):
        name = run.labels.u[i] if run.labels.u else "u" if m == 1 else f"u{i + 1}"
        left.set(xlabel=name, ylabel="v", title="input block" if m == 1 else f"block of {name}")
    right.set(xlabel="w", ylabel=run.labels.y, title="output block")
    lefts[0].legend(fontsize=8, frameon=False)
    groups = zip(below, "abcd", (found.a, found.b, found.c, found.d), found.names, found.std, strict=True)
    for place, (axis, letter, group, names, std) in enumerate(groups):
        _paths(axis, run, group, names, std)
        axis.set_ylabel(letter)
        if place > 1:
            axis.set_xlabel(time_label(run))
        date_axis(axis, run)
    for axis in curves:
        axis.title.set_fontsize(10)
        axis.grid(alpha=0.25, lw=0.5)
    return figure


def _points(signal: Any) -> Any:
    """Points over the central 99 % of a signal."""
    values = signal[np.isfinite(signal)]
    low, high = np.quantile(values, (0.005, 0.995)) if values.size else (-1.0, 1.0)
    return np.linspace(low, high, POINTS)


def _paths(axis: Axes, run: Track, group: Any, names: Any, std: Any) -> None:
    """Coefficients over time, with bands of two standard deviations if known; the leading 1 is left out."""
    late = settled(run)
    shown = [i for i in range(group.shape[1]) if not np.all(group[late, i] == 1.0)]
    for i in shown:
        (line,) = axis.plot(run.time, group[:, i], lw=1.2, label=names[i])
        known = np.isfinite(std[:, i])
        low, high = group[:, i] - 2.0 * std[:, i], group[:, i] + 2.0 * std[:, i]
        axis.fill_between(run.time, low, high, where=known, color=line.get_color(), alpha=0.2, lw=0)
    if shown:
        frame(axis, group[late][:, shown].ravel())
        axis.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=len(shown))
    else:
        axis.text(0.5, 0.5, "the identity", transform=axis.transAxes, ha="center", va="center", color="grey")
        axis.set_axis_off()
    axis.grid(alpha=0.25, lw=0.5)
