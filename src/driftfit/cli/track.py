"""``driftfit track``: track the parameters of a model in a record, or in a fleet of records."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from driftfit.cli.options import Given, Out, Plot, Report, reads
from driftfit.cli.program import app, say
from driftfit.results import Track
from driftfit.show.export import check_ending, write

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@app.command()
@reads
def track(
    given: Given,
    write_to: Out = None,
    plot: Plot = None,
    system: Annotated[
        Path | None, Option(help="Save a picture of responses, poles and gain over time (ARX, one output).")
    ] = None,
    report: Report = None,
) -> None:
    """Track the parameters of a model in a record, or in a fleet of records."""
    if write_to is not None:
        check_ending(write_to)
    if report is not None:
        from driftfit.show.report import check_path

        check_path(report)
    run = given.run()
    say(run.summary())
    if write_to is not None:
        write(run, write_to)
    if plot is not None:
        run.plot().savefig(plot, dpi=150)
    if system is not None:
        plot_system(run).savefig(system, dpi=150)
    if report is not None:
        run.report(report)


def plot_system(run: Any) -> Figure:
    """The picture of the system, for runs that have one."""
    if not isinstance(run, Track):
        raise ValueError("--system: this draws one series with one output; leave out --by and further --y.")
    return run.plot_system()


@app.command()
@reads
def verdict(
    given: Given,
    level: Annotated[float, Option(help="Error rate of the test; for a fleet, the false discovery rate.")] = 0.05,
    lags: Annotated[int | None, Option(help="Lags of correlation of the noise to allow for.")] = None,
    report: Report = None,
) -> None:
    """Report whether the parameters move, which ones and when, and whether tracking them pays."""
    run = given.run()
    say(run.verdict(level=level, lags=lags))
    if report is not None:
        run.report(report)
