"""Commands that read no record: trackers, demo, cache, warm, export c, serve, journal."""

from __future__ import annotations

import getpass
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text
from typer import Argument, Option

from driftfit import trackers as known
from driftfit.cli.options import Own, Setting
from driftfit.cli.program import app, out, progress, say
from driftfit.embedded import export_c
from driftfit.engine.disk_cache import Contents, contents, folder, prune
from driftfit.parsing.settings import default, given_fields, parse_model, parse_tracker
from driftfit.results import Track
from driftfit.run.parallel_lanes import FEWEST_LANES
from driftfit.show.text import facts
from driftfit.streams import Live
from driftfit.tracking import track


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


@app.command()
def cache(
    remove: Annotated[
        bool, Option("--prune", help="Remove what other versions made, and what was not used for --days.")
    ] = False,
    days: Annotated[float, Option(help="With --prune: days without use; 0 removes everything.")] = 30.0,
) -> None:
    """Show where compiled code is stored and how much of it there is, or prune it."""
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


RECORD_LENGTH = 600
"""Of the simulated record, of which half is the reference of the alarms."""


@app.command()
def warm(
    model: Annotated[
        list[str] | None, Option(help="As in `driftfit track`; repeat it. Default: arx:2,2,intercept.")
    ] = None,
    tracker: Annotated[str, Option(help="Tracker, as `driftfit trackers` lists them.")] = "adaptive-kalman",
    p: Setting = None,
    own: Own = None,
    inputs: Annotated[int, Option(help="Number of inputs of the record.")] = 1,
    fleet: Annotated[bool, Option("--fleet", help="Compile for fleets as well.")] = False,
) -> None:
    """Compile and store what models and a tracker need: record, stream, summary, verdict, alarms, smoother, report."""
    if inputs < 0:
        raise ValueError(f"--inputs {inputs}: the number of inputs must be at least 0.")
    start, before = time.perf_counter(), contents()
    rng = np.random.default_rng(0)
    y, u = rng.normal(size=RECORD_LENGTH), rng.normal(size=(RECORD_LENGTH, inputs)) if inputs else None
    chosen = parse_tracker(tracker, p or [], own)
    for text in model or [f"arx:2,{2 if inputs else 0},intercept"]:
        bound = parse_model(text)
        with progress.status(f"compiling {text}"):
            run = track(bound, chosen, y, u)
            lacking = _used(run)
            Live(run.model, chosen).update(0.0, None if u is None else u[0])
            if fleet:
                many = np.tile(y, (FEWEST_LANES, 1))
                _used(track(bound, chosen, many, None if u is None else np.tile(u, (FEWEST_LANES, 1, 1)), by="row"))
        for verb, reason in lacking.items():
            say(Text(f" {text}, without {verb}: {reason}", "dim"))
    after = contents()
    say(facts(*stored(after, f"{after.files - before.files} new"), ("Seconds", f"{time.perf_counter() - start:.0f}")))
    if folder() is None:
        raise ValueError("no folder can be written, so nothing was kept; set NUMBA_CACHE_DIR.")


def _used(run: Any) -> dict[str, str]:
    """Do with a result what users do; returns the reasons why a model or a tracker cannot have some of it, by verb."""
    verbs: dict[str, Callable[[], Any]] = {"summary": run.summary, "verdict": run.verdict, "diagnose": run.diagnose}
    verbs["detect"] = lambda: run.detect(reference=RECORD_LENGTH // 2)
    if isinstance(run, Track):
        verbs["smooth"] = lambda: run.smooth().std
    if find_spec("matplotlib"):
        verbs["report"] = lambda: _reported(run)
    lacking = {}
    for verb, call in verbs.items():
        try:
            call()
        except ValueError as error:
            lacking[verb] = str(error)
    return lacking


def _reported(run: Any) -> None:
    with TemporaryDirectory() as folder:
        run.report(Path(folder) / "page.html")


export = typer.Typer(no_args_is_help=True, help="Write a tracker in another language.")
app.add_typer(export, name="export")


@export.callback()
def _languages() -> None:
    """Write a tracker in another language."""


@export.command(name="c")
def to_c(
    model: Annotated[str, Option(help="As in `driftfit track`: arx:2,2 or 'ARX(2, 2)'.")],
    out: Annotated[Path, Option(help="The folder to write into.")],
    tracker: Annotated[str, Option(help="Tracker, by its name or as in Python.")] = "adaptive-kalman",
    p: Setting = None,
    own: Own = None,
    fixed_rate: Annotated[bool, Option("--fixed-rate", help="No uneven intervals, no known factors.")] = False,
    gate: Annotated[bool | None, Option("--gate/--no-gate", help="Judge readings first.")] = None,
    horizon: Annotated[int | None, Option(help="Samples for which inputs are planned, too.")] = None,
) -> None:
    """Write a tracker as C99 for a controller: tracker.h, tracker.c, a self-test and a README."""
    made = parse_model(model), parse_tracker(tracker, p or [], own)
    export_c(*made, out, fixed_rate=fixed_rate, gate=gate, horizon=horizon)
    readme = (out / "README.md").read_text(encoding="utf-8")
    state = readme.split("State: ")[1].split(".")[0]
    say(facts(("Written", str(out)), ("State", state), ("Check it", f"see {out / 'README.md'}")))


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
    with TemporaryDirectory(prefix="driftfit-demo-") as temporary:
        home = Path(temporary) if demo and folder is None else home
        progress.print(service.greeting(config, home), markup=False, highlight=False, soft_wrap=True)
        if rebuild:
            service.rebuild(home)
        service.run(config, home)
