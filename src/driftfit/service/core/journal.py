"""The journal: one SQLite database in which samples, states, results and positions of sources change together.

    log        what came in, in groups: numbered samples in columns, and operator's actions
    unit       number, name, section and topic of every unit
    program    models and trackers that states were made with, by the fingerprint of the states
    snapshot   the last stored state of a unit, and the number up to which it knows the samples
    result     the results of the trackers, in the order in which they arose; sinks and the page read from here
    block      the results of one unit in pieces, with least, largest and mean of every column, for the page
    event      alarms, failures, operator's actions
    position   where sources continue, and how far sinks have come

Journal before update: a group is committed (WAL, ``synchronous=FULL``) before any tracker processes it, and
acknowledged after that. The next transaction contains the results of the group. After a crash the results that are
missing are computed again from snapshots and log, bit for bit.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from driftfit.engine.kernel import Array
from driftfit.service.core.results import Results
from driftfit.service.sinks.contract import Event, Outcome

SCHEMA = """
create table if not exists meta (key text primary key, value text);
create table if not exists unit (id integer primary key, name text unique, section integer, topic text, born integer,
    about text);
create table if not exists log (first integer primary key, count integer, at real, items blob);
create table if not exists result (first integer primary key, count integer, at real, rows blob);
create table if not exists program (tag blob primary key, about text);
create table if not exists snapshot (unit integer primary key, number integer, state blob);
create table if not exists block (unit integer, first integer, last integer, start real, stop real, count integer,
    rows blob, extremes blob, primary key (unit, first));
create table if not exists event (id integer primary key, number integer, unit integer, at real, kind text,
    detail text);
create index if not exists event_of_unit on event (unit, id);
create table if not exists position (name text primary key, value text);
"""
PRAGMAS = ("page_size=8192", "journal_mode=wal", "synchronous=full", "wal_autocheckpoint=2000", "temp_store=memory")
FORMAT = "3"
REMEDY = "driftfit serve FILE --rebuild computes the states again from the journal"
RESULTS_FROM, NEEDED_FROM = "results from", "needed from"
"""Keys of ``meta``: of `Journal.first_without_results` and `Journal.first_needed`."""
NAME = "driftfit.db"


class Rows(NamedTuple):
    """One entry of a group: samples of the units of a section, sorted by unit and time."""

    section: int
    unit: Array
    """(N,): the number of each sample's unit."""
    time: Array | None
    """(N,), in seconds."""
    values: Array
    """(N, 1 + m): y, u_1 .. u_m, NaN where missing."""

    @property
    def length(self) -> int:
        """How many sample numbers of the journal the entry uses."""
        return len(self.unit)

    def some(self, which: Array) -> Rows:
        """Some of the samples."""
        time = None if self.time is None else self.time[which]
        return Rows(self.section, self.unit[which], time, self.values[which])

    def plain(self) -> list[Any]:
        """The columns as bytes."""
        time = None if self.time is None else self.time.tobytes()
        return [self.section, self.unit.tobytes(), time, self.values.tobytes()]

    @classmethod
    def of(cls, section: int, unit: bytes, time: bytes | None, values: bytes) -> Rows:
        """The inverse of `plain`."""
        units = np.frombuffer(unit, np.int32)
        times = None if time is None else np.frombuffer(time)
        return cls(section, units, times, np.frombuffer(values).reshape(len(units), -1))


class Act(NamedTuple):
    """One entry of a group: an action on a unit, by an operator or by the service itself."""

    unit: int
    action: dict[str, Any]
    length: int = 1

    def plain(self) -> list[Any]:
        """As numbers, texts and so on."""
        return [self.unit, self.action]


class Group(NamedTuple):
    """The results of a group."""

    first: int
    """Number of its first sample."""
    parts: list[Results]
    events: list[list[Any]]
    """With units as numbers."""
    at: float
    """When the oldest of its samples arrived, in seconds since 1970."""


Item = Rows | Act
_decode = msgspec.msgpack.Decoder(list[list[Any]]).decode
_encode = msgspec.msgpack.Encoder().encode
_RESULTS = msgspec.msgpack.Decoder(tuple[list[tuple[bytes, bytes, bytes, bytes]], list[list[Any]]])


