"""Streams with the keyed state of Spark (`transformWithState`): for millions of units most of which are silent.

A micro-batch touches only the units that have new rows, where the table of `follow` passes all states along; but every
unit that has rows costs a call and two passages between Java and Python, some milliseconds. Spark keeps the states,
their checkpoints and their changes (RocksDB); rows of a batch that is run again give the same results.

The state of a unit is a few numbers, its packed state and the rows that wait:

    counts, last and newest time (8 bytes each), lengths of the packed state and of that of the alarm (8 each), those
    states, rows of 8 (2 + m) bytes
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from struct import Struct
from typing import Any

import numpy as np

from driftfit.bridges.spark.batch import results_schema
from driftfit.bridges.spark.frames import rows_of, task_of
from driftfit.bridges.spark.pieces import COUNTS, LATE, REPEATED, SAMPLES, UNTIMED, USED, alarm_of, watch_of
from driftfit.bridges.spark.task import Task
from driftfit.data.known import INTERVAL
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.run.live.alarm import check_rule
from driftfit.run.live.rule import FROZEN, AlarmRule
from driftfit.run.states import late
from driftfit.trackers.base import Tracker

HEAD = Struct(f"<{len(COUNTS)}q8s8sqq")
MICROS = "M8[us]"
PLACES = {late.LATE: LATE, late.REPEATED: REPEATED, late.UNTIMED: UNTIMED}


def follow_keyed(
    stream: Any, model: Model, tracker: Tracker, *, y: str, by: str | Sequence[str], time: str,
    u: str | Sequence[str] | None = None, dt: Any = None, arrays: bool = False, hold: Any = 0,
    rule: AlarmRule | None = None,
) -> Any:  # fmt: skip
    """Follow every unit of a stream with Spark's own keyed state; PySpark 4.1 or later.

    Set ``spark.sql.streaming.stateStore.providerClass`` to Spark's RocksDBStateStoreProvider first. Arguments are those
    of `driftfit.bridges.spark.follow`, and so are the results; settings of units, initial states, expiry and migration
    need that function.

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

    from driftfit.bridges.spark.follow import duration

    task = task_of(stream, model, tracker, {"y": y, "u": u, "by": by, "time": time}, dt, None, arrays)
    if rule is not None:
        check_rule(rule)
    if not hasattr(GroupedData, "transformWithState"):
        raise ImportError("spark.follow_keyed needs transformWithState on rows: pip install 'pyspark>=4.1'.")
    rows = rows_of(stream, task, None)
    kinds = dict(rows.dtypes)
    dated = kinds[time].startswith("timestamp")
    if dated:
        rows = rows.withColumn(time, F.unix_micros(F.col(time).cast("timestamp")))
    schema = {name: kinds[name] for name in task.by} | {time: "bigint" if dated else "double"}
    schema |= dict.fromkeys((task.y, *task.u), "double") | results_schema(task)
    schema |= ({} if rule is None else {"alarm": "boolean", "cause": "string"}) | {"failed": "string"}
    made = ", ".join(f"`{name}` {kind}" for name, kind in schema.items())
    processor = _processor(Unit(task, duration("hold", hold, dated), dated, rule), tuple(schema))
    found = rows.groupBy(*task.by).transformWithState(processor, made, "Append", "None")
    return found.withColumn(time, F.timestamp_micros(time).cast(kinds[time])) if dated else found


def _processor(unit: Unit, names: Sequence[str]) -> Any:
    """The class that Spark calls, made here so that this module can be imported without PySpark."""
    from pyspark.sql import Row
    from pyspark.sql.streaming import StatefulProcessor

    class Processor(StatefulProcessor):
        def init(self, handle: Any) -> None:
            self.state = handle.getValueState("state", "state binary")

        def handleInputRows(self, key: Any, rows: Any, timer: Any) -> Iterator[Any]:  # noqa: N802
            before = bytes(self.state.get()[0]) if self.state.exists() else None
            after, results = unit.step(before, [tuple(row[name] for name in unit.task.columns) for row in rows])
            self.state.update((after,))
            for found in results:
                yield Row(**{name: found.get(name) for name in names})

        def close(self) -> None:
            pass

    return Processor()


