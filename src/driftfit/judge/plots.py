"""Plots of diagnostics, alarms and selections."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from driftfit.engine.kernel import Array
from driftfit.show.plots import BLUE, GREY, RED, date_axis, new_figure, time_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from driftfit.judge.alarms.detect import Alarms
    from driftfit.judge.diagnose import Diagnosis
    from driftfit.judge.structures.select import Selection

COLOURS = (BLUE, RED, "#3a8f4d", "#9a6fb0", "#c08a1e", "#4aa3a8", "#7a5c46", "#d17aa5")


def draw_diagnosis(said: Diagnosis) -> Figure:
    """Six plots on one page."""
    figure = new_figure(11.0, 8.2)
    axes = figure.subplots(3, 2)
    _innovations(axes[0, 0], said)
    _correlations(axes[0, 1], said)
    _levels(axes[1, 0], said)
    _quantiles(axes[1, 1], said)
    _excitation(axes[2, 0], said)
    _paths(axes[2, 1], said)
    for axis in axes[:, 0]:
        axis.set_xlabel(time_label(said.run))
        date_axis(axis, said.run)
    date_axis(axes[2, 1], said.run)
    axes[2, 1].set_xlabel(time_label(said.run))
    return figure


def _titled(axis: Axes, title: str, ok: bool) -> None:
    axis.set_title(title if ok else f"{title}: out of bounds", fontsize=10, loc="left", color="black" if ok else RED)
    axis.grid(alpha=0.25, lw=0.5)
    axis.tick_params(labelsize=8)


def _innovations(axis: Axes, said: Diagnosis) -> None:
    axis.plot(said.run.time, said.z, ls="", marker=".", ms=2.5, color=BLUE)
    for limit in (-1.96, 1.96):
        axis.axhline(limit, color=GREY, lw=0.8, ls="--")
    shown = np.abs(said.z[np.isfinite(said.z)])
    if shown.size:
        axis.set_ylim(*(np.array([-1.1, 1.1]) * max(4.0, min(shown.max(), 12.0))))
    _titled(axis, "innovation / its standard deviation", said["outliers"].ok)


def _correlations(axis: Axes, said: Diagnosis) -> None:
    lags = np.arange(1, len(said.white.r) + 1)
    axis.bar(lags, said.white.r, width=0.5, color=BLUE)
    axis.fill_between(lags, -1.96 * said.white.std, 1.96 * said.white.std, color=GREY, alpha=0.3, lw=0)
    axis.axhline(0.0, color=GREY, lw=0.8)
    axis.set_xlabel("lag, samples", fontsize=9)
    _titled(axis, "correlation of innovations", said["whiteness (p)"].ok)


def _levels(axis: Axes, said: Diagnosis) -> None:
    """Mean square of clipped innovations in a moving window."""
    known = np.flatnonzero(np.isfinite(said.z))
    window = max(20, len(known) // 40)
    if len(known) > window:
        square = np.minimum(said.z[known] ** 2, 16.0)
        total = np.concatenate([[0.0], np.cumsum(square)])
        axis.plot(said.run.time[known[window - 1 :]], (total[window:] - total[:-window]) / window, color=BLUE, lw=1.1)
        half = 1.96 * np.sqrt(2.0 / window)
        axis.axhspan(max(1.0 - half, 0.0), 1.0 + half, color=GREY, alpha=0.25, lw=0)
    axis.set_ylim(bottom=0.0)
    fine = said["noise level"].ok and said["steady noise"].ok
    _titled(axis, f"normalised innovation squared, mean of {window}", fine)


def _quantiles(axis: Axes, said: Diagnosis) -> None:
    z = np.sort(said.z[np.isfinite(said.z)])
    if len(z):
        normal = special.ndtri((np.arange(len(z)) + 0.5) / len(z))
        axis.plot(normal, normal, color=GREY, lw=0.9)
        axis.plot(normal, np.clip(z, -12.0, 12.0), ls="", marker=".", ms=3.0, color=BLUE)
    axis.set_xlabel("normal quantile", fontsize=9)
    _titled(axis, "distribution of innovations", said["symmetry"].ok and said["outliers"].ok)


def _excitation(axis: Axes, said: Diagnosis) -> None:
    excited = said.excited
    if len(excited.at):
        time = said.run.time[said.rows.at[excited.at]]
        values = np.maximum(excited.eigenvalues, 1e-12)
        for i in range(values.shape[1]):
            last = i in (0, values.shape[1] - 1)
            axis.plot(time, values[:, i], color=RED if i == 0 else BLUE, lw=1.3 if last else 0.6)
        axis.plot(time, values[:, -1] / 1e4, color=GREY, lw=0.9, ls="--")
        axis.set_yscale("log")
    _titled(axis, "excitation: eigenvalues of windows, and the limit", said["excitation"].ok)


def _paths(axis: Axes, said: Diagnosis) -> None:
    path: Array = said.constant.path
    if len(path) and np.isfinite(path).all():
        inner = slice(len(path) // 20, len(path) - len(path) // 20)
        for i, name in enumerate(said.run.model.names):
            colour = COLOURS[i % len(COLOURS)]
            axis.plot(said.run.time[said.rows.at][inner], path[inner, i], lw=1.1, color=colour, label=name)
        axis.axhspan(-3.0, 3.0, color=GREY, alpha=0.2, lw=0)
        if path.shape[1] <= 8:
            axis.legend(fontsize=7, ncols=2, frameon=False)
    _titled(axis, "constancy: paths of the estimates, standardised", said["constancy (p)"].ok)


def plot_alarms(said: Alarms, labels: Array | None = None) -> Figure:
    """The output, and each statistic over its limit (probabilities unscaled), with alarms and labels shaded."""
    run, c = said.run, len(said.names)
    figure = new_figure(9.5, 1.5 * c + 2.0)
    axes = figure.subplots(c + 1, 1, sharex=True)
    axes[0].plot(run.time, run.y, color=BLUE, lw=0.8)
    axes[0].set_ylabel(run.labels.y)
    for j, (axis, name) in enumerate(zip(axes[1:], said.names, strict=True)):
        unit = 1.0 if said.kind == "probability" else said.limits[j]
        column, limit = said.statistic[:, j] / unit, said.limits[j] / unit
        axis.plot(run.time, column, color=BLUE, lw=0.9)
        axis.axhline(limit, color=RED, lw=0.9, ls="--", label=f"limit {said.rule.limit_text(j)}")
        axis.legend(loc="upper left", fontsize=7, frameon=False)
        axis.set_ylabel(name)
        shown = column[said.start :][np.isfinite(column[said.start :])]
        if shown.size:
            axis.set_ylim(min(shown.min(), 0.0) - 0.1, min(max(1.3 * limit, 1.1 * shown.max()), 8.0))
    for axis in axes:
        for shaded, colour in ((said.active, RED), (labels, GREY)):
            if shaded is not None:
                low, high = axis.get_ylim()
                axis.fill_between(run.time, low, high, where=np.asarray(shaded, bool), color=colour, alpha=0.25, lw=0)
                axis.set_ylim(low, high)
        axis.grid(alpha=0.25, lw=0.5)
        if said.start < len(run):
            axis.axvline(run.time[said.start], color=GREY, lw=0.8, ls=":")
    axes[0].set_title(
        f"alarms red, labels grey; {'probabilities' if said.kind == 'probability' else 'statistics over their limits'}",
        fontsize=9,
        loc="left",
    )
    axes[-1].set_xlabel(time_label(run))
    date_axis(axes[-1], run)
    return figure


def plot_selection(said: Selection, most: int) -> Figure:
    """Distance from the best structure with standard errors, and the loss of the leading structures over time."""
    rows = said.rows[:most]
    figure = new_figure(11.0, max(3.2, 0.27 * len(rows) + 1.2))
    table, loss = figure.subplots(1, 2, width_ratios=[1.1, 1.0])
    place = np.arange(len(rows))
    table.errorbar([-row.below for row in rows], place, xerr=[row.std for row in rows], fmt="o", ms=4, color=BLUE, lw=1)
    table.set_yticks(place, [row.name if len(row.name) < 60 else f"{row.name[:57]}..." for row in rows], fontsize=7)
    table.invert_yaxis()
    table.axvline(0.0, color=GREY, lw=0.8)
    table.set_xlabel("log-likelihood below the best, +- one standard error", fontsize=9)
    table.set_xscale("symlog", linthresh=10.0)
    table.set_xlim(right=5.0)
    order = {structure.name: p for structure, p in zip(said.structures, said.predictions, strict=True)}
    top = np.where(said.judged, order[rows[0].name].loglik, 0.0)
    for row, colour in zip(rows[1:6], COLOURS, strict=False):
        gap = np.cumsum(np.where(said.judged, order[row.name].loglik, 0.0) - top)
        loss.plot(gap, lw=1.1, color=colour, label=row.name if len(row.name) < 40 else f"{row.name[:37]}...")
    loss.axhline(0.0, color=GREY, lw=0.8)
    loss.set_xlabel("sample", fontsize=9)
    loss.set_title("log-likelihood below the best so far", fontsize=9, loc="left")
    if len(rows) > 1:
        loss.legend(fontsize=7, frameon=False)
    for axis in (table, loss):
        axis.grid(alpha=0.25, lw=0.5)
    return figure
