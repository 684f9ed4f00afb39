"""``driftfit smooth``: estimate every parameter from the whole record, past and future."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import polars as pl
import typer
from rich.text import Text

from driftfit.cli.parts.options import Given, reads
from driftfit.cli.parts.program import app, progress, say
from driftfit.cli.track import Plot
from driftfit.engine.settings import missing_settings
from driftfit.show.export import write_table
from driftfit.show.text import digits, facts, table_of
from driftfit.tune.tune import tune
from driftfit.tune.tuned import Tuned

PLACES = 5
"""Number of samples that are printed."""


@app.command()
@reads
def smooth(
    given: Given,
    write_to: Annotated[Path | None, typer.Option("--out", help="Write the path to .csv or .parquet.")] = None,
    plot: Plot = None,
) -> None:
    """Estimate the parameters at every sample from the whole record; settings that are left out are tuned first."""
    if write_to is not None and write_to.suffix.lower() not in (".csv", ".parquet"):
        raise ValueError(f"--out {write_to}: a path is written to .csv or .parquet.")
    if given.by or len(given.outputs) > 1:
        raise ValueError("smooth: one series of one output at a time; leave out --by and further --y.")
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
    for t in np.unique(np.linspace(0, len(run) - 1, PLACES).astype(int)):
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
