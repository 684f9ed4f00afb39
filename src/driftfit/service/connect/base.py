"""What sources and sinks are: options, which are the fields of a frozen dataclass, and one method that opens them.

    class MineSource(Source):                   # src/driftfit/service/connect/mine.py, kind = "mine"
        url: str                                # an option
        def open(self, position): ...           # connect; position is where the last run had come to, or None:
                                                # a Reader, whose read(wait) gives a Batch, or None if nothing came
    class MineSink(Sink):                       # kind = "mine"
        def open(self): ...                     # a Writer, whose write(batch) returns once the batch is safe

`Reader.read` is called repeatedly in a thread of its own and blocks for at most ``wait`` seconds. The acknowledgement
of a batch is called, from the thread of the journal, after its samples are on disk. A sink reads the stored results
from where it stopped, so one that is away or slow never delays the tracking and loses nothing. After a crash the last
batches come again: every result has a ``number``, by which an idempotent sink skips those that it has. An exception
means that the source or the sink is away: it is closed, and opened again after a pause of 1 s, 2 s, ... 60 s. A sink
with ``one_by_one`` takes events in batches of one, and raises `RefusedError` for one that its receiver does not want:
after some tries that event is set aside, so that it does not hold up those behind it.

Samples by topic, decoded from JSON.

A payload is an object of numbers (one sample), an object of lists of equal length (many samples; numbers beside them
are repeated), or a list of objects:

    {"ts": 12.0, "flow": 3.1}      {"ts": [12.0, 13.0], "flow": [3.1, 3.2]}      [{"ts": 12.0, "flow": 3.1}, ...]

Anything else raises ValueError, which the caller counts. Decoding an object takes less than a microsecond.
"""

from __future__ import annotations

import asyncio
import json
import math
import queue
import threading
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import msgspec
import numpy as np

from driftfit.engine.kernel import Array
from driftfit.service.core.results import Result, Results

MESSAGE_SAMPLES = 10_000
"""Samples of one message."""
MESSAGE_FIELDS = 256
"""Fields of one message."""
MESSAGE_BYTES = 4 << 20
"""Bytes of one message."""

Cell = float | int | bool | str | None
_DECODE = msgspec.json.Decoder(dict[str, Cell | list[Cell]] | list[dict[str, Cell]])

NAMED_SAMPLES = 20
"""Samples of a message that an answer names."""

TOO_MANY_NEW = "too many new units"
NO_SIGNAL = "no signal"
"""Why a unit that reads a topic took no sample of it."""


class Samples(NamedTuple):
    """Samples of one topic."""

    topic: str
    length: int
    columns: Mapping[str, Any]
    """A list of ``length`` values, or one value for all of them, by name of the field."""


@dataclass
class Receipt:
    """What becomes of a batch, for a sender that waits for an answer."""

    offered: int = 0
    """Samples times the units that read their topic."""
    left_out: Counter[str] = field(default_factory=Counter)
    """How many of these the units did not take, by reason."""
    missing: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)
    """By topic and signal: how many samples have no finite number for it, and the first of them."""

    def note_missing(self, samples: Samples, names: Iterable[str]) -> None:
        """Note the samples of a message without a finite number for one of the signals ``names``."""
        for name in names:
            cells = samples.columns.get(name)
            if isinstance(cells, list):
                places = np.flatnonzero(~np.isfinite(numbers_of(cells))).tolist()
            else:
                places = [] if math.isfinite(number(cells)) else list(range(samples.length))
            if places:
                signals = self.missing.setdefault(samples.topic, {})
                signals[name] = {"count": len(places), "first": places[:NAMED_SAMPLES]}


class ShapeError(ValueError):
    """A message in JSON that holds no samples: lists of different lengths, too many of them, or none."""


def decode(topic: str, payload: bytes | str) -> Samples:
    """The samples of one message; ValueError if it is not one of the three forms."""
    if len(payload) > MESSAGE_BYTES:
        raise ValueError(f"a message of {len(payload)} bytes; at most {MESSAGE_BYTES} are read.")
    try:
        data = _DECODE.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        data = _with_nan(payload)
    rows = bounded(len(data)) if isinstance(data, list) else 0
    columns = of_rows(topic, data).columns if rows else data
    if len(columns) > MESSAGE_FIELDS:
        raise ShapeError(f"{len(columns)} fields; at most {MESSAGE_FIELDS} are read.")
    sizes = {name: len(value) for name, value in columns.items() if isinstance(value, list)}
    lengths = set(sizes.values())
    if len(lengths) > 1:
        found = ", ".join(f"{name[:50]} {size}" for name, size in list(sizes.items())[:8])
        raise ShapeError(f"lists of different lengths ({found}); give one number per sample in each, null if missing.")
    return Samples(topic, rows or bounded(lengths.pop() if lengths else 1), columns)


