"""Streams with the keyed state of Spark (`transformWithState`): for millions of units most of which are silent.

A micro-batch touches only the units that have new rows, where the table of `follow` passes all states along; but every
unit that has rows costs a call and two passages between Java and Python, some milliseconds. Spark keeps the states,
their checkpoints and their changes (RocksDB); rows of a batch that is run again give the same results.

Units that are silent end by a timer of event time. Spark's watermark is the newest of all times in ticks of a
ten-thousandth of ``expire``; the column that it watches is ahead of it by `AHEAD`, so that Spark drops no row as late
(`driftfit.data.late` decides that, unit by unit). A unit has one timer: when it fires and rows have come
since, it is set again.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from driftfit.bridges.spark.follow import duration
from driftfit.bridges.spark.frames import rows_of, task_of
from driftfit.bridges.spark.pieces import COUNTS, alarms_schema, rules_of
from driftfit.bridges.spark.task import Task, results_schema
from driftfit.bridges.spark.unit import Unit
from driftfit.models.base import Model
from driftfit.run.live.rule import AlarmRule
from driftfit.trackers.base import Tracker

EXPIRED = "silent for too long"
"""The reason in the row of a unit that has ended."""
TICKS = 10_000
"""Ticks of ``expire``; a tick is a millisecond for Spark."""
AHEAD = 1_000_000_000 * TICKS
"""Ticks of which the watched column is ahead: rows later than this would be dropped."""
EVENT = "_event"
"""The column that Spark's watermark watches."""


def follow_keyed(
    stream: Any, model: Model, tracker: Tracker | Mapping[str, Tracker], *, y: str | Sequence[str],
    by: str | Sequence[str], time: str, u: str | Sequence[str] | None = None, dt: Any = None, arrays: bool = False,
    gate: Any = None, hold: Any = 0, rule: AlarmRule | Mapping[str, AlarmRule] | None = None, expire: Any = None,
    initial: Any = None,
    before: Any = None,
) -> Any:  # fmt: skip
    """Follow every unit of a stream with Spark's own keyed state; PySpark 4.1 or later.

    Set ``spark.sql.streaming.stateStore.providerClass`` to Spark's RocksDBStateStoreProvider first. Arguments are those
    of `driftfit.bridges.spark.follow`, and so are the results; settings of units need that function.

    Parameters
    ----------
    expire : number, duration or None
        As for `follow`, to a ten-thousandth of it. A unit that ends gives a row whose ``failed`` is "silent for too
        long", with its state in the column ``state``.
    initial : pyspark.sql.DataFrame or None
        As for `follow`; Spark reads it in the first batch only.
    before : Tracker, mapping from outputs to trackers, or None
        The tracker that made the states in the checkpoint, where it was another one: what depends on settings takes its
        new value, all else is carried over, as soon as a unit has a row.

    Returns
    -------
    pyspark.sql.DataFrame
        A stream of results, a row per sample, and of rows that were left out, whose column ``failed`` has the reason.
        Write it with a sink that takes a batch once.

    Raises
    ------
    ValueError
        For what cannot run.
    ImportError
        If PySpark or Java is missing or too old.
    """
    from pyspark.sql import functions as F  # noqa: N812
    from pyspark.sql.group import GroupedData

    task = task_of(stream, model, tracker, {"y": y, "u": u, "by": by, "time": time}, dt, None, arrays, gate)
    rules = rules_of(task, rule)
    if not hasattr(GroupedData, "transformWithState"):
        raise ImportError("spark.follow_keyed needs transformWithState on rows: pip install 'pyspark>=4.1'.")
    rows = rows_of(stream, task, None)
    kinds = dict(rows.dtypes)
    dated = kinds[time].startswith("timestamp")
    span = None if expire is None else _ticks(duration("expire", expire, dated))
    if dated:
        rows = rows.withColumn(time, F.unix_micros(F.col(time).cast("timestamp")))
    unit = Unit(task, duration("hold", hold, dated), dated, rules, before)
    schema = _schema(task, kinds, unit, span is not None)
    if span is not None:
        ticks = F.floor(F.col(time) / F.lit(span)) + F.lit(2 * AHEAD)
        rows = rows.withColumn(EVENT, F.timestamp_millis(ticks)).withWatermark(EVENT, f"{AHEAD} milliseconds")
    made = ", ".join(f"`{name}` {kind}" for name, kind in schema.items())
    begun = None if initial is None else _begun(initial, task, dated).groupBy(*task.by)
    processor = _processor(unit, tuple(schema), span)
    mode = "None" if span is None else "EventTime"
    found = rows.groupBy(*task.by).transformWithState(processor, made, "Append", mode, begun)
    return found.withColumn(time, F.timestamp_micros(time).cast(kinds[time])) if dated else found


