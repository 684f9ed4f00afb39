"""Plots of diagnostics, alarms and selections."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy

from driftfit.engine.kernel import Array
from driftfit.judge.evidence import Evidence
from driftfit.judge.regressors import Excitation
from driftfit.judge.statistics.whiteness import Whiteness
from driftfit.run.live.rule import AlarmRule
from driftfit.run.result import Track
from driftfit.show.axes import BLUE, GREY, RED, date_axis, panels, time_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = (BLUE, RED, "#3a8f4d", "#9a6fb0", "#c08a1e", "#4aa3a8", "#7a5c46", "#d17aa5")
BRIDGE = 1.36
"""What a Brownian bridge exceeds with probability 0.05 (Kolmogorov)."""


class Health(NamedTuple):
    """What a diagnosis examines; ``fine`` maps the names of checks to whether they are within their limits."""

    known: Evidence
    z: Array
    white: Whiteness
    excited: Excitation
    fine: Callable[[str], bool]


def draw_diagnosis(diagnosis: Health, ax: Any = None) -> Figure:
    """Six plots on one page."""
    figure, axes = panels(ax, (11.0, 8.2), 6, 2)
    for draw, axis in zip((_innovations, _correlations, _levels, _quantiles, _excitation, _paths), axes, strict=True):
        draw(axis, diagnosis)
    for axis in (*axes[::2], axes[5]):
        axis.set_xlabel(time_label(diagnosis.known.run))
        date_axis(axis, diagnosis.known.run)
        if len(diagnosis.known.run) > 1 and not np.isfinite(axis.dataLim.intervalx).all():  # nothing is known
            axis.set_xlim(diagnosis.known.run.time[0], diagnosis.known.run.time[-1])
    return figure


def _titled(axis: Axes, title: str, ok: bool) -> None:
    axis.set_title(title if ok else f"{title}: out of bounds", fontsize=10, loc="left", color="black" if ok else RED)
    axis.grid(alpha=0.25, lw=0.5)
    axis.tick_params(labelsize=8)


def _innovations(axis: Axes, diagnosis: Health) -> None:
    axis.plot(diagnosis.known.run.time, diagnosis.z, ls="", marker=".", ms=2.5, color=BLUE)
    for limit in (-1.96, 1.96):
        axis.axhline(limit, color=GREY, lw=0.8, ls="--")
    shown = np.abs(diagnosis.z[np.isfinite(diagnosis.z)])
    if shown.size:
        axis.set_ylim(*(np.array([-1.1, 1.1]) * max(4.0, min(shown.max(), 12.0))))
    _titled(axis, "innovation / its standard deviation", diagnosis.fine("outliers"))


def _correlations(axis: Axes, diagnosis: Health) -> None:
    lags = np.arange(1, len(diagnosis.white.r) + 1)
    axis.bar(lags, diagnosis.white.r, width=0.5, color=BLUE)
    axis.fill_between(lags, -1.96 * diagnosis.white.std, 1.96 * diagnosis.white.std, color=GREY, alpha=0.3, lw=0)
    axis.axhline(0.0, color=GREY, lw=0.8)
    axis.set_xlabel("lag, samples", fontsize=9)
    axis.locator_params(axis="x", integer=True)
    _titled(axis, "correlation of innovations", diagnosis.fine("whiteness (p)"))


def _levels(axis: Axes, diagnosis: Health) -> None:
    """Mean square of clipped innovations in a moving window."""
    known = np.flatnonzero(np.isfinite(diagnosis.z))
    window = max(20, len(known) // 40)
    if len(known) > window:
        square = np.minimum(diagnosis.z[known] ** 2, 16.0)
        total = np.concatenate([[0.0], np.cumsum(square)])
        axis.plot(
            diagnosis.known.run.time[known[window - 1 :]],
            (total[window:] - total[:-window]) / window,
            color=BLUE,
            lw=1.1,
        )
        half = 1.96 * np.sqrt(2.0 / window)
        axis.axhspan(max(1.0 - half, 0.0), 1.0 + half, color=GREY, alpha=0.25, lw=0)
    axis.set_ylim(bottom=0.0)
    fine = diagnosis.fine("noise level") and diagnosis.fine("steady noise")
    _titled(axis, f"normalised innovation squared, mean of {window}", fine)


def _quantiles(axis: Axes, diagnosis: Health) -> None:
    z = np.sort(diagnosis.z[np.isfinite(diagnosis.z)])
    if len(z):
        normal = scipy.special.ndtri((np.arange(len(z)) + 0.5) / len(z))
        axis.plot(normal, normal, color=GREY, lw=0.9)
        axis.plot(normal, np.clip(z, -12.0, 12.0), ls="", marker=".", ms=3.0, color=BLUE)
    axis.set_xlabel("normal quantile", fontsize=9)
    _titled(axis, "distribution of innovations", diagnosis.fine("symmetry") and diagnosis.fine("outliers"))


def _excitation(axis: Axes, diagnosis: Health) -> None:
    excited = diagnosis.excited
    if len(excited.at):
        time = diagnosis.known.run.time[diagnosis.known.rows.at[excited.at]]
        values = np.maximum(excited.eigenvalues, 1e-12)
        for i in range(values.shape[1]):
            last = i in (0, values.shape[1] - 1)
            axis.plot(time, values[:, i], color=RED if i == 0 else BLUE, lw=1.3 if last else 0.6)
        axis.plot(time, values[:, -1] / 1e4, color=GREY, lw=0.9, ls="--")
        axis.set_yscale("log")
    else:
        _unknown(axis)
    _titled(axis, "excitation: eigenvalues of windows, and the limit", diagnosis.fine("excitation"))


def _paths(axis: Axes, diagnosis: Health) -> None:
    """Sums of scores of each parameter, a Brownian bridge if it is constant, and what 5 % of these leave."""
    if diagnosis.known.changes is not None:
        path = diagnosis.known.changes.scores
        for i, name in enumerate(diagnosis.known.names):
            colour = COLOURS[i % len(COLOURS)]
            axis.plot(diagnosis.known.run.time[diagnosis.known.tested.at], path[:, i], lw=1.1, color=colour, label=name)
        axis.axhspan(-BRIDGE, BRIDGE, color=GREY, alpha=0.2, lw=0)
        if path.shape[1] <= 8:
            axis.legend(fontsize=7, ncols=2, frameon=False)
    else:
        _unknown(axis)
    _titled(axis, "constancy: sums of scores, standardised", diagnosis.fine("constancy (p)"))


def _unknown(axis: Axes) -> None:
    """Say that a panel is empty because there is nothing to show."""
    axis.text(0.5, 0.5, "not known", transform=axis.transAxes, ha="center", va="center", color=GREY)


def plot_alarms(
    run: Track, rule: AlarmRule, statistic: Array, active: Array, start: int, labels: Array | None = None,
    ax: Any = None,
) -> Figure:  # fmt: skip
    """The output, and each statistic over its limit, with alarms and labels shaded."""
    c = len(rule.names)
    figure, axes = panels(ax, (9.5, 1.5 * c + 2.0), c + 1, sharex=True)
    axes[0].plot(run.time, run.y, color=BLUE, lw=0.8)
    axes[0].set_ylabel(run.labels.y)
    for j, (axis, name) in enumerate(zip(axes[1:], rule.names, strict=True)):
        column, limit = statistic[:, j] / rule.limits[j], 1.0
        axis.plot(run.time, column, color=BLUE, lw=0.9)
        axis.axhline(limit, color=RED, lw=0.9, ls="--", label=f"limit {rule.limits[j]:.4g}")
        axis.legend(loc="upper left", fontsize=7, frameon=False)
        axis.set_ylabel(name)
        shown = column[start:][np.isfinite(column[start:])]
        if shown.size:
            axis.set_ylim(min(shown.min(), 0.0) - 0.1, min(max(1.3 * limit, 1.1 * shown.max()), 8.0))
    for axis in axes:
        for shaded, colour in ((active, RED), (labels, GREY)):
            if shaded is not None:
                low, high = axis.get_ylim()
                axis.fill_between(run.time, low, high, where=np.asarray(shaded, bool), color=colour, alpha=0.25, lw=0)
                axis.set_ylim(low, high)
        axis.grid(alpha=0.25, lw=0.5)
        if start < len(run):
            axis.axvline(run.time[start], color=GREY, lw=0.8, ls=":")
    axes[0].set_title("alarms red, labels grey; statistics over their limits", fontsize=9, loc="left")
    axes[-1].set_xlabel(time_label(run))
    date_axis(axes[-1], run)
    return figure


def plot_selection(names: Sequence[str], below: Array, std: Array, terms: Sequence[Array], ax: Any = None) -> Figure:
    """Distances from the best with standard errors, and the losses of the leading structures over time.

    Structures are in order, the best first; ``terms`` are the log-likelihoods of each sample under the first of them.
    """
    figure, (table, loss) = panels(ax, (11.0, max(3.2, 0.27 * len(names) + 1.2)), 2, 2)
    place = np.arange(len(names))
    table.errorbar(-below, place, xerr=std, fmt="o", ms=4, color=BLUE, lw=1)
    table.set_yticks(place, [name if len(name) < 60 else f"{name[:57]}..." for name in names], fontsize=7)
    table.invert_yaxis()
    table.axvline(0.0, color=GREY, lw=0.8)
    table.set_xlabel("log-likelihood below the best, +- one standard error", fontsize=9)
    table.set_xscale("symlog", linthresh=10.0)
    table.set_xlim(right=5.0)
    for name, term, colour in zip(names[1:], terms[1:], COLOURS, strict=False):
        label = name if len(name) < 40 else f"{name[:37]}..."
        loss.plot(np.cumsum(term - terms[0]), lw=1.1, color=colour, label=label)
    loss.axhline(0.0, color=GREY, lw=0.8)
    loss.set_xlabel("sample", fontsize=9)
    loss.set_title("log-likelihood below the best so far", fontsize=9, loc="left")
    if len(names) > 1:
        loss.legend(fontsize=7, frameon=False)
    for axis in (table, loss):
        axis.grid(alpha=0.25, lw=0.5)
    return figure
