"""Fleets on Spark: rows per second of batch and streams, beside the floor and beside the obvious ways.

All on local[2] in one run, with n = 4, forty rows per unit, and results written nowhere ("noop"), so that what is
measured is Spark's shuffle, the passage to Python and back, and the step:

    floor          the same shuffle and sort, and `mapInArrow` returning columns of the same bytes without a step
    spark.track    a row of results per sample
    summary        a row per unit
    applyInPandas  one `track` per unit, and statsmodels' recursive least squares per unit
    spark.follow   a stream with one or twenty rows per unit and batch: seconds per batch and state in bytes

    python -m benchmarks.spark            1,000 to 50,000 units
    python -m benchmarks.spark --quick    200 and 1,000 units
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

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


def seconds(run: Callable[[], Any], best: int = 2) -> float:
    """The shorter of some runs."""
    found = []
    for _ in range(best):
        begin = time.perf_counter()
        run()
        found.append(time.perf_counter() - begin)
    return min(found)


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
    from driftfit.bridges.spark.task import ROWS, Task

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
    """Rows per second of a table."""
    print(f"{'units':>8} {'rows':>9} {'floor':>11} {'spark.track':>12} {'times':>6} {'summary':>11}   rows per second")
    for units in sizes:
        path = folder / f"table{units}.parquet"
        rows_of(units, EACH).write_parquet(path, row_group_size=100_000)
        frame = session.read.parquet(str(path))
        run = lambda frame, **more: nowhere(bridge.track(frame, MODEL, TRACKER, **COLUMNS, **more))  # noqa: E731
        base = seconds(lambda: nowhere(floor(frame)))  # noqa: B023
        full = seconds(lambda: run(frame))  # noqa: B023
        short = seconds(lambda: run(frame, outputs="summary"))  # noqa: B023
        count = units * EACH
        rates = f"{count / base:>11,.0f} {count / full:>12,.0f} {full / base:>6.2f} {count / short:>11,.0f}"
        print(f"{units:>8} {count:>9} {rates}")


def obvious(session: Any, folder: Path, units: int) -> None:
    """Rows per second of one call per unit, on the smallest table."""
    frame = session.read.parquet(str(folder / f"table{units}.parquet"))
    some = frame.where(f"unit < 'meter {units // 5:07d}'")
    made = f"{SCHEMA}, a1 double, e double"
    for name, function in (("applyInPandas, track", by_track), ("applyInPandas, statsmodels", by_statsmodels)):
        wall = seconds(lambda: nowhere(some.groupBy("unit").applyInPandas(function, made)), 1)  # noqa: B023
        print(f"{name:<28} {units // 5 * EACH / wall:>11,.0f} rows per second")


def streams(session: Any, folder: Path, sizes: list[int]) -> None:
    """Seconds per batch of a stream in which every unit has some rows, after the first batch."""
    heads = f"{'s per batch':>12} {'rows per s':>11} {'ms per unit':>12} {'state, bytes':>13} {'on disk':>8}"
    print(f"{'units':>8} {'rows each':>9} {heads}")
    for units in sizes:
        for each in (1, 20):
            where = folder / f"stream{units}x{each}"
            (where / "in").mkdir(parents=True)
            for i in range(4):
                path = where / "in" / f"{i}.parquet"
                rows_of(units, each, float(i * each), i).write_parquet(path)
                os.utime(path, (1e9 + i, 1e9 + i))
            stream = session.readStream.schema(SCHEMA).option("maxFilesPerTrigger", 1).parquet(str(where / "in"))
            out = str(where / "out")
            query = bridge.follow(stream, MODEL, TRACKER, path=out, trigger={"availableNow": True}, **COLUMNS)
            query.awaitTermination()
            batches = [one for one in query.recentProgress if one["numInputRows"]]
            state = bridge.Store(session, out).states().selectExpr("avg(octet_length(state))").first()[0]
            disk = sum(one.stat().st_size for one in Path(out).glob("batch=3/kind=state/*.parquet")) / units
            s = min(one["durationMs"]["triggerExecution"] for one in batches[1:]) / 1e3
            rates = f"{s:>12.2f} {units * each / s:>11,.0f} {1e3 * s / units:>12.2f} {state:>13.0f} {disk:>8.0f}"
            print(f"{units:>8} {each:>9} {rates}")


def main(quick: bool = False) -> None:
    sizes = [200, 1_000] if quick else [1_000, 10_000, 50_000]
    session = bridge.session("local[2]", spark__ui__enabled="false", spark__driver__memory="3g",
                             spark__sql__shuffle__partitions="4")  # fmt: skip
    session.sparkContext.setLogLevel("OFF")
    step()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows_of(100, EACH).write_parquet(folder / "warm.parquet")
        nowhere(bridge.track(session.read.parquet(str(folder / "warm.parquet")), MODEL, TRACKER, **COLUMNS))
        batch(session, folder, sizes)
        obvious(session, folder, sizes[0])
        streams(session, folder, sizes[:1] if quick else sizes[:2])
    session.stop()


if __name__ == "__main__":
    main("--quick" in sys.argv)
