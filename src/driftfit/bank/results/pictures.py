"""Plots of hypotheses: probabilities stacked below the parameters, with events marked; the present tree."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from driftfit.bank.layout import COUNTER
from driftfit.bank.leaves.leaf_matrix import CODE, WEIGHT
from driftfit.bank.reduction import GPB, Decide
from driftfit.bank.results.events import Event
from driftfit.bank.results.mixture import mixture_of
from driftfit.engine.kernel import Array
from driftfit.run.live.live import Live
from driftfit.run.result import Track
from driftfit.show.axes import BLUE, GREY, RED, date_axis, draw_parameter, panels, time_label

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = ("#e8e8e8", "#c23b22", "#1f5fa8", "#e0a030", "#4f8f5b", "#7a5195", "#8c6d46", "#5fb5c4")
"""Colours of events, the normal course first."""


def plot_hypotheses(
    run: Track, latest: Array, names: tuple[str, ...], events: list[Event], level: float, ax: Any = None
) -> Figure:
    """Parameters with bands; under them the probabilities (T, H) of events; changes as lines, faults as shades."""
    n = run.model.n
    figure, axes = panels(ax, (9.0, 1.4 * n + 2.6), n + 1, sharex=True, heights=[*[1.4] * n, 1.6])
    for i in range(n):
        draw_parameter(axes[i], run, i, level)
    below, colours = axes[n], [COLOURS[k % len(COLOURS)] for k in range(len(names))]
    below.stackplot(run.time, np.nan_to_num(latest).T, labels=names, colors=colours, step="mid", linewidth=0)
    below.set_ylim(0.0, 1.0)
    below.set_ylabel("events")
    below.legend(loc="upper center", bbox_to_anchor=(0.5, -0.28), ncols=min(len(names), 4), fontsize=8, frameon=False)
    for event in events:
        if event.kind == "change":
            for axis in axes[:n]:
                axis.axvline(event.date, color=RED, linewidth=1.0, linestyle=":")
        else:
            for axis in axes[:n]:
                last = min(event.span.last + 1, len(run) - 1)
                axis.axvspan(event.first, run.time[last], color=GREY, alpha=0.25, linewidth=0)
    axes[n].set_xlabel(time_label(run))
    date_axis(axes[n], run)
    figure.align_ylabels(axes)
    return figure


def plot_tree(live: Live, levels: int = 3, ax: Any = None) -> Figure:
    """The tree of hypotheses of a stream that decides (`Decide`, `GPB`): events as branches, weights as widths.

    The newest levels are drawn, with the oldest on the left; each leaf is labelled with its weight and its mean.
    ``ax``: the axes to draw in; None for a new figure.
    """
    bank: Any = live.tracker
    lane = live.lane()
    if not isinstance(getattr(bank, "reduction", None), Decide | GPB):
        raise ValueError("plot_tree: a tree has codes of its histories under Decide and GPB only.")
    H = len(bank.event_names)
    B = bank.array(live.model, lane, "leaves")[:, : lane["counters"][COUNTER.many_leaves]]
    means = mixture_of(bank, live, lane).means
    depth = min(levels, max(1, round(float(np.log(max(B[CODE].max(), 1.0) + 1.0) / np.log(max(H, 2))) + 0.499)))
    figure, (axis,) = panels(ax, (2.2 * depth + 2.4, max(2.5, 0.24 * H**depth + 0.8)))
    axis.set_axis_off()
    codes, weights = B[CODE].astype(int) % H**depth, B[WEIGHT]
    height: dict[tuple[int, ...], float] = {(): (H**depth - 1) / 2.0}
    for d in range(depth):
        width = H ** (depth - 1 - d)
        for code in range(H ** (d + 1)):
            path = tuple(map(int, np.unravel_index(code, (H,) * (d + 1))))
            height[path] = code * width + (width - 1) / 2.0
            mass = float(weights[codes // width == code].sum())
            axis.plot(
                [d, d + 1], [-height[path[:-1]], -height[path]], color=BLUE if path[-1] == 0 else RED,
                linewidth=0.4 + 5.0 * mass, alpha=0.25 + 0.75 * mass, solid_capstyle="round",
            )  # fmt: skip
            if d == 0:
                axis.annotate(
                    bank.event_names[code], (0.5, -(height[()] + height[path]) / 2.0), fontsize=7, ha="center"
                )
    for code in range(H**depth):
        of = codes == code
        mass = float(weights[of].sum())
        if mass > 1e-4:
            mean = (means[of] * weights[of, None]).sum(axis=0) / mass
            text = f"{mass:.3f}  " + ", ".join(f"{value:.2f}" for value in mean)
            axis.annotate(text, (depth + 0.08, -code), fontsize=7, va="center", color=GREY)
    axis.set_xlim(-0.1, depth + 1.6)
    return figure
