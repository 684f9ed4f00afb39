"""``driftfit cache``: the compiled code that is stored on disk."""

from __future__ import annotations

from typing import Annotated

import typer

from driftfit.cli.parts.program import app, helpful, say
from driftfit.engine.disk_cache import contents, prune
from driftfit.show.parts.text import facts


@app.command()
def cache(
    remove: Annotated[
        bool, typer.Option("--prune", help="Remove what other versions made, and what was not used for --days.")
    ] = False,
    days: Annotated[float, typer.Option(help="With --prune: days without use; 0 removes everything.")] = 30.0,
) -> None:
    """Show where compiled code is stored and how much of it there is, or prune it."""
    with helpful():
        if days < 0.0:
            raise ValueError(f"--days {days:g}: at least 0.")
        gone = prune(days) if remove else None
        there = contents()
        say(
            facts(
                ("Folder", str(there.place or "none: no folder can be written, see NUMBA_CACHE_DIR")),
                ("Files", f"{there.files}, {there.usable} of them of this version and processor"),
                ("Size", f"{there.size / 1e6:.1f} MB"),
                *([] if gone is None else [("Removed", f"{gone} files")]),
            )
        )
