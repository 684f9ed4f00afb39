"""What runs in a worker: tables of many units, each with the bits of `driftfit.track`, and the batches of streams.

`repartition` brings the rows of a unit together, `sortWithinPartitions` puts them in order, and every partition is read
once (`mapInArrow`), in pieces of 64,000 rows that end where a unit ends, whose units run in the lanes of tiles. A unit
with more rows is run in parts, so memory does not depend on its length.

Of a stream, states and rows of some units go in; results, states and late rows come out.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa

from driftfit.bridges.spark.frames import by_unit, rows_of, task_of
from driftfit.bridges.spark.units import (
    ARROW,
    COUNTS,
    JUDGED,
    PLACES,
    SAMPLES,
    SQUARES,
    STANDARD,
    Done,
    Task,
    Units,
    by_output,
    chunks,
    numbers,
    parameters,
    parameters_schema,
    results,
    results_schema,
    times,
)
from driftfit.data import late
from driftfit.data.storage import describe
from driftfit.engine.kernel import Array
from driftfit.engine.settings import one_of
from driftfit.judge.fleet_verdict import COLUMNS, Judgement, coverage
from driftfit.judge.verdict import verdict
from driftfit.models.base import Model
from driftfit.run.fleet import Outputs
from driftfit.run.layout import tag_of
from driftfit.run.live.alarm import LiveAlarm, check_rule
from driftfit.run.live.rule import AlarmRule
from driftfit.run.program import state_of
from driftfit.run.result import Track, burn_in
from driftfit.run.warm_start import End, JointLayout, carried
from driftfit.trackers.base import Tracker

OLD, WAITED, NEW = range(3)
"""Values of the column ``_kind``: a state, a row that waits, a row that has come."""
REFUSED = -1
"""The fate of a row of a unit that cannot run, besides those of `driftfit.data.late`."""
STATE = {"state": "binary", "settings": "string", **dict.fromkeys(COUNTS, "bigint"), "watch": "string"}
"""Columns of states, after those of their unit and before their times, ``last`` and ``newest``."""


def results_of(task: Task, kinds: Mapping[str, str], rules: Sequence[AlarmRule | None]) -> dict[str, str]:
    """Columns and types of the results, and of rows that are left out; ``kinds`` are the types of the rows."""
    own = {name: kinds[name] for name in task.columns} | results_schema(task) | alarms_schema(task, rules)
    return own | {"failed": "string"}


@dataclass(frozen=True)
class Flow:
    """The settings of a stream that a worker receives in addition to its task.

    ``kinds`` are the types of the rows, ``rules`` has the rule of each output. ``origins`` are the trackers that made
    states before.
    """

    task: Task
    kinds: Mapping[str, str]
    hold: Any
    rules: tuple[AlarmRule | None, ...]
    origins: tuple[Any, ...] = ()

    @property
    def dated(self) -> bool:
        """Whether times are dates."""
        return self.kinds[self.task.time].startswith("timestamp")

    @cached_property
    def state(self) -> dict[str, str]:
        """Columns and types of a state, without those of its unit."""
        return STATE | dict.fromkeys(("last", "newest"), self.kinds[self.task.time])

    @cached_property
    def schema(self) -> dict[str, str]:
        """Columns and types of all that comes out."""
        return {"kind": "string", **results_of(self.task, self.kinds, self.rules), **self.state}

    def work(self, batches: Iterator[pa.RecordBatch], expired: Any = None) -> Iterator[pa.RecordBatch]:
        """What a partition runs; units whose newest time is before ``expired`` end."""
        for table, _ in chunks(batches, self.task.by, parts=False):
            known = Known(self, table)
            for kind, columns in self.parts(known, expired):
                kinds = pa.array([kind] * len(next(iter(columns.values()))))
                yield from known.filled(columns | {"kind": kinds}, self.schema).to_batches()

    def parts(self, known: Known, expired: Any = None) -> Iterator[tuple[str, dict[str, Any]]]:
        """All that comes out: the kind of some rows, and their columns that are not null; the given rows are in the
        order of unit and kind.
        """
        rows = np.flatnonzero(known.kind != OLD)
        waited = known.kind[rows] == WAITED
        fates = late.sort_out(known.code[rows], known.time[rows], waited, known.newest, self.hold)
        order, good = rows[fates.order], known.good
        known.newest[good] = fates.newest[good]
        silent = known.silent(expired)
        over, stays = silent[known.code[order]], known.kind[order] == WAITED
        # a unit that cannot run stays as it is: what waits continues to wait, and the rest is refused
        other = np.where(stays & ~over, late.WAITING, REFUSED)
        fate = np.where(good[known.code[order]], late.ended(fates.fate, over), other)
        earlier = known.counts[:, SAMPLES].copy()
        frozen = any(one is not None and one.kind == "glr" for one in self.rules)  # needs what the tracker receives
        done = known.run(order[fate == late.RELEASED], frozen)
        if done is not None:
            alarms = self._watched(known, done, earlier) if any(self.rules) else {}
            own = known.taken(self.task.columns, done.rows)
            yield "result", own | results(self.task, done.found) | alarms
        known.count(fate, order)
        yield from self._left_out(known, order, fate)
        yield from self._states(known, good | (known.kind[known.first] == OLD), silent)
        if (bad := np.flatnonzero(~good)).size:
            reasons = {"failed": [known.reason(k) for k in bad.tolist()]}
            yield "failed", known.taken(self.task.by, known.first[bad]) | reasons

    def _watched(self, known: Known, done: Done, earlier: Array) -> dict[str, Any]:
        """The alarms at every sample, as `LiveAlarm` gives them."""
        schema, records, ny = alarms_schema(self.task, self.rules), done.found.records, len(self.task.y)
        columns: dict[str, list[Any]] = {name: [] for name in schema}
        for j, k in enumerate(done.keys):
            lanes = done.found.lanes.part(range(j * ny, (j + 1) * ny))
            y = records.y[records.first[j] : records.first[j] + records.length[j]].reshape(-1, ny)
            before, found = json.loads(known.watch[k] or "[]") or [None] * ny, iter(schema)
            after: list[Any] = [None] * ny
            for i, (rule, program, lane) in enumerate(zip(self.rules, known.joint(k).programs, lanes, strict=True)):
                if rule is None:
                    continue
                if before[i] is None:  # it begins to watch after as many samples as in `Live`
                    first = max(burn_in(program.model.n) - int(earlier[k]), 0)
                    alarm = LiveAlarm(rule, program.tracker, program.names, first)
                else:
                    alarm = LiveAlarm.of(before[i] | {"rule": describe(rule)}, program.tracker, program.names)
                causes = alarm.take_many(lane.out, lane.lane, y[:, i], np.ones(len(y)))
                alarm.onsets()
                after[i] = {name: value for name, value in alarm.plain().items() if name != "rule"}
                columns[next(found)] += [cause is not None for cause in causes]
                columns[next(found)] += causes
            known.watch[k] = json.dumps(after)
        return {name: pa.array(columns[name], ARROW[kind]) for name, kind in schema.items()}

    def _left_out(self, known: Known, order: Array, fate: Array) -> Iterator[tuple[str, dict[str, Any]]]:
        """Rows that wait, and rows that are left out."""
        for code in (late.WAITING, *PLACES, REFUSED):
            which = order[fate == code]
            if which.size:
                own = known.taken(self.task.columns, which)
                if code == late.WAITING:
                    yield "waiting", own
                    continue
                refused = (known.reason(k) for k in known.code[which].tolist())
                reasons = list(refused) if code == REFUSED else [late.REASONS[code]] * len(which)
                yield "late", own | {"failed": reasons}

    def _states(self, known: Known, kept: Array, silent: Array) -> Iterator[tuple[str, dict[str, Any]]]:
        """The states of units, those that go on and those that have been silent for too long."""
        for kind, which in (("state", np.flatnonzero(kept & ~silent)), ("expired", np.flatnonzero(kept & silent))):
            if which.size:
                units = which.tolist()
                own = known.taken(self.task.by, known.first[which]) | known.counted(units)
                own["state"] = [known.state(k) for k in units]
                own |= {"settings": [known.settings[k] for k in units], "watch": [known.watch[k] for k in units]}
                own |= {"last": known.instants(known.last[which]), "newest": known.instants(known.newest[which])}
                yield kind, own


class Known(Units):
    """Units whose first row is their state, if they have one, after which come the rows that wait and that are new."""

    def __init__(self, flow: Flow, table: pa.Table) -> None:
        super().__init__(flow.task, table)
        self.kind = numbers(table.column("_kind")).astype(int)
        heads = table.take(pa.array(self.first))
        counts = np.stack([numbers(heads.column(name)) for name in COUNTS], axis=1)
        self.counts = np.nan_to_num(counts).astype(np.int64)
        self.last, self.newest = (times(heads.column(name)).copy() for name in ("last", "newest"))
        self.watch: list[str | None] = heads.column("watch").to_pylist()
        before: list[str | None] = heads.column("settings").to_pylist()
        settings = before.copy()
        if self.task.settings:  # those that new rows bring, and where there are none those of before
            latest = np.append(self.first[1:], table.num_rows) - 1
            given, come = self.task.settings_of(table, latest), self.kind[latest] == NEW
            settings = [new if there else kept for new, kept, there in zip(given, before, come, strict=True)]
        self.set(settings)
        states = heads.column("state").to_pylist()
        for k in np.flatnonzero(self.kind[self.first] == OLD).tolist():
            joint, self.packed[k] = self.joints[k], states[k]
            if isinstance(joint, str):  # it stays as it is, with the settings that made it
                self.settings[k] = before[k]
            elif before[k] != settings[k] or tag_of(states[k]) != joint.tag:
                self.words[k] = migrated(self.task, joint, self.packed.pop(k), before[k], flow.origins)

    def silent(self, before: Any) -> Array:
        """Which units have no new row, and have had none since a time; none if that is None."""
        come = np.bincount(self.code[self.kind == NEW], minlength=len(self.first)) > 0
        return np.zeros(len(come), bool) if before is None else ~come & (self.newest < before)


def migrated(task: Task, now: JointLayout, state: bytes, settings: str | None, origins: Sequence[Any]) -> Array:
    """The words of a state that other settings of the tracker made: what depends on them begins anew, all else is kept.

    ``settings`` are those of the unit at that time. ValueError for a state that none of the trackers ``origins`` made.
    """
    for tracker in (task.tracker, *origins):
        old = task.joint_of(settings, tracker)
        if old.tag == tag_of(state):
            tile = old.filled(old.unpack(state))
            states = tuple(state_of(tile, lane) for lane in range(len(old.programs)))
            return now.taken(now.tile(carried(End(old.programs, states, None), now.programs)))
    return now.unpack(state)  # which says that it is another's


def rules_of(task: Task, rule: Any) -> tuple[AlarmRule | None, ...]:
    """The rule of each output: one output has one, several have rules by their names; ValueError for anything else."""
    if rule is None or len(task.y) == 1:
        return (None if rule is None else check_rule(rule),)
    given = dict(rule) if isinstance(rule, Mapping) else {None: rule}
    if not given or any(name not in task.y for name in given):
        raise ValueError(
            f"spark.follow: give rules by the name of their output; got {rule!r}, and the outputs are "
            f"{', '.join(task.y)}."
        )
    return tuple(check_rule(given[name]) if name in given else None for name in task.y)


def alarms_schema(task: Task, rules: Sequence[AlarmRule | None]) -> dict[str, str]:
    """Columns and types of alarms."""
    own = [of for of, one in zip(task.suffixes, rules, strict=False) if one is not None]
    return {f"{name}{of}": kind for of in own for name, kind in (("alarm", "boolean"), ("cause", "string"))}


OUTPUTS = ("samples", "summary", "verdict", "states")
VERDICT = {name: kind for name, kind in COLUMNS.items() if name not in ("q", "rms", "samples")}


def track(
    df: Any, model: Model, tracker: Tracker | Mapping[str, Tracker], *, y: str | Sequence[str],
    by: str | Sequence[str], time: str, u: str | Sequence[str] | None = None, dt: Any = None, settings: Any = None,
    outputs: str = "samples", arrays: bool = False, gate: Any = None,
) -> Any:  # fmt: skip
    """Track every unit of a data frame of Spark.

    Parameters
    ----------
    df : pyspark.sql.DataFrame
        One row per sample, in any order.
    model, tracker : Model, Tracker
        As for `driftfit.track`. A model with several outputs has a theta for each; ``tracker`` may map the name of each
        output to its tracker.
    y, u, time : names of columns
        Output or outputs, inputs and time (numbers, timestamps or dates). Rows without a time are counted and left out;
        so are rows at a repeated time, of which the one with the smallest numbers is used, because data frames have no
        order.
    by : name or names of columns
        What identifies a unit. Rows in which all of them are null are reported as a unit that failed.
    dt : number, duration or step of the calendar
        Nominal interval, as for `driftfit.track`.
    settings : pyspark.sql.DataFrame or None
        Settings for each unit: the columns of ``by``, and columns that are called as settings of the tracker; a null
        leaves the setting of ``tracker``.
    outputs : "samples", "summary", "verdict" or "states"
        A row per sample with the columns of `Track.to_table`; a row per unit with its last parameters, the root mean
        square of its innovations (``rms``) and of its standardised innovations (``standardised``, about 1 where the
        tracker's variances hold) and counts; the same with the columns of ``fleet.verdict().table`` besides q, for
        which a unit is held in memory, ``drifts`` and ``pays`` at the level of 5 % for each unit; or a row per unit
        with its state, from which `follow` begins.
    gate : bool, Gate or None
        As for `driftfit.track`; ``ok`` is false for what it leaves out.
    arrays : bool
        Put the parameters of a sample into the array columns ``theta`` and ``std``.

    Of several outputs, the columns of results end in the name of the output in brackets, ``prediction[flow]``; a sample
    is used if one of its outputs is.

    Returns
    -------
    pyspark.sql.DataFrame
        It is computed when it is used. The column ``failed`` is the reason why a unit has no result, in a row of its
        own, and otherwise null.

    Raises
    ------
    ValueError
        Before any job runs: for a column that does not exist or cannot be used, and for settings that are incomplete.
    ImportError
        If PySpark or Java is missing.
    """
    one_of("spark.track", "outputs", outputs, OUTPUTS)
    task = task_of(df, model, tracker, {"y": y, "u": u, "by": by, "time": time}, dt, settings, arrays, gate)
    rows = rows_of(df, task, settings)
    made = schema_of(task, dict(rows.dtypes), outputs)
    return by_unit(rows, task, Partition(task, outputs, made).work, made)


def schema_of(task: Task, kinds: Mapping[str, str], outputs: str) -> dict[str, str]:
    """Columns and types of a result, before any data."""
    own = {name: kinds[name] for name in (*task.by, task.time)}
    if outputs == "samples":
        own |= dict.fromkeys((*task.y, *task.u), "double")
        return own | results_schema(task) | {"failed": "string"}
    counts = dict.fromkeys(COUNTS, "bigint")
    if outputs == "states":
        return own | {"state": "binary", "settings": "string"} | counts | {"failed": "string"}
    judged = {"rms": "double", "standardised": "double"} | (VERDICT if outputs == "verdict" else {})
    sums = {f"{name}{of}": kind for of in task.suffixes for name, kind in judged.items()}
    return own | parameters_schema(task) | sums | counts | {"failed": "string"}


class Partition:
    """The units of a partition, one piece after the other."""

    def __init__(self, task: Task, outputs: str, schema: Mapping[str, str]) -> None:
        self.task, self.outputs, self.schema = task, outputs, schema
        self._going: Units | None = None
        """The part before of a unit that is cut into parts."""

    def work(self, batches: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
        """What a partition runs."""
        for table, more in chunks(batches, self.task.by, parts=self.outputs != "verdict"):
            for found in self.run(table, more):
                yield from found.to_batches()

    def run(self, table: pa.Table, more: bool) -> Iterator[pa.Table]:
        """Results of some rows; ``more`` if their only unit continues in the next call."""
        units, before = Units(self.task, table), self._going
        if before is not None:
            units.last[0], units.counts[0], units.squares[0] = before.last[0], before.counts[0], before.squares[0]
            units.words = before.words
        self._going = units if more else None
        order, fate, _ = late.sort_out(units.code, units.time, np.zeros(table.num_rows, bool), units.last, 0)
        units.count(fate, order)
        done = units.run(order[fate == late.RELEASED])
        if self.outputs == "samples" and done is not None:
            own = units.taken(self.task.columns, done.rows)
            yield units.filled(own | results(self.task, done.found), self.schema)
        if not more:
            empty = dict.fromkeys(np.flatnonzero(units.counts[:, SAMPLES] == 0).tolist(), "no row has a time")
            failed = empty | {k: why for k in range(len(units.first)) if (why := units.reason(k))}
            good, bad = [k for k in range(len(units.first)) if k not in failed], sorted(failed)
            if self.outputs != "samples" and good:
                yield units.filled(self._of_units(units, good, done), self.schema)
            if bad:
                yield units.filled(self._named(units, bad) | {"failed": [failed[k] for k in bad]}, self.schema)

    def _named(self, units: Units, which: list[int]) -> dict[str, Any]:
        """The units, their last times and their counts."""
        own = units.taken(self.task.by, units.first[which]) | units.counted(which)
        return own | {self.task.time: units.instants(units.last[which])}

    def _of_units(self, units: Units, which: list[int], done: Done | None) -> dict[str, Any]:
        """A row for each unit that has a result."""
        own = self._named(units, which)
        if self.outputs == "states":
            return own | {"state": [units.state(k) for k in which], "settings": [units.settings[k] for k in which]}
        fields = ([units.joint(k).field(units.words[k], name) for k in which] for name in ("theta", "var"))
        theta, var = map(np.array, fields)
        sums = units.squares[which]
        with np.errstate(invalid="ignore", divide="ignore"):
            rms, standardised = (np.sqrt(sums[..., j] / sums[..., JUDGED]) for j in (SQUARES, STANDARD))
            own |= parameters(self.task, theta, np.sqrt(var))
        own |= by_output(self.task, {"rms": rms, "standardised": standardised})
        return own if done is None or self.outputs == "summary" else own | self._verdicts(done, which)

    def _verdicts(self, done: Done, which: list[int]) -> dict[str, Any]:
        """What is judged of every output of each unit."""
        found, ny = done.found, len(self.task.y)
        columns = {f"{name}{of}": list[Any]() for of in self.task.suffixes for name in VERDICT}
        for j in map(done.keys.index, which):
            each = range(j * ny, (j + 1) * ny)
            own, programs = found.lanes.part(each), [found.programs[i] for i in each]
            if ny == 1:
                runs: Any = [Track(programs[0], found.records.part(j), own[0])]
            else:
                runs = Outputs(programs, found.records.some(j, j + 1), own, {}, {}).values()
            for run, of in zip(runs, self.task.suffixes, strict=True):
                truth, nan = verdict(run), float("nan")
                one = Judgement(j, truth, nan, nan, truth.drifts, truth.pays, coverage(run), len(run.left_out)).columns
                for name in VERDICT:
                    columns[f"{name}{of}"].append(one[name])
        return columns
