"""``driftfit verdict``: is the time variation real, which parameters move, and does tracking them pay?"""

from __future__ import annotations

from typing import Annotated

import typer

from driftfit.cli.parts.options import Given, reads
from driftfit.cli.parts.program import app, say
from driftfit.cli.track import Report


@app.command()
@reads
def verdict(
    given: Given,
    level: Annotated[float, typer.Option(help="Error rate of the test; for a fleet, the false discovery rate.")] = 0.05,
    lags: Annotated[int | None, typer.Option(help="Lags of correlation of the noise to allow for.")] = None,
    report: Report = None,
) -> None:
    """Report whether the parameters move, which ones and when, and whether tracking them pays."""
    run = given.run()
    say(run.verdict(level=level, lags=lags))
    if report is not None:
        run.report(report)
