"""Banks of hypotheses, reproduced: tables of accuracy with reference values, with RLS, tuned Kalman filters and IMM.

Prints root mean square error, error after jumps and when steady, detection, delay, false alarms, log density of the
outputs, calibration and cost for every reduction, on clean records and with outliers, a frozen sensor and regimes; then
the cost of wrong settings, the effects of smoothing and unknown noise, and the claims that hold. RLS and Kalman filters
were tuned for the error on other records of the kind; banks were not. Run ``python -m lab reproduce hypotheses
--help``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import track as progress
from rich.table import Table

from lab.reproduce.hypotheses import others, sensitivity
from lab.reproduce.hypotheses.contests import Contest, contests
from lab.reproduce.hypotheses.scores import HEADS, Measured, measure

QUICK, LITTLE = ("clean", "regimes"), 3.0
"""Tables of a quick run, and the leaf updates per sample that its rows need at most."""
RUNS = 50
"""Records behind the reference values of smoothing and of unknown noise; four times as many are run."""
Row = tuple[float, ...]


def table_of(title: str, heads: Sequence[str]) -> Table:
    """An empty table."""
    table = Table(box=SIMPLE_HEAD, show_edge=False, title_justify="left", title=title, pad_edge=False)
    for head in ("", *heads):
        table.add_column(head, justify="right" if head else "left", no_wrap=True)
    return table


def cells(values: Sequence[float], reference: Sequence[float | None] | None) -> list[str]:
    """Measured values, each with its reference in brackets."""
    known = reference or (None,) * len(values)
    return [cell(value, other) for value, other in zip(values, known, strict=True)]


def cell(value: float, reference: float | None) -> str:
    """A measured value and the reference."""
    return "-" if np.isnan(value) else short(value) + ("" if reference is None else f" ({short(reference)})")


def short(value: float) -> str:
    """Three digits, without the zero before the point."""
    digits = 1 if abs(value) >= 9.95 else 2 if abs(value) >= 0.9995 else 3
    text = f"{value:.{digits}f}"
    return text.replace("0.", ".", 1) if text.lstrip("-").startswith("0.") else text


def with_gap(reference: tuple[float | None, ...] | None) -> tuple[float | None, ...] | None:
    """Reference values have no standard error."""
    return None if reference is None else (reference[0], None, *reference[1:])


def contest_of(contest: Contest, quick: bool, console: Console) -> dict[str, Measured]:
    """Run one table and print it."""
    names = [name for name in contest.entries if not quick or cheap(contest, name)]
    rows = {
        name: measure(contest, name, contest.runs)
        for name in progress(names, description=contest.title, console=Console(stderr=True), transient=True)
    }
    table = table_of(f"{contest.title}: {contest.runs} records of {contest.T} samples, measured (reference)", HEADS)
    for name, row in rows.items():
        table.add_row(name, *cells(row.values, with_gap(contest.reference.get(name))))
    console.print(table)
    console.print("" if quick else distance(contest, rows) + "\n")
    return rows


def distance(contest: Contest, rows: dict[str, Measured]) -> str:
    """How far RMSEs are from their references, in percent and in standard errors of the difference."""
    found = []
    for name, reference in contest.reference.items():
        if name in rows and reference[0]:
            value, error, *_ = rows[name].values
            gap = error * np.sqrt(1.0 + contest.runs / contest.against)
            found.append((abs(value - reference[0]) / gap, value / reference[0], name))
    if not found:
        return ""
    z, ratio, name = max(found)
    middle = 100.0 * (float(np.median([ratio for _, ratio, _ in found])) - 1.0)
    return (
        f"RMSE against the reference: median {middle:+.1f} %; furthest off {100.0 * (ratio - 1.0):+.0f} % ({name}), "
        f"{z:.1f} standard errors of the difference"
    )


def cheap(contest: Contest, name: str) -> bool:
    """Whether a row takes little time."""
    return (contest.reference.get(name, (np.inf,))[-1] or np.inf) <= LITTLE


def wrong_settings(runs: int, console: Console) -> dict[str, Row]:
    """The table of sensitivity."""
    table = table_of(
        f"RMSE with wrong settings: {runs} records of 600 samples, measured (reference)",
        (*sensitivity.REDUCTIONS, "Decide(4), steady"),
    )
    found = sensitivity.rows(runs)
    for name, (values, reference) in found.items():
        table.add_row(name, *cells(values, reference))
    console.print(table)
    console.print()
    return {name: values for name, (values, _) in found.items()}


def further(runs: int, console: Console) -> dict[str, Row]:
    """Smoothing and unknown noise; returns the latter."""
    table = table_of(f"RMSE of paths: {runs} records of 600 samples, measured (reference)", ("RMSE", "+-"))
    for name, values in others.smoothing(runs).items():
        table.add_row(name, *cells(values, (others.SMOOTHING[name], None)))
    console.print(table)
    heads = [f"sigma {sigma:g}" for sigma in others.SIGMAS]
    table = table_of(
        f"\nRMSE with unknown noise, Decide(2): {runs} records of 600 samples, measured (reference)", heads
    )
    found = [others.noise(runs, sigma) for sigma in others.SIGMAS]
    for name, reference in others.NOISE.items():
        table.add_row(name, *cells([one[name][0] for one in found], reference))
    console.print(table)
    console.print()
    return {name: tuple(one[name][0] for one in found) for name in others.NOISE}


def main(
    quick: Annotated[bool, typer.Option("--quick", help="The rows of little cost of two tables.")] = False,
    only: Annotated[str, typer.Option(help="Only tables whose title contains this.")] = "",
) -> None:
    """Tables of accuracy of banks of hypotheses, with reference values."""
    from lab.reproduce.hypotheses.claims import print_claims

    console = Console(width=200)
    found = {
        contest.table: contest_of(contest, quick, console)
        for contest in contests()
        if only.lower() in contest.title.lower() and (not quick or contest.table in QUICK)
    }
    runs = 4 * RUNS
    wrong = wrong_settings(runs, console) if only.lower() in "wrong settings" and not quick else {}
    noise = further(runs, console) if only.lower() in "smoothing and unknown noise" and not quick else {}
    if not only and not quick:
        print_claims(found, wrong, noise, runs, console)
