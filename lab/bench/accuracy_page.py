"""The page and the pictures of the tracking benchmark, written from its results only."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from driftfit.show.axes import BLUE, GREY, RED, new_figure
from lab import scenarios
from lab.bench.accuracy import HINDSIGHT, ORACLE, TUNING_SEED, Cell, Size
from lab.bench.causes import CAUSES, REAL_CAUSES
from lab.bench.computer import computer, markdown, versions
from lab.bench.contestants import own
from lab.bench.real import REFERENCE, Result
from lab.bench.records import simulated

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LESS, OFTEN = 0.97, 0.75
"""A row beats the reference where its error is 3 % less in the median run, and less in three of four runs."""

ERA = 1.0e3
"""Ratios above this count as divergence."""


def figures(value: float, digits: int = 2) -> str:
    """A number of a table; a dash for none."""
    if np.isnan(value):
        return "–"
    return "diverged" if value > ERA else f"{value:.{digits}f}"


def table(cells: Sequence[Cell]) -> str:
    """One scenario, its models side by side; a row that repeats one above is left out."""
    heads, rows = [""], {name: list[str]() for name in cells[0].scores}
    for cell in cells:
        jumps = ["found", "delay", "false / 1000"] if cell.detections else []
        heads += [f"{cell.kind}: / oracle", "one-step / oracle", "theta in band", "y in band", *jumps]
        for name, row in rows.items():
            row += [figures(float(np.median(cell.ratio(name, what))), d) for what, d in (("rmse", 2), ("error", 3))]
            row += [figures(float(np.mean(cell.values(name, what))), 3) for what in ("theta", "y")]
            row += detection(cell, name) if jumps else []
    shown: dict[tuple[str, ...], str] = {}
    for name, row in rows.items():
        shown.setdefault(tuple(row), name)
    return markdown(heads, [[name, *row] for row, name in shown.items()])


def detection(cell: Cell, name: str) -> list[str]:
    """Jumps found, median delay, false alarms per 1000 samples; the oracle knows them."""
    found = cell.detections.get(name)
    if found is None:
        return ["–"] * 3
    delay = f"{np.median(found.delays):g}" if found.delays else "–"
    return [f"{len(found.delays)} of {found.jumps}", delay, f"{1000.0 * found.false / max(found.quiet, 1):.2f}"]


def summary(cells: Sequence[Cell]) -> str:
    """Every row over all cells, best first."""
    names = [name for name in cells[0].scores if name != ORACLE]
    heads = ["", "median / oracle", "worst / oracle", "within 10 % of best fixed", "theta in band", "y in band"]
    order = sorted(names, key=lambda name: float(np.median(_medians(cells, name))))
    return markdown(heads, [_overall(cells, name) for name in order])


def _medians(cells: Sequence[Cell], name: str, to: str = ORACLE) -> list[float]:
    return [float(np.median(cell.ratio(name, to=to))) for cell in cells]


def _overall(cells: Sequence[Cell], name: str) -> list[str]:
    to_oracle = _medians(cells, name)
    near = sum(ratio <= 1.1 for ratio in _medians(cells, name, HINDSIGHT))
    shares = [
        _range([float(np.mean(cell.values(name, what))) for cell in cells]) for what in ("theta", "y")
    ]  # fmt: skip
    return [name, figures(float(np.median(to_oracle))), figures(max(to_oracle)), f"{near} of {len(cells)}", *shares]


def _range(shares: Sequence[float]) -> str:
    """Mean and range over scenarios."""
    known = [share for share in shares if np.isfinite(share)]
    return f"{np.mean(known):.3f} ({min(known):.2f} to {max(known):.2f})" if known else "–"


def losses(cells: Iterable[Cell]) -> list[tuple[str, str, str, float, float]]:
    """(scenario, model, row, median ratio to the reference, share of runs won) for rows that beat the reference."""
    lost = []
    for cell in cells:
        for name in cell.scores:
            ratio = cell.ratio(name, to=REFERENCE)
            middle, wins = float(np.median(ratio)), float(np.mean(ratio < 1.0))
            if name not in (ORACLE, REFERENCE) and middle < LESS and wins >= OFTEN:
                lost.append((cell.scenario, cell.kind, name, middle, wins))
    return lost


def lost_table(cells: Sequence[Cell]) -> str:
    """Where and why the tracker without settings is beaten."""
    lost = losses(cells)
    if not lost:
        return f"Nowhere was a row better than `{REFERENCE}` by 3 % in the median and in three of four runs."
    rows = [[s, kind, name, f"{ratio:.2f}", f"{100.0 * wins:.0f} %"] for s, kind, name, ratio, wins in lost]
    causes = [f"* **{name}.** {CAUSES[name]}" for name in dict.fromkeys(s for s, *_ in lost) if name in CAUSES]
    text = markdown(["scenario", "model", "better", f"RMSE / {REFERENCE}", "runs won"], rows)
    return "\n\n".join([text, "\n".join(causes)])


def real_table(result: Result) -> str:
    """One real record."""
    rows = [[row.name, f"{row.error:.4g}", figures(row.y, 3), f"{row.t:+.1f}"] for row in result.rows]
    title = f"### {result.title} ({result.samples} samples scored)"
    return f"{title}\n\n{markdown(['', 'one-step error', 'y in band', 't'], rows)}"


def page(cells: Sequence[Cell], real: tuple[Sequence[Result], Sequence[str]], size: Size, absent: Sequence[str]) -> str:
    """The whole page as markdown."""
    left_out = f"Not installed, left out: {', '.join(absent)}." if absent else "Every peer was installed."
    parts = [
        "# Scoreboard: accuracy",
        INTRODUCTION,
        f"{computer()}. {versions()}. {size.note}; seeds 0 to {size.runs - 1} are scored, {TUNING_SEED} to "
        f"{TUNING_SEED + size.tuning - 1} tune. {left_out}",
        "## All scenarios",
        summary(cells),
        f"Trackers that took part: {', '.join(c.name for c in own())}. {SAME}",
        f"## Where `{REFERENCE}` loses",
        lost_table(cells),
    ]
    for name in dict.fromkeys(cell.scenario for cell in cells):
        parts += [f"## {name}", (scenarios.found()[name].__doc__ or "").strip()]
        parts += [f"![{name}](figures/scoreboard_{name}.png)"]
        parts += [table([cell for cell in cells if cell.scenario == name])]
    results, missing = real
    parts += ["## Real records", REAL, *(real_table(result) for result in results)]
    if missing:
        parts.append(f"Records of {', '.join(missing)} are left out: not installed.")
    return "\n\n".join([*parts, REAL_CAUSES]) + "\n"


INTRODUCTION = """\
Written by `python -m lab bench accuracy --out docs`, which prints every figure.

