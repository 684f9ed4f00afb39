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
import pyarrow as pa

from driftfit.bridges.spark.batch import NEW, OLD, STATE, WAITED, Flow, Known, results_of
from driftfit.bridges.spark.follow import begun, duration, flow_of
from driftfit.bridges.spark.frames import rows_of, sql_of, task_of
from driftfit.bridges.spark.units import ARROW
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
    initial: Any = None, before: Any = None,
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
    if not hasattr(GroupedData, "transformWithState"):
        raise ImportError("spark.follow_keyed needs transformWithState on rows: pip install 'pyspark>=4.1'.")
    flow = flow_of(stream, task, hold, rule, () if before is None else (before,))
    kinds, dated = flow.kinds, flow.dated
    span = None if expire is None else _ticks(duration("expire", expire, dated))
    rows = _in_micros(rows_of(stream, task, None), dated, time)
    if span is not None:
        ticks = F.floor(F.col(time) / F.lit(span)) + F.lit(2 * AHEAD)
        rows = rows.withColumn(EVENT, F.timestamp_millis(ticks)).withWatermark(EVENT, f"{AHEAD} milliseconds")
    given = None if initial is None else _in_micros(begun(initial, task), dated, "last", "newest").groupBy(*task.by)
    schema = results_of(task, kinds, flow.rules) | {time: dict(rows.dtypes)[time]}
    schema |= {} if span is None else {"state": "binary"}
    processor, mode = _processor(Unit(flow), tuple(schema), span), "None" if span is None else "EventTime"
    found = rows.groupBy(*task.by).transformWithState(processor, sql_of(schema), "Append", mode, given)
    return found.withColumn(time, F.timestamp_micros(time).cast(kinds[time])) if dated else found


def _in_micros(frame: Any, dated: bool, *names: str) -> Any:
    """A data frame whose dates of these names are microseconds, which Python and Java exchange without a time zone."""
    from pyspark.sql import functions as F  # noqa: N812

    return frame.withColumns({name: F.unix_micros(F.col(name).cast("timestamp")) for name in names * dated})


def _ticks(span: Any) -> float:
    """A tick in the unit of times, which are microseconds if they are dates; ValueError for a span of 0."""
    whole = float(span / np.timedelta64(1, "us")) if isinstance(span, np.timedelta64) else float(span)
    if not whole > 0.0:
        raise ValueError("spark.follow_keyed: expire must be above 0; leave it out to keep units for ever.")
    return whole / TICKS


