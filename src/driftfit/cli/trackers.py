"""``driftfit trackers``: the trackers with their settings and defaults."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text
from typer import Option

from driftfit import trackers as known
from driftfit.cli.program import app, out, progress, say
from driftfit.parsing.settings import default, given_fields


@app.command()
def trackers() -> None:
    """List the trackers with their settings and defaults."""
    table = Table(box=SIMPLE_HEAD, show_edge=False, width=out.width)
    for head in ("tracker", "settings", "what it is"):
        table.add_column(head)
    for name, kind in known.found().items():
        required = kind.required
        settings = [f"{f.name}={'...' if f.name in required else default(f)}" for f in given_fields(kind)]
        first = (kind.__doc__ or "").strip().splitlines()[0]
        table.add_row(Text(name, "bold"), Text("\n".join(settings)), Text(first))
        table.add_section()
    say(table)
    say(Text(" ... must be given. On the command line: --tracker augmented-fls -p mu=10", "dim"))


@app.command()
def demo(plot: Annotated[Path, Option(help="File of the picture.")] = Path("driftfit-demo.png")) -> None:
    """Track the US demand for money from 1959 to 2009."""
    from driftfit.demo.demo import show

    show(out, progress, plot)
