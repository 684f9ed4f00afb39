"""``driftfit serve``: a live service that follows the units of a plant."""

from __future__ import annotations

import getpass
import tempfile
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from driftfit.cli.program import app, progress, say

NEEDED = "driftfit serve needs more packages: pip install 'driftfit[serve]' ({})."


journal = typer.Typer(no_args_is_help=True, help="The journal of a service.")
app.add_typer(journal, name="journal")


@journal.command()
def verify(
    folder: Annotated[Path, Argument(help="The folder of the service, which may run meanwhile.")],
    digest: Annotated[str, Option(help="A digest that was printed earlier; the chain must have it.")] = "",
) -> None:
    """Check the sum of every row, and the chain of digests; exit code 1 if something is wrong."""
    try:
        from driftfit.service.core.journal import verify as faults_of
    except ImportError as error:
        raise ValueError(NEEDED.format(error)) from None
    found, faults = faults_of(folder, digest)
    for line in [*faults, f"{found}: {len(faults)} faults"]:
        say(line, soft_wrap=True)
    if faults:
        raise typer.Exit(1)


@app.command()
def serve(
    file: Annotated[Path | None, Argument(help="Configuration, a TOML file; docs/service.md explains it.")] = None,
    check: Annotated[bool, Option("--check", help="Only say whether the configuration is valid.")] = False,
    demo: Annotated[bool, Option("--demo", help="A simulated plant; no file, broker or network needed.")] = False,
    port: Annotated[int | None, Option(help="Port of the page.")] = None,
    folder: Annotated[Path | None, Option(help="Where journal and results are stored.")] = None,
    rebuild: Annotated[
        bool, Option("--rebuild", help="First compute all states again from the journal, as with another gate.")
    ] = False,
    make_hash: Annotated[bool, Option("--hash", help="Ask for a password and print its hash.")] = False,
    make_token: Annotated[bool, Option("--token", help="Print a new token and its hash.")] = False,
) -> None:
    """Follow the units of a plant: sensors in, parameters, bands and alarms out, and a page to watch."""
    try:
        from driftfit.service import supervisor as service
        from driftfit.service.config import ProblemsError
    except ImportError as error:
        raise ValueError(NEEDED.format(error)) from None
    if make_hash or make_token:
        from driftfit.service.page.access import hashed, new_token

        for line in [hashed(getpass.getpass("Password: "))] if make_hash else new_token():
            say(line, soft_wrap=True)
        return
    if demo == (file is not None):
        raise ValueError("name a configuration, as in driftfit serve plant.toml, or try driftfit serve --demo.")
    try:
        config, home = service.configured(service.DEMO if file is None else file, port, folder)
    except ProblemsError as error:
        for problem in error.messages:
            typer.echo(f"driftfit: {problem}", err=True)
        raise typer.Exit(2) from None
    if check:
        say(service.described(config), soft_wrap=True)
        return
    with tempfile.TemporaryDirectory(prefix="driftfit-demo-") as temporary:
        home = Path(temporary) if demo and folder is None else home
        progress.print(service.greeting(config, home), markup=False, highlight=False, soft_wrap=True)
        if rebuild:
            service.rebuild(home)
        service.run(config, home)
