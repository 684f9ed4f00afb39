"""Streams: every unit of a stream of Spark, exactly once, with the states in a table of our own.

For every micro-batch (`foreachBatch`) the new rows meet the states after the batch before: both are brought together by
unit, run in the lanes of tiles, and written with the new states as one folder. A batch
that Spark runs again after a crash finds the same rows and the same states, and writes the same folder, or finds it
complete and leaves it as it is. The folder of a stream is

    PATH/batch=17/kind=result/*.parquet     a row per sample
                 /kind=late                 rows that came too late, twice, without a time or to a unit that cannot run,
                                            with the reason
                 /kind=failed               units that cannot run, with the reason
                 /kind=expired              states of units that were silent for too long
                 /kind=state, kind=waiting  what the next batch begins with
                 /_SUCCESS                  written last: without it the batch does not exist
    PATH/programs/0, 1, ..                  model and tracker of the states, each time that they changed
    PATH/checkpoint                         Spark's own
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from driftfit.bridges.spark.batch import NEW, OLD, STATE, WAITED, Flow, results_of, rules_of
from driftfit.bridges.spark.frames import by_unit, rows_of, sql_of, task_of
from driftfit.bridges.spark.units import SETTING, Task, trackers_of
from driftfit.data.clock import Clock
from driftfit.data.storage import describe, parts_of, rebuild
from driftfit.models.base import Model
from driftfit.readings.gate import Gate
from driftfit.run.live.rule import AlarmRule
from driftfit.trackers.base import Tracker

KINDS = ("result", "late", "failed", "expired", "state", "waiting")
"""Kinds of rows."""
NEXT = ("state", "waiting")
"""Those that the next batch reads."""


class Store:
    """The table of a stream.

    Parameters
    ----------
    spark : pyspark.sql.SparkSession
    path : str
        A folder in any file system that Spark reads and writes.
    """

    def __init__(self, spark: Any, path: str) -> None:
        self.spark, self.path = spark, path.rstrip("/")
        self._newest: dict[str, Any] | None = None
        """What `begin` noted last; reading it is a job."""

    def __repr__(self) -> str:
        return f"Store({self.path!r}): {len(self.batches())} batches"

    def _folder(self, *parts: str) -> tuple[Any, Any]:
        """(the file system, a path in it)."""
        path = self.spark._jvm.org.apache.hadoop.fs.Path("/".join([self.path, *parts]))
        return path.getFileSystem(self.spark._jsc.hadoopConfiguration()), path

    def _names(self, *parts: str) -> list[str]:
        files, path = self._folder(*parts)
        return [one.getPath().getName() for one in files.listStatus(path)] if files.exists(path) else []

    def has(self, batch: int) -> bool:
        return "_SUCCESS" in self._names(f"batch={batch}")

    def batches(self) -> list[int]:
        """The batches that are complete, in order."""
        found = [int(name.removeprefix("batch=")) for name in self._names() if name.startswith("batch=")]
        return sorted(batch for batch in found if self.has(batch))

    def write(self, table: Any, batch: int) -> None:
        """Write a batch, completely or not at all."""
        table.write.partitionBy("kind").mode("overwrite").parquet(f"{self.path}/batch={batch}")

    def read(self, *kinds: str, batches: Sequence[int] | None = None) -> Any:
        """The rows of some kinds, of all complete batches or of some, with the columns that these kinds have.

        Raises
        ------
        ValueError
            If there is no such batch, or no such kind.
        """
        from pyspark.sql import functions as F  # noqa: N812

        if wrong := [kind for kind in kinds if kind not in KINDS]:
            raise ValueError(f"Store.read: {wrong[0]!r} is none of the kinds {', '.join(KINDS)}.")
        found = self.batches() if batches is None else list(batches)
        if not found:
            raise ValueError(f"Store.read: {self.path} has no complete batch.")
        reader = self.spark.read.schema(self.schema()).option("basePath", self.path)
        rows = reader.parquet(*(f"{self.path}/batch={batch}" for batch in found))
        return rows.where(F.col("kind").isin(*kinds))

    def results(self) -> Any:
        """The results of all complete batches: a row per sample."""
        return self.read("result").select("batch", *self.schema_of("results"))

    def states(self, batch: int | None = None) -> Any:
        """The states after a batch, the last one by default: a row per unit."""
        last = self.batches()[-1] if batch is None else batch
        return self.read("state", batches=[last]).select(*self.schema_of("states"))

    def late(self) -> Any:
        """Rows that were left out, with the reason."""
        return self.read("late").select("batch", *self.schema_of("rows"), "failed")

    def forget(self, before: int) -> None:
        """Delete the states of batches before this one; their results stay."""
        for batch in self.batches():
            if batch < before:
                for kind in NEXT:
                    files, path = self._folder(f"batch={batch}", f"kind={kind}")
                    if files.exists(path):
                        files.delete(path, True)

    def begin(self, about: dict[str, Any]) -> None:
        """Note model, tracker and columns of what follows."""
        count = len([name for name in self._names("programs") if name.isdigit()])
        text = json.dumps(about, sort_keys=True)
        frame = self.spark.createDataFrame([(text,)], "value string").coalesce(1)
        frame.write.mode("overwrite").text(f"{self.path}/programs/{count}")
        self._newest = about

    def abouts(self) -> list[dict[str, Any]]:
        """What `begin` noted, the oldest first."""
        names = sorted((name for name in self._names("programs") if name.isdigit()), key=int)
        rows = [self.spark.read.text(f"{self.path}/programs/{name}", wholetext=True).first() for name in names]
        return [json.loads(row[0]) for row in rows if row is not None]

    def schema(self) -> str:
        return str(self._about()["schema"])

    def schema_of(self, what: str) -> list[str]:
        """The columns that "results", "states" or "rows" have."""
        return list(self._about()[what])

    def _about(self) -> dict[str, Any]:
        if self._newest is None:
            found = self.abouts()
            if not found:
                raise ValueError(f"{self.path} is not the table of a stream: driftfit.bridges.spark.follow makes one.")
            self._newest = found[-1]
        return self._newest


def follow(
    stream: Any, model: Model, tracker: Tracker | Mapping[str, Tracker], *, path: str, y: str | Sequence[str],
    by: str | Sequence[str], time: str, u: str | Sequence[str] | None = None, dt: Any = None, settings: Any = None,
    arrays: bool = False, gate: Any = None, hold: Any = 0, rule: AlarmRule | Mapping[str, AlarmRule] | None = None,
    expire: Any = None, initial: Any = None, migrate: bool = False, sink: Any = None,
    trigger: Mapping[str, Any] | None = None,
) -> Any:  # fmt: skip
    """Follow every unit of a stream of Spark.

    Parameters
    ----------
    stream : pyspark.sql.DataFrame
        A streaming data frame; one row per sample.
    model, tracker, y, u, by, time, dt, settings, arrays, gate
        As for `driftfit.bridges.spark.track`. Rows of a unit whose settings cannot run in a batch are kept with the
        reason (`Store.late`), and its state stays as it is.
    path : str
        The folder of the results, the states and the checkpoint (`Store`).
    hold : number or duration
        How far behind the newest time of its unit a row may come: samples wait for so long, and go on in the order of
        their times. Rows that are later, at a repeated time, or without a time are counted and kept (`Store.late`).
    rule : AlarmRule, mapping from outputs to rules, or None
        The rule of a reference run, ``run.detect(...).rule``: gives the columns ``alarm`` and ``cause``; of several
        outputs each may have a rule, under its name.
    expire : number, duration or None
        Units without a row in a batch whose newest time is so far behind the newest of all before that batch end with
        it: samples that wait are processed, and the states are kept with the kind "expired". Rows that come later begin
        the unit again.
    initial : pyspark.sql.DataFrame or None
        States to begin with: ``track(..., outputs="states")``, or those of another stream, ``Store.states()``.
    migrate : bool
        Go on from states that another tracker's settings made: what depends on settings takes its new value, all else
        is carried over.
    sink : callable or None
        ``sink(results, batch)`` is called after a batch is written, and may be called again for the same batch after a
        crash: it must be idempotent, as a MERGE by unit and time, or a write that replaces the batch.
    trigger : mapping or None
        As for ``DataStreamWriter.trigger``: ``{"availableNow": True}``, ``{"processingTime": "1 minute"}``.

    Returns
    -------
    pyspark.sql.streaming.StreamingQuery

    Raises
    ------
    ValueError
        For what cannot run, and for a path whose states were made by another model or other settings.
    ImportError
        If PySpark or Java is missing.
    """
    columns = {"y": y, "u": u, "by": by, "time": time}
    flow = flow_of(stream, task_of(stream, model, tracker, columns, dt, settings, arrays, gate), hold, rule)
    store = Store(stream.sparkSession, path)
    flow = replace(flow, origins=_origins(store, flow, migrate))
    run = _Batches(store, flow, settings, initial, duration("expire", expire, flow.dated), sink)
    writer = stream.writeStream.foreachBatch(run).option("checkpointLocation", f"{store.path}/checkpoint")
    return writer.trigger(**(trigger or {"processingTime": "0 seconds"})).start()


def flow_of(stream: Any, task: Task, hold: Any, rule: Any, origins: tuple[Any, ...] = ()) -> Flow:
    """The flow of a stream."""
    flow = Flow(task, dict(rows_of(stream, task, None).dtypes), None, rules_of(task, rule), origins)
    return replace(flow, hold=duration("hold", hold or 0, flow.dated))


def duration(name: str, value: Any, dated: bool) -> Any:
    """A span of time in the type of times; None for None."""
    if value is None:
        return None
    span = value if isinstance(value, int | float) and not dated else Clock.of(value).duration if value else 0
    none = np.timedelta64(0, "us") if dated else 0
    if dated and not value:
        return none
    if span is None or not span >= none or (dated and isinstance(span, int | float)):
        raise ValueError(
            f"spark.follow: {name} must be {'a duration, such as 10min' if dated else 'a number'}, not negative; "
            f"got {value!r}."
        )
    return span


def _origins(store: Store, flow: Flow, migrate: bool) -> tuple[Any, ...]:
    """The trackers that made the states so far, the newest first; notes what is followed from now on.

    Those before the newest count too: a batch that was cut off before it was complete has not carried states over.
    """
    task = flow.task
    joint = task.joint_for(None)
    text = "" if isinstance(joint, str) else joint.programs[0].layout.text
    about: dict[str, Any] = {"model": describe(task.model), "fields": text}
    about |= {"tracker": [describe(one) for one in trackers_of(task.tracker)]}
    about |= {"gate": task.gate.settings() if isinstance(task.gate, Gate) else task.gate}
    about |= {"schema": sql_of({"batch": "int", **flow.schema})}
    about |= {"results": [name for name in results_of(task, flow.kinds, flow.rules) if name != "failed"]}
    about |= {"rows": list(task.columns), "states": [*task.by, *flow.state]}
    found = store.abouts()
    if not found:
        store.begin(about)
        return ()
    last, made = found[-1], f"spark.follow: the states in {store.path} were made"
    if last["model"] != about["model"]:
        followed = rebuild(last["model"], Model, parts_of(task.model))
        raise ValueError(f"{made} with {followed!r}, not with {task.model!r}; begin in another folder.")
    if last.get("gate", "older") != about["gate"]:
        raise ValueError(
            f"{made} with another gate, and a gate must know all readings from the first on; give gate= as it was, or "
            "begin in another folder with the whole stream."
        )
    if len({last["fields"], about["fields"]} - {""}) > 1:
        raise ValueError(f"{made} by another version, whose states have other fields; begin in another folder.")
    origins = tuple(_origin(task, one["tracker"]) for one in reversed(found))
    if not migrate and origins[0] != task.tracker:
        raise ValueError(
            f"{made} with {origins[0]!r}, not with {task.tracker!r}: give migrate=True to carry them over, or begin in "
            "another folder."
        )
    if last != about:
        store.begin(about)
    return origins


def _origin(task: Task, described: Sequence[Any]) -> Any:
    """The tracker that made states, or that of each output, from what was noted of it."""
    own = tuple(parts_of(trackers_of(task.tracker)))
    trackers: list[Tracker] = [rebuild(one, Tracker, own) for one in described]
    return dict(zip(task.y, trackers, strict=True)) if len(trackers) > 1 else trackers[0]


class _Batches:
    """What Spark calls with every micro-batch."""

    def __init__(self, store: Store, flow: Flow, settings: Any, initial: Any, expire: Any, sink: Any) -> None:
        self.store, self.flow, self.settings, self.initial = store, flow, settings, initial
        self.expire, self.sink = expire, sink

    def __call__(self, rows: Any, batch: int) -> None:
        store = self.store
        if not store.has(batch):
            done = [one for one in store.batches() if one < batch]
            store.write(self._table(rows, done[-1] if done else None), batch)
            # two are kept: the state of the previous batch is needed if this one is lost
            if done:
                store.forget(done[-1])
        if self.sink is not None:
            self.sink(store.read("result", batches=[batch]).select("batch", *store.schema_of("results")), batch)

    def _table(self, rows: Any, before: int | None) -> Any:
        """The table of a batch, which begins with the states after another one."""
        from pyspark.sql import functions as F  # noqa: N812

        flow, task, expired = self.flow, self.flow.task, None
        new = rows_of(rows, task, self.settings).withColumn("_kind", F.lit(NEW))
        parts = [new]
        if before is not None:
            kept = self.store.read(*NEXT, batches=[before])
            which = F.when(F.col("kind") == "state", F.lit(OLD)).otherwise(F.lit(WAITED))
            parts.append(kept.withColumn("_kind", which).select(*task.columns, *flow.state, "_kind"))
            newest = None if self.expire is None else kept.agg({"newest": "max"}).first()[0]
            if newest is not None:  # units whose newest time is before this have been silent for too long
                expired = (newest if isinstance(newest, float) else np.datetime64(newest, "us")) - self.expire
        elif self.initial is not None:
            parts.append(begun(self.initial, task).withColumn("_kind", F.lit(OLD)))
        every = parts[0]
        for part in parts[1:]:
            every = every.unionByName(part, allowMissingColumns=True)
        for name, kind in flow.state.items():
            if name not in every.columns:
                every = every.withColumn(name, F.lit(None).cast(kind))
        own = [SETTING + name for name in task.settings]
        every = every.select(*task.columns, *flow.state, *own, "_kind")
        return by_unit(every, task, partial(flow.work, expired=expired), flow.schema, ["_kind"])


def begun(initial: Any, task: Task) -> Any:
    """States to begin with, from a batch run or from another stream."""
    from pyspark.sql import functions as F  # noqa: N812

    if "failed" in initial.columns:
        initial = initial.where("failed is null")
    if "newest" not in initial.columns:
        initial = initial.withColumn("last", F.col(task.time)).withColumn("newest", F.col(task.time))
    names = [name for name in STATE if name in initial.columns]
    return initial.select(*task.by, *names, "last", "newest")
