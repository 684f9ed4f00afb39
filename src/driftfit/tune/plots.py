"""Pictures of tuning: the criterion along each setting, and the frontier of the two costs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from driftfit.show.plots import BLUE, GREY, RED, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from driftfit.tune.frontier import Frontier
    from driftfit.tune.tune import Tuned


def plot_tuned(tuned: Tuned) -> Figure:
    """One panel per knob: the criterion over its range, the chosen value, and its interval."""
    curves = tuned.curves()
    figure = new_figure(4.6 * min(len(curves), 2), 3.2 * -(-len(curves) // 2))
    panels = figure.subplots(-(-len(curves) // 2), min(len(curves), 2), squeeze=False).ravel()
    for panel, (name, values, criterion) in zip(panels, curves, strict=False):
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
    for panel in panels[len(curves) :]:
        panel.set_visible(False)
    return figure


def plot_frontier(frontier: Frontier) -> Figure:
    """Measurement cost against dynamic cost, and both against mu."""
    figure = new_figure(9.0, 3.6)
    left, right = figure.subplots(1, 2)
    left.loglog(frontier.dynamic, frontier.measurement, color=BLUE, lw=1.3, marker="o", ms=2.5)
    for i in range(0, len(frontier.mu), max(len(frontier.mu) // 6, 1)):
        point = (frontier.dynamic[i], frontier.measurement[i])
        left.annotate(
            f"{frontier.mu[i]:.2g}", point, (-4, -10), textcoords="offset points", ha="right", fontsize=7, color=GREY
        )
    left.set_xlabel("dynamic cost r_D^2")
    left.set_ylabel("measurement cost r_M^2 (numbers: mu)")
    right.loglog(frontier.mu, frontier.measurement, color=BLUE, lw=1.3, label="measurement cost r_M^2")
    right.loglog(frontier.mu, frontier.dynamic, color=RED, lw=1.3, label="dynamic cost r_D^2")
    right.set_xlabel("mu")
    right.legend(fontsize=8, frameon=False)
    for axis in (left, right):
        axis.grid(alpha=0.25, lw=0.5)
    return figure
