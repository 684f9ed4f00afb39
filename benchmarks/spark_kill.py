"""Kill the driver and workers of a stream on Spark with signal 9 while rows flow; count what is lost or doubled.

Rows of 500 units lie in files, two per cent of them out of order and one per cent twice. A driver follows them
(`driftfit.bridges.spark.follow`) file by file and is killed three times with all its processes, each time in the middle
of a batch; three times a Python worker alone is killed, whose task Spark runs again. Afterwards the table is compared
with `track` on one machine, which was not interrupted: rows, results and final states.

With --cluster Spark starts a cluster on this machine, local-cluster[2,1,1024]: two executors, Java processes of
their own; three of them are killed too, with the Python workers that they have.

    python -m benchmarks.spark_kill             200,000 rows
    python -m benchmarks.spark_kill --quick     2,000 rows, one kill of each kind
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import polars as pl

from driftfit import ARX, Kalman, track

MODEL, TRACKER = ARX(2, 2), Kalman(q=1e-4, r=0.1)
HOLD = 4.0
SCHEMA = "unit string, t double, y double, u double"


def write_rows(folder: Path, units: int, T: int, files: int, seed: int = 0) -> pl.DataFrame:
    """The rows in order of arrival as files; returns the sorted table without repeated rows."""
    rng = np.random.default_rng(seed)
    time_of = np.tile(np.arange(T) * 1.0, units)
    u = rng.normal(size=units * T)
    y = 0.3 * rng.normal(size=units * T).cumsum()
    y[rng.random(len(y)) < 0.02] = np.nan
    unit = np.repeat([f"unit {k}" for k in range(units)], T)
    rows = pl.DataFrame({"unit": unit, "t": time_of, "y": y, "u": u})
    arrival = time_of + np.where(rng.random(len(y)) < 0.02, rng.uniform(0.0, 0.9 * HOLD, len(y)), 0.0)
    twice = np.flatnonzero(rng.random(len(y)) < 0.01)
    which = np.concatenate([np.arange(len(y)), twice])
    which = which[np.argsort(np.concatenate([arrival, arrival[twice] + 1.0]), kind="stable")]
    for i, part in enumerate(np.array_split(which, files)):
        path = folder / f"rows{i:04d}.parquet"
        rows[part].write_parquet(path)
        os.utime(path, (1e9 + i, 1e9 + i))
    return rows


def drive(folder: Path) -> None:
    """The driver: follow all files, then end."""
    from driftfit.bridges import spark as bridge

    # a task may fail four times, as on a cluster; Java compiles little, which halves the CPU of a short life
    master = "local-cluster[2,1,1024]" if "--cluster" in sys.argv else "local[2,4]"
    path = os.environ.get("PYTHONPATH", "")
    session = bridge.session(master, spark__sql__shuffle__partitions="2", spark__ui__enabled="false",
                             spark__executorEnv__PYTHONPATH=path, spark__sql__codegen__wholeStage="false",
                             spark__driver__extraJavaOptions="-XX:TieredStopAtLevel=1 -XX:+UseSerialGC")  # fmt: skip
    session.sparkContext.setLogLevel("OFF")
    rows = session.readStream.schema(SCHEMA).option("maxFilesPerTrigger", 1).parquet(str(folder / "in"))
    columns = {"y": "y", "u": "u", "by": "unit", "time": "t"}
    query = bridge.follow(
        rows, MODEL, TRACKER, path=str(folder / "out"), hold=HOLD, trigger={"availableNow": True}, **columns
    )
    query.awaitTermination()


def start(folder: Path) -> subprocess.Popen[bytes]:
    """A driver in a group of processes of its own."""
    command = [sys.executable, __file__, "--drive", *(one for one in sys.argv if one == "--cluster"), str(folder)]
    with open(folder / "driver.log", "ab") as log:
        return subprocess.Popen(command, start_new_session=True, stdout=log, stderr=log)


def done(folder: Path) -> int:
    """How many batches are complete."""
    return len(list((folder / "out").glob("batch=*/_SUCCESS")))


def processes(driver: int, what: str) -> list[int]:
    """The Python workers of a driver (what the daemon of PySpark has forked), or its executors."""
    parents: dict[int, tuple[int, str]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
                parents[int(entry.name)] = (int(fields[1]), (entry / "cmdline").read_text())
            except (OSError, ValueError):
                continue
    mark = "pyspark.daemon" if what == "worker" else "CoarseGrainedExecutorBackend"
    found = {pid for pid, (_, command) in parents.items() if mark in command and _session(pid) == driver}
    return [pid for pid in found if what != "worker" or parents[pid][0] in found]


def _session(pid: int) -> int:
    try:
        return os.getsid(pid)
    except OSError:
        return -1


def end(session: int) -> None:
    """Kill all processes of a session with signal 9."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and _session(int(entry.name)) == session:
            try:
                os.kill(int(entry.name), signal.SIGKILL)
            except OSError:
                continue


