"""Command line: ``driftfit track``, ``trackers``, ``demo``, ``reproduce``, ``bench``.

What a user got wrong ends in one line on stderr and exit code 2; a traceback is always a fault of the program.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, Field, fields
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from driftfit import __version__, models, trackers
from driftfit.bench import commands as bench
from driftfit.export import check_ending, write
from driftfit.models.base import Model
from driftfit.reproduce import found as reproductions
from driftfit.settings import Settings, near
from driftfit.summary import WIDTH
from driftfit.track import track as run_track
from driftfit.trackers.base import Tracker

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__.splitlines()[0], rich_markup_mode=None)
app.add_typer(bench.app, name="bench", help="Compare accuracy and speed with other packages.")
out = Console(width=WIDTH, highlight=False, soft_wrap=False)
progress = Console(stderr=True)

Kind = TypeVar("Kind", bound=Settings)


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
        Path | None, typer.Option("--out", help="Write the result to .csv, .parquet or .npz (a Track).")
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
        bound = parse_model(model or f"arx:2,{2 if inputs else 0},intercept", outputs)
        bound = bound if bound.shared else bound.bind(inputs)
        chosen = parse_tracker(tracker, p or [], own)
        if write_to is not None:
            check_ending(write_to)
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


@app.command(
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []},
    help=f"Reproduce a paper: {', '.join(reproductions())}. Options: driftfit reproduce NAME --help.",
)
def reproduce(context: typer.Context, name: Annotated[str, typer.Argument(help="Which one.")] = "--help") -> None:
    """Run one of the reproductions with the options that it has itself."""
    if name == "--help":
        out.print(f"driftfit reproduce {{{','.join(reproductions())}}} [--help]")
        return
    with helpful():
        if name not in reproductions():
            raise ValueError(f"there is no reproduction {name!r}; {near(name, reproductions())}")
        program = typer.Typer(add_completion=False, rich_markup_mode=None)
        program.command()(import_module(f"driftfit.reproduce.{name.replace('-', '_')}").main)
        program(args=context.args, prog_name=f"driftfit reproduce {name}", standalone_mode=False)


def given_fields(kind: type[Settings]) -> list[Field[Any]]:
    """The settings of a model or tracker, in the order in which they are given."""
    return [field for field in fields(kind) if field.init]  # type: ignore[arg-type]


def default(field: Field[Any]) -> str:
    """The default of a setting as a user would type it in Python."""
    if isinstance(field.default, float):
        return f"{field.default:g}"
    if field.default is not MISSING:
        return repr(field.default)
    return "..." if field.default_factory is MISSING else repr(field.default_factory())


def lookup(what: str, name: str, known: dict[str, type[Kind]]) -> type[Kind]:
    """A class by its name, whatever its case, and with - or _ between words."""
    plain = {key.lower(): kind for key, kind in known.items()}
    wanted = re.sub(r"[-_\s]", "", name).lower()
    if wanted not in plain:
        raise ValueError(f"there is no {what} {name!r}: {near(wanted, known)}")
    return plain[wanted]


def listed(given: Sequence[str] | None) -> list[str]:
    """Names that were repeated, or separated by commas."""
    return [name.strip() for entry in given or [] for name in entry.split(",") if name.strip()]


def parse_model(text: str, outputs: Sequence[str] = ()) -> Model:
    """``arx:2,2,nk=1,intercept`` as ARX(2, 2, nk=1, intercept=True), for outputs of these names if they are several."""
    name, _, rest = text.partition(":")
    kind = lookup("model", name, models.found())
    known = {field.name: field for field in given_fields(kind)}
    places = [key for key, field in known.items() if field.type not in ("bool", bool)]
    settings: dict[str, Any] = {}
    for position, entry in enumerate(entry.strip() for entry in rest.split(",") if entry.strip()):
        key, is_named, value = entry.partition("=")
        key = key.strip()
        if not is_named and key not in known:
            if not re.fullmatch(r"[\d./]+", key):
                raise ValueError(f"--model {text}: {key!r} is neither a number nor a setting; {near(key, known)}")
            if position >= len(places):
                raise ValueError(f"--model {text}: too many numbers; {kind.__name__} takes {', '.join(known)}.")
            key, value = places[position], key
        add_setting(f"--model {text}", settings, known, key, parse_value(value, "/") if value else True)
    if len(outputs) > 1:
        if "ny" not in known:
            raise ValueError(f"--model {text}: {kind.__name__} has one output, but --y names {', '.join(outputs)}.")
        if settings.get("ny", len(outputs)) != len(outputs):
            raise ValueError(f"--model {text}: ny={settings['ny']}, but --y names {', '.join(outputs)}.")
        settings["ny"] = tuple(outputs)
    return build(f"--model {text}", kind, settings)


def parse_units(given: Sequence[str] | None) -> dict[str, str]:
    """``flow=l/min`` as a name and its unit."""
    pairs = {entry: entry.partition("=") for entry in given or []}
    for entry, (name, _, unit) in pairs.items():
        if not name.strip() or not unit.strip():
            raise ValueError(f"--unit {entry}: a unit is given as column=unit, such as --unit flow=l/min.")
    return {name.strip(): unit.strip() for name, _, unit in pairs.values()}


def own_tracker(place: str) -> type[Tracker]:
    """The class that ``module:Class`` names; modules of the present folder are found."""
    module, _, name = place.partition(":")
    if not module or not name:
        raise ValueError(f"--with {place}: name the module and the class, such as --with mine:MyTracker.")
    sys.path.insert(0, "")
    kind = getattr(import_module(module), name, None)
    if not (isinstance(kind, type) and issubclass(kind, Tracker)):
        raise ValueError(f"--with {place}: {module} has no Tracker of the name {name}.")
    return kind


def parse_tracker(name: str, given: Sequence[str], own: str | None = None) -> Tracker:
    """A tracker from its name, or its place in a module of the user's, and ``key=value`` settings."""
    kind = own_tracker(own) if own else lookup("tracker", name, trackers.found())
    known = [field.name for field in given_fields(kind)]
    settings: dict[str, Any] = {}
    for entry in given:
        key, is_named, value = entry.partition("=")
        if not is_named or not value.strip():
            raise ValueError(f"-p {entry}: a setting is name=value, such as -p {known[0]}=1e-4.")
        others = [other for other, at in trackers.found().items() if key.strip() in {f.name for f in given_fields(at)}]
        if key.strip() not in known and others:
            raise ValueError(
                f"-p {entry}: {kind.__name__} has no setting {key.strip()!r}; that is one of {', '.join(others)}."
            )
        add_setting(f"-p {entry}", settings, known, key.strip(), parse_value(value, ","))
    return build(f"--with {own}" if own else f"--tracker {name}", kind, settings)


