"""The options of every command that reads data: files and columns, which part of them to use, model and tracker."""

from __future__ import annotations

import csv
import inspect
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import numpy as np
from typer import Argument, Option

from driftfit.cli.program import progress, writable
from driftfit.data.clock import Clock
from driftfit.data.columns import Wanted
from driftfit.data.files import Files
from driftfit.engine.settings import missing_settings, near
from driftfit.models.arx import ARX
from driftfit.models.base import Model
from driftfit.parsing.settings import own_tracker, parse_model, parse_tracker
from driftfit.trackers.base import Tracker

Range = tuple[float, float]


def limits_from(entry: str, names: Sequence[str]) -> tuple[str, Range]:
    """``flow=0:80`` as a name and its range."""
    name, _, bounds = entry.rpartition("=")
    low, colon, high = bounds.partition(":")
    try:
        found = float(low or "-inf"), float(high or "inf")
    except ValueError:
        colon = ""
    if not colon or not found[0] <= found[1]:
        raise ValueError(f"--limits {entry}: give a valid range as column=low:high, such as --limits flow=0:80.")
    if name.strip() not in names:
        raise ValueError(f"--limits {entry}: no signal has the name {name.strip()!r}; {near(name.strip(), names)}")
    return name.strip(), found


def interval_from(entry: str, option: str = "--exclude") -> tuple[str, str]:
    """``2024-03-01..2024-03-04`` as a pair of ends."""
    first, dots, last = entry.partition("..")
    if not (dots and first.strip() and last.strip()):
        raise ValueError(f"{option} {entry}: give an interval as FROM..TO, such as {option} 2024-03-01..2024-03-04.")
    return first.strip(), last.strip()


def sample_of(row: str, first: int) -> int:
    """The sample, from 0, of a row that is given as text."""
    if not row.isdigit():
        raise ValueError(f"--exclude: without --time give an interval of rows, such as 100..120; got {row!r}.")
    return int(row) - first


def rows_from(text: str | None) -> tuple[int, int | None]:
    """``100:500`` as the first and the last row, None: to the end."""
    if text is None:
        return 1, None
    first, colon, last = text.partition(":")
    if not colon or not all(part.strip().isdigit() or not part.strip() for part in (first, last)):
        raise ValueError(f"--rows {text}: rows are counted from 1, as in --rows 100:500, 100: or :500.")
    a, b = int(first or 1), int(last) if last.strip() else None
    if a < 1 or (b is not None and b < a):
        raise ValueError(
            f"--rows {text}: there are no such rows; rows are counted from 1, and the first must not be after the last."
        )
    return a, b


def listed(given: Sequence[str] | None) -> list[str]:
    """Names that were given in several options, or separated by commas; one with a comma is quoted, as in a CSV file.

    In a shell that is ``--u '"flow, cold",temperature'``. Blanks, parentheses and other signs need no quotes here.
    """
    try:
        rows = [next(csv.reader([entry], skipinitialspace=True, strict=True), []) for entry in given or []]
    except csv.Error:
        raise ValueError(
            f"{', '.join(given or [])}: a name with a comma is quoted as in a CSV file, in a shell as "
            "--u '\"flow, cold\",temperature'."
        ) from None
    return [name.strip() for row in rows for name in row if name.strip()]


def parse_units(given: Sequence[str] | None) -> dict[str, str]:
    """``flow=l/min`` as a name and its unit."""
    pairs = {entry: entry.rpartition("=") for entry in given or []}
    for entry, (name, _, unit) in pairs.items():
        if not name.strip() or not unit.strip():
            raise ValueError(f"--unit {entry}: give a unit as column=unit, such as --unit flow=l/min.")
    return {name.strip(): unit.strip() for name, _, unit in pairs.values()}


def parse_interval(text: str | None, option: str = "--dt") -> float | str | None:
    """``0.5`` as a number; a duration or a step of the calendar as text, in which ``m`` after a number is minutes."""
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        given = re.sub(r"(\d\s*)m\s*$", r"\1min", text)
    try:
        Clock.of(given)
    except ValueError as error:
        raise ValueError(f"{option} {text}: {error}") from None
    return given