*RMSE* is the error of the parameters after 200 samples. *Oracle* is the Kalman filter that is given the drift
covariance and the noise variance of every sample. Ratios to it are computed for each run: tables have the medians of
RMSE and of the one-step error, pictures the quartiles. A row that repeats one above is left out. In *ramp* and
*sinusoid* the oracle is given the size of the steps, not that they persist. *In band* gives shares within 95 % bands;
simulated outliers of y are not counted. *Default* is a package with its default settings, *tuned* uses the setting of
a grid with the least parameter error on other runs of the same scenario, and *Kalman, hindsight* is the best setting
on the scored runs themselves. A tracker without default settings has no such row.

All methods start from zero. Peers receive the regressors, since they do not handle lags, and skip samples with a
missing lag; `track` fills the lag of a missing output. For jumps, the innovations of every method are passed to the
same detector, at the threshold that gives one alarm in 1000 samples without drift."""

SAME = """\
pykalman, simdkalman and dynamax run the filter of `Kalman` when given its settings. `python -m lab bench speed`
checks that they give the same estimates; their rows would repeat that of `Kalman`, as filterpy's does."""

REAL = """\
The first half determines the settings by one-step error, and the second half is scored. *t* is the paired t
statistic of the differences of squared errors to those of `AdaptiveKalman`: a negative value is a smaller error
than its own, and values below 2 in size are insignificant."""


def draw(name: str, cells: Sequence[Cell], T: int) -> Figure:
    """Ratios to the oracle of every row, one panel per model; under them one path of the first run."""
    figure = new_figure(11.0, 8.5)
    grid = figure.add_gridspec(2, len(cells), height_ratios=[2.2, 1.0])
    for i, cell in enumerate(cells):
        axis = figure.add_subplot(grid[0, i])
        _draw_ratios(axis, cell, labels=i == 0)
        _draw_path(figure.add_subplot(grid[1, i]), name, cell.kind, T)
    figure.suptitle(name)
    return figure


def _draw_ratios(axis: Axes, cell: Cell, labels: bool) -> None:
    names = [row for row in cell.scores if row != ORACLE]
    for place, row in enumerate(names):
        low, middle, high = np.quantile(cell.ratio(row), [0.25, 0.5, 0.75])
        color = BLUE if row == REFERENCE else RED if row == HINDSIGHT else GREY
        if middle < 30.0:
            axis.plot([low, min(high, 30.0)], [place, place], color=color, lw=1.5)
            axis.plot(middle, place, "o", color=color, ms=5)
        else:
            axis.annotate("→", (28.0, place), va="center", ha="right", color=color)
    axis.axvline(1.0, color=GREY, lw=0.8, ls="--")
    axis.set_xscale("log")
    axis.set_xlim(0.5, 30.0)
    axis.set_xticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
    axis.set_yticks(range(len(names)), names if labels else [""] * len(names), fontsize=8)
    axis.invert_yaxis()
    axis.grid(alpha=0.25, lw=0.5)
    axis.set_title(f"{cell.kind}: parameter RMSE / oracle, quartiles", fontsize=10)


def _draw_path(axis: Axes, name: str, kind: str, T: int) -> None:
    record = simulated(name, kind, 0, T)
    assert record.truth is not None
    reference = next(c for c in own() if c.name == REFERENCE)
    out = reference.follow(record, None, np.ones(record.phi.shape[1]))
    i = 0 if kind == "regression" else 2
    time, half = np.arange(T), 1.96 * out.std[:, i]
    axis.fill_between(
        time[50:], (out.theta[:, i] - half)[50:], (out.theta[:, i] + half)[50:], color=BLUE, alpha=0.2, lw=0
    )
    axis.plot(time, record.truth.theta[:, i], color=GREY, lw=1.2, label="truth")
    axis.plot(time[50:], out.theta[50:, i], color=BLUE, lw=1.0, label=f"{REFERENCE}, 95 % band")
    axis.set_xlabel("sample")
    axis.set_ylabel(("theta1", "", "b1")[i])
    axis.legend(fontsize=8, frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0))


def write(
    folder: Path,
    cells: Sequence[Cell],
    real: tuple[Sequence[Result], Sequence[str]],
    size: Size,
    absent: Sequence[str],
) -> Path:
    """Write ``scoreboard_accuracy.md`` and its pictures into a folder; the page's path."""
    pictures = folder / "figures"
    pictures.mkdir(parents=True, exist_ok=True)
    for name in dict.fromkeys(cell.scenario for cell in cells):
        figure = draw(name, [cell for cell in cells if cell.scenario == name], size.T)
        figure.savefig(pictures / f"scoreboard_{name}.png", dpi=80)
    target = folder / "scoreboard_accuracy.md"
    target.write_text(page(cells, real, size, absent))
    return target
