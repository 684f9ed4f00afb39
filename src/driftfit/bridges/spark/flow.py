"""One batch of a stream in a worker: states and rows of some units go in; results, states and late rows come out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa

from driftfit.bridges.spark.alarms import alarms_schema, collects, watched
from driftfit.bridges.spark.task import Task, chunks, results_schema
from driftfit.bridges.spark.units import ARROW, COUNTS, PLACES, SAMPLES, Done, Units, numbers, results, times
from driftfit.data import late
from driftfit.engine.kernel import Array
from driftfit.run.layout import tag_of
from driftfit.run.live.rule import AlarmRule
from driftfit.run.program import state_of
from driftfit.run.warm_start import End, JointLayout, carried

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
    states before; units whose newest time is before ``expired`` end.
    """

    task: Task
    kinds: Mapping[str, str]
    hold: Any
    rules: tuple[AlarmRule | None, ...]
    origins: tuple[Any, ...] = ()
    expired: Any = None

    @cached_property
    def state(self) -> dict[str, str]:
        """Columns and types of a state, without those of its unit."""
        return STATE | dict.fromkeys(("last", "newest"), self.kinds[self.task.time])

    @cached_property
    def schema(self) -> dict[str, str]:
        """Columns and types of all that comes out."""
        return {"kind": "string", **results_of(self.task, self.kinds, self.rules), **self.state}

    def work(self, batches: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
        """What a partition runs."""
        for table, _ in chunks(batches, self.task.by, parts=False):
            for found in self.tables(table):
                yield from found.to_batches()

    def tables(self, table: pa.Table) -> Iterator[pa.Table]:
        """All that comes out, by kind; the rows are in the order of unit and kind."""
        known = Known(self, table)
        rows = np.flatnonzero(known.kind != OLD)
        waited = known.kind[rows] == WAITED
        fates = late.sort_out(known.code[rows], known.time[rows], waited, known.newest, self.hold)
        order, good = rows[fates.order], known.good
        known.newest[good] = fates.newest[good]
        silent = known.silent(self.expired)
        over, stays = silent[known.code[order]], known.kind[order] == WAITED
        # a unit that cannot run stays as it is: what waits continues to wait, and the rest is refused
        other = np.where(stays & ~over, late.WAITING, REFUSED)
        fate = np.where(good[known.code[order]], late.ended(fates.fate, over), other)
        earlier = known.counts[:, SAMPLES].copy()
        done = known.run(order[fate == late.RELEASED], collects(self.rules))
        if done is not None:
            alarms = self._watched(known, done, earlier) if any(self.rules) else {}
            own = known.taken(self.task.columns, done.rows)
            yield self._table(known, "result", own, results(self.task, done.found), alarms)
        known.count(fate, order)
        yield from self._left_out(known, order, fate)
        yield from self._states(known, good | (known.kind[known.first] == OLD), silent)
        if (bad := np.flatnonzero(~good)).size:
            reasons = {"failed": [known.reason(k) for k in bad.tolist()]}
            yield self._table(known, "failed", known.taken(self.task.by, known.first[bad]), reasons)

    def _table(self, known: Known, kind: str, *parts: Mapping[str, Any]) -> pa.Table:
        """Rows of a kind."""
        merged = {name: values for part in parts for name, values in part.items()}
        count = len(next(iter(merged.values())))
        return known.filled(merged | {"kind": pa.array([kind] * count)}, self.schema)

    def _watched(self, known: Known, done: Done, earlier: Array) -> dict[str, Any]:
        """The alarms at every sample, as `LiveAlarm` gives them."""
        schema, records, ny = alarms_schema(self.task, self.rules), done.found.records, len(self.task.y)
        columns: dict[str, list[Any]] = {name: [] for name in schema}
        for j, k in enumerate(done.keys):
            lanes = done.found.lanes.part(range(j * ny, (j + 1) * ny))
            y = records.y[records.first[j] : records.first[j] + records.length[j]].reshape(-1, ny)
            causes, known.watch[k] = watched(self.rules, known.joint(k), known.watch[k], int(earlier[k]), lanes, y)
            each = [column for one in causes for column in ([cause is not None for cause in one], one)]
            for name, values in zip(schema, each, strict=True):
                columns[name] += values
        return {name: pa.array(columns[name], ARROW[kind]) for name, kind in schema.items()}

    def _left_out(self, known: Known, order: Array, fate: Array) -> Iterator[pa.Table]:
        """Rows that wait, and rows that are left out."""
        for code in (late.WAITING, *PLACES, REFUSED):
            which = order[fate == code]
            if which.size:
                own = known.taken(self.task.columns, which)
                if code == late.WAITING:
                    yield self._table(known, "waiting", own)
                    continue
                refused = (known.reason(k) for k in known.code[which].tolist())
                reasons = list(refused) if code == REFUSED else [late.REASONS[code]] * len(which)
                yield self._table(known, "late", own, {"failed": reasons})

    def _states(self, known: Known, kept: Array, silent: Array) -> Iterator[pa.Table]:
        """The states of units, those that go on and those that have been silent for too long."""
        for kind, which in (("state", np.flatnonzero(kept & ~silent)), ("expired", np.flatnonzero(kept & silent))):
            if which.size:
                units = which.tolist()
                own: dict[str, Any] = {"state": [known.state(k) for k in units]}
                own |= {"settings": [known.settings[k] for k in units], "watch": [known.watch[k] for k in units]}
                own |= {"last": known.instants(known.last[which]), "newest": known.instants(known.newest[which])}
                yield self._table(known, kind, known.taken(self.task.by, known.first[which]), own, known.counted(units))


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
