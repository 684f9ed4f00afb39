"""What a worker of Spark receives: the settings of its task, and pieces of the rows, whose units it runs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from driftfit.data import late
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
        return Task, tuple(getattr(self, name) for name in self.__dataclass_fields__)

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


ARROW = {
    "double": pa.float64(), "boolean": pa.bool_(), "bigint": pa.int64(), "string": pa.string(), "binary": pa.binary(),
    "array<double>": pa.list_(pa.float64()),
}  # fmt: skip
COUNTS = ("samples", "used", "without_time", "repeated", "late")
"""Counts that a unit has."""
SAMPLES, USED, *_REFUSED = range(len(COUNTS))
PLACES = dict(zip((late.UNTIMED, late.REPEATED, late.LATE), _REFUSED, strict=True))
"""Where rows that are left out are counted."""
SQUARES, STANDARD, JUDGED = range(3)
"""Sums of each output: of e^2, of e^2 / s, and how many terms the latter has."""


class Done(NamedTuple):
    """A run of units."""

    rows: Array
    """(N,): the rows of its samples in the table."""
    keys: list[int]
    """The numbers of its units."""
    found: Advanced


class Units:
    """U units, whose N rows are sorted by unit.

    Attributes
    ----------
    first, code : (U,), (N,)
        The first row of each unit, and the number of the unit of each row.
    time : (N,)
        Floats, or datetime64 in UTC; NaN or NaT where there is none.
    there : (U,) bool
        Which units have a name.
    settings, joints : list of U
        Settings as JSON, None where they are the task's; the programs, or why there are none.
    last, newest : (U,)
        Times of the last sample, and of the newest row; NaN or NaT without one.
    counts, squares : (U, COUNTS), (U, ny, 3)
    packed : dict
        States as they came, by the number of the unit; they are unpacked to ``words`` when a sample follows.
    """

    def __init__(self, task: Task, table: pa.Table) -> None:
        self.task, self.table = task, table
        self.first = begins(table, task.by)
        self.code = np.repeat(np.arange(len(self.first)), np.diff(np.append(self.first, table.num_rows)))
        self.time = times(table.column(task.time))
        self.there = np.ones(len(self.first), bool)
        for name in task.by:
            self.there &= pc.is_valid(table.column(name)).to_numpy()[self.first]
        self.last = np.full(len(self.first), "NaT" if self.time.dtype.kind == "M" else np.nan, self.time.dtype)
        self.newest = self.last.copy()
        self.counts: Array = np.zeros((len(self.first), len(COUNTS)), np.int64)
        self.squares = np.zeros((len(self.first), len(task.y), 3))
        self.packed: dict[int, bytes] = {}
        self.words: dict[int, Array] = {}
        self.set(task.settings_of(table, self.first))

    def set(self, settings: list[str | None]) -> None:
        """Give every unit its settings."""
        self.settings, self.joints = settings, [self.task.joint_for(one) for one in settings]

    @property
    def good(self) -> Array:
        """Which units can run."""
        return np.asarray(self.there & np.array([isinstance(one, JointLayout) for one in self.joints]))

    def joint(self, k: int) -> JointLayout:
        """The programs of a unit that can run."""
        found = self.joints[k]
        assert isinstance(found, JointLayout)
        return found

    def reason(self, k: int) -> str | None:
        """Why a unit cannot run."""
        found = self.joints[k]
        return "rows without a unit" if not self.there[k] else found if isinstance(found, str) else None

    def state(self, k: int) -> bytes:
        """The packed state of a unit."""
        if k in self.packed:
            return self.packed[k]
        return self.joint(k).pack(self.words[k]) if k in self.words else self.joint(k).start

    def count(self, fate: Array, rows: Array) -> None:
        """Count rows that are left out."""
        for code, place in PLACES.items():
            self.counts[:, place] += np.bincount(self.code[rows[fate == code]], minlength=len(self.first))

    def run(self, rows: Array, collected: bool = False) -> Done | None:
        """Run the units that can on some rows, in the order of unit and time; None if there is no sample.

        States, times, counts and sums go on.
        """
        rows = rows[self.good[self.code[rows]]]
        if not len(rows):
            return None
        records = self._records(rows)
        keys, ny = self.code[rows[records.first]].tolist(), len(self.task.y)
        for k in self.packed.keys() & set(keys):
            self.words[k] = self.joint(k).unpack(self.packed.pop(k))
        begun = np.array([k in self.words for k in keys])
        known = [self.words[k].reshape(ny, -1) if k in self.words else np.zeros((ny, 0), np.int64) for k in keys]
        words = np.zeros((len(keys) * ny, max(one.shape[1] for one in known)), np.int64)
        for j in np.flatnonzero(begun).tolist():
            words[j * ny : (j + 1) * ny, : known[j].shape[1]] = known[j]
        programs = [one for k in keys for one in self.joint(k).programs]
        found = advance(programs, records, words, np.repeat(begun, ny), threads=1, collected=collected)
        self._go_on(found, keys)
        return Done(rows, keys, found)

    def _records(self, rows: Array) -> Records:
        """The samples of units in flat arrays, one unit after the other."""
        task = self.task
        keys, first, length = np.unique(self.code[rows], return_index=True, return_counts=True)
        time = self.time[rows]
        gaps = task.clock.continued(time, first, self.last[keys])
        signals = np.stack([numbers(self.table.column(name))[rows] for name in (*task.y, *task.order)], axis=1)
        every, u = (np.ascontiguousarray(part) for part in np.split(signals, [len(task.y)], axis=1))
        y, known, outputs = every[:, 0], Known.of(gaps), tuple[str, ...]()
        if len(task.y) > 1:
            y, known, outputs = every, known.for_outputs(np.ones(every.shape)), task.y
        labels = Labels(task.y[0] if not outputs else "y", task.order, task.time, zone=task.zone, by=task.by)
        return Records(tuple(keys.tolist()), first, length, y, u, known, time, labels, outputs=outputs)

    def _go_on(self, found: Advanced, keys: Sequence[int]) -> None:
        """Note states and times after the samples; a sample is used if one of its outputs is."""
        records, ny, after = found.records, len(self.task.y), found.states()
        assert records.time is not None
        self.last[keys] = records.time[records.first + records.length - 1]
        for j, k in enumerate(keys):
            self.words[k] = after[j * ny : (j + 1) * ny, : found.programs[j * ny].layout.size].reshape(-1)
        ok, e, s = (found.column(name).reshape(len(records.time), ny) for name in ("ok", "e", "s"))
        used = ok > 0.0
        judged = used & np.isfinite(s) & (s > 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            terms = {SQUARES: np.where(judged, e * e, 0.0), STANDARD: np.where(judged, e * e / s, 0.0), JUDGED: judged}
        for place, values in terms.items():
            self.squares[keys, :, place] += np.add.reduceat(np.asarray(values, float), records.first)
        self.counts[keys, USED] += np.add.reduceat(used.any(axis=1).astype(int), records.first)
        self.counts[keys, SAMPLES] += records.length

    def taken(self, names: Sequence[str], rows: Array) -> dict[str, Any]:
        """Columns of some rows of the table."""
        return {name: self.table.column(name).take(pa.array(rows)) for name in names}

    def counted(self, which: Sequence[int]) -> dict[str, Any]:
        """The counts of some units."""
        return {name: self.counts[which, j] for j, name in enumerate(COUNTS)}

    def instants(self, values: Array) -> pa.Array:
        """Times as a column of the table's type; NaN and NaT are null."""
        if values.dtype.kind != "M":
            return pa.array(values, mask=np.isnan(values))
        like = self.table.schema.field(self.task.time).type
        return pa.array(values.astype("M8[us]").view(np.int64), mask=np.isnat(values)).cast(like)

    def filled(self, columns: Mapping[str, Any], schema: Mapping[str, str]) -> pa.Table:
        """A table with all columns of a schema, null where there are none; keys and times have this table's types."""
        count, types, made = len(next(iter(columns.values()))), self.table.schema, {}
        for name, kind in schema.items():
            arrow, column = types.field(name).type if name in types.names else ARROW[kind], columns.get(name)
            known = isinstance(column, pa.Array | pa.ChunkedArray)
            made[name] = pa.nulls(count, arrow) if column is None else column if known else pa.array(column, arrow)
        return pa.table(made)


