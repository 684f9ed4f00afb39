"""Old journals: exported to Parquet, then deleted, a piece at a time; results that no sink waits for are deleted.

A piece is written under a temporary name and moved into place before its rows leave the database, so a crash at any
moment leaves every sample in at least one of the two, and a piece that is written again replaces itself.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import polars as pl

from driftfit.data.storage import replace_file
from driftfit.service.core.journal import Act, Item, Journal, Pending
from driftfit.service.options import ServiceOptions

log = logging.getLogger("driftfit.service")
SEARCH_SECONDS = 60.0
"""Seconds between two searches."""
PIECE_GROUPS = 2_000
"""Groups of one piece."""
DAY_SECONDS = 86_400.0
OLD = "stop < ? and stop > 1e8"
"""Which blocks of the history are older than a time; those of units without times are kept."""
TYPES: dict[str, Any] = {
    "number": pl.Int64, "unit": pl.String, "time": pl.Float64, "values": pl.List(pl.Float64), "action": pl.String,
}  # fmt: skip


class Archive:
    """Keeps the database small."""

    def __init__(self, options: ServiceOptions, folder: Path, pool: Executor) -> None:
        self.options, self.folder, self._pool = options, folder, pool
        self._looked = time.monotonic()
        self._writing: Future[int] | None = None

    def forget(self, pending: Pending, journal: Journal, sinks_at: int) -> None:
        """Add the rows that may be deleted to the next transaction, and start to export those that may be deleted
        later.
        """
        if self._writing is not None and self._writing.done():
            if self._writing.exception() is not None:
                log.error("archive", extra={"detail": str(self._writing.exception())})
            elif upto := self._writing.result():
                pending.forget.append(("delete from log where first < ?", (upto,)))
                pending.forget.append(("delete from chain where number < ?", (upto,)))
            self._writing = None
        if time.monotonic() - self._looked < SEARCH_SECONDS or self._writing is not None:
            return
        self._looked = time.monotonic()
        self.begin(pending, journal, sinks_at)

    def begin(self, pending: Pending, journal: Journal, sinks_at: int) -> None:
        """Look for old rows; results that no sink has written yet are not deleted without an event."""
        now, needed = time.time(), journal.number("needed from")
        query = "select count(*) from result where at < ? and first > ?"
        ((lost,),) = journal.db.execute(query, (now - DAY_SECONDS * self.options.results, sinks_at))
        if lost:
            why = f"{lost} groups of results are older than {self.options.results} days, and a sink was away"
            log.error("lost", extra={"detail": why})
            pending.add_event(sinks_at, 0, now, "lost", {"why": why})
        old = now - DAY_SECONDS * self.options.history
        pending.forget += [
            ("delete from result where at < ? and first < ?", (now - 60.0, min(needed, sinks_at))),
            ("delete from result where at < ?", (now - DAY_SECONDS * self.options.results,)),
            (f"delete from history where (unit, first) in (select unit, first from block where {OLD})", (old,)),
            (f"delete from block where {OLD}", (old,)),
        ]
        self._writing = self._pool.submit(export, self.folder, needed, now - DAY_SECONDS * self.options.keep)


def export(folder: Path, needed: int, before: float) -> int:
    """Write the oldest piece of the log, if all of it is older than ``before`` seconds and stored in states.

    Returns the number up to which the log may be deleted; 0 if nothing was written.
    """
    journal = Journal(folder, read_only=True)
    try:
        query = "select first, count from log where at < ? and first + count <= ? order by first limit ?"
        found = journal.db.execute(query, (before, needed, PIECE_GROUPS)).fetchall()
        if not found:
            return 0
        first, upto = found[0][0], found[-1][0] + found[-1][1]
        names = {number: name for number, name, *_ in journal.units()}
        tables = []
        for number, items in journal.groups(first):
            if number >= upto:
                break
            for item in items:
                tables.append(table_of(number, item, names))
                number += item.length
    finally:
        journal.close()
    target = folder / "journal" / f"{first:016d}-{upto - 1:016d}.parquet"
    target.parent.mkdir(exist_ok=True)
    replace_file(target, pl.concat(tables).write_parquet)
    return int(upto)


def table_of(number: int, item: Item, names: Mapping[int, str]) -> pl.DataFrame:
    """An entry of the log, whose first sample has a number, as a table."""
    count = item.length
    columns: dict[str, Any] = {"number": range(number, number + count)}
    if isinstance(item, Act):
        columns |= {"unit": [names[item.unit]], "time": [None], "values": [[]], "action": [str(item.action)]}
    else:
        columns |= {
            "unit": [names[unit] for unit in item.unit.tolist()],
            "time": [None] * count if item.time is None else item.time,
        }
        columns |= {"values": item.values.tolist(), "action": [None] * count}
    return pl.DataFrame(columns, schema=TYPES)
