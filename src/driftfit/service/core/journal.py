"""The journal: one SQLite database in which samples, states, results and positions of sources change together.

    log        what came in, in groups: numbered samples in columns, and operator's actions
    undelivered  events that the receiver of a sink has refused again and again
    evicted    units that are known by their rows only, because they had few samples
    trouble    what does not work in a unit, and why
    unit       number, name, section and topic of every unit
    program    models and trackers that states were made with, by the fingerprint of the states
    snapshot   the last stored state of a unit, and the number up to which it knows the samples
    result     the results of the trackers, in the order in which they arose; sinks and the page read from here
    block      pieces of the results of one unit: least, largest and mean of every column, for the page
    history    the results in a block
    event      alarms, failures, operator's actions
    position   where sources continue, and how far sinks have come
    chain      with ``audit``: for each group of the log a digest of the group and of the digest before it

Journal before update: a group is committed (WAL, ``synchronous=FULL``) before any tracker processes it, and
acknowledged after that. The next transaction contains the results of the group. After a crash the results that are
missing are computed again from snapshots and log, bit for bit.

Every row ends with a check sum of the others (`sum_of`), which is compared when the row is read. A damaged group, state
or block is left out and reported (`DAMAGED`); of the other tables, on which all depends, a damaged row is an error.
"""

from __future__ import annotations

import hashlib
import logging
import sqlite3
import zlib
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np

from driftfit.engine.kernel import Array
from driftfit.service.connect.base import Event, Outcome
from driftfit.service.core.results import Results

SCHEMA = """
create table if not exists meta (key text primary key, value text, sum integer);
create table if not exists unit (id integer primary key, name text unique, section integer, topic text, born integer,
    about text, sum integer);
create table if not exists log (first integer primary key, count integer, at real, items blob, sum integer);
create table if not exists result (first integer primary key, count integer, at real, rows blob, sum integer);
create table if not exists program (tag blob primary key, about text, sum integer);
create table if not exists snapshot (unit integer primary key, number integer, state blob, sum integer);
create table if not exists block (unit integer, first integer, last integer, start real, stop real, count integer,
    extremes blob, sum integer, primary key (unit, first));
create table if not exists history (unit integer, first integer, last integer, count integer, rows blob, sum integer,
    primary key (unit, first));
create table if not exists event (number integer, unit integer, at real, kind text, detail text, sum integer);
create index if not exists event_of_unit on event (unit);
create table if not exists position (name text primary key, value text, sum integer);
create table if not exists chain (number integer primary key, before blob, digest blob, sum integer);
create table if not exists undelivered (sink text, number integer, unit text, at real, kind text, detail text,
    tries integer, why text);
create table if not exists trouble (unit integer primary key, what text);
create table if not exists evicted (unit integer primary key);
"""
log = logging.getLogger("driftfit.service")
PRAGMAS = ("page_size=8192", "journal_mode=wal", "synchronous=full", "wal_autocheckpoint=2000", "temp_store=memory")
FORMAT = "3"
REMEDY = "driftfit serve FILE --rebuild computes the states again from the journal"
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
        time = None if self.time is None else self.time[which]
        return Rows(self.section, self.unit[which], time, self.values[which])

    def plain(self) -> list[Any]:
        time = None if self.time is None else self.time.tobytes()
        return [self.section, self.unit.tobytes(), time, self.values.tobytes()]

    @classmethod
    def of(cls, section: int, unit: bytes, time: bytes | None, values: bytes) -> Rows:
        units = np.frombuffer(unit, np.int32)
        times = None if time is None else np.frombuffer(time)
        return cls(section, units, times, np.frombuffer(values).reshape(len(units), -1))


class Act(NamedTuple):
    """One entry of a group: an action on a unit, by an operator or by the service itself."""

    unit: int
    action: dict[str, Any]
    length: int = 1

    def plain(self) -> list[Any]:
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
DAMAGED: deque[tuple[str, Sequence[Any]]] = deque(maxlen=1000)
"""(table, first columns) of the damaged rows that this process has read and not yet reported as events."""
_RESULTS = msgspec.msgpack.Decoder(tuple[list[tuple[bytes, bytes, bytes, bytes]], list[list[Any]]])


def sum_of(*values: Any) -> int:
    """CRC-32 of the values of a row."""
    return zlib.crc32(_encode(values))


def sound(table: str, row: Sequence[Any]) -> bool:
    """Whether the sum at the end of a row is that of the others; if not, this is reported."""
    fits = sum_of(*row[:-1]) == int(row[-1])
    if not fits:
        log.error("damaged", extra={"detail": {"table": table, "row": row[:2]}})
        DAMAGED.append((table, row[:2]))
    return fits


