"""``driftfit forecast``: outputs and parameters after the end of the record."""

from __future__ import annotations

from pathlib import Path
from statistics import NormalDist
from typing import Annotated, Any

import numpy as np
import polars as pl
import typer
from rich.text import Text

from driftfit.cli.parts.options import Given, reads
from driftfit.cli.parts.program import app, say
from driftfit.cli.parts.reading import Part, rows_of
from driftfit.engine.kernel import Array
from driftfit.results import Track
from driftfit.show.export import write_table
from driftfit.show.parts.text import table_of

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
    half = NormalDist().inv_cdf(0.5 + level / 2.0) * made.y_std
    columns = {
        "ahead": np.arange(1, ahead + 1), run.labels.y: made.y_hat, "std": made.y_std, "low": made.y_hat - half,
        "high": made.y_hat + half,
    }  # fmt: skip
    table = table_of(
        f"{run.labels.y} after {run.time_text(-1)}", "ahead", run.labels.y, "std", f"{level:.0%} from", "to"
    )
    for row in zip(*columns.values(), strict=True):
        if row[0] <= SHOWN:
            table.add_row(*(f"{value:.6g}" for value in row))
    say(table)
    if ahead > SHOWN:
        say(Text(f" the first {SHOWN} of {ahead}; --out writes all", "dim"))
    if write_to is not None:
        more: dict[str, Any] = {f"theta_{name}": made.theta[:, i] for i, name in enumerate(run.names)}
        more |= {f"std_{name}": made.std[:, i] for i, name in enumerate(run.names)}
        write_table(pl.DataFrame({**columns, **more}), write_to)


def _inputs(given: Given, future: str) -> Array:
    if not given.inputs:
        raise ValueError(f"--future {future}: the model has no inputs; leave it out.")
    read = rows_of([future], given.inputs, None, [], Part(separator=given.part().separator, decimal=given.decimal))
    return np.stack([read.numbers[name] for name in given.inputs], axis=1)
