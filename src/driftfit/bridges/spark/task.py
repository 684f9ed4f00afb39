"""The settings that a worker of Spark receives, and pieces of the rows that it is given."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from driftfit.data.arguments import ordered
from driftfit.data.clock import Clock
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
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


def begins(table: pa.Table, by: Sequence[str]) -> Array:
    """The first row of each unit of a table with at least one row, in the order of units; missing names are equal."""
    new = np.zeros(table.num_rows, bool)
    new[0] = True
    for name in by:
        column = table.column(name).combine_chunks()
        codes = pc.dictionary_encode(column, null_encoding="encode").indices.to_numpy(zero_copy_only=False)
        new[1:] |= codes[1:] != codes[:-1]
    return np.flatnonzero(new)


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
        cut = int(begins(table, by)[-1])
        if cut:
            yield table.slice(0, cut), False
        elif parts:
            cut = count - 1  # the last row stays, so that the unit is known to go on
            yield table.slice(0, cut), True
        waiting = table.slice(cut).to_batches()
    if sum(one.num_rows for one in waiting):
        yield pa.Table.from_batches(waiting).combine_chunks(), False
