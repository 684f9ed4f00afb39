"""One batch of a stream in a worker: states and rows of some units go in; results, states and late rows come out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from driftfit.bridges.spark.pieces import (
    ARROW,
    COUNTS,
    LATE,
    REPEATED,
    UNTIMED,
    Sums,
    add,
    alarms_of,
    alarms_schema,
    collects,
    filled,
    instants,
    named,
    results,
    watched,
)
from driftfit.bridges.spark.task import (
    Series,
    Task,
    chunks,
    continued,
    numbers,
    series_of,
    times,
    units_of,
    words_after,
)
from driftfit.data import late
from driftfit.engine.kernel import Array
from driftfit.run.layout import tag_of, unpacked
from driftfit.run.live.rule import AlarmRule
from driftfit.run.parallel_lanes import Advanced
from driftfit.run.program import state_of
from driftfit.run.warm_start import End, JointLayout, carried

OLD, WAITED, NEW = range(3)
"""Values of the column ``_kind``: a state, a row that waits, a row that has come."""
PLACES = {late.LATE: LATE, late.REPEATED: REPEATED, late.UNTIMED: UNTIMED}
"""Where rows that are left out are counted."""
REFUSED = -1
"""The fate of a row of a unit that cannot run, besides those of `driftfit.data.late`."""


class Origin(NamedTuple):
    """What made states: the tracker, or that of each output, and the fields of a state in the version of that time."""

    tracker: Any
    fields: str


@dataclass(frozen=True)
class Flow:
    """The settings of a stream that a worker receives in addition to its task.

    ``rules`` has the rule of each output. ``origins`` are the trackers and versions that made states before; units
    whose newest time is before ``expired`` end.
    """

    task: Task
    schema: Mapping[str, str]
    hold: Any
    rules: tuple[AlarmRule | None, ...]
    origins: tuple[Origin, ...] = ()
    expired: Any = None

    def work(self, batches: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
        """What a partition runs."""
        for table, _ in chunks(batches, self.task.by, parts=False):
            for found in self.tables(Known.of(self, table)):
                yield from found.to_batches()

    def tables(self, known: Known) -> Iterator[pa.Table]:
        """All that comes out, by kind."""
        task, table = self.task, known.table
        rows = np.flatnonzero(known.kind != OLD)
        waited = known.kind[rows] == WAITED
        fates = late.sort_out(known.code[rows], known.time[rows], waited, known.newest, self.hold)
        order = rows[fates.order]
        good = known.there & np.array([not isinstance(one, str) for one in known.joints])
        known.newest[good] = fates.newest[good]
        silent = known.silent(self.expired)
        over, stays = silent[known.code[order]], known.kind[order] == WAITED
        # a unit that cannot run stays as it is: what waits continues to wait, and the rest is refused
        other = np.where(stays & ~over, late.WAITING, REFUSED)
        fate = np.where(good[known.code[order]], late.ended(fates.fate, over), other)
        released = order[fate == late.RELEASED]
        some = series_of(task, table, known.code, released, known.time, good)
        going = (task, table, some, known.joints, known.unpacked(some.keys), known.last, collects(self.rules))
        found = continued(*going) if len(released) else None
        if found is not None:
            yield self._results(known, some, found)
        yield from self._left_out(known, order, fate)
        yield from self._states(known, good | known.old, silent)
        if (bad := np.flatnonzero(~good)).size:
            yield self._table("failed", known.keys(bad), {"failed": known.reasons(bad)}, table)

    def _table(self, kind: str, *columns: Any) -> pa.Table:
        """Rows of a kind, from columns and the table that they came from."""
        *parts, table = columns
        merged = {name: values for part in parts for name, values in part.items()}
        count = len(next(iter(merged.values())))
        return filled(merged | {"kind": pa.array([kind] * count)}, self.schema, table)

    def _results(self, known: Known, some: Series, found: Advanced) -> pa.Table:
        """A row per sample; the units' states, times and sums go on."""
        sums = Sums.of(len(known.first), self.task)
        add(sums, some, found)
        earlier = known.counts[:, 0].copy()
        known.counts[...] += sums.counts
        known.last[some.keys] = some.time[some.first + some.length - 1]
        known.words.update(words_after(found, some))
        own = {name: known.table.column(name).take(pa.array(some.rows)) for name in self.task.columns}
        alarms = self._watched(known, some, found, earlier) if any(self.rules) else {}
        return self._table("result", own, results(self.task, found), alarms, known.table)

    def _watched(self, known: Known, some: Series, found: Advanced, earlier: Array) -> dict[str, Any]:
        """The alarms at every sample, as `LiveAlarm` gives them."""
        schema, ny = alarms_schema(self.task, self.rules), len(self.task.y)
        columns: dict[str, list[Any]] = {name: [] for name in schema}
        for j, k in enumerate(some.keys.tolist()):
            joint, lanes = known.joints[k], found.lanes.part(range(j * ny, (j + 1) * ny))
            assert isinstance(joint, JointLayout)
            y = some.y[some.first[j] : some.first[j] + some.length[j]]
            causes, known.watch[k] = watched(self.rules, joint, known.watch[k], int(earlier[k]), lanes, y)
            for name, values in alarms_of(schema, causes).items():
                columns[name] += values
        return {
            name: pa.array(values, ARROW[kind])
            for (name, kind), values in zip(schema.items(), columns.values(), strict=True)
        }

    def _left_out(self, known: Known, order: Array, fate: Array) -> Iterator[pa.Table]:
        """Rows that wait, and rows that are left out and counted."""
        names = self.task.columns
        waiting = order[fate == late.WAITING]
        if waiting.size:
            rows = pa.array(waiting)
            yield self._table("waiting", {name: known.table.column(name).take(rows) for name in names}, known.table)
        for code in (*PLACES, REFUSED):
            which = order[fate == code]
            if which.size:
                unit = known.code[which]
                reasons = known.reasons(unit) if code == REFUSED else [late.REASONS[code]] * len(which)
                if code != REFUSED:
                    known.counts[:, PLACES[code]] += np.bincount(unit, minlength=len(known.first))
                own = {name: known.table.column(name).take(pa.array(which)) for name in names}
                yield self._table("late", own, {"failed": reasons}, known.table)

    def _states(self, known: Known, kept: Array, silent: Array) -> Iterator[pa.Table]:
        """The states of units, those that go on and those that have been silent for too long."""
        for kind, which in (("state", np.flatnonzero(kept & ~silent)), ("expired", np.flatnonzero(kept & silent))):
            if which.size:
                units, like = which.tolist(), known.table.schema.field(self.task.time).type
                own: dict[str, Any] = {"state": [known.packed(k) for k in units]}
                own |= {"settings": [known.settings[k] for k in units], "watch": [known.watch[k] for k in units]}
                own |= {"last": instants(known.last[which], like), "newest": instants(known.newest[which], like)}
                own |= {name: known.counts[which, j] for j, name in enumerate(COUNTS)}
                yield self._table(kind, known.keys(which), own, known.table)


