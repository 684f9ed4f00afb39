"""``python -m lab bench accuracy`` and ``python -m lab bench speed``."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

app = typer.Typer(no_args_is_help=True, rich_markup_mode=None)
out = Console(highlight=False, soft_wrap=True)
progress = Console(stderr=True)

Quick = Annotated[bool, typer.Option(help="Small sizes: to see that it works, not to quote.")]
Out = Annotated[Path | None, typer.Option("--out", help="Also write the page and its pictures into this folder.")]


@app.command()
def accuracy(
    quick: Quick = False,
    runs: Annotated[int | None, typer.Option(min=2, help="Scored runs of each scenario and model.")] = None,
    write_to: Out = None,
    scenario: Annotated[list[str] | None, typer.Option(help="Only this scenario; repeat it.")] = None,
    real: Annotated[bool, typer.Option(help="Score the real records too.")] = True,
) -> None:
    """Score every tracker and every installed peer on simulated and real records."""
    from lab.bench import accuracy, accuracy_page
    from lab.bench.real import run_real
    from lab.bench.records import MODELS

    size = accuracy.QUICK if quick else accuracy.Size()
    size = accuracy.Size(runs or size.runs, size.tuning, size.T)
    try:
        names = accuracy.chosen(scenario)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    cells: list[accuracy.Cell] = []
    with progress.status("compiling") as status:
        for name in names:
            for kind in MODELS:
                status.update(f"{name}, {kind} ({len(cells) + 1} of {2 * len(names)})")
                cells.append(accuracy.run_cell(name, kind, size))
        status.update("real records")
        records = run_real() if real else ([], [])
    absent = accuracy.contestants()[1]
    out.print(Text(accuracy_page.page(cells, records, size, absent)))
    if write_to is not None:
        progress.print(f"written: {accuracy_page.write(write_to, cells, records, size, absent)}")


THREADS = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
"""Read by the libraries when they are loaded, so before the process starts."""


@app.command()
def speed(quick: Quick = False, write_to: Out = None) -> None:
    """Time every way to run, and compare it with installed peers and with lower bounds."""
    arguments = [*(["--quick"] if quick else []), *(["--out", str(write_to)] if write_to else [])]
    command = [sys.executable, "-m", "lab.bench.commands", *arguments]
    raise typer.Exit(subprocess.run(command, env=os.environ | THREADS, check=False).returncode)


def speed_here(quick: Quick = False, write_to: Out = None) -> None:
    """The same in this process, whose libraries were loaded for one thread."""
    from lab.bench import speed, speed_page, speed_process

    finishes = []
    with progress.status("speed") as status:
        for finish in speed.contests(quick):
            finishes.append(finish)
            status.update(f"{finish.title}: done")
        slopes = speed.slopes(quick)
        starts = speed_process.starts(1 if quick else 5)
    text = speed_page.page(finishes, slopes, starts, quick)
    out.print(Text(text))
    if write_to is not None:
        progress.print(f"written: {speed_page.write(write_to, text, slopes)}")


if __name__ == "__main__":
    typer.run(speed_here)