class Journal:
    """The database, opened by the one process that writes it."""

    def __init__(self, folder: Path, read_only: bool = False, rebuild: bool = False) -> None:
        self.path = folder / NAME
        if read_only:
            uri = f"{self.path.resolve().as_uri()}?mode=ro"
            self.db = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False, timeout=10.0)
            return
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        self.db = sqlite3.connect(self.path, isolation_level=None, check_same_thread=False, timeout=10.0)
        self.path.chmod(0o600)
        for line in PRAGMAS:
            self.db.execute(f"pragma {line}")
        self.db.executescript(SCHEMA)
        self.db.execute("insert or ignore into meta values ('format', ?)", (FORMAT,))
        found = self.meta("format")
        if found == "2" and not rebuild:
            raise ValueError(
                f"{self.path} was written by an older driftfit, whose states are of no use here; {REMEDY}."
            )
        if found not in ("2", FORMAT):
            raise ValueError(f"{self.path} has the format {found}; this version reads {FORMAT}. Use another folder.")
        if rebuild:
            self._rebuild()

    def _rebuild(self) -> None:
        """Forget all states, so that they are computed again from the samples that the log still has."""
        oldest = self.db.execute("select coalesce(min(first), 1) from log").fetchone()[0]
        self.db.execute("begin immediate")
        for table in ("snapshot", "program"):
            self.db.execute(f"delete from {table}")
        values = {"format": FORMAT, NEEDED_FROM: str(oldest)}
        self.db.executemany("insert or replace into meta values (?, ?)", values.items())
        self.db.execute("commit")

    def close(self) -> None:
        self.db.close()

    def meta(self, key: str) -> str | None:
        row = self.db.execute("select value from meta where key = ?", (key,)).fetchone()
        return None if row is None else str(row[0])

    def next_number(self) -> int:
        """The number of the next sample."""
        row = self.db.execute("select first + count from log order by first desc limit 1").fetchone()
        return max(int(row[0]) if row else 1, int(self.meta("next") or 1))

    def first_without_results(self) -> int:
        """The first group whose results are not yet stored."""
        return int(self.meta(RESULTS_FROM) or 1)

    def first_needed(self) -> int:
        """The number from which the log is needed, because some state is not stored after it."""
        return int(self.meta(NEEDED_FROM) or 1)

    def positions(self) -> dict[str, Any]:
        """The positions of sources and sinks."""
        return {name: msgspec.json.decode(value) for name, value in self.db.execute("select * from position")}

    def groups(self, first: int) -> Iterator[tuple[int, list[Item]]]:
        """(number of the first sample, entries) of the groups from a number on, a few at a time."""
        first = self.db.execute("select coalesce(max(first), 0) from log where first <= ?", (first,)).fetchone()[0]
        while rows := self.db.execute(
            "select first, items from log where first >= ? order by first limit 64", (first,)
        ).fetchall():
            for start, items in rows:
                yield start, [Rows.of(*one) if len(one) == 4 else Act(*one) for one in _decode(items)]
            first = rows[-1][0] + 1

    def outcomes(self, after: int, most: int = 64) -> list[Group]:
        """The stored results of groups after one."""
        query = "select first, at, rows from result where first > ? order by first limit ?"
        found = [(*one, *_RESULTS.decode(rows)) for *one, rows in self.db.execute(query, (after, most)).fetchall()]
        return [Group(first, [Results.of(*one) for one in parts], events, at) for first, at, parts, events in found]

    def units(self, after: int = 0) -> list[tuple[int, str, int, str, int, str]]:
        """(number, name, section, topic, born, about) of the units with larger numbers."""
        return self.db.execute("select * from unit where id > ? order by id", (after,)).fetchall()

    def state(self, unit: int) -> tuple[int, bytes] | None:
        """(number up to which samples are in it, the stored state)."""
        row = self.db.execute("select number, state from snapshot where unit = ?", (unit,)).fetchone()
        return None if row is None else (int(row[0]), bytes(row[1]))

    def rows_of(self, unit: int) -> tuple[list[float], list[list[float]]]:
        """All samples of a unit that the log has, in the order of their arrival."""
        times: list[float] = []
        rows: list[list[float]] = []
        for _, items in self.groups(1):
            for item in items:
                if isinstance(item, Rows):
                    own = item.some(np.flatnonzero(item.unit == unit))
                    times += [] if own.time is None else own.time.tolist()
                    rows += own.values.tolist()
        return times, rows

    def programs(self) -> dict[bytes, str]:
        """Models and trackers that states were made with, by the fingerprint of the states."""
        return dict(self.db.execute("select tag, about from program").fetchall())


