"""The journal is what was written: flipped bytes are found, and with ``audit`` what somebody rewrote."""

import shutil
import sqlite3
import time
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

pytest.importorskip("msgspec", reason="the service needs driftfit[serve]")

from service_support import (
    HTTP,
    UNIT,
    configured,
    events,
    feed,
    message,
    opened,
    record,
    results_of,
    rows_of,
    run_of,
    settled,
)
from typer.testing import CliRunner

from driftfit import track
from driftfit.cli import app
from driftfit.service.core.archive import export
from driftfit.service.core.journal import DAMAGED, NAME, Journal, sum_of, verify
from driftfit.service.page import feed as history

Y, U = record(400)
AUDIT = "[service]\naudit = true\n"


def written(folder, more=""):
    """The folder of a service that has taken eight groups of 50 samples; states are stored before the last two."""
    engine = opened(configured(UNIT, source=more + HTTP), folder)
    for k in range(0, 400, 50):
        if k == 300:
            engine._store_states(everything=True)
        feed(engine, message("plant/a", range(k, k + 50), Y[k : k + 50], U[k : k + 50]))
    settled(engine)
    engine.close()
    with sqlite3.connect(folder / NAME) as db:
        db.execute("pragma wal_checkpoint(truncate)")
    db.close()
    DAMAGED.clear()
    return folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return written(tmp_path_factory.mktemp("journal"), AUDIT)


@pytest.fixture
def folder(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "copy")
    yield tmp_path / "copy"
    DAMAGED.clear()


def change(folder, *statements):
    with sqlite3.connect(folder / NAME) as db:
        for statement, *values in statements:
            db.execute(statement, values)
    db.close()


