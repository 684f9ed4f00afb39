"""kill -9 at random moments: nothing lost, nothing doubled, states and results as if it had never happened."""

import itertools
import multiprocessing
import os
import signal
import sqlite3
import sys
import time
from collections import Counter

import numpy as np
import polars as pl
import pytest

pytest.importorskip("msgspec", reason="the service needs driftfit[serve]")

from service_support import MODEL, TRACKER, UNIT, configured, opened, record, rows_of

from driftfit import track

KILLS, UNITS, T = 20, 4, 2500


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that begin as copies")
def test_twenty_kills(tmp_path, monkeypatch):
    import service_process  # compiles: not while tests are collected

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # of the process that is copied
    data = [record(T, seed) for seed in range(UNITS)]
    rows = {"pump": [], "t": [], "y": [], "u": []}
    for t in range(T):
        for k, (y, u) in enumerate(data):
            for name, value in zip(rows, (f"p{k}", float(t), y[t], u[t]), strict=True):
                rows[name].append(value)
    pl.DataFrame(rows).write_csv(tmp_path / "plant.csv")
    source = f'[service]\ngroup = 50\nsnapshot = 0.2\n[source.file]\nkind = "replay"\npath = "{tmp_path}/plant.csv"\n'
    source += 'topic = "plant"\nby = "pump"\nspeed = 4000.0\n'
    sinks = f'[[sink]]\nkind = "sqlite"\npath = "{tmp_path}/out.db"\n'
    sinks += f'[[sink]]\nkind = "parquet"\npath = "{tmp_path}/out"\nseconds = 0.1\n'
    config = configured(UNIT, sinks, source)
    context, rng = multiprocessing.get_context("forkserver"), np.random.default_rng(8)
    context.set_forkserver_preload(["service_process"])
    for kills in range(KILLS + 1):
        process = context.Process(
            target=service_process.work, args=(source + UNIT + sinks, tmp_path / "folder", UNITS * T)
        )
        process.start()
        if kills == KILLS:
            process.join(120)
            break
        before = journaled(tmp_path / "folder")
        until = time.monotonic() + 60
        while journaled(tmp_path / "folder") == before and time.monotonic() < until:
            time.sleep(0.005)
        time.sleep(float(rng.uniform(0.0, 0.1)))
        assert process.exitcode is None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
    assert process.exitcode == 0
    check(config, tmp_path, data)


def journaled(folder):
    """How many samples are in the journal."""
    if not (folder / "driftfit.db").exists():
        return 0
    with sqlite3.connect(folder / "driftfit.db") as db:
        known = db.execute("pragma table_info(log)").fetchall()
        found = db.execute("select sum(count) from log").fetchone()[0] if known else 0
    db.close()
    return found or 0


def check(config, home, data):
    engine = opened(config, home / "folder")
    with sqlite3.connect(home / "out.db") as db:
        sink = db.execute("select unit, time, e from result").fetchall()
    db.close()
    parquet = pl.concat(pl.read_parquet(file) for file in (home / "out").glob("*.parquet"))
    for k, (y, u) in enumerate(data):
        run = track(MODEL, TRACKER, y, u, time=np.arange(T) * 1.0, dt=1.0)
        times, journal = rows_of(engine, engine.units.names[f"p{k}"])
        assert times == run.time.tolist()  # none lost, none doubled, in order
        assert np.array_equal(journal, np.column_stack([y, u]))
        assert np.array_equal(engine.units.get(engine.units.names[f"p{k}"]).live.theta, run.theta[-1])
        written = sorted((time, e) for unit, time, e in sink if unit == f"p{k}")
        assert Counter(time for time, _ in written) == Counter(times)
        assert np.array_equal(np.array([e for _, e in written], float), run.innovation, equal_nan=True)
        mine = parquet.filter(pl.col("unit") == f"p{k}").sort("time")
        assert mine["time"].to_list() == times
        assert np.array_equal(np.array(mine["theta"].to_list()), run.theta)
    blocks = engine.journal.db.execute("select unit, first, last, count from block order by unit, first").fetchall()
    for unit in {one[0] for one in blocks}:
        mine = [one for one in blocks if one[0] == unit]
        assert all(before[2] < after[1] for before, after in itertools.pairwise(mine))
    assert sum(one[3] for one in blocks) == UNITS * T
