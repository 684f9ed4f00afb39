"""Time-varying Hammerstein-Wiener systems, reproduced: four examples, 24 seeds (20 for the furnace).

Prints medians and reference values of an independent implementation, the cost of separation, and the verdicts on the
claims of the paper; draws figures 2 to 10, 12 and 13. Source: Feng and Hong (2021), Int. J. Systems Science 52(16). Run
``python -m lab reproduce hammerstein-wiener --help``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console


def main(
    seeds: Annotated[int, typer.Option(help="Seeds per example; the reference has 24.")] = 24,
    quick: Annotated[bool, typer.Option("--quick", help="What costs little, on all seeds.")] = False,
    figures: Annotated[Path | None, typer.Option(help="Folder for the pictures.")] = None,
) -> None:
    """Reproduce the examples of parameter tracking of time-varying Hammerstein-Wiener systems."""
    from lab.reproduce.hammerstein_wiener import claims, cost, tables

    out = Console(width=132, highlight=False)
    found = tables.measure(seeds, quick)
    out.print(tables.table(found))
    if not quick:
        ratio, where = tables.worst_ratio(found)
        far = f"{100 * ratio:.0f} % ({where})"
        out.print(f"{seeds} seeds; largest deviation of a median from its reference, beyond rounding, {far}\n")
        times = cost.measure()
        out.print(cost.table(times), "\n", sep="")
        claims.show(out, claims.all_claims(found, times))
    if figures is not None:
        from lab.reproduce.hammerstein_wiener import figures as pictures

        figures.mkdir(parents=True, exist_ok=True)
        pictures.draw(figures)
