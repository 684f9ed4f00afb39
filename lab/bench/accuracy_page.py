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
    """One scenario, its models side by side, without default settings; no row has the errors of one above."""
    heads, rows = [""], {name: list[str]() for name in cells[0].scores if not name.endswith(", default")}
    errors = {name: list[str]() for name in rows}
    for cell in cells:
        jumps = ["found", "delay", "false / 1000"] if cell.detections else []
        heads += [f"{cell.kind}: / oracle", "one-step / oracle", "theta in band", "y in band", *jumps]
        for name, row in rows.items():
            ratios = [figures(float(np.median(cell.ratio(name, what))), d) for what, d in (("rmse", 2), ("error", 3))]
            shares = [figures(float(np.mean(cell.values(name, what))), 3) for what in ("theta", "y")]
            found = detection(cell, name) if jumps else []
            row += ratios + shares + found
            errors[name] += ratios + found
    shown: dict[tuple[str, ...], str] = {}
    for name in rows:
        shown.setdefault(tuple(errors[name]), name)
    return markdown(heads, [[name, *rows[name]] for name in shown.values()])


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
    """Where and why the tracker without settings is beaten; a row that repeats one of its scenario is left out."""
    lost = losses(cells)
    if not lost:
        return f"Nowhere was a row better than `{REFERENCE}` by 3 % in the median and in three of four runs."
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for scenario, kind, name, ratio, wins in lost:
        rows.setdefault((scenario, kind), {}).setdefault(f"{ratio:.2f} ({100.0 * wins:.0f} %)", name)
    why: dict[str, list[str]] = {}
    for name in dict.fromkeys(scenario for scenario, _ in rows if scenario in CAUSES):
        why.setdefault(CAUSES[name], []).append(name)
    better = {place: "; ".join(f"{name} {result}" for result, name in row.items()) for place, row in rows.items()}
    text = markdown(
        ["scenario", "model", f"better: RMSE / {REFERENCE} (runs won)"], [[*at, row] for at, row in better.items()]
    )
    return "\n\n".join([text, "\n".join(f"* **{', '.join(names)}.** {cause}" for cause, names in why.items())])


def real_table(result: Result) -> str:
    """One real record."""
    shown: dict[tuple[str, str], list[str]] = {}
    for row in result.rows:
        error, t = f"{row.error:.4g}", f"{row.t:+.1f}"
        shown.setdefault((error, t), [row.name, error, figures(row.y, 3), t])
    title = f"### {result.title} ({result.samples} samples scored)"
    return f"{title}\n\n{markdown(['', 'one-step error', 'y in band', 't'], [*shown.values()])}"


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

| term | meaning |
|---|---|
| *RMSE* | error of the parameters after 200 samples |
| *oracle* | the Kalman filter that is given the drift covariance and noise variance of every sample |
| */ oracle* | ratio of errors in each run; tables have the medians, pictures the quartiles |
| *one-step* | error of the prediction one sample ahead |
| *in band* | share within 95 % bands, without simulated outliers of y |
| *default* | a package with its default settings; shown in the next table and in the pictures |
| *tuned* | the setting of a grid with the least parameter error on other runs of the same scenario |
| *Kalman, hindsight* | the best setting on the scored runs themselves |

In *ramp* and *sinusoid* the oracle is given the size of the steps, not that they persist. All methods start from zero.
Peers receive the regressors, since they do not handle lags, and skip samples with a missing lag; `track` fills the lag
of a missing output. For jumps, the same detector reads the innovations of every method, at the threshold that gives one
alarm in 1000 samples without drift. Tables of scenarios and records leave out a row whose errors are those of a row
above."""

SAME = """\
pykalman, simdkalman and dynamax run the filter of `Kalman` when given its settings, so their rows would repeat its row;
`python -m lab bench speed` checks that they give the same estimates."""

REAL = """\
The first half determines the settings by one-step error, and the second half is scored. *t* is the paired t
statistic of squared errors less those of `AdaptiveKalman`: negative where a row is better, and insignificant below 2
in size."""


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