class Unit:
    """One unit of a stream: its state and some rows go in, its state and results come out, by the flow of `follow`.

    A state has the columns of a state of `follow`, and what waits: a list of (time, outputs, inputs) for each row.
    Times are numbers, or microseconds.
    """

    def __init__(self, flow: Flow) -> None:
        self.flow, task = flow, flow.task
        self.dated = flow.dated
        self.row = (task.time, *task.y, *task.u)
        when = pa.timestamp("us") if self.dated else pa.float64()
        self.when = {name: when for name in (task.time, "last", "newest")}
        self.types = {name: ARROW[kind] for name, kind in flow.state.items() if name in STATE} | self.when

    @property
    def state(self) -> str:
        """The type of a state for Spark."""
        times = dict.fromkeys(("last", "newest"), "bigint" if self.dated else "double")
        return sql_of(STATE | times | {"waiting": "array<array<double>>"})

    def begun(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """A state to begin with, from a row of the states of a batch run or of another stream."""
        return {name: given.get(name) for name in (*STATE, "last", "newest")} | {"waiting": []}

    def step(
        self, state: Mapping[str, Any] | None, rows: Sequence[Sequence[Any]], expired: Any = None
    ) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """(the state after some rows (time, outputs, inputs), the results)."""
        before = [] if state is None else [state]
        waiting = [] if state is None else state["waiting"]
        every = [[None] * len(self.row) for _ in before] + [*waiting, *rows]
        kind = [OLD] * len(before) + [WAITED] * len(waiting) + [NEW] * len(rows)
        columns = dict.fromkeys(self.flow.task.by, pa.array([""] * len(every))) | {"_kind": pa.array(kind)}
        for name, values in zip(self.row, zip(*every, strict=True), strict=True):
            columns[name] = self._column(values, self.when.get(name, pa.float64()))
        for name in (*STATE, "last", "newest"):
            own = [one[name] for one in before]
            columns[name] = self._column([*own, *[None] * (len(every) - len(own))], self.types[name])
        found: dict[str, list[dict[str, Any]]] = {}
        for what, made in self.flow.parts(Known(self.flow, pa.table(columns)), expired):
            cells = zip(*map(_listed, made.values()), strict=True)
            found.setdefault(what, []).extend({"failed": None, **dict(zip(made, row, strict=True))} for row in cells)
        ((after,),) = (found[kind] for kind in ("expired", "state") if kind in found)
        waiting = [[row[name] for name in self.row] for row in found.get("waiting", [])]
        return self.begun(after) | {"waiting": waiting}, found.get("result", []) + found.get("late", [])

    def ended(self, state: Mapping[str, Any], reason: str) -> list[dict[str, Any]]:
        """The results of what waits, and a row with the reason and the last state of the unit."""
        after, results = self.step(state, [], np.datetime64(2**63 - 1, "us") if self.dated else np.inf)
        own = dict.fromkeys(self.row, np.nan) | {self.row[0]: after["last"]}
        return [*results, own | {"failed": reason, "state": after["state"]}]

    def _column(self, values: Sequence[Any], kind: pa.DataType) -> pa.Array:
        """Values as a column; waiting times in microseconds are whole numbers, which floats hold exactly."""
        if pa.types.is_timestamp(kind):
            return pa.array([None if one is None else int(one) for one in values], pa.int64()).cast(kind)
        return pa.array(values, kind)


def _listed(column: Any) -> list[Any]:
    """A column as a list; dates are microseconds."""
    if isinstance(column, pa.Array | pa.ChunkedArray):
        found = column.cast(pa.int64()) if pa.types.is_timestamp(column.type) else column
        return list(found.to_pylist())
    return list(column.tolist() if isinstance(column, np.ndarray) else column)


def _processor(unit: Unit, names: Sequence[str], span: float | None) -> Any:
    """The class that Spark calls, made here so that this module can be imported without PySpark."""
    from pyspark.sql import Row
    from pyspark.sql.streaming import StatefulProcessor

    by, columns = unit.flow.task.by, (*STATE, "last", "newest", "waiting")

    def rows_for(key: Sequence[Any], found: Sequence[dict[str, Any]]) -> Iterator[Any]:
        named = dict(zip(by, key, strict=True))
        for one in found:
            yield Row(**{name: (one | named).get(name) for name in names})

    class Processor(StatefulProcessor):
        def init(self, handle: Any) -> None:
            self.handle, self.value = handle, handle.getValueState("state", unit.state)
            self.came: set[Any] = set()

        def state(self) -> dict[str, Any] | None:
            return dict(zip(columns, self.value.get(), strict=True)) if self.value.exists() else None

        def update(self, after: Mapping[str, Any]) -> None:
            self.value.update(tuple(after[name] for name in columns))

        def handleInputRows(self, key: Any, rows: Any, timerValues: Any) -> Iterator[Any]:  # noqa: N802
            before = self.state()
            after, found = unit.step(before, [tuple(row[name] for name in unit.row) for row in rows])
            self.update(after)
            if span is not None:
                self.came.add(tuple(key))
            if before is None:
                self.set(after)
            yield from rows_for(key, found)

        def handleExpiredTimer(self, key: Any, timerValues: Any, expiredTimerInfo: Any) -> Iterator[Any]:  # noqa: N802
            before, now = self.state(), timerValues.getCurrentWatermarkInMs()
            if before is None:
                return
            if tuple(key) in self.came:
                self.set(before, now)
            elif _due(before, span or 1.0) > now:
                self.set(before)
            else:
                self.value.clear()
                yield from rows_for(key, unit.ended(before, EXPIRED))

        def handleInitialState(self, key: Any, initialState: Any, timerValues: Any) -> None:  # noqa: N802
            after = unit.begun(initialState.asDict())
            self.update(after)
            self.set(after)

        def set(self, state: Mapping[str, Any], now: int = 0) -> None:
            if span is not None:
                self.handle.registerTimer(max(_due(state, span), now + 1))

        def close(self) -> None:
            pass

    return Processor()


def _due(state: Mapping[str, Any], span: float) -> int:
    """When a unit has been silent for too long, as Spark's watermark; that of a unit without a time is soon."""
    newest = state["newest"]
    return 0 if newest is None else int(np.floor(newest / span)) + AHEAD + TICKS
