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

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from struct import Struct
from typing import Any

import numpy as np
import pyarrow as pa

from driftfit.bridges.spark.flow import NEW, OLD, WAITED, Flow, Known, Origin
from driftfit.bridges.spark.follow import begun, duration, schema_of
from driftfit.bridges.spark.frames import rows_of, task_of
from driftfit.bridges.spark.pieces import ARROW, COUNTS, STATE, rules_of
from driftfit.bridges.spark.task import Task
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
HEAD = Struct(f"<{len(COUNTS)}q8s8sqq")
"""What a state begins with."""


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
    joint = task.joint_of(None, tracker)
    origins = () if before is None else (Origin(before, joint.text),)
    unit = Unit(Flow(task, schema_of(task, kinds, rules), duration("hold", hold, dated), rules, origins), dated)
    schema = _schema(unit, span is not None)
    if span is not None:
        ticks = F.floor(F.col(time) / F.lit(span)) + F.lit(2 * AHEAD)
        rows = rows.withColumn(EVENT, F.timestamp_millis(ticks)).withWatermark(EVENT, f"{AHEAD} milliseconds")
    made = ", ".join(f"`{name}` {kind}" for name, kind in schema.items())
    given = None if initial is None else _begun(initial, task, dated).groupBy(*task.by)
    processor = _processor(unit, tuple(schema), span)
    mode = "None" if span is None else "EventTime"
    found = rows.groupBy(*task.by).transformWithState(processor, made, "Append", mode, given)
    return found.withColumn(time, F.timestamp_micros(time).cast(kinds[time])) if dated else found


def _ticks(span: Any) -> float:
    """A tick in the unit of times, which are microseconds if they are dates; ValueError for a span of 0."""
    whole = float(span / np.timedelta64(1, "us")) if isinstance(span, np.timedelta64) else float(span)
    if not whole > 0.0:
        raise ValueError("spark.follow_keyed: expire must be above 0; leave it out to keep units for ever.")
    return whole / TICKS


def _schema(unit: Unit, expires: bool) -> dict[str, str]:
    """Columns and types of the results; dates are microseconds, as Spark's state keeps no others."""
    task, schema = unit.flow.task, unit.flow.schema
    own = {name: kind for name, kind in schema.items() if name not in ("kind", *STATE, "last", "newest")}
    return own | {task.time: "bigint" if unit.dated else "double"} | ({"state": "binary"} if expires else {})


def _begun(initial: Any, task: Task, dated: bool) -> Any:
    """States to begin with, from a batch run or from another stream."""
    from pyspark.sql import functions as F  # noqa: N812

    found = begun(initial, task)
    for name in ("last", "newest") if dated else ():
        found = found.withColumn(name, F.unix_micros(F.col(name).cast("timestamp")))
    return found if "watch" in found.columns else found.withColumn("watch", F.lit(None).cast("string"))


def _processor(unit: Unit, names: Sequence[str], span: float | None) -> Any:
    """The class that Spark calls, made here so that this module can be imported without PySpark."""
    from pyspark.sql import Row
    from pyspark.sql.streaming import StatefulProcessor

    by = unit.flow.task.by

    def rows_for(key: Sequence[Any], found: Sequence[dict[str, Any]]) -> Iterator[Any]:
        named = dict(zip(by, key, strict=True))
        for one in found:
            yield Row(**{name: (named | one).get(name) for name in names})

    class Processor(StatefulProcessor):
        def init(self, handle: Any) -> None:
            self.handle, self.state = handle, handle.getValueState("state", "state binary")
            self.came: set[Any] = set()

        def handleInputRows(self, key: Any, rows: Any, timerValues: Any) -> Iterator[Any]:  # noqa: N802
            before = bytes(self.state.get()[0]) if self.state.exists() else None
            after, found = unit.step(before, [tuple(row[name] for name in unit.names) for row in rows])
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


