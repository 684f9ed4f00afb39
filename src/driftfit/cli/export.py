"""``driftfit export c``: a tracker as standalone C99."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from driftfit.cli.options import Own, Setting
from driftfit.cli.program import app, say
from driftfit.parsing.settings import parse_model, parse_tracker
from driftfit.show.text import facts

export = typer.Typer(no_args_is_help=True, help="Write a tracker in another language.")
app.add_typer(export, name="export")


@export.callback()
def _languages() -> None:
    """Write a tracker in another language."""


@export.command(name="c")
def to_c(
    model: Annotated[str, Option(help="As in `driftfit track`: arx:2,2 or 'ARX(2, 2)'.")],
    out: Annotated[Path, Option(help="The folder to write into.")],
    tracker: Annotated[str, Option(help="Tracker, by its name or as in Python.")] = "adaptive-kalman",
    p: Setting = None,
    own: Own = None,
    fixed_rate: Annotated[bool, Option("--fixed-rate", help="No uneven intervals, no known factors.")] = False,
    gate: Annotated[bool | None, Option("--gate/--no-gate", help="Judge readings first.")] = None,
) -> None:
    """Write a tracker as C99 for a controller: tracker.h, tracker.c, a self-test and a README."""
    from driftfit.embedded import export_c

    export_c(parse_model(model), parse_tracker(tracker, p or [], own), out, fixed_rate=fixed_rate, gate=gate)
    readme = (out / "README.md").read_text(encoding="utf-8")
    state = readme.split("State: ")[1].split(".")[0]
    say(facts(("Written", str(out)), ("State", state), ("Check it", f"see {out / 'README.md'}")))