def numbers(column: pa.ChunkedArray) -> Array:
    """Floats, NaN where there is none."""
    return np.asarray(column.cast(pa.float64()).to_numpy(), float)  # a null becomes NaN


def times(column: pa.ChunkedArray) -> Array:
    """Floats, or datetime64 in UTC; NaN or NaT where there is none."""
    if not pa.types.is_timestamp(column.type):
        return numbers(column)
    return np.asarray(column.cast(pa.timestamp("us")).to_numpy().astype("M8[us]"))


def results(task: Task, found: Advanced) -> dict[str, pa.Array]:
    """The results at every sample, as `results_schema` names them."""
    with np.errstate(invalid="ignore"):
        std, deviation = np.sqrt(found.column("var")), np.sqrt(found.column("s"))
    own = {"prediction": found.column("y_hat"), "innovation": found.column("e"), "innovation_std": deviation}
    own["ok"] = found.column("ok") > 0.0
    return by_output(task, own) | parameters(task, found.column("theta"), std)


def by_output(task: Task, own: Mapping[str, Array]) -> dict[str, pa.Array]:
    """A column for each output of values (N,) or (N, ny)."""
    return {
        f"{name}{of}": pa.array(np.ascontiguousarray(values.reshape(len(values), -1)[:, j]))
        for j, of in enumerate(task.suffixes)
        for name, values in own.items()
    }


def parameters(task: Task, theta: Array, std: Array) -> dict[str, pa.Array]:
    """The columns of parameters (N, n) or (N, ny, n)."""
    columns: dict[str, pa.Array] = {}
    for j, (names, of) in enumerate(zip(task.names, task.suffixes, strict=True)):
        for what, every in (("theta", theta), ("std", std)):
            path = every.reshape(len(every), len(task.y), -1)[:, j]
            if task.arrays:
                offsets = np.arange(len(path) + 1, dtype=np.int32) * path.shape[1]
                columns[f"{what}{of}"] = pa.ListArray.from_arrays(offsets, np.ascontiguousarray(path).ravel())
            else:
                columns |= {f"{what}_{name}": pa.array(path[:, i].copy()) for i, name in enumerate(names)}
    return columns
