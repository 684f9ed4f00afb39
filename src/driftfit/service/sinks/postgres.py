"""PostgreSQL, by psycopg: tables ``driftfit_result`` and ``driftfit_event``, by COPY into a staging table.

A result that comes again is left out (ON CONFLICT DO NOTHING). Where TimescaleDB is installed, the results become a
hypertable by time. docs/service has a dashboard of Grafana that reads these tables.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial

from driftfit.service.connector import client_library
from driftfit.service.options import Secret
from driftfit.service.sinks.contract import Outcome, Sink, Writer

SCHEMA = """
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
library = partial(client_library, "postgres", "psycopg", "psycopg", "postgres")
COLUMNS = "time, number, unit, seconds, y, y_hat, e, s, ok, alarm, theta, std, names"


@dataclass(frozen=True)
class Postgres(Sink):
    """A database."""

    url: str
    """postgresql://user@host:port/database, without the password"""
    password: Secret | None = None
    schema: str = "public"

    def check(self) -> None:
        if not self.schema.isidentifier():
            raise ValueError(f"postgres: schema must be a plain name; got {self.schema!r}.")
        if "@" in self.url and ":" in self.url.partition("://")[2].partition("@")[0]:
            raise ValueError('postgres: no password in url; write password = { env = "NAME" }.')
        library()

    def open(self) -> Writer:
        return _Postgres(self)


class _Postgres(Writer):
    def __init__(self, options: Postgres) -> None:
        self.options = options
        extra = {"password": options.password.value} if options.password else {}
        self.db = library().connect(options.url, connect_timeout=10, autocommit=True, **extra)
        self.db.execute("set client_min_messages = warning")
        for statement in SCHEMA.format(schema=options.schema).split(";\n"):
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
                f"insert into {schema}.driftfit_event values (to_timestamp(%s), %s, %s, %s, %s) on conflict do nothing",
                [(one.at, one.number, one.unit, one.kind, json.dumps(dict(one.detail))) for one in batch.events],
            )

    def close(self) -> None:
        self.db.close()


def _moment(time: float | None, number: int) -> datetime:
    """The time as a date; seconds since 1970 if it is only a number, and the sample's number if it has none."""
    try:
        return datetime.fromtimestamp(number if time is None else time, UTC)
    except (OverflowError, ValueError, OSError):
        return datetime.fromtimestamp(0, UTC)