def parse_seconds(text: str) -> float:
    """``45``, ``45s`` or ``1m`` in seconds."""
    given = parse_interval(text, "--budget")
    if isinstance(given, float):
        return given
    length = Clock.of(given).duration
    if length is None:
        raise ValueError(f"--budget {text}: give seconds, or a duration such as 45s or 2m.")
    return float(length / np.timedelta64(1, "s"))


Names = list[str] | None
WRITTEN = {"write_to": "--out", "plot": "--plot", "system": "--system", "report": "--report"}
"""Arguments of commands that are files to be written."""


Own = Annotated[str | None, Option("--with", metavar="MODULE:CLASS", help="Your own tracker.")]
Setting = Annotated[Names, Option("-p", help="Setting of the tracker; repeat it.")]
Out = Annotated[Path | None, Option("--out", help="Write the result to .csv, .parquet or .npz (complete).")]
Table = Annotated[Path | None, Option("--out", help="Write the result to .csv or .parquet.")]
Plot = Annotated[Path | None, Option(help="Save a picture (.png, .pdf, .svg).")]
Since = Annotated[str | None, Option(help="The page of a fleet begins with what changed from this time on.")]
Report = Annotated[Path | None, Option(help="Write a page (.html) to send to someone; a fleet has one page.")]


def check_table(path: Path | None, what: str) -> None:
    """ValueError for a file whose ending is not that of a table."""
    if path is not None and path.suffix.lower() not in (".csv", ".parquet"):
        raise ValueError(f"--out {path}: {what} written to .csv or .parquet.")


@dataclass(frozen=True, kw_only=True)
class Cells:
    """The options that say how the cells of a file are read."""

    time: Annotated[str | None, Option(help="Column of the time: numbers or dates.")] = None
    dt: Annotated[
        str | None,
        Option(
            help="Nominal interval: a number; for dates 10ms, 1s, 15min, 1h, 1d, 1w, 'business day', month, quarter, "
            "year, or label if samples are one step apart whatever their dates."
        ),
    ] = None
    separator: Annotated[
        str | None,
        Option(help="Separator of cells: , ; tab or another character; by default detected from the header."),
    ] = None
    decimal: Annotated[str, Option(help="Decimal sign of the numbers: . or , (points then group thousands).")] = "."
    dates: Annotated[
        str | None, Option(help="Form of dates that do not begin with the year: '%d.%m.%Y %H:%M', as in Python.")
    ] = None
    missing: Annotated[
        Names, Option(help="What the file holds where there is no reading: Offline or -999; repeat it.")
    ] = None
    limits: Annotated[
        Names, Option(help="Valid range of a column: flow=0:80, flow=0: or flow=:80; outside is missing.")
    ] = None

    @property
    def wanted(self) -> Wanted:
        """How columns are read that are yet to be named."""
        if self.decimal not in (".", ","):
            raise ValueError(f"--decimal {self.decimal}: the decimal sign must be a point or a comma.")
        sign = "\t" if self.separator in ("tab", "\\t") else self.separator
        if sign is not None and len(sign) != 1:
            raise ValueError(f"--separator {sign}: the separator must be one character, such as ';', or tab.")
        return Wanted((), None, (), tuple(self.missing or ()), sign, self.decimal, self.dates)