def add_setting(where: str, settings: dict[str, Any], known: Any, key: str, value: Any) -> None:
    """Note a setting once, under a name that exists."""
    if key not in known:
        raise ValueError(f"{where}: there is no setting {key!r}; {near(key, known)}")
    if key in settings:
        raise ValueError(f"{where}: {key} is given twice.")
    settings[key] = value


def build(where: str, kind: type[Kind], settings: dict[str, Any]) -> Kind:
    """Construct a model or tracker; a value of the wrong kind is the user's to put right, and so is a missing one."""
    try:
        return kind(**settings)
    except TypeError as error:
        raise ValueError(f"{where}: {str(error).replace('.__init__()', '')}.") from None


def parse_value(text: str, separator: str) -> Any:
    """A number, several with the separator between them, true, false, none, or text as it stands."""
    words = {"none": None, "true": True, "false": False}
    text = text.strip()
    if text.lower() in words:
        return words[text.lower()]
    if separator in text:
        return tuple(parse_value(part, separator) for part in text.split(separator) if part.strip())
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            pass
    return text


UNITS = {"us": "us", "ms": "ms", "s": "s", "min": "m", "m": "m", "h": "h", "d": "D", "w": "W"}


def parse_interval(text: str | None) -> float | np.timedelta64 | None:
    """``0.5`` as a number, ``15min`` as a duration."""
    if text is None:
        return None
    match = re.fullmatch(r"\s*(\d+)\s*([a-z]+)\s*", text)
    if match and match[2] in UNITS:
        return np.timedelta64(int(match[1]), UNITS[match[2]])  # type: ignore[call-overload,no-any-return]
    try:
        return float(text)
    except ValueError:
        raise ValueError(
            f"--dt {text}: give a number, or a whole number with one of {', '.join(UNITS)} for a time that is a date."
        ) from None
