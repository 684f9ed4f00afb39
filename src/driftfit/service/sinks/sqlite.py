"""SQLite: results and events as plain tables, for SQL, pandas or a spreadsheet. Repeats are left out."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import dataclass
from typing import Any

from driftfit.service.sinks.contract import Outcome, Sink, Writer

SCHEMA = """
create table if not exists result (number integer, unit text, time real, y real, y_hat real, e real, s real,
    ok integer, alarm integer, theta text, std text, primary key (number, unit)) without rowid;
create table if not exists event (number integer, unit text, at real, kind text, detail text,
    primary key (number, unit, kind)) without rowid;
"""


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
            rows = [(r.number, r.unit, r.time, r.y, r.y_hat, r.e, r.s, r.ok, r.alarm,
                     named(batch, r.unit, r.theta), named(batch, r.unit, r.std)) for r in batch.results]  # fmt: skip
            self.db.executemany("insert or ignore into result values (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", rows)
            events = [(e.number, e.unit, e.at, e.kind, json.dumps(dict(e.detail))) for e in batch.events]
            self.db.executemany("insert or ignore into event values (?, ?, ?, ?, ?)", events)
            self.db.execute("commit")
        except BaseException:
            self.db.execute("rollback")
            raise

    def close(self) -> None:
        """Close the file."""
        self.db.close()


def named(batch: Outcome, unit: str, values: list[float]) -> str:
    """Parameters by name, as JSON; null where they are not finite."""
    return json.dumps(by_name(batch, unit, values))


def by_name(batch: Outcome, unit: str, values: list[float]) -> dict[str, Any]:
    """Parameters by name; None where they are not finite."""
    names = batch.about[unit]["names"]
    return {name: value if abs(value) < float("inf") else None for name, value in zip(names, values, strict=False)}