def linked(before: bytes, group: Sequence[Any]) -> bytes:
    """The digest of a group of the log (first, count, at, items) in the chain."""
    return hashlib.sha256(before + _encode(group)).digest()


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
        old = self.db.execute("select 1 from sqlite_master where name = 'meta'").fetchone()
        row = self.db.execute("select value from meta where key = 'format'").fetchone() if old else None
        if row not in (None, (FORMAT,)):
            raise ValueError(
                f"{self.path} has the format {row[0]}, and this version reads {FORMAT}: use another folder, or the "
                "version of driftfit that wrote it."
            )
        self.db.executescript(SCHEMA)
        if row is None:
            self._put("meta", ("format", FORMAT))
        if rebuild:
            self._forget_states()

    def _put(self, table: str, row: Sequence[Any]) -> None:
        self.db.execute(f"insert or replace into {table} values ({'?, ' * len(row)}?)", (*row, sum_of(*row)))

    def _forget_states(self) -> None:
        """Forget all states, so that they are computed again from the samples that the log still has."""
        oldest = self.db.execute("select coalesce(min(first), 1) from log").fetchone()[0]
        self.db.execute("begin immediate")
        for table in ("snapshot", "program"):
            self.db.execute(f"delete from {table}")
        self._put("meta", ("needed from", str(oldest)))
        self.db.execute("commit")

    def close(self) -> None:
        self.db.close()

    def rows(self, table: str, where: str = "", *values: Any) -> Iterator[tuple[Any, ...]]:
        """Rows of a table; those that are damaged are left out and reported."""
        return (row for row in self.db.execute(f"select * from {table} {where}", values) if sound(table, row))

    def certain(self, table: str, where: str = "", *values: Any) -> list[Any]:
        """Rows of a table on which all depends, without their sums; ValueError if one is damaged."""
        found = self.db.execute(f"select * from {table} {where}", values).fetchall()
        if not all([sound(table, row) for row in found]):
            raise ValueError(
                f"{self.path}: the table {table} is damaged; `driftfit journal verify` names its rows. Put a copy of "
                "the folder in its place, or use another folder."
            )
        return [row[:-1] for row in found]

    def meta(self, key: str) -> str | None:
        rows = self.certain("meta", "where key = ?", key)
        return str(rows[0][1]) if rows else None

    def head(self) -> bytes:
        """The last digest of the chain; empty without one."""
        return bytes.fromhex(self.meta("head") or "")

    def number(self, key: Literal["next", "results from", "needed from"]) -> int:
        """The number of the next sample, of the first group whose results are not yet stored, or that from which the
        log is needed because some state is not stored after it.
        """
        return int(self.meta(key) or 1)

    def positions(self) -> dict[str, Any]:
        return {name: msgspec.json.decode(value) for name, value in self.certain("position")}

    def groups(self, first: int) -> Iterator[tuple[int, list[Item]]]:
        """(number of the first sample, entries) of the groups from a number on, one at a time."""
        first = self.db.execute("select coalesce(max(first), 0) from log where first <= ?", (first,)).fetchone()[0]
        for row in self.rows("log", "where first >= ? order by first", first):
            yield row[0], [Rows.of(*one) if len(one) == 4 else Act(*one) for one in _decode(row[3])]

    def outcomes(self, after: int, most: int = 64) -> list[Group]:
        """The stored results of groups after one."""
        found, query = [], "select * from result where first > ? order by first limit ?"
        for row in self.db.execute(query, (after, most)):
            parts, events = _RESULTS.decode(row[3]) if sound("result", row) else ([], [])
            found.append(Group(row[0], [Results.of(*one) for one in parts], events, row[2]))
        return found

    def units(self, after: int = 0) -> list[tuple[int, str, int, str, int, str]]:
        """(number, name, section, topic, born, about) of the units with larger numbers."""
        return self.certain("unit", "where id > ? order by id", after)

    def state(self, unit: int) -> tuple[int, bytes] | None:
        """(number up to which samples are in it, the stored state)."""
        row = self.db.execute("select * from snapshot where unit = ?", (unit,)).fetchone()
        return None if row is None else (int(row[1]), bytes(row[2]) if sound("snapshot", row) else b"")

    def evicted(self) -> set[int]:
        """Numbers of the units that are known by their rows only."""
        return {unit for (unit,) in self.db.execute("select unit from evicted")}

    def programs(self) -> dict[bytes, str]:
        """Models and trackers that states were made with, by the fingerprint of the states."""
        return dict(self.certain("program"))


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
        self.chain: list[tuple[int, bytes, bytes]] = []
        self.forget: list[tuple[str, Any]] = []

    def __bool__(self) -> bool:
        return any(map(bool, self.__dict__.values()))

    def add_group(self, first: int, items: list[Item], at: float) -> None:
        """The group that is to be journaled."""
        count = sum(item.length for item in items)
        self.log = (first, count, at, _encode([item.plain() for item in items]))
        self.meta["next"] = str(first + count)

    def add_link(self, before: bytes) -> bytes:
        """Add the group to the chain, whose last digest is given; the digest of the group."""
        assert self.log is not None
        digest = linked(before, self.log)
        self.chain.append((self.log[0], before, digest))
        self.meta["head"] = digest.hex()
        return digest

    def add_results(self, group: Group) -> None:
        """The results of a group."""
        first, parts, events, at = group
        if parts or events:
            count = sum(len(one.number) for one in parts)
            self.results.append((first, count, at, _encode(([one.plain() for one in parts], events))))
            self.events += [(n, unit, when, kind, _json(detail)) for n, unit, when, kind, detail in events]
        self.meta["results from"] = str(first + 1)

    def add_event(self, number: int, unit: int, at: float, kind: str, detail: dict[str, Any]) -> None:
        """An event that no sample caused, of a unit or, with 0, of none."""
        self.events.append((number, unit, at, kind, _json(detail)))
        if kind == "undelivered":
            row = detail | {"detail": _json(detail["detail"])}
            values = ":sink, :number, :unit, :at, :kind, :detail, :tries, :why"
            self.forget.append((f"insert into undelivered values ({values})", row))

    def commit(self, db: sqlite3.Connection) -> None:
        """Write everything in one transaction; on an error nothing is written, and it can be tried again."""
        tables: dict[str, Sequence[tuple[Any, ...]]] = {
            "or ignore into program": self.programs, "into unit": self.units,
            "into log": [self.log] if self.log else [], "into chain": self.chain,
            "or ignore into result": self.results, "into event": self.events,
            "or ignore into block": [(*one[:6], one[7]) for one in self.blocks],
            "or ignore into history": [(*one[:3], *one[5:7]) for one in self.blocks],
            "or replace into snapshot": self.snapshots, "or replace into meta": list(self.meta.items()),
            "or replace into position": [(name, _json(value)) for name, value in self.positions.items()],
        }  # fmt: skip
        db.execute("begin immediate")
        try:
            for into, rows in tables.items():
                for row in rows:
                    db.execute(f"insert {into} values ({'?, ' * len(row)}?)", (*row, sum_of(*row)))
            for statement, values in self.forget:
                db.execute(statement, values)
            db.execute("commit")
        except BaseException:
            if db.in_transaction:
                db.execute("rollback")
            raise


