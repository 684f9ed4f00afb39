"""``driftfit warm``: compile before the first user has to wait, for example when a container image is built."""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer
from rich.text import Text

from driftfit.cli.compiled.cache import stored
from driftfit.cli.parts.program import app, helpful, progress, say
from driftfit.engine.disk_cache import contents, folder
from driftfit.parsing.settings import parse_model, parse_tracker
from driftfit.results import Track
from driftfit.run.parallel_lanes import FEWEST
from driftfit.show.text import facts

SAMPLES = 600
"""Length of the simulated record, of which half is the reference of the alarms."""


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
    """Compile and store what models and a tracker need: record, stream, summary, verdict, alarms, smoother, report."""
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
                lacking = _used(run)
                Live(run.model, chosen).update(0.0, None if u is None else u[0])
                if fleet:
                    many = np.tile(y, (FEWEST, 1))
                    _used(track(bound, chosen, many, None if u is None else np.tile(u, (FEWEST, 1, 1)), by="row"))
            for verb, reason in lacking.items():
                say(Text(f" {text}, without {verb}: {reason}", "dim"))
        after = contents()
        say(
            facts(
                *stored(after, f"{after.files - before.files} new"),
                ("Seconds", f"{time.perf_counter() - start:.0f}"),
            )
        )
        if folder() is None:
            raise ValueError("no folder can be written, so nothing was kept; set NUMBA_CACHE_DIR.")


def _used(run: Any) -> dict[str, str]:
    """Do with a result what users do; returns the reasons why a model or a tracker cannot have some of it, by verb."""
    verbs: dict[str, Callable[[], Any]] = {"summary": run.summary, "verdict": run.verdict, "diagnose": run.diagnose}
    verbs["detect"] = lambda: run.detect(reference=SAMPLES // 2)
    if isinstance(run, Track):
        verbs["smooth"] = lambda: run.smooth().std
    if find_spec("matplotlib"):
        verbs["report"] = lambda: _reported(run)
    lacking = {}
    for verb, call in verbs.items():
        try:
            call()
        except ValueError as error:
            lacking[verb] = str(error)
    return lacking


def _reported(run: Any) -> None:
    with TemporaryDirectory() as folder:
        run.report(Path(folder) / "page.html")
