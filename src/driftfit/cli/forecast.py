"""``driftfit forecast``: outputs and parameters after the end of the record."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

import numpy as np
import polars as pl
from rich.text import Text
from typer import Option

from driftfit.cli.options import Given, Plot, Table, check_table, reads
from driftfit.cli.program import app, progress, say
from driftfit.cli.reading import rows_of
from driftfit.engine.kernel import Array
from driftfit.engine.settings import missing_settings
from driftfit.results import Track
from driftfit.show.export import write_table
from driftfit.show.text import digits, facts, table_of
from driftfit.tune.tune import tune
from driftfit.tune.tuned import Tuned

FORECAST_ROWS, SMOOTHED_ROWS = 40, 5
"""Rows that are printed, at most."""


@app.command()
@reads
def forecast(
    given: Given,
    ahead: Annotated[int | None, Option("--ahead", help="Samples to forecast; as many as --future has rows.")] = None,
    future: Annotated[str | None, Option(help="File of future inputs, with the columns of --u.")] = None,
    level: Annotated[float, Option(help="Level of the bands.")] = 0.95,
    write_to: Table = None,
) -> None:
    """Forecast the outputs, and the parameters, after the end of the record."""
    if not 0.0 < level < 1.0:
        raise ValueError(f"--level must be between 0 and 1, such as 0.95; got {level!r}.")
    check_table(write_to, "a forecast is")
    given.check_single("forecast")
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
    for k, row in enumerate(frame.head(FORECAST_ROWS).select("y_hat", "y_std", "low", "high").iter_rows()):
        table.add_row(made.time_text(k), *(f"{value:.6g}" for value in row))
    say(table)
    if ahead > FORECAST_ROWS:
        say(Text(f" the first {FORECAST_ROWS} of {ahead}; --out writes all", "dim"))
    if write_to is not None:
        write_table(frame, write_to)


def _inputs(given: Given, future: str) -> Array:
    if not given.inputs:
        raise ValueError(f"--future {future}: the model has no inputs; leave it out.")
    read = rows_of([future], given.inputs, None, [], replace(given.part(), first=None, last=None, rows=(1, None)))
    return np.stack([read.numbers[name] for name in given.inputs], axis=1)


@app.command()
@reads
def smooth(given: Given, write_to: Table = None, plot: Plot = None) -> None:
    """Estimate the parameters at every sample from the whole record; settings that are left out are tuned first."""
    check_table(write_to, "a path is")
    given.check_single("smooth")
    tracker = given.chosen_tracker()
    if missing_settings(tracker):
        with progress.status("tuning"):
            tuned = tune(given.models()[0], tracker, **given.arrays())
        assert isinstance(tuned, Tuned)  # `arrays` are of one output
        tracker = tuned.tracker
    run = given.run(tracker=tracker)
    smoothed = run.smooth()
    say(facts(("Model", repr(run.model)), ("Tracker", repr(run.tracker)), ("Samples", str(len(run)))))
    table = table_of("Parameters from the whole record", "at", *run.names)
    for t in np.unique(np.linspace(0, len(run) - 1, SMOOTHED_ROWS).astype(int)):
        cells = (f"{digits(v, s)} +- {s:.2g}" for v, s in zip(smoothed.theta[t], smoothed.std[t], strict=True))
        table.add_row(Text(run.time_text(int(t))), *cells)
    say(table)
    say(Text(" +- one standard deviation", "dim"))
    if write_to is not None:
        columns: dict[str, Any] = {run.labels.time or "sample": run.time}
        columns |= {f"theta_{name}": smoothed.theta[:, i] for i, name in enumerate(run.names)}
        columns |= {f"std_{name}": smoothed.std[:, i] for i, name in enumerate(run.names)}
        write_table(pl.DataFrame(columns), write_to)
    if plot is not None:
        smoothed.plot().savefig(plot, dpi=150)