def check_storable(action: dict[str, Any]) -> None:
    """Raise ValueError for an action that the journal cannot store: a number beyond 64 bits, half a character."""
    try:
        _encode(action)
    except (OverflowError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"the action cannot be stored: {error}.") from None


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
        for number, name, section, topic, _, about in self._journal.units(max(self.names, default=0)):
            self.names[number] = name
            self.about[name] = msgspec.json.decode(about) | {"topic": topic, "section": section, "number": number}

    def outcome(self, group: int, parts: list[Results], events: Iterable[list[Any]]) -> Outcome:
        """Stored results as a batch for a sink."""
        events = list(events)
        units = {unit for one in parts for unit in np.unique(one.unit).tolist()} | {row[1] for row in events if row[1]}
        if not units <= self.names.keys():
            self.read()
        named = [Event(row[0], self.names.get(row[1], ""), *row[2:]) for row in events]
        return Outcome(group, parts, named, self.names, self.about)


TABLES = ("meta", "unit", "log", "result", "program", "snapshot", "block", "history", "event", "position", "chain")


def verify(folder: Path, digest: str = "") -> tuple[str, list[str]]:
    """(what there is, in words; the faults). ``digest`` is one of the chain that was printed earlier."""
    try:
        with closing(Journal(folder, read_only=True)) as journal:
            groups = journal.db.execute("select count(*) from log").fetchone()[0]
            chain = [bytes(one) for (one,) in journal.db.execute("select digest from chain order by number")]
            faults = [*_sums(journal), *_links(journal)]
    except sqlite3.Error as error:
        raise ValueError(f"{folder / NAME} cannot be read: {error}.") from None
    if digest and bytes.fromhex(digest) not in chain:
        faults.append(f"the chain does not have the digest {digest}")
    return f"{groups} groups" + (f"; the chain ends with {chain[-1].hex()}" if chain else ", no chain"), faults


def _sums(journal: Journal) -> Iterator[str]:
    found = [one for (one,) in journal.db.execute("pragma integrity_check")]
    yield from (f"SQLite: {one}" for one in found if one != "ok")
    for table in TABLES:
        for row in journal.db.execute(f"select * from {table}"):
            if sum_of(*row[:-1]) != row[-1]:
                yield f"{table}: the check sum of the row {row[:2]} does not fit"


def _links(journal: Journal) -> Iterator[str]:
    last = None
    for number, before, digest, _ in journal.db.execute("select * from chain order by number"):
        group = journal.db.execute("select first, count, at, items from log where first = ?", (number,)).fetchone()
        if last not in (None, before):
            yield f"chain: links before the group {number} are missing"
        if group is None or linked(before, group) != digest:
            yield f"log: the group {number} is {'missing' if group is None else 'another one'}"
        last = digest
    if last not in (None, journal.head()):
        yield "chain: its last links are missing"
    since = "(select min(number) from chain)"
    for (first,) in journal.db.execute(
        f"select first from log where first > {since} and first not in (select number from chain)"
    ):
        yield f"log: the group {first} is not in the chain"