def disturb(folder: Path, kills: list[str], files: int, patience: float) -> list[str]:
    """Run the driver to its end, with the ``kills`` on the way; returns what was killed and when."""
    random.seed(0)
    result, driver, began = [], start(folder), time.monotonic()
    marks = [round((k + 1) * files / (len(kills) + 1)) for k in range(len(kills))]
    for what, mark in zip(kills, marks, strict=True):
        while done(folder) < mark and driver.poll() is None and time.monotonic() - began < patience:
            time.sleep(0.05)
        while what != "driver" and not processes(driver.pid, what) and driver.poll() is None:
            time.sleep(0.02)
        time.sleep(random.random() * 0.5)  # somewhere in the next batch
        if driver.poll() is not None:
            break
        if what != "driver":
            found = processes(driver.pid, what)
            if found:
                os.kill(found[0], signal.SIGKILL)
                result.append(f"{what} after {done(folder)} batches")
        else:
            end(driver.pid)
            driver.wait()
            result.append(f"driver after {done(folder)} batches")
            driver = start(folder)
    try:
        code = driver.wait(timeout=max(patience - (time.monotonic() - began), 1.0))
    except subprocess.TimeoutExpired:
        end(driver.pid)
        raise
    if code:
        raise RuntimeError((folder / "driver.log").read_text()[-3000:])
    return result


def compare(folder: Path, rows: pl.DataFrame) -> dict[str, int]:
    """What the table has too few and too many, and what differs from the run that nothing interrupted."""
    parts = sorted((folder / "out").glob("batch=*/kind=result/*.parquet"))
    found = pl.concat([pl.read_parquet(path) for path in parts])
    due = rows.filter(pl.col("t") <= pl.col("t").max().over("unit") - HOLD)
    fleet = track(MODEL, TRACKER, "y", "u", data=due, by="unit", time="t")
    whole = fleet.to_table().sort("unit", "t")
    once = found.unique(["unit", "t"])
    names = [name for name in whole.columns if name in found.columns]
    pairs = once.select(names).sort("unit", "t")
    last = max((folder / "out").glob("batch=*/_SUCCESS"), key=lambda path: int(path.parent.name[6:])).parent
    states = pl.concat([pl.read_parquet(path) for path in (last / "kind=state").glob("*.parquet")])
    own = {key: run.program.pack(run._lane.tile, run._lane.lane)[24:] for key, run in fleet.items()}
    return {
        "rows": len(due),
        "lost": len(whole.join(once, on=["unit", "t"], how="anti")),
        "doubled": len(found) - len(once),
        "results that differ": different(pairs, whole.select(names)),
        "states": len(states),
        "states that differ": sum(own[key] != state[24:] for key, state in states.select("unit", "state").iter_rows()),
    }


def different(one: pl.DataFrame, other: pl.DataFrame) -> int:
    """Rows that differ, NaN being equal to NaN."""
    if len(one) != len(other):
        return max(len(one), len(other))
    same = pl.all_horizontal(pl.col(name).eq_missing(other[name]) for name in one.columns)
    return int((~one.select(same).to_series()).sum())


def main(quick: bool = False) -> None:
    units, T, files = (50, 40, 4) if quick else (500, 400, 20)
    kinds = ["driver", "worker", "executor"] if "--cluster" in sys.argv else ["driver", "worker"]
    kills = kinds if quick else kinds * 3
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "in").mkdir()
        rows = write_rows(folder / "in", units, T, files)
        for result in disturb(folder, kills, files, 7200.0):
            print(f"killed the {result}")
        for what, count in compare(folder, rows).items():
            print(f"{what:>20} {count:>8}")


if __name__ == "__main__":
    if "--drive" in sys.argv:
        drive(Path(sys.argv[-1]))
    else:
        main("--quick" in sys.argv)
