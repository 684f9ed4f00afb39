"""``driftfit identify``: from a file to an answer."""

from __future__ import annotations

import json
from pathlib import Path
from time import monotonic
from typing import Annotated

import typer
from typer import Argument, Option

from driftfit.cli.options import Cells, Names, limits_from, listed, parse_interval, reads
from driftfit.cli.program import app, progress, say, writable
from driftfit.engine.compile_notice import PATIENCE
from driftfit.identify.answer import Identification, ManyIdentified, identify
from driftfit.identify.roles import NoAnswerError


@app.command("identify")
@reads
def identify_command(
    file: Annotated[list[str], Argument(help="CSV or Parquet files, or patterns such as 'runs/*.csv'.")],
    cells: Cells,
    *,
    y: Annotated[str | None, Option(help="Column of the output.")] = None,
    u: Annotated[Names, Option(help="Inputs to choose from; repeat it, or separate names by commas.")] = None,
    not_u: Annotated[Names, Option(help="Columns that are no inputs.")] = None,
    by: Annotated[str | None, Option(help="Column that identifies records of one structure.")] = None,
    max_lag: Annotated[int, Option(help="Longest lag of an input, in samples.")] = 30,
    forecast: Annotated[
        bool, Option("--forecast/--explain", help="Only inputs of earlier samples, or also of the same.")
    ] = False,
    horizon: Annotated[int, Option(help="Steps ahead of the second comparison.")] = 10,
    level: Annotated[float, Option(help="Error rate of the statement that parameters move.")] = 0.05,
    gate: Annotated[
        bool | None, Option("--gate/--no-gate", help="Leave out fault codes however many, or use all readings.")
    ] = None,
    budget: Annotated[
        float,
        Option(
            help="Seconds for one record.", metavar="SECONDS", parser=lambda text: float(str(text).removesuffix("s"))
        ),
    ] = 45.0,
    seed: Annotated[int, Option(help="Seed of the displaced copies of inputs.")] = 0,
    page: Annotated[Path | None, Option(help="Write the answer to a page (.html).")] = None,
    json_to: Annotated[Path | None, Option("--json", help="Write the answer as JSON; - is stdout.")] = None,
    quiet: Annotated[bool, Option("--quiet", help="Print the headline alone.")] = False,
) -> None:
    """From a file to an answer: which inputs matter, what changed, since when, and is it time or the working point?

    Exit codes: 0 answered, 1 undecided, 2 arguments or file, 3 the record cannot answer.
    """
    writable(page, "--page")
    ranges = dict(limits_from(one, [one.rpartition("=")[0].strip()]) for one in cells.limits or [])
    began = monotonic()
    with progress.status("reading") as status:
        if not (progress.is_terminal and not quiet):
            status.stop()

        def tell(text: str) -> None:
            if monotonic() - began > PATIENCE:
                status.update(text)

        try:
            found = identify(
                file if len(file) > 1 else file[0], y, u=listed(u) or None, not_u=listed(not_u), time=cells.time,
                dt=parse_interval(cells.dt), by=by, limits=ranges,
                max_lag=max_lag, forecast=forecast, horizon=horizon, level=level, gate=gate,
                budget=budget, seed=seed, reading=cells.wanted, progress=tell,
            )  # fmt: skip
        except NoAnswerError as error:
            status.stop()
            typer.echo(f"driftfit: this record cannot answer: {error}", err=True)
            raise typer.Exit(3) from None
    write(found, page, json_to, quiet)
    raise typer.Exit(found.code)


def write(found: Identification | ManyIdentified, page: Path | None, json_to: Path | None, quiet: bool) -> None:
    """Print the answer, and write what the options ask for."""
    to_stdout = str(json_to) == "-"
    if json_to is not None:
        text = json.dumps(found.json(), indent=1)
        typer.echo(text) if to_stdout else json_to.write_text(text, encoding="utf-8")
    if not to_stdout:
        say(" ".join(found.headline.split()) if quiet else found)
    if page is not None:
        found.page(page)