@dataclass(frozen=True, kw_only=True)
class Given(Cells):
    """The options that commands share, as given on the command line."""

    file: Annotated[
        list[str],
        Argument(help="CSV files with a header line, or Parquet files, or patterns such as 'runs/*.csv'; - is stdin."),
    ]
    y: Annotated[
        list[str],
        Option(help="Column of the output; repeat it, or separate names by commas, for several (ARX, Regression)."),
    ]
    u: Annotated[Names, Option(help="Column of an input; repeat it, or separate names by commas.")] = None
    model: Annotated[
        Names,
        Option(
            help="Model and settings by position or name: arx:2,2,nk=1,intercept; one value per input with a slash: "
            "arx:2,2/1,nk=0/1; regression:intercept; or as in Python: 'ARX(2, [2, 1])'. Default: arx:2,2,intercept, "
            "without inputs arx:2,0,intercept; `track` without inputs chooses model and inputs."
        ),
    ] = None
    tracker: Annotated[
        str, Option(help="Tracker, as `driftfit trackers` lists them, or as in Python: 'Kalman(q=1e-4, r=0.1)'.")
    ] = "adaptive-kalman"
    p: Annotated[Names, Option("-p", help="Setting of the tracker: q=1e-4, q=1e-4,0,0 or p0=none; repeat it.")] = None
    by: Annotated[
        Names, Option(help="Column that identifies the series of a fleet, or `file`; repeat it for several.")
    ] = None
    unit: Annotated[Names, Option(help="Unit of a column: flow=l/min; repeat it.")] = None
    own: Annotated[
        str | None, Option("--with", metavar="MODULE:CLASS", help="Your own tracker, from a module in this folder.")
    ] = None
    first: Annotated[str | None, Option("--from", help="First time to use, with --time.")] = None
    last: Annotated[str | None, Option("--to", help="Last time to use, with --time.")] = None
    rows: Annotated[
        str | None, Option(help="Rows to use of each file, counted from 1 after the header: 100:500, 100: or :500.")
    ] = None
    exclude: Annotated[
        Names, Option(help="Interval to leave out: FROM..TO, in times, or in rows without --time; repeat it.")
    ] = None
    gate: Annotated[
        bool | None,
        Option(
            "--gate/--no-gate",
            help="Leave out readings that look like fault codes, or use all. Default: as the tracker asks.",
            show_default=False,
        ),
    ] = None
    start: Annotated[
        Path | None, Option(help="Continue from a saved run (.npz) or live state, with its model and tracker.")
    ] = None

    @property
    def outputs(self) -> list[str]:
        names = listed(self.y)
        if not names:
            raise ValueError("--y names no column.")
        if len(set(names)) < len(names):
            raise ValueError(f"--y {','.join(names)}: name each output once.")
        return names

    @property
    def inputs(self) -> list[str]:
        names = listed(self.u)
        if both := [name for name in names if name in listed(self.y)]:
            raise ValueError(
                f"--u {both[0]}: this is the output, which would explain itself; its past is in arx models."
            )
        return names

    @property
    def free(self) -> bool:
        """Whether a record is given, and neither inputs nor a model."""
        more = self.u or self.model or self.by or self.start or self.own or self.first or self.last or self.rows
        return not more and len(self.outputs) == len(self.file) == 1 and self.file != ["-"]

    def models(self) -> list[Model]:
        """The models, each bound to the inputs."""
        default = [f"arx:2,{2 if self.inputs else 0},intercept"]
        found = [parse_model(text) for text in self.model or default]
        several = len(found) > 1  # then one of them may have no inputs
        alone = [model.shared or (several and isinstance(model, ARX) and model.nb == 0) for model in found]
        return [model if one else model.bind(self.inputs) for model, one in zip(found, alone, strict=True)]

    def chosen_tracker(self) -> Tracker:
        return parse_tracker(self.tracker, self.p or [], self.own)

    @cached_property
    def files(self) -> Files:
        """The files, which part of them is used, and how they are read."""
        if (self.first or self.last) and self.time is None:
            raise ValueError("--from and --to are times, so they need --time; rows are chosen with --rows.")
        source = sys.stdin.buffer.read() if "-" in self.file else self.file
        return Files(source, rows_from(self.rows), (self.first, self.last), self.wanted)

    def signals(self) -> dict[str, Any]:
        """The arguments of `track` other than model and tracker."""
        outputs, first = self.outputs, self.files.rows[0]
        exclude: list[tuple[Any, Any]] = list(map(interval_from, self.exclude or []))
        if self.time is None:  # intervals are rows
            exclude = [(sample_of(low, first), sample_of(high, first)) for low, high in exclude]
        limits = dict(limits_from(entry, [*outputs, *self.inputs]) for entry in self.limits or [])
        return {
            "y": outputs if len(outputs) > 1 else outputs[0], "u": self.inputs, "data": self.files, "time": self.time,
            "limits": limits or None, "exclude": exclude or None, "missing": self.missing or (), "gate": self.gate,
            "by": self.by or None, "dt": parse_interval(self.dt), "units": parse_units(self.unit) or None,
        }  # fmt: skip

    def run(self, tracker: Tracker | None = None) -> Any:
        """Run the configuration that the options describe: a Track, an Outputs or a fleet."""
        from driftfit.tracking import track

        model, chosen, before = self._begun()
        if tracker is None and (missing := missing_settings(chosen)):
            typed, names = " ".join(f"-p {name}=..." for name in missing), ", ".join(missing)
            raise ValueError(
                f"--tracker {self.tracker}: {names} must be given: {typed}; `driftfit tune` estimates them from data."
            )
        signals: Any = self.signals()
        more: Any = {} if before is None else {"warm_start": before}
        if before is not None and self.gate is None:
            signals["gate"] = before.end().programs[0].gate or False
        with progress.status("tracking"):
            return track(model, tracker or chosen, **signals, **more)

    def _begun(self) -> tuple[Model, Tracker, Any]:
        """(model, tracker, run to continue or None); all three come from the saved run if there is one."""
        models = self.models()
        if len(models) > 1:
            raise ValueError("--model: give one model; `driftfit select` compares several.")
        if self.start is None:
            return models[0], self.chosen_tracker(), None
        if self.model or self.p or self.tracker != "adaptive-kalman":
            raise ValueError(f"--start {self.start}: model and tracker come from the file; leave out --model, -p ...")
        if self.by or len(self.outputs) > 1:
            raise ValueError(f"--start {self.start}: the file holds one run of one output; leave out --by.")
        before = saved(self.start, [own_tracker(self.own)] if self.own else [])
        return before.model, before.tracker, before

    def check_single(self, verb: str) -> None:
        """Raise ValueError for several series or outputs."""
        if self.by or len(self.outputs) > 1:
            raise ValueError(f"{verb}: one series of one output at a time; leave out --by and further --y.")

    def arrays(self) -> dict[str, Any]:
        """One series in the form that `tune` and `select` take."""
        if self.by or len(self.outputs) > 1 or self.start is not None:
            raise ValueError("this command takes one series of one output; leave out --by, --start and further --y.")
        signals = self.signals()
        return {name: signals[name] for name in signals if name not in ("by", "units")}