@dataclass(frozen=True)
class Unit:
    """One unit, run by the flow of `follow`: its state as bytes and rows go in, its state and results come out.

    Times are numbers, or microseconds if they are ``dated``. A state is what the table of `follow` has of a unit:
    counts, last and newest time (8 bytes each), lengths of the packed state and of that of the alarms (8 each), those
    states, rows that wait of 8 (1 + ny + m) bytes.
    """

    flow: Flow
    dated: bool

    @property
    def names(self) -> tuple[str, ...]:
        """The columns of a row: time, outputs, inputs."""
        task = self.flow.task
        return task.columns[len(task.by) :]

    def step(self, state: bytes | None, rows: Sequence[tuple[Any, ...]]) -> tuple[bytes, list[dict[str, Any]]]:
        """(the state after some rows (time, y, u), the results)."""
        before = [] if state is None else self._unpacked(state)
        found = self._run(self.flow, [*before, *self._named(NEW, rows)])
        (after,) = found["state"]
        return self._packed(after, found.get("waiting", [])), found.get("result", []) + found.get("late", [])

    def ended(self, state: bytes, reason: str) -> list[dict[str, Any]]:
        """The results of what waits, and a row with the reason and the last state of the unit."""
        never = np.datetime64(2**63 - 1, "us") if self.dated else np.inf
        found = self._run(replace(self.flow, expired=never), self._unpacked(state))
        (after,) = found.get("expired") or found["state"]
        signals = dict.fromkeys(self.names, np.nan) | {self.names[0]: after["last"]}
        return [*found.get("result", []), signals | {"failed": reason, "state": after["state"]}]

    def begun(self, given: Mapping[str, Any]) -> bytes:
        """A state to begin with, from a packed state, that of alarms, the last and newest time, and counts by name."""
        return self._packed(given, [])

    def newest(self, state: bytes) -> float | None:
        """The newest time of a row; None if there is none."""
        found = self._time(HEAD.unpack_from(state)[len(COUNTS) + 1])
        return None if found is None else float(found)

    def _run(self, flow: Flow, rows: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
        """What comes out, by kind; dates are microseconds."""
        when = {name: pa.timestamp("us") if self.dated else pa.float64() for name in (self.names[0], "last", "newest")}
        types = dict.fromkeys(flow.task.by, pa.string()) | dict.fromkeys(self.names, pa.float64())
        types |= {name: ARROW[kind] for name, kind in STATE.items()} | when | {"_kind": pa.int32()}
        unit, found = dict.fromkeys(flow.task.by, ""), dict[str, list[dict[str, Any]]]()
        known = Known.of(flow, pa.Table.from_pylist([unit | row for row in rows], pa.schema(types)))
        for table in flow.tables(known):
            for name in when if self.dated else ():
                place = table.schema.get_field_index(name)
                table = table.set_column(place, name, table.column(name).cast(pa.int64()))
            for row in table.drop_columns(list(unit)).to_pylist():
                found.setdefault(row.pop("kind"), []).append(row)
        return found

    def _named(self, kind: int, rows: Iterable[Sequence[Any]]) -> list[dict[str, Any]]:
        return [dict(zip(self.names, row, strict=True), _kind=kind) for row in rows]

    def _packed(self, after: Mapping[str, Any], waiting: Sequence[Mapping[str, Any]]) -> bytes:
        state, alarms = bytes(after["state"]), (after["watch"] or "").encode()
        stamps = (self._bytes([after["last"]]), self._bytes([after["newest"]]))
        head = HEAD.pack(*(after[name] or 0 for name in COUNTS), *stamps, len(state), len(alarms))
        rows = np.array([[row[name] for name in self.names[1:]] for row in waiting], float)
        return head + state + alarms + self._bytes([row[self.names[0]] for row in waiting]) + rows.tobytes()

    def _unpacked(self, state: bytes) -> list[dict[str, Any]]:
        *counts, last, newest, length, alarms = HEAD.unpack_from(state)
        middle = HEAD.size + length
        end, width = middle + alarms, len(self.names)
        count = (len(state) - end) // (8 * width)
        rows = np.frombuffer(state, float, count * (width - 1), end + 8 * count).reshape(count, width - 1)
        times = [self._time(state[end + 8 * k : end + 8 * k + 8]) for k in range(count)]
        before = dict(
            zip(COUNTS, counts, strict=True), state=state[HEAD.size : middle], watch=state[middle:end].decode()
        )
        before |= {"last": self._time(last), "newest": self._time(newest), "_kind": OLD}
        return [before, *self._named(WAITED, ((time, *row) for time, row in zip(times, rows.tolist(), strict=True)))]

    def _bytes(self, times: Sequence[Any]) -> bytes:
        if self.dated:
            return np.array(["NaT" if one is None else one for one in times], "M8[us]").tobytes()
        return np.array([np.nan if one is None else one for one in times], float).tobytes()

    def _time(self, stamp: bytes) -> Any:
        """A number or whole microseconds; None if there is none."""
        (found,) = np.frombuffer(stamp, "M8[us]" if self.dated else float)
        return None if found != found else found.astype(np.int64 if self.dated else float).item()
