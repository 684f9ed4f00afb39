"""Banks of hypotheses, reproduced: tables of accuracy beside reference values, with RLS, tuned Kalman filters and IMM.

Prints root mean square error, error after jumps and when steady, detection, delay, false alarms, log density of the
outputs, calibration and cost for every reduction, on clean records and with outliers, a frozen sensor and regimes. RLS
and Kalman filters were tuned for the error on other records of the kind; banks were not. Run
``driftfit reproduce hypotheses --help``.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import track as progress
from rich.table import Table

from driftfit.reproduce.hypotheses.contests import Contest, contests
from driftfit.reproduce.hypotheses.references import Row
from driftfit.reproduce.hypotheses.scores import HEADS, measure

QUICK, COSTLY = 4, 300
"""Records of a quick run, and the leaf updates a sample above which it leaves a row out."""


def table_of(contest: Contest, rows: dict[str, tuple[float, ...]], runs: int) -> Table:
    """Measured values, the reference under them in brackets."""
    table = Table(box=SIMPLE_HEAD, show_edge=False, title_justify="left")
    table.title = f"{contest.title}: {runs} records of {contest.T} samples, measured (reference)"
    for head in ("", *HEADS):
        table.add_column(head, justify="right" if head else "left")
    for name, values in rows.items():
        reference = contest.reference.get(name, (None,) * len(values))
        table.add_row(name, *(cell(value, other) for value, other in zip(values, reference, strict=True)))
    return table


def cell(value: float, reference: float | None) -> str:
    """A measured value beside the reference."""
    if np.isnan(value):
        return "-"
    digits = 1 if abs(value) >= 10.0 else 2 if abs(value) >= 1.0 else 3
    return f"{value:.{digits}f}" + ("" if reference is None else f" ({reference:.{digits}f})")


def worst(rows: dict[str, tuple[float, ...]], reference: dict[str, Row]) -> tuple[float, str]:
    """The largest relative difference of an RMSE from its reference, and where."""
    found = [(abs(rows[name][0] / row[0] - 1.0), name) for name, row in reference.items() if name in rows and row[0]]
    return max(found)


def main(
    quick: Annotated[bool, typer.Option(help="Few records, and no row of great cost.")] = False,
    only: Annotated[str, typer.Option(help="Only tables whose title contains this.")] = "",
) -> None:
    """Tables of accuracy of banks of hypotheses, beside reference values."""
    console = Console(width=150)
    for contest in contests():
        if only.lower() not in contest.title.lower():
            continue
        runs = QUICK if quick else contest.runs
        names = [name for name in contest.entries if not (quick and costly(contest, name))]
        rows = {
            name: measure(contest, name, runs)
            for name in progress(names, description=contest.title, console=Console(stderr=True), transient=True)
        }
        console.print(table_of(contest, rows, runs))
        ratio, name = worst(rows, contest.reference)
        console.print(f"largest difference of an RMSE from its reference: {100.0 * ratio:.0f} % ({name})\n")


def costly(contest: Contest, name: str) -> bool:
    """Whether a row takes long."""
    return (contest.reference.get(name, (0.0,))[-1] or 0.0) > COSTLY