def saved(path: Path, classes: list[Any]) -> Any:
    """Load a run, or the state of a stream, from a file; ``classes`` are those of the user's own that it may need."""
    from driftfit.results import Track
    from driftfit.streams import Live

    try:
        return Track.load(path, classes)
    except ValueError as error:
        if "state" not in str(error):
            raise
    return Live.load(path, classes)


def reads(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command, whose first argument is a `Given`, all its options on the command line.

    An argument that is a dataclass of options is replaced by its fields.
    """
    groups: dict[str, Any] = {}
    options: list[inspect.Parameter] = []
    for one in inspect.signature(command, eval_str=True).parameters.values():
        if is_dataclass(one.annotation):
            groups[one.name], hints = one.annotation, get_type_hints(one.annotation, include_extras=True)
            for field in fields(one.annotation):
                default = inspect.Parameter.empty if field.default is MISSING else field.default
                option = inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=default)
                options.append(option.replace(annotation=hints[field.name]))
        else:
            options.append(one.replace(kind=inspect.Parameter.KEYWORD_ONLY))

    def run(**typed: Any) -> None:
        for name, option in WRITTEN.items():
            writable(typed.get(name), option)
        grouped = {name: kind(**{f.name: typed.pop(f.name) for f in fields(kind)}) for name, kind in groups.items()}
        command(**grouped, **typed)

    vars(run)["__signature__"] = inspect.Signature(options)
    run.__annotations__ = {one.name: one.annotation for one in options}
    run.__name__, run.__doc__ = command.__name__, command.__doc__
    return run
