"""Command line: ``driftfit track``, ``trackers``, ``demo``.

What a user got wrong ends in one line on stderr and exit code 2; a traceback is always a fault of the program.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from driftfit import __version__, trackers
from driftfit.arguments import default, given_fields, listed, parse_interval, parse_model, parse_tracker, parse_units
from driftfit.export import check_ending, write
from driftfit.summary import WIDTH
from driftfit.track import track as run_track

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__.splitlines()[0], rich_markup_mode=None)
out = Console(width=WIDTH, highlight=False, soft_wrap=False)
progress = Console(stderr=True)


def main() -> None:
    """The program that the package installs."""
    app()


@contextmanager
def helpful() -> Iterator[None]:
    """Turn what a user can put right into one line and exit code 2."""
    try:
        yield
    except (ValueError, OSError, ImportError) as error:
        typer.echo(f"driftfit: {' '.join(str(error).split())}", err=True)
        raise typer.Exit(2) from None


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"driftfit {__version__}")
        raise typer.Exit


@app.callback(help="Follow the parameters of a system while they change.")
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    pass


@app.command()
def track(
    file: Annotated[
        list[str],
        typer.Argument(help="CSV files with a header line, or Parquet files, or patterns such as 'runs/*.csv'."),
    ],
    y: Annotated[
        list[str],
        typer.Option(
            help="Column of the output; repeat it, or separate names by commas, for several (ARX, Regression)."
        ),
    ],
    u: Annotated[
        list[str] | None, typer.Option(help="Column of an input; repeat it, or separate names by commas.")
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="Model and its settings by place or name: arx:2,2,nk=1,intercept; one value per input with a slash: "
            "arx:2,2/1,nk=0/1; regression:intercept. Default: arx:2,2,intercept, without inputs arx:2,0,intercept."
        ),
    ] = None,
    tracker: Annotated[
        str, typer.Option(help="Tracker, as `driftfit trackers` lists them; the default needs no settings.")
    ] = "adaptive-kalman",
    p: Annotated[
        list[str] | None, typer.Option("-p", help="Setting of the tracker: q=1e-4, q=1e-4,0,0 or p0=none; repeat it.")
    ] = None,
    time: Annotated[str | None, typer.Option(help="Column of the time: numbers or dates.")] = None,
    by: Annotated[
        list[str] | None,
        typer.Option(help="Column that tells the series of a fleet apart, or `file`; repeat it for several."),
    ] = None,
    unit: Annotated[list[str] | None, typer.Option(help="Unit of a column: flow=l/min; repeat it.")] = None,
    own: Annotated[
        str | None, typer.Option("--with", metavar="MODULE:CLASS", help="A tracker of your own, from a module here.")
    ] = None,
    dt: Annotated[
        str | None, typer.Option(help="Nominal interval: a number, or 10ms, 1s, 15min, 1h, 1d, 1w for dates.")
    ] = None,
    write_to: Annotated[
        Path | None, typer.Option("--out", help="Write the result to .csv, .parquet or .npz (one run).")
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Save a picture (.png, .pdf, .svg).")] = None,
    report: Annotated[
        Path | None,
        typer.Option(help="Write a page (.html) to send to someone; a fleet has one page."),
    ] = None,
) -> None:
    """Follow the parameters of a model through a record, or through a fleet of them."""
    with helpful():
        outputs, inputs = listed(y), listed(u)
        if not outputs:
            raise ValueError("--y names no column.")
        if len(set(outputs)) < len(outputs):
            raise ValueError(f"--y {','.join(outputs)}: an output is named once.")
        bound = parse_model(model or f"arx:2,{2 if inputs else 0},intercept", outputs)
        bound = bound if bound.shared else bound.bind(inputs)
        chosen = parse_tracker(tracker, p or [], own)
        if write_to is not None and check_ending(write_to) == ".npz" and by:
            raise ValueError(f"--out {write_to}: an .npz file holds one run; write a fleet as .parquet or .csv.")
        if report is not None:
            from driftfit.report import check_path

            check_path(report)
        if plot is not None and by and len(outputs) > 1:
            raise ValueError("--plot: there is no picture of many records with several outputs; --report has some.")
        several = len(outputs) > 1
        signals: Any = {"y": outputs if several else outputs[0], "u": inputs, "data": file, "time": time}
        signals |= {"by": by or None, "dt": parse_interval(dt), "units": parse_units(unit) or None}
        with progress.status("tracking (the first run of a model and tracker compiles it)"):
            run: Any = run_track(bound, chosen, **signals)
            summary = run.summary()
        out.print(summary, markup=False)  # names of parameters hold brackets
        if write_to is not None:
            write(run, write_to)
        if plot is not None:
            run.plot().savefig(plot, dpi=150)
        if report is not None:
            run.report(report)


@app.command(name="trackers")
def list_trackers() -> None:
    """List the trackers with their settings and defaults."""
    table = Table(box=SIMPLE_HEAD, show_edge=False, width=WIDTH)
    for head in ("tracker", "settings", "what it is"):
        table.add_column(head)
    for name, kind in trackers.found().items():
        required = kind.required
        settings = [f"{f.name}={'...' if f.name in required else default(f)}" for f in given_fields(kind)]
        first = (kind.__doc__ or "").strip().splitlines()[0]
        table.add_row(Text(name, "bold"), Text("\n".join(settings)), Text(first))
        table.add_section()
    out.print(table)
    out.print(Text(" ... must be given. On the command line: --tracker augmented-fls -p mu=10", "dim"))


@app.command()
def demo(
    plot: Annotated[Path, typer.Option(help="Where the picture goes.")] = Path("driftfit-demo.png"),
) -> None:
    """Follow the US demand for money from 1959 to 2009."""
    from driftfit.demo import show

    with helpful():
        show(out, progress, plot)