class Pending:
    """The contents of the next transaction."""

    def __init__(self) -> None:
        self.programs: list[tuple[bytes, str]] = []
        self.units: list[tuple[int, str, int, str, int, str]] = []
        self.log: tuple[int, int, float, bytes] | None = None
        self.results: list[tuple[int, int, float, bytes]] = []
        self.events: list[tuple[int, int, float, str, str]] = []
        self.blocks: list[tuple[Any, ...]] = []
        self.snapshots: list[tuple[int, int, bytes]] = []
        self.positions: dict[str, Any] = {}
        self.meta: dict[str, str] = {}
        self.forget: list[tuple[str, tuple[Any, ...]]] = []

    def __bool__(self) -> bool:
        return any(map(bool, self.__dict__.values()))

    def add_group(self, first: int, items: list[Item], at: float) -> None:
        """The group that is to be journaled."""
        count = sum(item.length for item in items)
        self.log = (first, count, at, _encode([item.plain() for item in items]))
        self.meta["next"] = str(first + count)

    def add_results(self, group: Group) -> None:
        """The results of a group."""
        first, parts, events, at = group
        if parts or events:
            count = sum(len(one.number) for one in parts)
            self.results.append((first, count, at, _encode(([one.plain() for one in parts], events))))
            self.events += [(n, unit, when, kind, _json(detail)) for n, unit, when, kind, detail in events]
        self.meta[RESULTS_FROM] = str(first + 1)

    def commit(self, db: sqlite3.Connection) -> None:
        """Write everything in one transaction; on an error nothing is written, and it can be tried again."""
        db.execute("begin immediate")
        try:
            put = db.executemany
            put("insert or ignore into program values (?, ?)", self.programs)
            put("insert into unit values (?, ?, ?, ?, ?, ?)", self.units)
            if self.log is not None:
                db.execute("insert into log values (?, ?, ?, ?)", self.log)
            put("insert or ignore into result values (?, ?, ?, ?)", self.results)
            put("insert into event (number, unit, at, kind, detail) values (?, ?, ?, ?, ?)", self.events)
            put("insert or ignore into block values (?, ?, ?, ?, ?, ?, ?, ?)", self.blocks)
            put("insert or replace into snapshot values (?, ?, ?)", self.snapshots)
            put("insert or replace into position values (?, ?)", [(k, _json(v)) for k, v in self.positions.items()])
            put("insert or replace into meta values (?, ?)", self.meta.items())
            for statement, values in self.forget:
                db.execute(statement, values)
            db.execute("commit")
        except BaseException:
            if db.in_transaction:
                db.execute("rollback")
            raise


def _json(value: Any) -> str:
    text: str = msgspec.json.encode(value).decode()
    return text


class Names:
    """Units by number, as the database knows them; new ones are read when they are needed."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self.names: dict[int, str] = {}
        self.about: dict[str, dict[str, Any]] = {}

    def read(self) -> None:
        """Add the units that are new."""
        for number, name, section, topic, _, about in self._journal.units(max(self.names, default=0)):
            self.names[number] = name
            self.about[name] = msgspec.json.decode(about) | {"topic": topic, "section": section, "number": number}

    def outcome(self, group: int, parts: list[Results], events: Iterable[list[Any]]) -> Outcome:
        """Stored results as a batch for a sink."""
        events = list(events)
        units = {unit for one in parts for unit in np.unique(one.unit).tolist()} | {row[1] for row in events}
        if not units <= self.names.keys():
            self.read()
        named = [Event(row[0], self.names[row[1]], *row[2:]) for row in events]
        return Outcome(group, parts, named, self.names, self.about)
