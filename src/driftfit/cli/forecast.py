"""``driftfit forecast``: outputs and parameters after the end of the record."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.text import Text

from driftfit.cli.parts.options import Given, reads
from driftfit.cli.parts.program import app, say
from driftfit.cli.parts.reading import rows_of
from driftfit.engine.kernel import Array
from driftfit.results import Track
from driftfit.show.export import write_table
from driftfit.show.text import table_of

SHOWN = 40
"""Largest number of rows that are printed."""


@app.command()
@reads
def forecast(
    given: Given,
    ahead: Annotated[
        int | None, typer.Option("--ahead", help="Samples to forecast; as many as --future has rows.")
    ] = None,
    future: Annotated[str | None, typer.Option(help="File of future inputs, with the columns of --u.")] = None,
    level: Annotated[float, typer.Option(help="Level of the bands.")] = 0.95,
    write_to: Annotated[Path | None, typer.Option("--out", help="Write the forecast to .csv or .parquet.")] = None,
) -> None:
    """Forecast the outputs, and the parameters, after the end of the record."""
    if not 0.0 < level < 1.0:
        raise ValueError(f"--level must be between 0 and 1, such as 0.95; got {level!r}.")
    if write_to is not None and write_to.suffix.lower() not in (".csv", ".parquet"):
        raise ValueError(f"--out {write_to}: a forecast is written to .csv or .parquet.")
    if given.by or len(given.outputs) > 1:
        raise ValueError("forecast: one series of one output at a time; leave out --by and further --y.")
    u = None if future is None else _inputs(given, future)
    if ahead is None:
        ahead = 10 if u is None else len(u)
    if u is None and given.inputs:
        raise ValueError(
            f"forecast: future inputs are needed: --future FILE with the columns {', '.join(given.inputs)}."
        )
    run: Track = given.run()
    made = run.forecast(ahead, None if u is None else u[:ahead])
    low, high = made.band(level)
    frame = made.table.with_columns(low=low, high=high)
    table = table_of(
        f"{run.labels.y} after {run.time_text(-1)}", "ahead" if made.time is None else made.axis, run.labels.y, "std",
        f"{level:.0%} from", "to",
    )  # fmt: skip
    for k, row in enumerate(frame.head(SHOWN).select("y_hat", "y_std", "low", "high").iter_rows()):
        table.add_row(made.time_text(k), *(f"{value:.6g}" for value in row))
    say(table)
    if ahead > SHOWN:
        say(Text(f" the first {SHOWN} of {ahead}; --out writes all", "dim"))
    if write_to is not None:
        write_table(frame, write_to)


def _inputs(given: Given, future: str) -> Array:
    if not given.inputs:
        raise ValueError(f"--future {future}: the model has no inputs; leave it out.")
    read = rows_of([future], given.inputs, None, [], replace(given.part(), first=None, last=None, rows=(1, None)))
    return np.stack([read.numbers[name] for name in given.inputs], axis=1)
