"""``driftfit cache``: the compiled code that is stored on disk."""

from __future__ import annotations

from typing import Annotated

import typer

from driftfit.cli.parts.program import app, helpful, say
from driftfit.engine.disk_cache import Contents, contents, prune
from driftfit.show.text import facts


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
            raise ValueError(f"--days {days:g}: the number of days must be at least 0.")
        gone = prune(days) if remove else None
        there = contents()
        say(
            facts(
                *stored(there, f"{there.usable} of them of this version and processor"),
                *([] if gone is None else [("Removed", f"{gone} files")]),
            )
        )


def stored(found: Contents, more: str) -> list[tuple[str, str]]:
    """Where compiled code is stored, how many files there are, and their size."""
    return [
        ("Folder", str(found.place or "none: no folder can be written, see NUMBA_CACHE_DIR")),
        ("Files", f"{found.files}, {more}"),
        ("Size", f"{found.size / 1e6:.1f} MB"),
    ]
