"""Fleets on Spark: rows per second of batch and streams, compared with the floor and with the obvious ways.

All on local[2] in one run, with n = 4, forty rows per unit, and results written nowhere ("noop"), so that what is
measured is Spark's shuffle, the passage to Python and back, and the step. Seconds by the clock depend on what else the
machine does, so the CPU of Java and of the Python workers is counted too:

    floor          the same shuffle and sort, and `mapInArrow` returning columns of the same bytes without a step
    spark.track    a row of results per sample
    summary        a row per unit
    applyInPandas  one `track` per unit, and statsmodels' recursive least squares per unit
    spark.follow   a stream with one or twenty rows per unit and batch: seconds and CPU per batch, and those of a stream
                   whose rows are shuffled, passed to Python and written; and the state in bytes

    python -m benchmarks.spark             1,000 to 50,000 units
    python -m benchmarks.spark streams     a part: step, batch, streams, equal
    python -m benchmarks.spark --quick     100 units
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
import polars as pl

from driftfit import ARX, Kalman, track
from driftfit.bridges import spark as bridge

MODEL, TRACKER = ARX(2, 2), Kalman(q=1e-4, r=0.1)
COLUMNS = {"y": "y", "u": "u", "by": "unit", "time": "t"}
SCHEMA = "unit string, t double, y double, u double"
EACH = 40


def rows_of(units: int, each: int, begin: float = 0.0, seed: int = 0) -> pl.DataFrame:
    """Rows of all units in the order of time, as they would arrive."""
    rng = np.random.default_rng(seed)
    unit = np.tile(np.array([f"meter {k:07d}" for k in range(units)]), each)
    t = begin + np.repeat(np.arange(each) * 1.0, units)
    return pl.DataFrame({"unit": unit, "t": t, "y": rng.normal(size=len(t)), "u": rng.normal(size=len(t))})


class Took(NamedTuple):
    """Seconds by the clock, and of CPU of Java and of Python workers."""

    wall: float
    java: float
    python: float

    @property
    def cpu(self) -> float:
        return self.java + self.python


def measured(run: Callable[[], Any], best: int = 2) -> Took:
    """The least of some runs."""
    found = []
    for _ in range(best):
        before, begin = used(), time.perf_counter()
        run()
        wall, after = time.perf_counter() - begin, used()
        found.append((wall, after[0] - before[0], after[1] - before[1]))
    return Took(*map(min, zip(*found, strict=True)))


def nowhere(frame: Any) -> None:
    """Compute all of a frame."""
    frame.write.format("noop").mode("overwrite").save()


def floor(frame: Any) -> Any:
    """The same shuffle, and as many columns of as many bytes, without a step."""
    import pyarrow as pa

    copies = [f"c{k}" for k in range(13)]

    def same(batches: Any) -> Any:
        for batch in batches:
            y = batch.column("y")
            yield pa.RecordBatch.from_arrays([*batch.columns, *[y] * len(copies)], [*batch.schema.names, *copies])

    made = ", ".join([SCHEMA, *(f"{name} double" for name in copies)])
    return frame.repartition("unit").sortWithinPartitions("unit", "t", "y", "u").mapInArrow(same, made)


def by_track(part: Any) -> Any:
    """One `track` per unit."""
    part = part.sort_values("t")
    run = track(MODEL, TRACKER, part["y"].to_numpy(), part["u"].to_numpy(), time=part["t"].to_numpy())
    part["a1"], part["e"] = run.theta[:, 0], run.innovation
    return part


def by_statsmodels(part: Any) -> Any:
    """Recursive least squares of statsmodels per unit."""
    from statsmodels.regression.recursive_ls import RecursiveLS

    part = part.sort_values("t")
    y, u = part["y"].to_numpy(), part["u"].to_numpy()
    X = np.stack([y[1:-1], y[:-2], u[1:-1], u[:-2]], axis=1)
    found = RecursiveLS(y[2:], X).fit()
    part["a1"] = np.concatenate([[np.nan] * 2, found.recursive_coefficients.filtered[0]])
    part["e"] = np.concatenate([[np.nan] * 2, np.asarray(found.resid_recursive)])
    return part


def step() -> None:
    """Processor time of a worker for a piece of 64,000 rows of a table, without Spark."""
    import pyarrow as pa

    from driftfit.bridges.spark.batch import Partition, schema_of
    from driftfit.bridges.spark.units import ROWS, Task

    print(
        f"{'units':>8} {'rows each':>9} {'us per row':>11} {'us per unit':>12}   one worker, {ROWS} rows, without Spark"
    )
    task = Task(MODEL, TRACKER, "y", ("u",), ("unit",), "t")
    made = schema_of(task, {"unit": "string", "t": "double"}, "samples")
    for each in (1000, 100, 40, 10, 1):
        rows = rows_of(ROWS // each, each).sort("unit", "t").to_arrow()
        rows = rows.cast(pa.schema([("unit", pa.string()), *((name, pa.float64()) for name in "tyu")])).combine_chunks()
        took = []
        for _ in range(3):
            begin = time.process_time()
            list(Partition(task, "samples", made).run(rows, False))
            took.append(time.process_time() - begin)
        print(f"{ROWS // each:>8} {each:>9} {1e6 * min(took) / ROWS:>11.2f} {1e6 * min(took) / (ROWS // each):>12.1f}")


def batch(session: Any, folder: Path, sizes: list[int]) -> None:
    """Rows per second of a table, and CPU per row."""
    print(f"{'':>18} {'rows per second':>35} {'us of CPU per row':>35}")
    names = f"{'floor':>11} {'track':>11} {'summary':>11}"
    print(f"{'units':>8} {'rows':>9} {names} {'floor':>9} {'track':>9} {'times':>5} {'summary':>9}")
    for units in sizes:
        path = folder / f"table{units}.parquet"
        rows_of(units, EACH).write_parquet(path, row_group_size=100_000)
        frame = session.read.parquet(str(path))
        run = lambda frame, **more: nowhere(bridge.track(frame, MODEL, TRACKER, **COLUMNS, **more))  # noqa: E731
        base = measured(lambda: nowhere(floor(frame)))  # noqa: B023
        full = measured(lambda: run(frame))  # noqa: B023
        short = measured(lambda: run(frame, outputs="summary"))  # noqa: B023
        count = units * EACH
        rates = " ".join(f"{count / one.wall:>11,.0f}" for one in (base, full, short))
        each = [1e6 * one.cpu / count for one in (base, full, short)]
        cpu = f"{each[0]:>9.2f} {each[1]:>9.2f} {each[1] / each[0]:>5.2f} {each[2]:>9.2f}"
        print(f"{units:>8} {count:>9} {rates} {cpu}", flush=True)


def obvious(session: Any, folder: Path, units: int) -> None:
    """The same of one call per unit, on a part of the smallest table."""
    frame = session.read.parquet(str(folder / f"table{units}.parquet"))
    some, count = frame.where(f"unit < 'meter {units // 5:07d}'"), units // 5 * EACH
    made = f"{SCHEMA}, a1 double, e double"
    for name, function in (("applyInPandas, track", by_track), ("applyInPandas, statsmodels", by_statsmodels)):
        took = measured(lambda: nowhere(some.groupBy("unit").applyInPandas(function, made)), 1)  # noqa: B023
        rate, cpu = f"{count / took.wall:,.0f} rows per second", f"{1e6 * took.cpu / count:.0f} us of CPU per row"
        print(f"{name:<28} {rate:>26} {cpu:>26}", flush=True)


def used() -> tuple[float, float]:
    """Seconds of CPU of Java and of the Python workers that it started."""
    parents, cpu, java = {}, {}, set()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                name, _, rest = (entry / "stat").read_text().partition("(")[2].rpartition(")")
            except OSError:  # it has ended
                continue
            fields = rest.split()
            pid, ticks = int(entry.name), sum(map(int, fields[11:15]))
            parents[pid], cpu[pid] = int(fields[1]), ticks / os.sysconf("SC_CLK_TCK")
            if name == "java":
                java.add(pid)
    own = {pid for pid in java if os.getpid() in ancestors(pid, parents)}
    workers = [pid for pid in cpu if pid not in own and own & set(ancestors(pid, parents))]
    return sum(cpu[pid] for pid in own), sum(cpu[pid] for pid in workers)


def ancestors(pid: int, parents: dict[int, int]) -> list[int]:
    found = []
    while (pid := parents.get(pid, 0)) > 1:
        found.append(pid)
    return found


def flowing(session: Any, where: Path, begin: Callable[[Any, Callable[..., None]], Any]) -> tuple[float, float, float]:
    """(seconds, seconds of CPU of Java, of Python) of the quickest batch but the first."""
    marks = [used()]
    stream = session.readStream.schema(SCHEMA).option("maxFilesPerTrigger", 1).parquet(str(where / "in"))
    query = begin(stream, lambda *_: marks.append(used()))
    query.awaitTermination()
    batches = [one["durationMs"]["triggerExecution"] / 1e3 for one in query.recentProgress if one["numInputRows"]]
    java, python = (min(b[k] - a[k] for a, b in pairwise(marks[1:])) for k in range(2))
    return min(batches[1:]), java, python


def passed_on(where: Path) -> Callable[[Any, Callable[..., None]], Any]:
    """The floor of a stream: the shuffle, the passage and the writing of as many bytes, without states and steps."""

    def begin(stream: Any, done: Callable[..., None]) -> Any:
        def batch(rows: Any, number: int) -> None:
            floor(rows).write.mode("overwrite").parquet(str(where / "floor" / f"batch={number}"))
            done()

        writer = stream.writeStream.foreachBatch(batch).option("checkpointLocation", str(where / "floor" / "check"))
        return writer.trigger(availableNow=True).start()

    return begin


def followed(path: str) -> Callable[[Any, Callable[..., None]], Any]:
    """The stream itself."""

    def begin(stream: Any, done: Callable[..., None]) -> Any:
        more: Any = {"trigger": {"availableNow": True}, **COLUMNS}
        return bridge.follow(stream, MODEL, TRACKER, path=path, sink=done, **more)

    return begin


def streams(session: Any, folder: Path, sizes: list[int], quick: bool) -> None:
    """Seconds and CPU per batch of a stream in which every unit has some rows, after the first batch."""
    files = 3 if quick else 4
    print(f"{'':>18} {'s per batch':>15} {'rows per s':>17} {'us of CPU per row':>33} {'bytes of a state':>17}")
    heads = f"{'floor':>7} {'follow':>7} {'floor':>8} {'follow':>8}"
    print(f"{'units':>8} {'rows each':>9} {heads} {'Java: floor':>11} {'follow':>6} {'Python':>6} {'follow':>6}"
          f" {'packed':>8} {'on disk':>8}")  # fmt: skip
    for units in sizes:
        for each in (20,) if quick else (1, 20):
            where = folder / f"stream{units}x{each}"
            (where / "in").mkdir(parents=True)
            for i in range(files):
                path = where / "in" / f"{i}.parquet"
                rows_of(units, each, float(i * each), i).write_parquet(path)
                os.utime(path, (1e9 + i, 1e9 + i))
            out = str(where / "out")
            base = flowing(session, where, passed_on(where))
            own = flowing(session, where, followed(out))
            state = bridge.Store(session, out).states().selectExpr("avg(octet_length(state))").first()[0]
            disk = sum(one.stat().st_size for one in Path(out).glob(f"batch={files - 1}/kind=state/*.parquet")) / units
            rows = units * each
            rates = f"{base[0]:>7.2f} {own[0]:>7.2f} {rows / base[0]:>8,.0f} {rows / own[0]:>8,.0f}"
            cpu = " ".join(f"{1e6 * one[k] / rows:>{wide}.1f}" for k, one, wide in
                           ((1, base, 11), (1, own, 6), (2, base, 6), (2, own, 6)))  # fmt: skip
            print(f"{units:>8} {each:>9} {rates} {cpu} {state:>8.0f} {disk:>8.0f}", flush=True)


def equal(session: Any, folder: Path, units: int) -> None:
    """Whether a fleet of unequal units with gaps, missing values and repeated rows has the bits of one machine."""
    rng = np.random.default_rng(5)
    length = rng.integers(1, 60, units)
    unit = np.repeat(np.arange(units), length)
    t = np.concatenate([np.cumsum(rng.choice([0.0, 1.0, 1.0, 1.0, 1.0, 3.0], size)) for size in length])
    y, u = np.where(rng.random(len(t)) < 0.03, np.nan, rng.normal(size=len(t))), rng.normal(size=len(t))
    table = pl.DataFrame({"unit": [f"meter {k:07d}" for k in unit], "t": t, "y": y, "u": u})
    table = table.sort("unit", "t", "y", "u")  # which row is used at a repeated time
    path = folder / "equal.parquet"
    table.sample(fraction=1.0, shuffle=True, seed=1).write_parquet(path)
    found = bridge.track(session.read.parquet(str(path)), MODEL, TRACKER, **COLUMNS)
    there = pl.from_arrow(found.where("failed is null").toArrow()).sort("unit", "t")
    fleet = track(MODEL, TRACKER, "y", "u", data=table, by="unit", time="t")
    here = pl.DataFrame(fleet.to_table()).sort("unit", "t")
    names = [name for name in here.columns if name.startswith(("theta", "std", "prediction", "innovation"))]
    differ = sum(not np.array_equal(there[name].to_numpy(), here[name].to_numpy(), equal_nan=True) for name in names)
    print(f"{units} units, {len(table)} rows, {len(there)} samples: {differ} of {len(names)} columns differ in any bit")


def main(quick: bool = False, part: str = "") -> None:
    sizes = [100] if quick else [1_000, 10_000, 50_000]
    session = bridge.session("local[2]", spark__ui__enabled="false", spark__driver__memory="3g",
                             spark__sql__shuffle__partitions="4")  # fmt: skip
    session.sparkContext.setLogLevel("OFF")
    if part in ("", "step"):
        step()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows_of(100, EACH).write_parquet(folder / "warm.parquet")
        nowhere(bridge.track(session.read.parquet(str(folder / "warm.parquet")), MODEL, TRACKER, **COLUMNS))
        if part in ("", "batch"):
            batch(session, folder, sizes)
            obvious(session, folder, sizes[0])
        if part in ("", "equal"):
            equal(session, folder, 500 if quick else 20_000)
        if part in ("", "streams"):
            streams(session, folder, sizes, quick)


if __name__ == "__main__":
    given = [one for one in sys.argv[1:] if not one.startswith("--")]
    main("--quick" in sys.argv, *given[:1])
    from pyspark.sql import SparkSession

    SparkSession.builder.getOrCreate().stop()
