"""The demonstration: the demand for money in the United States, 1959 to 2009.

    m_t = a m_{t-1} + b_income income_t + b_rate rate_t + c + v_t

with m and income the logarithms of real M1 (deflated by consumer prices) and real GDP, both relative to 1959 Q1, and
rate the three-month treasury bill rate in percent per year. The forecasts of this equation failed after 1973.
Each coefficient may follow a random walk; which one does, how fast, and r are chosen by maximum likelihood. The origin
of the logarithms does not matter while the coefficients are constant, but it does when they drift: relative to 1959 Q1
a change of the coefficient of income rotates the line about its start.

Source of the equation: Goldfeld, The Demand for Money Revisited (1973); of its failure: Goldfeld, The Case of the
Missing Money (1976). Departures: M1 and prices are those of the end of the quarter, there is one interest rate instead
of two, and the rate is not in logarithms.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from driftfit.data.files import read_columns
from driftfit.engine.kernel import Array
from driftfit.models.arx import ARX
from driftfit.results import Track
from driftfit.show.axes import GREY, RED, draw_innovation, draw_parameter, draw_prediction, new_figure
from driftfit.trackers.adaptive_kalman import AdaptiveKalman
from driftfit.trackers.kalman import Kalman
from driftfit.tracking import track

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MODEL = ARX(na=1, nb=(1, 1), nk=0, inputs=("income", "rate"), intercept=True)
LAGGED, INCOME, RATE, INTERCEPT = range(4)

CHOICES = {
    "intercept": (INTERCEPT,),
    "interest rate": (RATE,),
    "income": (INCOME,),
    "lagged money": (LAGGED,),
    "all four": (LAGGED, INCOME, RATE, INTERCEPT),
}
"""Which coefficients may drift."""

RATIOS = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Variance that the drift of one quarter adds to y through one coefficient, in units of r."""

SETTLED = 50
"""Quarters before estimates are evaluated: the bands are wide until then."""

CRISIS = 2008.0
"""The search is repeated without the quarters from here on, in which money jumped."""

HORIZON = 8
"""Quarters within which the largest change is searched for."""


@dataclass(frozen=True)
class Quarters:
    """Quarters as years (1959.25 is 1959 Q2), log real money (T,), and log real income and the rate (T, 2)."""

    time: Array
    y: Array
    u: Array

    def until(self, year: float) -> Quarters:
        """The quarters before a time."""
        early = self.time < year
        return Quarters(self.time[early], self.y[early], self.u[early])


def read_record() -> Quarters:
    """The record that is shipped with the package."""
    with resources.as_file(resources.files("driftfit") / "demo" / "us_money_demand.csv") as path:
        data = read_columns(path, ["year", "quarter", "m1", "cpi", "realgdp", "tbilrate"])
    money, income = np.log(data["m1"] / data["cpi"]), np.log(data["realgdp"])
    time = data["year"] + (data["quarter"] - 1.0) / 4.0
    return Quarters(time, money - money[0], np.column_stack([income - income[0], data["tbilrate"]]))


def fit(record: Quarters, drifting: tuple[int, ...], ratio: float) -> Track:
    """The run with q_i = ratio r / mean(phi_i^2) for the drifting coefficients and the maximum likelihood r.

    With q in units of r the likelihood is maximised over r in closed form: r is the mean of e^2 / s at r = 1.
    """
    regressors = np.column_stack([record.y, record.u, np.ones(len(record.y))])
    q = np.zeros(MODEL.n)
    q[list(drifting)] = ratio / np.mean(regressors**2, axis=0)[list(drifting)]
    unit = _run(record, q, 1.0)
    counted = unit.ok & np.isfinite(unit.innovation_std)
    r = float(np.mean((unit.innovation[counted] / unit.innovation_std[counted]) ** 2))
    return _run(record, q * r, r)


def _run(record: Quarters, q: Array, r: float) -> Track:
    return track(MODEL, Kalman(q=q, r=r), record.y, record.u, time=record.time, dt=0.25)


@dataclass(frozen=True)
class Search:
    """Every fit of the grid: ``runs[which][ratio]``, and the one without drift."""

    still: Track
    runs: dict[str, dict[float, Track]]

    @property
    def best(self) -> tuple[str, float]:
        """The choice and the ratio with the highest likelihood."""
        cells = [(which, ratio) for which, row in self.runs.items() for ratio in row]
        return max(cells, key=lambda cell: self.runs[cell[0]][cell[1]].loglik)

    @property
    def run(self) -> Track:
        """The run with the highest likelihood."""
        which, ratio = self.best
        return self.runs[which][ratio]

    def gain(self, which: str) -> float:
        """Increase of the log-likelihood over no drift, at the best ratio of a choice."""
        return max(run.loglik for run in self.runs[which].values()) - self.still.loglik


