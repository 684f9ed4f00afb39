"""Tables of results and events: SQLite, PostgreSQL, Parquet. Results that come again are left out.

sqlite    plain tables in a file, for SQL, pandas or a spreadsheet
postgres  tables ``driftfit_result`` and ``driftfit_event``, by COPY of psycopg into a staging table; a hypertable$
          by time where TimescaleDB is installed. docs/service has a dashboard of Grafana that reads them
parquet   a folder of files, each with the results of a minute or of 100,000 samples. A file is named by its first group
          and moved into place when it is complete; one that is written again after a crash replaces itself
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import polars as pl

from driftfit.data.storage import replace_file
from driftfit.engine.kernel import Array
from driftfit.service.connect.base import Outcome, Sink, Writer
from driftfit.service.core.results import ALARM, OK, THETA, Results
from driftfit.service.options import Secret

IN_SQLITE = """
create table if not exists result (number integer, unit text, time real, y real, y_hat real, e real, s real,
    ok integer, alarm integer, theta text, std text, primary key (number, unit)) without rowid;
create table if not exists event (number integer, unit text, at real, kind text, detail text,
    primary key (number, unit, kind, detail)) without rowid;
"""
RESULT = "insert or ignore into result values (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"


@dataclass(frozen=True)
class SqliteSink(Sink):
    """A database file."""

    path: str

    def open(self) -> Writer:
        return _SqliteWriter(self.path)


class _SqliteWriter(Writer):
    def __init__(self, path: str) -> None:
        self.db = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
        self.db.execute("pragma journal_mode=wal")
        self.db.executescript(IN_SQLITE)

    def write(self, batch: Outcome) -> None:
        """All of the batch, or nothing."""
        self.db.execute("begin immediate")
        try:
            for part in batch.parts:
                self.db.executemany(RESULT, _rows(batch, part))
            self.db.executemany("insert or ignore into event values (?, ?, ?, ?, ?)", _events(batch))
            self.db.execute("commit")
        except BaseException:
            self.db.execute("rollback")
            raise

    def close(self) -> None:
        self.db.close()


def _rows(batch: Outcome, part: Results) -> Iterable[tuple[Any, ...]]:
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


def _events(batch: Outcome) -> list[tuple[Any, ...]]:
    """(number, unit, time, kind, detail in JSON) of the events."""
    return [(one.number, one.unit, one.at, one.kind, json.dumps(dict(one.detail))) for one in batch.events]


IN_POSTGRES = """
create table if not exists {schema}.driftfit_result (
    time timestamptz not null, number bigint not null, unit text not null, seconds double precision,
    y double precision, y_hat double precision, e double precision, s double precision, ok boolean, alarm boolean,
    theta double precision[], std double precision[], names text[], primary key (unit, number, time));
create index if not exists driftfit_result_time on {schema}.driftfit_result (unit, time desc);
create table if not exists {schema}.driftfit_event (
    at timestamptz not null, number bigint, unit text, kind text, detail jsonb,
    primary key (unit, number, kind, detail));
create temporary table if not exists driftfit_staging (like {schema}.driftfit_result);
"""
COLUMNS = "time, number, unit, seconds, y, y_hat, e, s, ok, alarm, theta, std, names"


@dataclass(frozen=True)
class PostgresSink(Sink):
    """A database."""

    needs: ClassVar = ("psycopg", "psycopg", "postgres")
    url: str
    """postgresql://user@host:port/database, without the password"""
    password: Secret | None = None
    schema: str = "public"

    def check(self) -> None:
        if not self.schema.isidentifier():
            raise ValueError(f"postgres: schema must be a plain name; got {self.schema!r}.")
        if "@" in self.url and ":" in self.url.partition("://")[2].partition("@")[0]:
            raise ValueError('postgres: no password in url; write password = { env = "NAME" }.')
        super().check()

    def open(self) -> Writer:
        return _PostgresWriter(self)


class _PostgresWriter(Writer):
    def __init__(self, options: PostgresSink) -> None:
        self.options = options
        extra = {"password": options.password.value} if options.password else {}
        self.db = options.library().connect(options.url, connect_timeout=10, autocommit=True, **extra)
        self.db.execute("set client_min_messages = warning")
        for statement in IN_POSTGRES.format(schema=options.schema).split(";\n"):
            if statement.strip():
                self.db.execute(statement)
        if self.db.execute("select 1 from pg_extension where extname = 'timescaledb'").fetchone():
            query = "select create_hypertable(%s, 'time', if_not_exists => true, migrate_data => true)"
            self.db.execute(query, (f"{options.schema}.driftfit_result",))

    def write(self, batch: Outcome) -> None:
        """All of the batch, or nothing."""
        schema = self.options.schema
        with self.db.transaction(), self.db.cursor() as cursor:
            cursor.execute("truncate driftfit_staging")
            with cursor.copy(f"copy driftfit_staging ({COLUMNS}) from stdin") as copy:
                for one in batch.results:
                    names = list(batch.about[one.unit]["names"])
                    first = (_moment(one.time, one.number), one.number, one.unit, one.time)
                    copy.write_row(
                        (*first, one.y, one.y_hat, one.e, one.s, one.ok, one.alarm, one.theta, one.std, names)
                    )
            cursor.execute(
                f"insert into {schema}.driftfit_result ({COLUMNS}) select {COLUMNS} from driftfit_staging "
                "on conflict do nothing"
            )
            cursor.executemany(
                f"insert into {schema}.driftfit_event (number, unit, at, kind, detail) "
                "values (%s, %s, to_timestamp(%s), %s, %s) on conflict do nothing",
                _events(batch),
            )

    def close(self) -> None:
        self.db.close()


def _moment(time: float | None, number: int) -> datetime:
    """The time as a date; seconds since 1970 if it is only a number, and the sample's number if it has none."""
    try:
        return datetime.fromtimestamp(number if time is None else time, UTC)
    except (OverflowError, ValueError, OSError):
        return datetime.fromtimestamp(0, UTC)


@dataclass(frozen=True)
class ParquetSink(Sink):
    """A folder of files."""

    path: str
    seconds: float = 60.0
    """Time that one file covers."""
    most: ClassVar[int] = 100_000

    @property
    def gather(self) -> float:
        return self.seconds

    def open(self) -> Writer:
        Path(self.path).mkdir(parents=True, exist_ok=True)
        return _ParquetWriter(Path(self.path))


class _ParquetWriter(Writer):
    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def write(self, batch: Outcome) -> None:
        """One file, complete or not at all."""
        if not len(batch):
            return
        table = pl.concat([_table(batch, part) for part in batch.parts])
        replace_file(self.folder / f"results-{batch.group:016d}.parquet", table.write_parquet)


def _table(batch: Outcome, part: Results) -> pl.DataFrame:
    columns = {name: part.values[:, k] for k, name in enumerate(("time", "y", "y_hat", "e", "s"))}
    given = {"number": part.number, "unit": [batch.names[k] for k in part.unit.tolist()], **columns}
    given |= {"ok": (part.flags & OK) > 0, "theta": part.theta.tolist(), "std": part.std.tolist()}
    return pl.DataFrame(given | {"alarm": (part.flags & ALARM) > 0}).with_columns(pl.col("time").fill_nan(None))