def _with_nan(payload: bytes | str) -> Any:
    """JSON with NaN or Infinity, which Python's own encoder writes."""
    raw = payload if isinstance(payload, str) else payload.decode("utf-8", "replace")
    if "NaN" not in raw and "Infinity" not in raw:
        raise ValueError("not an object of numbers, an object of lists, or a list of objects in JSON.")
    try:
        return msgspec.convert(json.loads(raw), dict[str, Cell | list[Cell]] | list[dict[str, Cell]])
    except (ValueError, msgspec.ValidationError, RecursionError):
        raise ValueError("not JSON.") from None


def of_rows(topic: str, rows: list[dict[str, Any]]) -> Samples:
    """A sample for each row, missing where it has no cell."""
    names = dict.fromkeys(name for row in rows for name in row)
    return Samples(topic, len(rows), {name: [row.get(name) for row in rows] for name in names})


def by_topic(rows: Iterable[tuple[str, dict[str, Any]]]) -> list[Samples]:
    """The samples of each topic, from rows with their topics."""
    found: dict[str, list[dict[str, Any]]] = {}
    for topic, row in rows:
        found.setdefault(topic, []).append(row)
    return [of_rows(topic, own) for topic, own in found.items()]


def bounded(count: int) -> int:
    """A number of samples that one message may have; ValueError for another."""
    if not 0 < count <= MESSAGE_SAMPLES:
        raise ShapeError(f"{count} samples in one message; 1 to {MESSAGE_SAMPLES} are read.")
    return count


def number(cell: Any) -> float:
    """A cell as a number; NaN if it is none."""
    try:
        return float(cell)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def seconds(cell: Any, scale: float) -> float:
    """A time as seconds: a number in units of ``scale`` seconds, or a date in ISO 8601, in UTC unless it has a zone."""
    try:
        date = datetime.fromisoformat(cell)
    except (TypeError, ValueError):  # no text, or no date
        return number(cell) * scale
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()


def numbers_of(cells: list[Any]) -> Array:
    try:
        found = np.array(cells, float)
        return found if found.ndim == 1 else np.array([number(cell) for cell in cells])
    except (TypeError, ValueError, OverflowError):
        return np.array([number(cell) for cell in cells])


def seconds_of(cells: list[Any], scale: float) -> Array:
    if str in set(map(type, cells)):
        return np.array([seconds(cell, scale) for cell in cells])
    return numbers_of(cells) * scale


ANSWER_SECONDS = 20.0
"""In this time a broker, a server or the journal must have answered."""


@dataclass(frozen=True)
class Connector(ABC):
    """A source or a sink; the name is that of its table, or its kind and number."""

    needs: ClassVar[tuple[str, str, str] | None] = None
    """The module of its client library, the package, and the extra that installs it."""
    name: str

    @classmethod
    def kind(cls) -> str:
        """What the configuration calls it."""
        return cls.__name__.removesuffix("Source").removesuffix("Sink").lower()

    @classmethod
    def library(cls) -> Any:
        """Its client library; ImportError says how to install it."""
        assert cls.needs is not None
        module, package, extra = cls.needs
        try:
            return import_module(module)
        except ImportError:
            raise ImportError(f"{cls.kind()} needs {package}: pip install 'driftfit[{extra}]'.") from None

    def check(self) -> None:
        """Raise ValueError or ImportError if the options cannot work."""
        if self.needs is not None:
            self.library()


