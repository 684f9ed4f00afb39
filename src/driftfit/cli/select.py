"""``driftfit select``: find the structure that predicts best."""

from __future__ import annotations

from typing import Annotated

import typer

from driftfit.cli.parts.arguments import listed
from driftfit.cli.parts.options import Given, reads
from driftfit.cli.parts.program import app, progress, say
from driftfit.cli.track import Plot


@app.command()
@reads
def select(
    given: Given,
    keep: Annotated[list[str] | None, typer.Option(help="Regressor that every subset contains; repeat it.")] = None,
    most: Annotated[int | None, typer.Option(help="Largest number of regressors in a subset.")] = None,
    plot: Plot = None,
) -> None:
    """Compare models (repeat --model), or the regressors of one, by how well they predict."""
    from driftfit.judge.structures.select import Selection
    from driftfit.judge.structures.select import select as compare

    models = given.models()
    with progress.status("comparing"):
        selection = compare(
            models if len(models) > 1 else models[0], tracker=given.chosen_tracker(), keep=tuple(listed(keep)),
            most=most, **given.arrays(),
        )  # fmt: skip
    say(selection)
    assert isinstance(selection, Selection)  # `arrays` are of one output
    if plot is not None:
        selection.plot().savefig(plot, dpi=150)
