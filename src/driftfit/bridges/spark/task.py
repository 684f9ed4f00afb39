"""The settings that a worker of Spark receives, and how rows that are sorted by unit become series of arrays."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from driftfit.data.arguments import ordered
from driftfit.data.clock import Clock
from driftfit.data.record import Known, Labels, Records
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.run.parallel_lanes import Advanced, advance
from driftfit.run.program import Program, programs_of
from driftfit.run.warm_start import JointLayout
from driftfit.trackers.base import Tracker

ROWS = 64_000
"""Rows that go into lanes together, if no unit has more."""
SETTING = "_set_"
"""What the columns of a unit's settings begin with."""


@dataclass(frozen=True)
class Task:
    """Model, tracker and columns: pickled once for each task of Spark.

    The model's outputs have the names ``y``. ``tracker`` is one for all of them, or a mapping from their names.
    ``settings`` names the settings of the tracker that rows bring along, ``zone`` is the time zone of the session.
    """

    model: Model
    tracker: Any
    y: tuple[str, ...]
    u: tuple[str, ...]
    by: tuple[str, ...]
    time: str
    dt: Any = None
    zone: str | None = None
    settings: tuple[str, ...] = ()
    arrays: bool = False
    gate: Any = None

    @cached_property
    def clock(self) -> Clock:
        return Clock.of(self.dt, self.zone)

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns that are read."""
        return (*self.by, self.time, *self.y, *self.u)

    @property
    def suffixes(self) -> tuple[str, ...]:
        """What follows the names of an output's results: its name in brackets, if there are several."""
        return ("",) if len(self.y) == 1 else tuple(f"[{name}]" for name in self.y)

    @cached_property
    def names(self) -> tuple[tuple[str, ...], ...]:
        """Names of the parameters of each output; the tracker may be incomplete."""
        bound, trackers = self.model.bind(self.order), trackers_of(self.tracker)
        if len(self.y) == 1:
            return (trackers[0].names_for(bound),)
        each = trackers * len(self.y) if len(trackers) == 1 else trackers
        return tuple(Program(bound, one, name).names for one, name in zip(each, self.y, strict=True))

    @cached_property
    def order(self) -> tuple[str, ...]:
        """The columns of the inputs in the order of the model's."""
        place = np.arange(len(self.u), dtype=float)[None]
        sorted_, _ = ordered(self.model, place, self.u)
        return tuple(self.u[int(j)] for j in sorted_[0])

    @cached_property
    def _made(self) -> dict[str | None, JointLayout | str]:
        return {}

    def __reduce__(self) -> Any:
        """Without what was made here."""
        return _task, ({name: getattr(self, name) for name in self.__dataclass_fields__},)

    def joint_of(self, settings: str | None, tracker: Any) -> JointLayout:
        """The programs of a unit with these settings (JSON); ValueError if they are not complete."""
        return JointLayout(programs_of(self.model, _with(tracker, settings), self.order, self.gate))

    def joint_for(self, settings: str | None) -> JointLayout | str:
        """The programs of a unit with these settings (JSON) of its own, or why there are none."""
        if settings not in self._made:
            try:
                found = self.joint_of(settings, self.tracker)
                found.tile()  # where settings meet the number of parameters
                self._made[settings] = found
            except (ValueError, TypeError) as error:
                self._made[settings] = f"settings: {error}"
        return self._made[settings]

    def settings_of(self, table: pa.Table, first: Array) -> list[str | None]:
        """The settings of every unit as JSON, from the first of its rows; None where it has none of its own."""
        if not self.settings:
            return [None] * len(first)
        given = table.select([SETTING + name for name in self.settings]).take(first).to_pylist()
        rows = [{name.removeprefix(SETTING): v for name, v in row.items() if v is not None} for row in given]
        return [json.dumps(row, sort_keys=True, default=float) if row else None for row in rows]  # of decimals


def _task(fields: Mapping[str, Any]) -> Task:
    return Task(**fields)


def trackers_of(tracker: Any) -> tuple[Tracker, ...]:
    """The tracker of all outputs, or of each."""
    return tuple(tracker.values()) if isinstance(tracker, Mapping) else (tracker,)


def _with(tracker: Any, settings: str | None) -> Any:
    """A tracker, or that of each output, with the settings of a unit."""
    if settings is None:
        return tracker
    if isinstance(tracker, Mapping):
        return {name: _with(one, settings) for name, one in tracker.items()}
    return replace(tracker, **json.loads(settings))


def results_schema(task: Task) -> dict[str, str]:
    """Columns and types of the results at a sample; those of parameters need no complete tracker."""
    own = {"prediction": "double", "innovation": "double", "innovation_std": "double", "ok": "boolean"}
    each = {f"{name}{of}": kind for of in task.suffixes for name, kind in own.items()}
    return each | parameters_schema(task)


def parameters_schema(task: Task) -> dict[str, str]:
    """Columns and types of the parameters."""
    if task.arrays:
        return {f"{what}{of}": "array<double>" for of in task.suffixes for what in ("theta", "std")}
    return {f"{what}_{name}": "double" for names in task.names for name in names for what in ("theta", "std")}


class Units(NamedTuple):
    """Rows that are sorted by unit."""

    first: Array
    """(U,): the first row of each unit."""
    code: Array
    """(N,): the number of the unit of each row."""


