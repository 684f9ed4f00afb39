"""The configuration of the service: a TOML file, read completely before anything starts.

Every problem names its line and a way out; all of them are reported at once (`ProblemsError`).
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from driftfit.data.arguments import check_ready
from driftfit.data.clock import Clock
from driftfit.engine.settings import near
from driftfit.judge.alarms.detect import asked_for, check_alarm
from driftfit.models.base import Model
from driftfit.parsing.settings import parse_model, tracker_of
from driftfit.run.live.rule import KINDS
from driftfit.run.program import Program
from driftfit.service.connect.base import Connector, Sink, Source
from driftfit.service.options import PageOptions, Pattern, ServiceOptions, build, converted, kinds
from driftfit.streams import Live
from driftfit.trackers.base import Tracker

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
Made = TypeVar("Made")


class ProblemsError(ValueError):
    """The problems of a configuration, one message for each."""

    def __init__(self, messages: list[str]) -> None:
        super().__init__("\n".join(messages))
        self.messages = messages


@dataclass(frozen=True)
class AlarmSettings:
    """When a unit raises an alarm; its limits come from its own first samples, which are then frozen."""

    every: float = 10_000.0
    """Samples in which one false alarm may begin."""
    on: tuple[str, ...] = ("glr",)
    reference: int = 500
    """Number of first samples that are normal."""

    def __post_init__(self) -> None:
        _positive("every", self.every)
        for kind in self.on:
            if kind not in KINDS:
                raise ValueError(f"on: there is no alarm {kind!r}; {near(kind, KINDS)}")
        if self.reference < 1:
            raise ValueError(f"reference must be a whole number of samples; got {self.reference!r}.")

    @property
    def each(self) -> float:
        """Samples in which one false alarm of a kind may begin, so that all kinds together begin one in ``every``."""
        return self.every * len(self.on)


@dataclass(frozen=True)
class UnitSettings:
    """A section [[unit]]: a pattern of topics, and how the samples of each topic are tracked."""

    match: Pattern
    y: str
    u: tuple[str, ...]
    model: Model = field(repr=False)
    tracker: Tracker
    time: str | None = None
    time_unit: float = 1.0
    """Seconds."""
    dt: float | str | None = None
    hold_back: float = 0.0
    """Seconds for which samples wait for late ones."""
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    alarm: AlarmSettings | None = None
    ahead: float = 300.0
    """Seconds that a time may be ahead of both the newest of its unit and the clock of this machine."""
    rate: float = 10_000.0
    """Samples a second that one unit may send, on average over ten seconds."""
    gate: bool = True
    """Whether readings are judged before they are used."""

    @property
    def columns(self) -> tuple[str, ...]:
        return (self.y, *self.u)

    def live(self) -> Live:
        return Live(self.model, self.tracker, dt=self.dt, gate=self.gate)


@dataclass(frozen=True)
class Config:
    """A service."""

    service: ServiceOptions
    page: PageOptions
    sources: tuple[Source, ...]
    units: tuple[UnitSettings, ...]
    sinks: tuple[Sink, ...]


def read(path: Path) -> Config:
    """The configuration of a file; `ProblemsError` if it is not valid, OSError if it cannot be read."""
    return parse(path.read_text(encoding="utf-8"), str(path))


def parse(text: str, name: str = "configuration") -> Config:
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ProblemsError([f"{name}: {error}. One key = value per line; texts are in quotes."]) from None
    return _Reader(data, Lines(text), name).config()


class _Reader:
    """Reads a parsed file and collects its problems."""

    def __init__(self, data: dict[str, Any], lines: Lines, name: str) -> None:
        self.data, self.lines, self.name = data, lines, name
        self.problems: list[str] = []

    def config(self) -> Config:
        known = ("service", "page", "source", "unit", "sink")
        for key in self.data:
            if key not in known:
                self.fault((key,), f"there is no section {key!r}; {near(key, known)}")
        service = self.tried(("service",), lambda: build(ServiceOptions, self.table("service")))
        page = self.tried(("page",), lambda: build(PageOptions, self.table("page")))
        sources = [self.one("source", Source, key, given) for key, given in self.sources().items()]
        units = [self.tried(("unit", k), partial(self.unit, k)) for k in range(len(self.tables("unit")))]
        sinks = [self.one("sink", Sink, k, given) for k, given in enumerate(self.tables("sink"))]
        if not self.problems and not self.data.get("source"):
            self.fault((), 'there is no source; add a table such as [source.plant] with kind = "mqtt".')
        if not self.problems and not units:
            self.fault((), "there is no unit; add [[unit]] with match, y, u, model and tracker.")
        if self.problems:
            raise ProblemsError(self.problems)
        assert service is not None
        assert page is not None
        return Config(
            service, page, tuple(filter(None, sources)), tuple(filter(None, units)), tuple(filter(None, sinks))
        )

    def fault(self, path: tuple[Any, ...], message: str) -> None:
        self.problems.append(f"{self.name}:{self.lines.of(path)}: {' '.join(message.split())}")

    def tried(self, path: tuple[Any, ...], make: Callable[[], Made]) -> Made | None:
        """The constructed object; None if there is a problem, which is reported with its line."""
        try:
            return make()
        except KeyProblemError as problem:
            self.fault((*path, *problem.path), str(problem))
        except (ValueError, TypeError, ImportError) as error:
            self.fault(path, str(error))
        return None

    def table(self, key: str) -> dict[str, Any]:
        found = self.data.get(key, {})
        if not isinstance(found, dict):
            raise ValueError(f"{key} must be a table, written as [{key}].")
        return found

    def tables(self, key: str) -> list[dict[str, Any]]:
        found = self.data.get(key, [])
        if isinstance(found, list) and all(isinstance(one, dict) for one in found):
            return found
        self.fault((key,), f"{key} must be an array of tables, each beginning with [[{key}]].")
        return []

    def sources(self) -> dict[str, dict[str, Any]]:
        found = self.data.get("source", {})
        if isinstance(found, dict) and all(isinstance(one, dict) for one in found.values()):
            return found
        self.fault(("source",), "each source has a name: begin its table with [source.NAME].")
        return {}

    def one(self, what: str, base: type[Connector], key: Any, given: dict[str, Any]) -> Any:
        """A source or a sink."""

        def made() -> Any:
            known = kinds(base)
            kind = given.get("kind")
            if kind not in known:
                raise KeyProblemError(("kind",), f"{what} kind {kind!r}; {near(str(kind), known)}")
            rest = {name: value for name, value in given.items() if name != "kind"}
            rest.setdefault("name", key if isinstance(key, str) else f"{kind}-{key + 1}")
            found = build(known[kind], rest)
            found.check()
            return found

        return self.tried((what, key), made)

    def unit(self, k: int) -> UnitSettings:
        given = self.tables("unit")[k]
        known = [one.name for one in fields(UnitSettings)] + ["name"]
        for key in given:
            if key not in known:
                raise KeyProblemError((key,), f"unit has no setting {key!r}; {near(key, known)}")
        for key in ("match", "y"):
            if not isinstance(given.get(key), str):
                raise KeyProblemError(
                    (key,), f"unit needs {key} = a text" + ("; write a [[unit]] for each output." * (key == "y"))
                )
        named = given.get("u", [])
        u = at("u", lambda: converted([named] if isinstance(named, str) else named, tuple[str, ...]))
        model = at("model", lambda: parse_model(str(given.get("model", f"ARX(2, {2 if u else 0}, intercept=True)"))))
        model = at("model", lambda: model.bind(list(u)))
        if len(model.outputs) > 1:
            raise KeyProblemError(("model",), "a unit has one output; write one [[unit]] for each.")
        tracker = at("tracker", lambda: tracker_of(str(given.get("tracker", "AdaptiveKalman()"))))
        own = {key: at(key, partial(READ[key], given[key])) for key in READ if key in given}
        settings = UnitSettings(
            at("match", lambda: Pattern(given["match"], given.get("name", ""))), given["y"], u, model, tracker,
            limits=at("limits", lambda: valid_ranges(given.get("limits", {}), (given["y"], *u))),
            alarm=at("alarm", lambda: _alarm(given.get("alarm"), own.get("dt"))), **own,
        )  # fmt: skip
        if settings.time is None and (settings.hold_back or settings.dt is not None):
            raise KeyProblemError(
                ("dt" if settings.dt is not None else "hold_back",),
                "dt and hold_back need the name of the field of times: time = ...",
            )
        program = at("tracker", lambda: Program(model, check_ready(tracker)))
        at("tracker", program.tile)  # whether they fit; nothing is compiled
        if (alarm := settings.alarm) is not None:
            for kind in alarm.on:
                at("alarm", partial(check_alarm, program, asked_for(kind, alarm.each), alarm.reference))
        return settings


class KeyProblemError(ValueError):
    """A problem of one key of a section."""

    def __init__(self, path: tuple[Any, ...], message: str) -> None:
        super().__init__(message)
        self.path = path


def at(key: str, make: Callable[[], Made]) -> Made:
    """The constructed object; a problem is reported for this key."""
    try:
        return make()
    except (ValueError, TypeError) as error:
        raise KeyProblemError((key,), f"{key}: {error}") from None


def _seconds(name: str, given: Any, low: float = 0.0) -> float:
    if isinstance(given, str):
        clock = Clock.of(given)
        if clock.duration is None:
            raise ValueError(f"{given!r} has no fixed length; give seconds, or a duration such as '1s' or '15min'.")
        return float(clock.duration.astype("timedelta64[ns]").astype(float)) * 1e-9
    if isinstance(given, bool) or not isinstance(given, int | float) or not given >= low:
        raise ValueError(
            f"{name} must be a number of seconds of at least {low:g}, or a duration such as '2s'; got {given!r}."
        )
    return float(given)


def _positive(name: str, given: Any) -> float:
    if isinstance(given, bool) or not isinstance(given, int | float) or not given > 0.0:
        raise ValueError(f"{name} must be a positive number; got {given!r}.")
    return float(given)


def _time_unit(given: Any) -> float:
    if given not in TIME_UNITS:
        raise ValueError(f"times are numbers in one of {', '.join(TIME_UNITS)}, or dates as text; got {given!r}.")
    return TIME_UNITS[given]


READ: dict[str, Callable[[Any], Any]] = {
    "time": lambda given: converted(given, str),
    "time_unit": _time_unit,
    "dt": partial(_seconds, "dt", low=1e-12),
    "hold_back": partial(_seconds, "hold_back"),
    "ahead": partial(_seconds, "ahead"),
    "rate": partial(_positive, "rate"),
    "gate": lambda given: converted(given, bool),
}
"""How a setting of [[unit]] is read that no other setting matters for."""


def valid_ranges(given: Any, names: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    if not isinstance(given, dict):
        raise ValueError("give a range for each signal, such as { flow = [0, 80] }.")
    return {name: valid_range(name, bounds, names) for name, bounds in given.items()}


def valid_range(name: str, bounds: Any, names: tuple[str, ...]) -> tuple[float, float]:
    """A valid range of a signal; an end that is "-inf", "inf", or None is open."""
    if name not in names:
        raise ValueError(f"there is no signal {name!r}; {near(name, names)}")
    if not isinstance(bounds, list | tuple) or len(bounds) != 2:
        raise ValueError(f"the range of {name} must be [low, high]; got {bounds!r}.")
    low, high = (float(e if end is None else end) for end, e in zip(bounds, ("-inf", "inf"), strict=True))
    if not low < high:
        raise ValueError(f"the lower limit of {name} must be below the upper one; got {bounds!r}.")
    return low, high


def _alarm(given: Any, dt: float | None) -> AlarmSettings | None:
    if given is None:
        return None
    every = given.get("every")
    if isinstance(every, str):
        if dt is None:
            raise ValueError(f"every = {every!r} needs dt, the interval between samples; or give a number of samples.")
        given = given | {"every": _seconds("every", every.replace(" ", "")) / dt}
    return build(AlarmSettings, given)


HEADER = re.compile(r"\s*(\[\[?)\s*([^\]]+?)\s*\]")
KEY = re.compile(r"\s*((?:[\w-]+|\"[^\"]*\"|'[^']*')(?:\s*\.\s*(?:[\w-]+|\"[^\"]*\"|'[^']*'))*)\s*=")


class Lines:
    """In which line of a TOML file a key is written, which `tomllib` does not report.

    The path of a key has numbers for the entries of an array of tables: ("unit", 0, "model").
    """

    def __init__(self, text: str) -> None:
        self._lines: dict[tuple[Any, ...], int] = {(): 1}
        counts: dict[tuple[Any, ...], int] = {}
        table: tuple[Any, ...] = ()
        for number, line in enumerate(text.splitlines(), 1):
            if header := HEADER.match(line):
                table = _parts(header[2])
                if header[1] == "[[":
                    counts[table] = counts.get(table, -1) + 1
                    table = (*table, counts[table])
                self._lines[table] = number
            elif key := KEY.match(line):
                self._lines.setdefault((*table, *_parts(key[1])), number)

    def of(self, path: tuple[Any, ...]) -> int:
        """The line of a key, or of the nearest table that contains it."""
        while path not in self._lines:
            path = path[:-1]
        return self._lines[path]


def _parts(text: str) -> tuple[str, ...]:
    return tuple(part.strip().strip("\"'") for part in text.split("."))
