"""SQLite: results and events as plain tables, for SQL, pandas or a spreadsheet. Repeats are left out."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import msgspec

from driftfit.service.core.results import OK, THETA, Results
from driftfit.service.sinks.contract import Outcome, Sink, Writer

SCHEMA = """
create table if not exists result (number integer, unit text, time real, y real, y_hat real, e real, s real,
    ok integer, alarm integer, theta text, std text, primary key (number, unit)) without rowid;
create table if not exists event (number integer, unit text, at real, kind text, detail text,
    primary key (number, unit, kind)) without rowid;
"""

RESULT = "insert or ignore into result values (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"


@dataclass(frozen=True)
class Sqlite(Sink):
    """A database file."""

    path: str

    def open(self) -> Writer:
        """Open or make the file."""
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
        """Close the file."""
        self.db.close()


def rows_of(batch: Outcome, part: Results) -> Iterator[tuple[Any, ...]]:
    """Rows of the table ``result``; SQLite stores NaN as NULL."""
    number, unit, flags, values = (column.tolist() for column in part)
    encode, n = msgspec.json.Encoder().encode, part.n
    for k, row in enumerate(values):
        name = batch.names[unit[k]]
        names = batch.about[name]["names"]
        theta, std = (encode(dict(zip(names, row[a : a + n], strict=False))).decode() for a in (THETA, THETA + n))
        yield (number[k], name, *row[:THETA], flags[k] & OK, flags[k] >> 1, theta, std)


def by_name(batch: Outcome, unit: str, values: list[float]) -> dict[str, Any]:
    """Parameters by name; None where they are not finite."""
    names = batch.about[unit]["names"]
    return {name: value if abs(value) < float("inf") else None for name, value in zip(names, values, strict=False)}