def units_of(table: pa.Table, by: Sequence[str]) -> Units:
    """The units of a table with at least one row; missing names are equal."""
    new = np.zeros(table.num_rows, bool)
    new[0] = True
    for name in by:
        column = table.column(name).combine_chunks()
        codes = pc.dictionary_encode(column, null_encoding="encode").indices.to_numpy(zero_copy_only=False)
        new[1:] |= codes[1:] != codes[:-1]
    return Units(np.flatnonzero(new), np.cumsum(new) - 1)


def numbers(column: pa.ChunkedArray) -> Array:
    """Floats, NaN where there is none."""
    return np.asarray(pc.fill_null(column.cast(pa.float64()), np.nan).to_numpy(), float)


def times(column: pa.ChunkedArray) -> Array:
    """Floats, or datetime64 in UTC; NaN or NaT where there is none."""
    if not pa.types.is_timestamp(column.type):
        return numbers(column)
    instants: Array = column.cast(pa.timestamp("us")).to_numpy().astype("M8[us]")
    return instants


def chunks(batches: Iterator[pa.RecordBatch], by: Sequence[str], parts: bool) -> Iterator[tuple[pa.Table, bool]]:
    """(some rows, whether their only unit continues in the next): cut where a unit ends, about `ROWS` rows each.

    A unit with more rows is cut into such parts, or with ``parts=False`` kept together.
    """
    waiting: list[pa.RecordBatch] = []
    for batch in batches:
        waiting.append(batch)
        count = sum(one.num_rows for one in waiting)
        if count < ROWS:
            continue
        table = pa.Table.from_batches(waiting).combine_chunks()
        cut = int(units_of(table, by).first[-1])
        if cut:
            yield table.slice(0, cut), False
        elif parts:
            cut = count - 1  # the last row stays, so that the unit is known to go on
            yield table.slice(0, cut), True
        waiting = table.slice(cut).to_batches()
    if sum(one.num_rows for one in waiting):
        yield pa.Table.from_batches(waiting).combine_chunks(), False


class Series(NamedTuple):
    """Some units in flat arrays, one after the other."""

    keys: Array
    """(K,): the number of each among the units of the table."""
    rows: Array
    """(N,): the row of each sample in the table."""
    first: Array
    length: Array
    y: Array
    """(N, ny)"""
    time: Array


def series_of(task: Task, table: pa.Table, code: Array, rows: Array, time: Array, good: Array) -> Series:
    """The samples of the units that are ``good`` (U,), from rows in the order of unit and time."""
    rows = rows[good[code[rows]]]
    keys, first, length = np.unique(code[rows], return_index=True, return_counts=True)
    y = np.stack([numbers(table.column(name))[rows] for name in task.y], axis=1)
    return Series(keys, rows, first, length, y, time[rows])


def continued(
    task: Task, table: pa.Table, some: Series, joints: Sequence[Any], states: Mapping[int, Array], last: Array,
    collected: bool = False,
) -> Advanced:  # fmt: skip
    """Run the series from their states, by the number of the unit; ``last`` (U,) are times of their last samples.

    ``joints`` has an entry for each unit; those of the series are programs.
    """
    before = np.roll(some.time, 1)
    before[some.first] = last[some.keys]
    new = some.first[np.isnat(before[some.first]) if before.dtype.kind == "M" else np.isnan(before[some.first])]
    before[new] = some.time[new]
    gaps = task.clock.between(before, some.time)
    gaps[new] = 1.0
    keys, ny = some.keys.tolist(), len(task.y)
    begun = np.array([k in states for k in keys])
    words = np.zeros((len(keys) * ny, max((len(states[k]) // ny for k in keys if k in states), default=0)), np.int64)
    for j in np.flatnonzero(begun).tolist():
        own = states[keys[j]].reshape(ny, -1)
        words[j * ny : (j + 1) * ny, : own.shape[1]] = own
    programs = [one for k in keys for one in joints[k].programs]
    records = _records(task, table, some, gaps)
    return advance(programs, records, words, np.repeat(begun, ny), threads=1, collected=collected)


def _records(task: Task, table: pa.Table, some: Series, gaps: Array) -> Records:
    """The series as records."""
    inputs = [numbers(table.column(name))[some.rows] for name in task.order]
    u = np.stack(inputs, axis=1) if inputs else np.zeros((len(some.rows), 0))
    keys, y, known, outputs = tuple(some.keys.tolist()), some.y[:, 0], Known.of(gaps), tuple[str, ...]()
    if len(task.y) > 1:
        y, known, outputs = some.y, known.for_outputs(np.ones(some.y.shape)), task.y
    labels = Labels(task.y[0] if not outputs else "y", task.order, task.time, zone=task.zone, by=task.by)
    return Records(keys, some.first, some.length, y, u, known, some.time, labels, outputs=outputs)


def words_after(found: Advanced, some: Series) -> dict[int, Array]:
    """The words of every unit after its last sample, by its number."""
    rows, ny = found.states(), found.records.ny
    sizes = [program.layout.size for program in found.programs[::ny]]
    places = range(0, len(rows), ny)
    return {
        k: rows[j : j + ny, :size].reshape(-1) for k, j, size in zip(some.keys.tolist(), places, sizes, strict=True)
    }


def lists(values: Array) -> pa.Array:
    """A row of numbers (N, n) for each sample."""
    offsets = np.arange(len(values) + 1, dtype=np.int32) * values.shape[1]
    return pa.ListArray.from_arrays(offsets, np.ascontiguousarray(values).ravel())