def search(record: Quarters) -> Search:
    """Fit every choice at every ratio."""
    runs = {which: {ratio: fit(record, drifting, ratio) for ratio in RATIOS} for which, drifting in CHOICES.items()}
    return Search(fit(record, (), 0.0), runs)


def grid(found: Search) -> Table:
    """Table of the increase of the log-likelihood over no drift, for every choice and ratio."""
    table = Table(title=" Log-likelihood gained by drift", title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    table.show_edge = False
    table.add_column("ratio:")
    for ratio in RATIOS:
        table.add_column(f"{ratio:g}", justify="right")
    for which, row in found.runs.items():
        cells = [Text(f"{run.loglik - found.still.loglik:.1f}") for run in row.values()]
        if which == found.best[0]:
            cells[RATIOS.index(found.best[1])].stylize("bold reverse")
        table.add_row(which, *cells)
    return table


class Move(NamedTuple):
    """The largest change of a coefficient within `HORIZON` quarters: sample numbers of its two ends."""

    before: int
    after: int


def largest_move(path: Array) -> Move:
    """The two ends, both after the first `SETTLED` quarters."""
    pairs = [(i, j) for i in range(SETTLED, len(path)) for j in range(i + 1, min(i + HORIZON + 1, len(path)))]
    return Move(*max(pairs, key=lambda pair: abs(path[pair[1]] - path[pair[0]])))


def quarter(time: float) -> str:
    """1973.25 as 1973 Q2."""
    whole = round(4.0 * time)
    return f"{whole // 4} Q{whole % 4 + 1}"


def dated(run: Track, i: int, t: int) -> str:
    """A coefficient, its standard error and its quarter."""
    return f"{run.theta[t, i]:.3f} (standard error {run.std[t, i]:.3f}) in {quarter(run.time[t])}"


def sentence(found: Search) -> str:
    """The conclusion from the numbers."""
    which, run = found.best[0], found.run
    i = CHOICES[which][0]
    move = largest_move(run.theta[:, i])
    before, after = (dated(run, i, t) for t in move)
    return (
        f"The coefficient of {which} went from {before} to {after}, its largest move within two years, and letting it "
        f"drift raises the in-sample log-likelihood by {found.gain(which):.1f} over no drift."
    )


def caveat(found: Search, early: Search) -> str:
    """Facts that the numbers do not show; ``early`` is the search before the crisis of 2008."""
    i = CHOICES[found.best[0]][0]
    move = largest_move(found.run.theta[:, i])
    low, high = (bound[:, i] for bound in found.run.band(0.95))
    apart = max(low[move.before], low[move.after]) > min(high[move.before], high[move.after])
    return (
        f"The 95 % bands of the two dates {'do not overlap' if apart else 'overlap'}; estimates and standard errors "
        f"use the past only. This is not a test: the coefficient, the drift and r were chosen among "
        f"{len(CHOICES) * len(RATIOS)} fits to the same record, and no drift is the edge of the range of q, so twice "
        f"the gain follows no chi-square law. That the equation moved is clearer than which coefficient did: an "
        f"intercept that drifts alone gains {found.gain('intercept'):.1f}, and up to {quarter(early.run.time[-1])} "
        f"income gains {early.gain('income'):.1f} where all four together gain {early.gain('all four'):.1f}."
    )


def free(record: Quarters) -> Track:
    """The run of the tracker that needs no settings: every coefficient may drift, and nothing is searched."""
    return track(MODEL, AdaptiveKalman(), record.y, record.u, time=record.time, dt=0.25)


def adaptive_estimate(found: Search, adaptive: Track) -> str:
    """The estimate of the same coefficient by the tracker without settings."""
    i = CHOICES[found.best[0]][0]
    move = largest_move(adaptive.theta[:, i])
    before, after = (dated(adaptive, i, t) for t in move)
    errors = [run.summary().comparison.tracked for run in (adaptive, found.run)]
    return (
        f"Without a search, AdaptiveKalman lets all four drift, chooses its own numbers from the past only, and has "
        f"the coefficient of {found.best[0]} at {before} and at {after}; its one-step error is {errors[0]:.4f}, that "
        f"of the fit above, chosen on the whole record, {errors[1]:.4f}."
    )


def show(out: Console, progress: Console, picture: Path) -> None:
    """Print the grid, the summary and the conclusions, and save the picture."""
    record = read_record()
    with progress.status("tracking (the first run compiles)"):
        # the code it compiles is on disk when this process needs it: a cold demo takes a third less time on two cores
        ahead = get_context("spawn").Process(target=free, args=(record,))
        ahead.start()
        found, early = search(record), search(record.until(CRISIS))
        summary = found.run.summary()
        ahead.join()
        adaptive = free(record)
    which, ratio = found.best
    out.print(Text("\n The demand for money in the United States, 1959 Q1 to 2009 Q3", "bold"))
    out.print(" log real M1 on log real income, the treasury bill rate and log real M1 a quarter before\n")
    out.print(grid(found))
    out.print(
        " rows: what may drift; ratio: mean(phi^2) q / r; in every cell the most likely r\n"
        f" no drift: log-likelihood {found.still.loglik:.1f}; highest, {found.run.loglik:.1f}, where {which} drifts: "
        f"ratio {ratio:g}, r = {found.run.tracker.settings()['r']:.3g}\n",
        style="dim",
    )
    out.print(summary)
    out.print(Text(f"\n{sentence(found)}\n", "bold"))
    out.print(Text(f"{caveat(found, early)}\n"))
    out.print(Text(f"{adaptive_estimate(found, adaptive)}\n"))
    try:
        draw(found, adaptive).savefig(picture, dpi=150)
    except ImportError as error:
        out.print(Text(f"No picture: {error}"))
    else:
        out.print(Text(f"Picture: {picture}"))


EVENTS = (
    (1974.0, 1977.0, "“missing money”,\n1974 to 1976"),
    (1994.0, 1997.0, "banks sweep deposits\nout of M1, from 1994"),
    (2008.0, 2009.5, "crisis,\n2008"),
)
"""Events that histories of the period describe; the fit does not use them."""


def draw(found: Search, adaptive: Track) -> Figure:
    """The drifting coefficient with its band, the estimate of the tracker without settings; prediction, innovations."""
    figure = new_figure(10.0, 8.5)
    top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=[2.6, 1.0, 1.0])
    _draw_path(top, found, adaptive)
    draw_prediction(middle, found.run)
    middle.set_ylabel("log real M1")
    draw_innovation(bottom, found.run)
    years = range(1965, 2010, 5)
    bottom.set_xticks(years, [quarter(year) for year in years])
    bottom.set_xticks(range(1963, 2011), minor=True)
    bottom.set_xlim(1963.0, 2010.0)  # before that, the band of the coefficient fills the picture
    figure.align_ylabels()
    return figure


