"""What a worker of Spark is told, and how rows that are sorted by unit become series of arrays."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from driftfit.data.clock import Clock
from driftfit.data.known import Known
from driftfit.data.labels import ordered
from driftfit.data.record import Labels, Records
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.run.program import Program, programs_of
from driftfit.run.states.advance import Advanced, advance
from driftfit.trackers.base import Tracker

ROWS = 64_000
"""Rows that go into lanes together, if no unit has more."""
SETTING = "_set_"
"""What the columns of a unit's settings begin with."""


@dataclass(frozen=True)
class Task:
    """Model, tracker and columns: pickled once for each task of Spark.

    ``settings`` names the settings of the tracker that rows bring along, ``zone`` is the time zone of the session.
    """

    model: Model
    tracker: Tracker
    y: str
    u: tuple[str, ...]
    by: tuple[str, ...]
    time: str
    dt: Any = None
    zone: str | None = None
    settings: tuple[str, ...] = ()
    arrays: bool = False

    @cached_property
    def clock(self) -> Clock:
        """The nominal interval."""
        return Clock.of(self.dt, self.zone)

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns that are read."""
        return (*self.by, self.time, self.y, *self.u)

    @cached_property
    def program(self) -> Program:
        """The program of a unit without settings of its own; ValueError if they are not complete."""
        return programs_of(self.model, self.tracker, self.order)[0]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.tracker.names_for(self.model.bind(self.order))

    @cached_property
    def order(self) -> tuple[str, ...]:
        """The columns of the inputs in the order of the model's."""
        place = np.arange(len(self.u), dtype=float)[None]
        sorted_, _ = ordered(self.model, place, self.u)
        return tuple(self.u[int(j)] for j in sorted_[0])

    @cached_property
    def _made(self) -> dict[str | None, Program | str]:
        return {}

    def __reduce__(self) -> Any:
        """Without what was made here."""
        return _task, ({name: getattr(self, name) for name in self.__dataclass_fields__},)

    def program_for(self, settings: str | None, tracker: Tracker | None = None) -> Program | str:
        """The program of a unit with these settings (JSON), or why there is none."""
        if tracker is not None:
            return programs_of(self.model, _with(tracker, settings), self.order)[0]
        if settings not in self._made:
            try:
                self._made[settings] = programs_of(self.model, _with(self.tracker, settings), self.order)[0]
            except (ValueError, TypeError) as error:
                self._made[settings] = f"settings: {error}"
        return self._made[settings]

    def settings_of(self, table: pa.Table, first: Array) -> list[str | None]:
        """The settings of every unit as JSON, from the first of its rows; None where it has none of its own."""
        if not self.settings:
            return [None] * len(first)
        given = table.select([SETTING + name for name in self.settings]).take(first).to_pylist()
        rows = [{name.removeprefix(SETTING): v for name, v in row.items() if v is not None} for row in given]
        return [json.dumps(row, sort_keys=True) if row else None for row in rows]


def _task(fields: Mapping[str, Any]) -> Task:
    return Task(**fields)


def _with(tracker: Tracker, settings: str | None) -> Tracker:
    """A tracker with the settings of a unit."""
    if settings is None:
        return tracker
    changed: Tracker = replace(tracker, **json.loads(settings))  # type: ignore[type-var]
    return changed


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
    """(some rows, whether their only unit goes on in the next): cut where a unit ends, about `ROWS` rows each.

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
    time: Array


def series_of(task: Task, table: pa.Table, code: Array, rows: Array, time: Array, good: Array) -> Series:
    """The samples of the units that are ``good`` (U,), from rows in the order of unit and time."""
    rows = rows[good[code[rows]]]
    keys, first, length = np.unique(code[rows], return_index=True, return_counts=True)
    return Series(keys, rows, first, length, numbers(table.column(task.y))[rows], time[rows])


def continued(
    task: Task, table: pa.Table, some: Series, programs: Sequence[Any], states: Mapping[int, Array], last: Array,
    collected: bool = False,
) -> Advanced:  # fmt: skip
    """Run the series from their states, by the number of the unit; ``last`` (U,) are times of their last samples.

    ``programs`` has an entry for each unit; those of the series are programs.
    """
    before = np.roll(some.time, 1)
    before[some.first] = last[some.keys]
    new = some.first[np.isnat(before[some.first]) if before.dtype.kind == "M" else np.isnan(before[some.first])]
    before[new] = some.time[new]
    gaps = task.clock.between(before, some.time)
    gaps[new] = 1.0
    inputs = [numbers(table.column(name))[some.rows] for name in task.order]
    u = np.stack(inputs, axis=1) if inputs else np.zeros((len(some.rows), 0))
    labels = Labels(task.y, task.order, task.time, zone=task.zone, by=task.by)
    records = Records(tuple(some.keys.tolist()), some.first, some.length, some.y, u, Known.of(gaps), some.time, labels)
    keys = some.keys.tolist()
    begun = np.array([k in states for k in keys])
    words = np.zeros((len(keys), max((len(states[k]) for k in keys if k in states), default=0)), np.int64)
    for j in np.flatnonzero(begun).tolist():
        words[j, : len(states[keys[j]])] = states[keys[j]]
    return advance([programs[k] for k in keys], records, words, begun, threads=1, collected=collected)


def words_after(found: Advanced, some: Series) -> dict[int, Array]:
    """The words of every series after its last sample, by the number of its unit."""
    rows = found.states()
    sizes = [program.layout.size for program in found.programs]
    return {k: row[:size] for k, row, size in zip(some.keys.tolist(), rows, sizes, strict=True)}


def lists(values: Array) -> pa.Array:
    """A row of numbers (N, n) for each sample."""
    offsets = np.arange(len(values) + 1, dtype=np.int32) * values.shape[1]
    return pa.ListArray.from_arrays(offsets, np.ascontiguousarray(values).ravel())
