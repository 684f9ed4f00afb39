"""Check a journal: the sum of every row, and the chain of digests."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from driftfit.service.core.journal import NAME, Journal, linked, sum_of

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