def _ticks(span: Any) -> float:
    """A tick in the unit of times, which are microseconds if they are dates; ValueError for a span of 0."""
    whole = float(span / np.timedelta64(1, "us")) if isinstance(span, np.timedelta64) else float(span)
    if not whole > 0.0:
        raise ValueError("spark.follow_keyed: expire must be above 0; leave it out to keep units for ever.")
    return whole / TICKS


def _schema(task: Task, kinds: Mapping[str, str], unit: Unit, expires: bool) -> dict[str, str]:
    """Columns and types of the results."""
    schema = {name: kinds[name] for name in task.by} | {task.time: "bigint" if unit.dated else "double"}
    schema |= dict.fromkeys((*task.y, *task.u), "double") | results_schema(task)
    return schema | alarms_schema(task, unit.rules) | {"failed": "string"} | ({"state": "binary"} if expires else {})


def _begun(initial: Any, task: Task, dated: bool) -> Any:
    """States to begin with, from a batch run or from another stream."""
    from pyspark.sql import functions as F  # noqa: N812

    if "failed" in initial.columns:
        initial = initial.where("failed is null")
    last, newest = ("last", "newest") if "newest" in initial.columns else (task.time, task.time)
    when = (F.unix_micros(F.col(name).cast("timestamp")) if dated else F.col(name) for name in (last, newest))
    last, newest = (one.alias(name) for one, name in zip(when, ("last", "newest"), strict=True))
    watch = F.col("watch") if "watch" in initial.columns else F.lit(None).cast("string")
    return initial.select(*task.by, "state", watch.alias("watch"), *COUNTS, last, newest)


def _processor(unit: Unit, names: Sequence[str], span: float | None) -> Any:
    """The class that Spark calls, made here so that this module can be imported without PySpark."""
    from pyspark.sql import Row
    from pyspark.sql.streaming import StatefulProcessor

    columns, keys = unit.task.columns, len(unit.task.by)

    def rows_for(key: Sequence[Any], found: Sequence[dict[str, Any]]) -> Iterator[Any]:
        named = dict(zip(unit.task.by, key, strict=True))
        for one in found:
            yield Row(**{name: (named | one).get(name) for name in names})

    class Processor(StatefulProcessor):
        def init(self, handle: Any) -> None:
            self.handle, self.state = handle, handle.getValueState("state", "state binary")
            self.came: set[Any] = set()

        def handleInputRows(self, key: Any, rows: Any, timerValues: Any) -> Iterator[Any]:  # noqa: N802
            before = bytes(self.state.get()[0]) if self.state.exists() else None
            after, found = unit.step(before, [tuple(row[name] for name in columns)[keys:] for row in rows])
            self.state.update((after,))
            if span is not None:
                self.came.add(tuple(key))
                if before is None:
                    self.set(after)
            yield from rows_for(key, found)

        def handleExpiredTimer(self, key: Any, timerValues: Any, expiredTimerInfo: Any) -> Iterator[Any]:  # noqa: N802
            if not self.state.exists():
                return
            before, now = bytes(self.state.get()[0]), timerValues.getCurrentWatermarkInMs()
            if tuple(key) in self.came:
                self.set(before, now)
            elif due(before) > now:
                self.set(before)
            else:
                self.state.clear()
                yield from rows_for(key, unit.ended(before, EXPIRED))

        def handleInitialState(self, key: Any, initialState: Any, timerValues: Any) -> None:  # noqa: N802
            after = unit.begun(initialState.asDict())
            self.state.update((after,))
            if span is not None:
                self.set(after)

        def set(self, state: bytes, now: int = 0) -> None:
            self.handle.registerTimer(max(due(state), now + 1))

        def close(self) -> None:
            pass

    def due(state: bytes) -> int:
        """When a unit has been silent for too long, as Spark's watermark; that of a unit without a time is soon."""
        newest = unit.newest(state)
        return 0 if newest is None else int(np.floor(newest / (span or 1.0))) + AHEAD + TICKS

    return Processor()
