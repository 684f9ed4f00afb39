"""One batch of a stream in a worker: states and rows of some units go in; results, states and late rows come out."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from driftfit.bridges.spark.pieces import COUNTS, LATE, REPEATED, SUMS, UNTIMED, add, filled, instants, named, results
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
from driftfit.data.storage import describe
from driftfit.engine.kernel import Array
from driftfit.run.live.alarm import LiveAlarm
from driftfit.run.live.rule import FROZEN, AlarmRule
from driftfit.run.program import Program, state_of
from driftfit.run.result import burn_in
from driftfit.run.states import late
from driftfit.run.states.advance import Advanced
from driftfit.run.warm_start import End, carried
from driftfit.trackers.base import Tracker

OLD, WAITED, NEW = range(3)
"""Values of the column ``_kind``: a state, a row that waits, a row that has come."""
PLACES = {late.LATE: LATE, late.REPEATED: REPEATED, late.UNTIMED: UNTIMED}
"""Where rows that are left out are counted."""


@dataclass(frozen=True)
class Flow:
    """What a worker is told of a stream, beside its task.

    ``before`` is the tracker that made the states so far, where it was another one; units whose newest time is before
    ``expired`` end.
    """

    task: Task
    schema: Mapping[str, str]
    hold: Any
    rule: AlarmRule | None = None
    before: Tracker | None = None
    expired: Any = None

    def work(self, batches: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
        """What a partition runs."""
        for table, _ in chunks(batches, self.task.by, parts=False):
            for found in self.tables(Known.of(self, table)):
                yield from found.to_batches()

    def migrated(self, state: bytes, settings: str | None, now: Program) -> Array:
        """The words of a state that was made with other settings: what depends on them begins with the new ones."""
        old = self.task.program_for(settings, self.before)
        if isinstance(old, str):
            raise ValueError(old)
        end = End((old,), (state_of(old.unpack(state)),), None)
        (fields,) = carried(end, (now,))
        words: Array = now.layout.taken(now.tile(fields))[0]
        return words

    def tables(self, known: Known) -> Iterator[pa.Table]:
        """All that comes out, by kind."""
        task, table = self.task, known.table
        rows = np.flatnonzero(known.kind != OLD)
        waited = known.kind[rows] == WAITED
        fates = late.sort_out(known.code[rows], known.time[rows], waited, known.newest, self.hold)
        order = rows[fates.order]
        good = known.there & np.array([not isinstance(one, str) for one in known.programs])
        right = good[known.code[order]]
        known.newest[good] = fates.newest[good]
        released = order[right & (fates.fate == late.RELEASED)]
        some = series_of(task, table, known.code, released, known.time, good)
        frozen = self.rule is not None and self.rule.kind in FROZEN
        going = (task, table, some, known.programs, known.words, known.last, frozen)
        found = continued(*going) if len(released) else None
        if found is not None:
            yield self._results(known, some, found)
        yield from self._left_out(known, order[right], fates.fate[right])
        yield from self._states(known, good)
        if (bad := np.flatnonzero(~good)).size:
            reasons = [
                one if isinstance(one := known.programs[k], str) else "rows without a unit" for k in bad.tolist()
            ]
            yield self._table("failed", known.keys(bad), {"failed": reasons}, table)

    def _table(self, kind: str, *columns: Any) -> pa.Table:
        """Rows of a kind, from columns and the table that they came from."""
        *parts, table = columns
        merged = {name: values for part in parts for name, values in part.items()}
        count = len(next(iter(merged.values())))
        return filled(merged | {"kind": pa.array([kind] * count)}, self.schema, table)

    def _results(self, known: Known, some: Series, found: Advanced) -> pa.Table:
        """A row per sample; the units' states, times and sums go on."""
        sums = np.zeros((len(known.first), SUMS))
        add(sums, some, found)
        earlier = known.counts[:, 0].copy()
        known.counts[...] += sums[:, : len(COUNTS)].astype(np.int64)
        known.last[some.keys] = some.time[some.first + some.length - 1]
        known.words.update(words_after(found, some))
        own = {name: known.table.column(name).take(pa.array(some.rows)) for name in self.task.columns}
        alarms = {} if self.rule is None else self._watched(known, some, found, earlier)
        return self._table("result", own, results(self.task, found), alarms, known.table)

    def _watched(self, known: Known, some: Series, found: Advanced, earlier: Array) -> dict[str, Any]:
        """The alarms at every sample, as `LiveAlarm` gives them."""
        assert self.rule is not None
        causes: list[str | None] = [None] * len(some.rows)
        plain = describe(self.rule)
        lanes = found.lanes()
        for j, k in enumerate(some.keys.tolist()):
            program, (job, lane) = found.programs[j], lanes[j]
            if known.watch[k] is None:
                wait = max(burn_in(program.model.n) - int(earlier[k]), 0)
                alarm = LiveAlarm(self.rule, program.tracker, program.names, wait)
            else:
                alarm = LiveAlarm.of({**json.loads(known.watch[k]), "rule": plain}, program.tracker, program.names)
            count, first = int(some.length[j]), int(some.first[j])
            causes[first : first + count] = alarm.take_many(job.out[:count], lane, np.ones(count))
            alarm.onsets()
            known.watch[k] = json.dumps({name: value for name, value in alarm.plain().items() if name != "rule"})
        return {"alarm": [cause is not None for cause in causes], "cause": pa.array(causes, pa.string())}

    def _left_out(self, known: Known, order: Array, fate: Array) -> Iterator[pa.Table]:
        """Rows that wait, and rows that are left out and counted."""
        names = self.task.columns
        waiting = order[fate == late.WAITING]
        if waiting.size:
            rows = pa.array(waiting)
            yield self._table("waiting", {name: known.table.column(name).take(rows) for name in names}, known.table)
        for code, place in PLACES.items():
            which = order[fate == code]
            if which.size:
                known.counts[:, place] += np.bincount(known.code[which], minlength=len(known.first))
                own = {name: known.table.column(name).take(pa.array(which)) for name in names}
                yield self._table("late", own, {"failed": [late.REASONS[code]] * len(which)}, known.table)

    def _states(self, known: Known, good: Array) -> Iterator[pa.Table]:
        """The states of units, those that go on and those that have been silent for too long."""
        silent = np.zeros(len(good), bool) if self.expired is None else known.newest < self.expired
        for kind, which in (("state", np.flatnonzero(good & ~silent)), ("expired", np.flatnonzero(good & silent))):
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
    programs: list[Program | str]
    words: dict[int, Array]
    arrived: dict[int, bytes]
    """States as they came, of units that go on unchanged."""
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
        programs = [task.program_for(one) for one in settings]
        words, packed = {}, {}
        states = heads.column("state").to_pylist()
        arrived = np.bincount(code[kind == NEW], minlength=len(first)) > 0
        for k in np.flatnonzero(old).tolist():
            program = programs[k]
            if isinstance(program, str):
                continue
            if before[k] == settings[k] and flow.before is None:
                packed[k] = states[k]
                if arrived[k]:
                    words[k] = program.layout.unpack(states[k])
            else:
                words[k] = flow.migrated(states[k], before[k], program)
        return cls(
            flow, table, first, code, kind, times(table.column(task.time)), named(table, task.by)[first], settings,
            programs, words, packed, times(heads.column("last")).copy(), times(heads.column("newest")).copy(),
            np.nan_to_num(counts).astype(np.int64), heads.column("watch").to_pylist(),
        )  # fmt: skip

    def keys(self, which: Array) -> dict[str, Any]:
        """The names of units."""
        return {name: self.table.column(name).take(pa.array(self.first[which])) for name in self.flow.task.by}

    def packed(self, k: int) -> bytes:
        """The state of a unit as bytes."""
        program = self.programs[k]
        assert isinstance(program, Program)
        if k in self.words:
            return program.layout.pack(self.words[k])
        return self.arrived[k] if k in self.arrived else program.pack(program.tile())
