"""``driftfit demo``: the first picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from driftfit.cli.parts.program import app, helpful, out, progress


@app.command()
def demo(
    plot: Annotated[Path, typer.Option(help="File of the picture.")] = Path("driftfit-demo.png"),
) -> None:
    """Track the US demand for money from 1959 to 2009."""
    from driftfit.demo.demo import show

    with helpful():
        show(out, progress, plot)