def flip(folder, table, column, where="1"):
    """Flip one bit of a value."""
    with sqlite3.connect(folder / NAME) as db:
        ((value,),) = db.execute(f"select {column} from {table} where {where} order by rowid limit 1").fetchall()
        damaged = bytearray(value if isinstance(value, bytes) else value.encode())
        damaged[len(damaged) // 2] ^= 1
        value = bytes(damaged) if isinstance(value, bytes) else damaged.decode()
        db.execute(
            f"update {table} set {column} = ? where rowid = (select min(rowid) from {table} where {where})", [value]
        )
    db.close()


def test_a_damaged_group_is_left_out_and_named(folder):
    flip(folder, "log", "items", "first = 351")
    engine = opened(configured(source=AUDIT + HTTP), folder)
    assert engine.recovered == 50  # not 100
    feed(engine, message("plant/a", [400.0], [0.0], [0.0]))
    assert events(engine, "damaged") == [{"table": "log", "row": [351, 50]}]
    run = track(engine.config.units[0].model, engine.config.units[0].tracker, Y[:350], U[:350], dt=1.0, time=range(350))
    rows = [row for row in results_of(engine) if row[0] <= 350]
    assert np.array_equal([row[8] for row in rows], run.theta)
    assert [line.partition(":")[0] for line in verify(folder)[1]] == ["log", "log"]  # its sum, and its link


@pytest.mark.parametrize(
    ("table", "column", "read"),
    [("result", "rows", lambda journal: journal.outcomes(0)), ("snapshot", "state", lambda journal: journal.state(1)),
     ("block", "extremes", lambda journal: history.reduced(journal, 1, [], 0.0, 1e9, 5)),
     ("history", "rows", lambda journal: history.samples(journal, 1, [], 0.0, 1e9)),
     ("history", "rows", lambda journal: history.newest_blocks(journal, 1, [])),
     ("event", "detail", lambda journal: [*journal.rows("event")])],
    ids=["result", "snapshot", "block", "history", "latest", "event"],
)  # fmt: skip
def test_damaged_rows_are_not_read(folder, table, column, read):
    if table == "event":
        row = (7, 1, 0.5, "alarm", "{}")
        change(folder, ("insert into event values (?, ?, ?, ?, ?, ?)", *row, sum_of(*row)))
    journal = Journal(folder, read_only=True)
    before = read(journal)
    assert not DAMAGED
    flip(folder, table, column)
    assert repr(read(journal)) != repr(before)
    assert {one for one, _ in DAMAGED} == {table}
    assert verify(folder)[1][0].startswith(f"{table}: ")
    journal.close()


@pytest.mark.parametrize("table", ["unit", "program", "meta", "position"])
def test_what_all_depends_on_is_certain_or_an_error(folder, table):
    if table == "position":
        change(folder, ("insert into position values ('source:web', '12', ?)", sum_of("source:web", "12")))
    flip(
        folder,
        table,
        {"unit": "about", "program": "about"}.get(table, "value"),
        "value like '%1'" if table == "meta" else "1",
    )
    with pytest.raises(ValueError, match=f"the table {table} is damaged"):
        opened(configured(), folder)


def test_no_flipped_byte_alters_results_silently(folder):
    """38 of 100 flipped bytes did."""

    def read():
        journal = Journal(folder, read_only=True)
        try:
            found = repr([[row for part in group.parts for row in part.rows()] for group in journal.outcomes(0)])
            return found + repr(history.samples(journal, 1, [], 0.0, 1e9).tolist()) + repr([*journal.groups(1)])
        finally:
            journal.close()

    data, expected, rng = (folder / NAME).read_bytes(), read(), np.random.default_rng(0)
    found = 0
    for place in rng.integers(len(data), size=100):
        damaged = bytearray(data)
        damaged[place] ^= 1 << rng.integers(8)
        (folder / NAME).write_bytes(damaged)
        try:
            faults = verify(folder)[1]
        except ValueError:
            faults = ["not a database"]
        if faults:
            found += 1
        else:
            assert read() == expected
    assert found > 20  # the others are in free pages
    (folder / NAME).write_bytes(data)
    assert verify(folder)[1] == []


def rewritten(number):
    """Statements that give a group the items of another, with a sum that fits."""

    def statements(folder):
        with sqlite3.connect(folder / NAME) as db:
            row = db.execute("select first, count, at from log where first = ?", [number]).fetchone()
            (items,) = db.execute("select items from log where first = 1").fetchone()
        db.close()
        yield "update log set items = ?, sum = ? where first = ?", items, sum_of(*row, items), number

    return statements


@pytest.mark.parametrize(
    ("attack", "message"),
    [
        (rewritten(101), "the group 101 is another one"),
        (lambda _: [("delete from log where first = 101",)], "the group 101 is missing"),
        (lambda _: [("delete from log where first = 101",), ("delete from chain where number = 101",)],
         "links before the group 151 are missing"),
        (lambda _: [("delete from log where first = 351",), ("delete from chain where number = 351",)],
         "its last links are missing"),
        (lambda _: [("insert into log select first + 1, 0, at, items, 0 from log where first = 351",),
                    ], "the group 352 is not in the chain"),
    ],
    ids=["rewritten", "group", "group and link", "the last", "added"],
)  # fmt: skip
def test_what_somebody_rewrites_is_found(folder, attack, message):
    change(folder, *attack(folder))
    assert message in "\n".join(verify(folder)[1])


def test_the_chain_goes_on_after_a_restart_and_digests_can_be_noted(folder, tmp_path):
    noted = verify(folder)[0].rpartition(" ")[2]
    engine = opened(configured(source=AUDIT + HTTP), folder)
    feed(engine, message("plant/a", [400.0], [0.0], [0.0]))
    engine.close()
    run = CliRunner()
    done = run.invoke(app, ["journal", "verify", str(folder), "--digest", noted])
    assert done.exit_code == 0, done.output
    assert done.output.startswith("9 groups; the chain ends with ")
    other = written(tmp_path / "other", AUDIT)  # all of it made anew
    done = run.invoke(app, ["journal", "verify", str(other), "--digest", noted])
    assert done.exit_code == 1
    assert f"the chain does not have the digest {noted}" in done.output
    assert "no chain" in verify(written(tmp_path / "plain"))[0]


def test_groups_that_were_exported_leave_the_chain(folder):
    upto = export(folder, 301, 1e12)
    change(folder, ("delete from log where first < ?", upto), ("delete from chain where number < ?", upto))
    assert verify(folder)[1] == []


def test_a_folder_without_a_journal_is_named(tmp_path):
    done = CliRunner().invoke(app, ["journal", "verify", str(tmp_path)])
    assert done.exit_code == 2
    assert "driftfit.db" in done.output


def test_old_journals_become_parquet(tmp_path, monkeypatch):
    y, u = record(100)
    config = configured()
    engine = opened(replace(config, service=replace(config.service, keep=-1.0)), tmp_path)
    for k in range(0, 100, 10):
        feed(engine, message("plant/a", range(k, k + 10), y[k : k + 10], u[k : k + 10]))
    engine.act("a", {"do": "hold", "on": True, "who": "me", "why": "test"})
    engine.step(0.0)
    assert export(tmp_path, engine.journal.number("needed from"), time.time() + 1) == 0  # the states are not stored
    engine._store_states(everything=True)
    engine._commit()
    monkeypatch.setattr("driftfit.service.core.archive.SEARCH_SECONDS", -1.0)
    for _ in range(100):
        engine.step(0.0)
        if not rows_of(engine, 1)[0]:
            break
        time.sleep(0.05)
    table = pl.concat(pl.read_parquet(file) for file in sorted((tmp_path / "journal").glob("*.parquet")))
    samples = table.filter(pl.col("action").is_null())
    assert samples["time"].to_list() == list(range(100))
    run = run_of(*np.array(samples["values"].to_list()).T)
    assert np.array_equal(run.theta[-1], engine.units.get(1).live.theta)
    engine.close()
    engine = opened(configured(), tmp_path)
    assert engine.next == 102
    feed(engine, message("plant/a", [100.0], [0.0], [0.0]))
    assert engine.units.get(1).counts["samples"] == 101


def test_a_journal_of_another_format_is_refused_and_stays_as_it_is(folder):
    for older in ("2", "4"):
        change(folder, ("update meta set value = ? where key = 'format'", older))
        before = (folder / NAME).read_bytes()
        for again in (False, True):
            with pytest.raises(
                ValueError, match=f"has the format {older}, and this version reads 3: use another folder"
            ):
                Journal(folder, rebuild=again)
        assert (folder / NAME).read_bytes() == before
