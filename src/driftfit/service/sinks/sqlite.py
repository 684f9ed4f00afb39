"""SQLite: results and events as plain tables, for SQL, pandas or a spreadsheet. Repeats are left out."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import msgspec

from driftfit.engine.kernel import Array
from driftfit.service.core.results import OK, THETA, Results
from driftfit.service.sinks.contract import Outcome, Sink, Writer

SCHEMA = """
create table if not exists result (number integer, unit text, time real, y real, y_hat real, e real, s real,
    ok integer, alarm integer, theta text, std text, primary key (number, unit)) without rowid;
create table if not exists event (number integer, unit text, at real, kind text, detail text,
    primary key (number, unit, kind, detail)) without rowid;
"""

RESULT = "insert or ignore into result values (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"


@dataclass(frozen=True)
class Sqlite(Sink):
    """A database file."""

    path: str

    def open(self) -> Writer:
        return _Sqlite(self.path)


class _Sqlite(Writer):
    def __init__(self, path: str) -> None:
        self.db = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
        self.db.execute("pragma journal_mode=wal")
        self.db.executescript(SCHEMA)

    def write(self, batch: Outcome) -> None:
        """All of the batch, or nothing."""
        self.db.execute("begin immediate")
        try:
            for part in batch.parts:
                self.db.executemany(RESULT, rows_of(batch, part))
            events = [(e.number, e.unit, e.at, e.kind, json.dumps(dict(e.detail))) for e in batch.events]
            self.db.executemany("insert or ignore into event values (?, ?, ?, ?, ?)", events)
            self.db.execute("commit")
        except BaseException:
            self.db.execute("rollback")
            raise

    def close(self) -> None:
        self.db.close()


def rows_of(batch: Outcome, part: Results) -> Iterable[tuple[Any, ...]]:
    """Rows of the table ``result``; SQLite stores NaN as NULL."""
    units, n = part.unit.tolist(), part.n
    heads = (column.tolist() for column in part.values[:, :THETA].T)
    ok, alarm = (part.flags & OK).tolist(), (part.flags >> 1).tolist()
    named = {unit: batch.about[batch.names[unit]]["names"] for unit in set(units)}
    texts = (_texts(map(named.get, units), values) for values in (part.theta, part.std[:, :n]))
    return zip(part.number.tolist(), map(batch.names.get, units), *heads, ok, alarm, *texts, strict=True)


def _texts(names: Iterable[Any], values: Array) -> list[str]:
    """Rows of numbers as objects in JSON, for all rows at once: one after the other they would take twice the time."""
    objects = list(map(dict, map(zip, names, values.tolist())))
    lines: str = msgspec.json.Encoder().encode_lines(objects).decode()
    return lines.split("\n")[:-1]