def _draw_path(axis: Axes, found: Search, adaptive: Track) -> None:
    which, run = found.best[0], found.run
    i = CHOICES[which][0]
    draw_parameter(axis, run, i)
    axis.plot(adaptive.time, adaptive.theta[:, i], color=GREY, lw=1.0, label="AdaptiveKalman, no settings")
    axis.legend(loc="lower left", fontsize=9, frameon=False)
    axis.set_ylabel(f"coefficient of {which}")
    axis.set_title(f"Demand for money in the United States: the coefficient of {which}, 95 % band", loc="left")
    constant = float(found.still.theta[-1, i])
    axis.axhline(constant, color=GREY, lw=1.0, ls="--")
    axis.annotate(f"{constant:.3f} without drift", (1963.3, constant), va="bottom", fontsize=9, color=GREY)
    move = largest_move(run.theta[:, i])
    for t, side in ((move.before, "right"), (move.after, "left")):
        x, value = run.time[t], run.theta[t, i]
        axis.plot(x, value, "o", color=RED, ms=6)
        text = f"{quarter(x)}: {value:.3f} (s.e. {run.std[t, i]:.3f})"
        axis.annotate(
            text, (x, value), xytext=(-8 if side == "right" else 8, 6 if side == "right" else -14),
            textcoords="offset points", ha=side, fontsize=9, color=RED,
            bbox={"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 1.0},
        )  # fmt: skip
    for start, end, text in EVENTS:
        axis.axvspan(start, end, color=GREY, alpha=0.12, lw=0)
        axis.annotate(
            text, ((start + end) / 2.0, 0.98), xycoords=("data", "axes fraction"), ha="center", va="top", fontsize=8
        )