class EventLoop:
    """An event loop of asyncio in a thread of its own."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()

    def call(self, work: Any, seconds: float = ANSWER_SECONDS) -> Any:
        """The result of a coroutine."""
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(seconds)

    def end(self) -> None:
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join(5.0)
        self.loop.close()


@dataclass(frozen=True)
class Source(Connector):
    """A source of samples."""

    @abstractmethod
    def open(self, position: Any) -> Reader:
        """Connect, and continue at a position."""


@dataclass(frozen=True)
class FileSource(Source):
    """A source that reads a file."""

    path: str
    topic: str = ""
    """Topic of the samples; empty: the name of the file."""
    by: str = ""
    """Column that names the unit; it is added to the topic after a slash."""

    def topic_of(self, unit: Any) -> str:
        """The topic of the samples of a unit; without ``by`` that of all."""
        topic = self.topic or Path(self.path).name
        return f"{topic}/{unit}" if self.by else topic


class Reader(ABC):
    """An open source."""

    noticed = ""
    """What it noticed, which becomes an event."""

    @abstractmethod
    def read(self, wait: float) -> Batch | None:
        """The samples that have arrived, or None after ``wait`` seconds."""

    def close(self) -> None:
        """Disconnect."""
        return None


BATCH_MESSAGES = 2_000
"""Messages that a source reads at once, at most."""


class Batch(NamedTuple):
    """The samples that a source read at once."""

    samples: list[Samples]
    acknowledge: Callable[[], None] = lambda: None
    """To be called once the samples are in the journal."""
    position: Any = None
    """Where the source continues after these samples, as plain data; None if the sender keeps that."""
    client: str = ""
    """Who sent it, if the source has several clients."""
    noticed: str = ""
    """What the source noticed, which becomes an event."""
    refused: int = 0
    """Messages that could not be decoded."""
    arrived: float = 0.0
    """When the first of them arrived, in seconds of the monotonic clock."""
    receipt: Receipt | None = None
    """To be filled before the acknowledgement, if the sender waits for it."""


END = Batch([], position="end")
"""The result of `read` when the source has ended."""


class QueueReader(Reader):
    """A reader to whose bounded queue its client adds messages, from a thread of its own."""

    def __init__(self, most: int = BATCH_MESSAGES) -> None:
        self.arrived: queue.Queue[Any] = queue.Queue(most)
        self.error: Exception | None = None
        """Why nothing more will come."""

    @abstractmethod
    def batch(self, found: list[Any]) -> Batch:
        """The samples of some messages."""

    def read(self, wait: float) -> Batch | None:
        """What waits in the queue; the error once that is read."""
        try:
            first = self.arrived.get(timeout=wait)
        except queue.Empty:
            if self.error is not None:
                raise self.error from None
            return None
        return self.batch([first, *self.drain()])

    def drain(self) -> list[Any]:
        """What waits now."""
        found: list[Any] = []
        while len(found) < BATCH_MESSAGES and not self.arrived.empty():
            found.append(self.arrived.get())
        return found


class Event(NamedTuple):
    """Something that happened to a unit."""

    number: int
    """Number of the sample or action that caused it."""
    unit: str
    """Its name; empty for what is wrong with the journal."""
    at: float
    """Wall clock, seconds since 1970."""
    kind: str
    """new, alarm, over, failed, calibrated, action, damaged"""
    detail: Mapping[str, Any]

    @property
    def key(self) -> str:
        """The same when the event comes again, and that of no other: several alarms may begin at one sample."""
        return f"{self.number}-{self.kind}" + f"-{self.detail.get('kind')}" * (self.kind == "alarm")


class RefusedError(ConnectionError):
    """The receiver answered, and did not take the event."""


@dataclass(frozen=True)
class Outcome:
    """A batch for a sink."""

    group: int
    """Number of the first group in it; a batch that comes again begins with the same group."""
    parts: Sequence[Results]
    """The results in columns, for sinks that take columns."""
    events: list[Event]
    names: Mapping[int, str]
    """Names of the units by their numbers in ``parts``."""
    about: Mapping[str, Mapping[str, Any]]
    """By unit: names of parameters, y and u, topic and the parts that its pattern matched."""

    def __len__(self) -> int:
        return sum(len(one.number) for one in self.parts)

    @cached_property
    def results(self) -> list[Result]:
        return self._listed(self.parts)

    @cached_property
    def last(self) -> list[Result]:
        """The last result of each unit."""
        found = {one.unit: one for part in self.parts for one in self._listed([part.last()])}
        return list(found.values())

    def _listed(self, parts: Sequence[Results]) -> list[Result]:
        return [row._replace(unit=self.names[row.unit]) for one in parts for row in one.rows()]


@dataclass(frozen=True)
class Sink(Connector):
    """A sink of results and events."""

    most: ClassVar[int] = 5_000
    """Results of one batch at which it is not collected further."""
    one_by_one: ClassVar[bool] = False
    """Whether it takes events alone, one in a batch."""

    @property
    def gather(self) -> float:
        """Seconds for which results are collected into one batch."""
        return 0.0

    @abstractmethod
    def open(self) -> Writer:
        """Connect."""


class Writer(ABC):
    """An open sink."""

    @abstractmethod
    def write(self, batch: Outcome) -> None:
        """Write a batch; return once it is safe."""

    def close(self) -> None:
        """Disconnect."""
        return None