class Known(NamedTuple):
    """The units of a table: rows, and what is known of each unit from before."""

    flow: Flow
    table: pa.Table
    first: Array
    code: Array
    kind: Array
    time: Array
    there: Array
    settings: list[str | None]
    joints: list[JointLayout | str]
    words: dict[int, Array]
    arrived: dict[int, bytes]
    """States as they came, which are unpacked if a sample follows."""
    last: Array
    newest: Array
    counts: Array
    watch: list[str | None]

    @classmethod
    def of(cls, flow: Flow, table: pa.Table) -> Known:
        """From the rows of a chunk, in the order of unit and kind."""
        task = flow.task
        first, code = units_of(table, task.by)
        kind = numbers(table.column("_kind")).astype(int)
        heads = table.take(pa.array(first))
        old = kind[first] == OLD
        counts = np.stack([numbers(heads.column(name)) for name in COUNTS], axis=1)
        before = heads.column("settings").to_pylist()
        settings = before
        if task.settings:  # those that new rows bring, and where there are none those of before
            latest = np.append(first[1:], table.num_rows) - 1
            given = task.settings_of(table, latest)
            come = kind[latest] == NEW
            settings = [new if new_rows else kept for new, kept, new_rows in zip(given, before, come, strict=True)]
        joints = [task.joint_for(one) for one in settings]
        words, packed = {}, {}
        states = heads.column("state").to_pylist()
        for k in np.flatnonzero(old).tolist():
            joint = joints[k]
            if isinstance(joint, str):  # it stays as it is, with the settings that made it
                packed[k], settings[k] = states[k], before[k]
            elif before[k] == settings[k] and tag_of(states[k]) == joint.tag:
                packed[k] = states[k]
            else:
                words[k] = migrated(task, joint, states[k], before[k], flow.origins)
        return cls(
            flow, table, first, code, kind, times(table.column(task.time)), named(table, task.by)[first], settings,
            joints, words, packed, times(heads.column("last")).copy(), times(heads.column("newest")).copy(),
            np.nan_to_num(counts).astype(np.int64), heads.column("watch").to_pylist(),
        )  # fmt: skip

    def silent(self, before: Any) -> Array:
        """Which units have no new row, and have had none since a time; none if that is None."""
        come = np.bincount(self.code[self.kind == NEW], minlength=len(self.first)) > 0
        return np.zeros(len(come), bool) if before is None else ~come & (self.newest < before)

    @property
    def old(self) -> Array:
        return np.asarray(self.kind[self.first] == OLD)

    def reasons(self, which: Array) -> list[str]:
        return [one if isinstance(one := self.joints[k], str) else "rows without a unit" for k in which.tolist()]

    def keys(self, which: Array) -> dict[str, Any]:
        return {name: self.table.column(name).take(pa.array(self.first[which])) for name in self.flow.task.by}

    def unpacked(self, keys: Array) -> dict[int, Array]:
        """The words of the states so far, among them those of these units."""
        for k in keys.tolist():
            if k in self.arrived and k not in self.words:
                joint = self.joints[k]
                assert isinstance(joint, JointLayout)
                self.words[k] = joint.unpack(self.arrived[k])
        return self.words

    def packed(self, k: int) -> bytes:
        if k in self.arrived and k not in self.words:
            return self.arrived[k]
        joint = self.joints[k]
        assert isinstance(joint, JointLayout)
        return joint.pack(self.words[k]) if k in self.words else joint.start


def migrated(task: Task, now: JointLayout, state: bytes, settings: str | None, origins: Sequence[Origin]) -> Array:
    """The words of a state that other settings of the tracker or another version made.

    What depends on settings begins with the new ones, all else is carried over; fields are matched by their names.
    ``settings`` are those of the unit at that time. ValueError for a state that none of ``origins`` made.
    """
    tag, words = unpacked(state)
    for tracker, fields in ((task.tracker, now.text), *origins):
        old = task.joint_of(settings, tracker)
        if old.tag == tag or old.made_by(tag, fields):
            tile = old.filled(words) if old.tag == tag else old.filled(old.matched(words, fields))
            states = tuple(state_of(tile, lane) for lane in range(len(old.programs)))
            return now.taken(now.tile(carried(End(old.programs, states, None), now.programs)))
    return now.unpack(state)  # which says that it is another's
