"""``driftfit warm``: compile before the first user has to wait, for example when a container image is built."""

from __future__ import annotations

import time
from typing import Annotated

import numpy as np
import typer

from driftfit.cli.compiled.cache import stored
from driftfit.cli.parts.program import app, helpful, progress, say
from driftfit.engine.disk_cache import contents, folder
from driftfit.parsing.settings import parse_model, parse_tracker
from driftfit.run.parallel_lanes import FEWEST
from driftfit.show.parts.text import facts

SAMPLES = 300
"""Length of the simulated record."""


@app.command()
def warm(
    model: Annotated[
        list[str] | None, typer.Option(help="As in `driftfit track`; repeat it. Default: arx:2,2,intercept.")
    ] = None,
    tracker: Annotated[str, typer.Option(help="Tracker, as `driftfit trackers` lists them.")] = "adaptive-kalman",
    p: Annotated[list[str] | None, typer.Option("-p", help="Setting of the tracker; repeat it.")] = None,
    own: Annotated[str | None, typer.Option("--with", metavar="MODULE:CLASS", help="Your own tracker.")] = None,
    inputs: Annotated[int, typer.Option(help="Number of inputs of the record.")] = 1,
    fleet: Annotated[bool, typer.Option("--fleet", help="Compile for fleets as well.")] = False,
) -> None:
    """Compile everything that models and a tracker need (record, stream, summary, verdict), and store it on disk."""
    from driftfit.streams import Live
    from driftfit.tracking import track

    with helpful():
        if inputs < 0:
            raise ValueError(f"--inputs {inputs}: the number of inputs must be at least 0.")
        start, before = time.perf_counter(), contents()
        rng = np.random.default_rng(0)
        y, u = rng.normal(size=SAMPLES), rng.normal(size=(SAMPLES, inputs)) if inputs else None
        chosen = parse_tracker(tracker, p or [], own)
        for text in model or [f"arx:2,{2 if inputs else 0},intercept"]:
            bound = parse_model(text)
            with progress.status(f"compiling {text}"):
                run = track(bound, chosen, y, u)
                run.summary()
                run.verdict()
                Live(run.model, chosen).update(0.0, None if u is None else u[0])
                if fleet:
                    many = np.tile(y, (FEWEST, 1))
                    track(bound, chosen, many, None if u is None else np.tile(u, (FEWEST, 1, 1)), by="row")
        after = contents()
        say(
            facts(
                *stored(after, f"{after.files - before.files} new"),
                ("Seconds", f"{time.perf_counter() - start:.0f}"),
            )
        )
        if folder() is None:
            raise ValueError("no folder can be written, so nothing was kept; set NUMBA_CACHE_DIR.")