@dataclass(frozen=True)
class Unit:
    """How one unit goes on: its state as bytes, and rows (keys, time, y, u)."""

    task: Task
    hold: Any
    dated: bool
    rule: AlarmRule | None = None

    def step(self, before: bytes | None, rows: Sequence[tuple[Any, ...]]) -> tuple[bytes, list[dict[str, Any]]]:
        """(the state after some rows, the results)."""
        task, keys = self.task, len(self.task.by)
        tile, watch, (counts, last, newest), waiting = self._known(before)
        given = np.array([[np.nan if v is None else v for v in row[keys + 1 :]] for row in rows], float)
        every = np.concatenate([waiting[1], given.reshape(len(rows), 1 + len(task.u))])
        time = np.concatenate([waiting[0], self._times([row[keys] for row in rows])])
        waited = np.arange(len(time)) < len(waiting[0])
        fates = late.sort_out(np.zeros(len(time), int), time, waited, newest, self.hold)
        named = dict(zip(task.by, rows[0][:keys], strict=True))
        going = fates.order[fates.fate == late.RELEASED]
        results, watch = (
            self._run(tile, watch, (counts, last), time[going], every[going]) if len(going) else ([], watch)
        )
        for code, place in PLACES.items():
            out = fates.order[fates.fate == code]
            counts[place] += len(out)
            results += [self._row(time[k], every[k]) | {"failed": late.REASONS[code]} for k in out.tolist()]
        staying = fates.order[fates.fate == late.WAITING]
        if len(going):
            last = time[going[-1:]]
        packed = task.program.pack(tile)
        alarm = b"" if watch is None else watch.encode()
        head = HEAD.pack(*counts.tolist(), last.tobytes(), fates.newest.tobytes(), len(packed), len(alarm))
        rest = time[staying].tobytes() + every[staying].tobytes()
        return head + packed + alarm + rest, [named | one for one in results]

    def _known(self, before: bytes | None) -> tuple[Array, str | None, tuple[Array, Array, Array], tuple[Array, Array]]:
        """(tile, alarm, (counts, last time, newest time), rows that wait) from a state."""
        program, kind = self.task.program, np.dtype(MICROS if self.dated else float)
        width = 1 + len(self.task.u)
        if before is None:
            never = np.full(1, "NaT" if self.dated else np.nan, kind)
            times = np.zeros(len(COUNTS), int), never, never
            return program.tile(), None, times, (never[:0], np.zeros((0, width)))
        *counts, last, newest, length, watch = HEAD.unpack_from(before)
        middle = HEAD.size + length
        end = middle + watch
        count = (len(before) - end) // (8 * (1 + width))
        rows = np.frombuffer(before, float, count * width, end + 8 * count).reshape(count, width)
        waiting = np.frombuffer(before, kind, count, end), rows
        tile, alarm = program.unpack(before[HEAD.size : middle]), before[middle:end].decode() or None
        return tile, alarm, (np.array(counts), np.frombuffer(last, kind), np.frombuffer(newest, kind)), waiting

    def _times(self, given: Sequence[Any]) -> Array:
        if self.dated:
            return np.array(["NaT" if t is None else t for t in given], MICROS)
        return np.array([np.nan if t is None else t for t in given], float)

    def _row(self, time: Any, values: Array) -> dict[str, Any]:
        """The signals of a row."""
        found = dict(zip((self.task.y, *self.task.u), values.tolist(), strict=True))
        stamp = None if time != time else int(time.astype(np.int64)) if self.dated else float(time)
        return {self.task.time: stamp} | found

    def _run(
        self, tile: Array, watch: str | None, so_far: tuple[Array, Array], time: Array, rows: Array
    ) -> tuple[list[dict[str, Any]], str | None]:
        """(results of samples, the alarm after them); ``so_far`` are the counts, which go on, and the last time."""
        task, T, (counts, last) = self.task, len(time), so_far
        known = np.ones((T, 3, 1))
        known[:, INTERVAL, 0] = task.clock.steps(time)
        if last[0] == last[0]:
            known[0, INTERVAL, 0] = task.clock.between(last, time[:1])[0]
        inputs = rows[:, [1 + task.u.index(name) for name in task.order]]
        run, out = task.program.loop(tile, T, "std", float, self.rule is not None and self.rule.kind in FROZEN)
        run(tile, rows[:, :1], inputs[:, :, None], known, out)
        numbers = self._numbers(out)
        if self.rule is not None:
            alarm = alarm_of(self.rule, task.program, watch, int(counts[SAMPLES]))
            numbers["cause"] = np.array(alarm.take_many(out, 0, np.ones(T)), object)
            numbers["alarm"], watch = numbers["cause"] != None, watch_of(alarm)  # noqa: E711 (elementwise)
        counts[[SAMPLES, USED]] += T, int(out["ok"].sum())
        columns = {name: values.tolist() for name, values in numbers.items()}
        found = [self._row(time[t], rows[t]) | {name: column[t] for name, column in columns.items()} for t in range(T)]
        return found, watch

    def _numbers(self, out: Array) -> dict[str, Array]:
        """The columns of results."""
        with np.errstate(invalid="ignore"):
            theta, std = out["theta"][..., 0], np.sqrt(out["var"][..., 0])
            numbers: dict[str, Array] = {"prediction": out["y_hat"][:, 0], "innovation": out["e"][:, 0]}
            numbers |= {"innovation_std": np.sqrt(out["s"][:, 0]), "ok": out["ok"][:, 0] > 0.0}
        if self.task.arrays:
            return numbers | {"theta": theta, "std": std}
        paths = (("theta", theta), ("std", std))
        return numbers | {
            f"{what}_{name}": path[:, i] for i, name in enumerate(self.task.names) for what, path in paths
        }
