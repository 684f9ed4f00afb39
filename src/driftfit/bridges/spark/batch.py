"""Batch: a table of many units, each with the bits of `driftfit.track` on one machine.

`repartition` brings the rows of a unit together, `sortWithinPartitions` puts them in order, and every partition is read
once (`mapInArrow`), in pieces of 64,000 rows that end where a unit ends, whose units run in the lanes of tiles. A unit
with more rows is run in parts, so memory does not depend on its length.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from driftfit.bridges.spark.frames import rows_of, task_of
from driftfit.bridges.spark.pieces import (
    COUNTS,
    REPEATED,
    UNTIMED,
    Piece,
    Sums,
    add,
    ends,
    filled,
    instants,
    named,
    results,
    why,
)
from driftfit.bridges.spark.task import (
    Task,
    chunks,
    continued,
    parameters_schema,
    results_schema,
    series_of,
    times,
    units_of,
    words_after,
)
from driftfit.engine.kernel import Array
from driftfit.engine.settings import one_of
from driftfit.judge.verdict import verdict
from driftfit.models.base import Model
from driftfit.run.outputs import Outputs
from driftfit.run.result import Track
from driftfit.run.warm_start import JointLayout
from driftfit.trackers.base import Tracker

OUTPUTS = ("samples", "summary", "verdict", "states")
VERDICT = {"drifts": "boolean", "p": "double", "pays": "boolean", "moved": "string"}


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
        tracker's variances hold) and counts; the same with what `Track.verdict` says (whether parameters move, its p,
        whether tracking pays, the parameter that moves most clearly), for which a unit is held in memory; or a row per
        unit with its state, from which `follow` begins.
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
    order = [*task.by, task.time, *task.y, *task.u]
    sorted_rows = rows.repartition(*task.by).sortWithinPartitions(*order)
    made = schema_of(task, dict(rows.dtypes), outputs)
    return sorted_rows.mapInArrow(_worker(task, outputs, made), ", ".join(f"`{n}` {kind}" for n, kind in made.items()))


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


def _worker(
    task: Task, outputs: str, schema: Mapping[str, str]
) -> Callable[[Iterator[pa.RecordBatch]], Iterator[pa.RecordBatch]]:

    def work(batches: Iterator[pa.RecordBatch]) -> Iterator[pa.RecordBatch]:
        part = Partition(task, outputs, schema)
        for table, more in chunks(batches, task.by, parts=outputs != "verdict"):
            for found in part.run(table, more):
                yield from found.to_batches()

    return work


class Partition:
    """The units of a partition, one piece after the other."""

    def __init__(self, task: Task, outputs: str, schema: Mapping[str, str]) -> None:
        self.task, self.outputs, self.schema = task, outputs, schema
        self._going: Piece | None = None
        """The part before of a unit that is cut into parts."""

    def run(self, table: pa.Table, more: bool) -> Iterator[pa.Table]:
        """Results of some rows; ``more`` if their only unit continues in the next call."""
        piece = self._piece(table)
        self._going = piece if more else None
        if self.outputs == "samples" and piece.found is not None:
            rows = pa.array(piece.some.rows)
            own = {name: table.column(name).take(rows) for name in self.task.columns}
            yield filled(own | results(self.task, piece.found), self.schema, table)
        good = [k for k, reason in enumerate(piece.reasons) if reason is None]
        bad = [k for k, reason in enumerate(piece.reasons) if reason is not None]
        if self.outputs != "samples" and good and not more:
            yield filled(self._of_units(piece, good), self.schema, table)
        if bad and not more:
            reasons = {"failed": [piece.reasons[k] for k in bad]}
            yield filled(self._named(piece, bad) | self._counts(piece, bad) | reasons, self.schema, table)

    def _piece(self, table: pa.Table) -> Piece:
        task = self.task
        first, code = units_of(table, task.by)
        time, there = times(table.column(task.time)), named(table, task.by)[first]
        settings = task.settings_of(table, first)
        joints = [task.joint_for(one) for one in settings]
        last = np.full(len(first), "NaT" if time.dtype.kind == "M" else np.nan, time.dtype)
        states: dict[int, Array] = {}
        sums = Sums.of(len(first), task)
        if self._going is not None:
            last[0], states = self._going.last[0], dict(self._going.words)
            sums.counts[0], sums.squares[0] = (part[0] for part in self._going.sums)
        rows = _usable(code, time, last, sums.counts)
        good = there & np.array([isinstance(one, JointLayout) for one in joints])
        some = series_of(task, table, code, rows, time, good)
        found = continued(task, table, some, joints, states, last) if len(some.rows) else None
        if found is not None:
            add(sums, some, found)
            last[some.keys] = some.time[some.first + some.length - 1]
            states |= words_after(found, some)
        return Piece(table, first, settings, joints, why(joints, there, sums), last, sums, some, found, states)

    def _named(self, piece: Piece, which: list[int]) -> dict[str, Any]:
        """The units, and their last times."""
        rows = pa.array(piece.first[which])
        columns: dict[str, Any] = {name: piece.table.column(name).take(rows) for name in self.task.by}
        return columns | {self.task.time: instants(piece.last[which], piece.table.schema.field(self.task.time).type)}

    def _counts(self, piece: Piece, which: list[int]) -> dict[str, Any]:
        return {name: piece.sums.counts[which, j] for j, name in enumerate(COUNTS)}

    def _of_units(self, piece: Piece, which: list[int]) -> dict[str, Any]:
        """A row for each unit that has a result."""
        own = self._named(piece, which) | self._counts(piece, which)
        if self.outputs == "states":
            packed = [piece.joints[k].pack(piece.words[k]) for k in which]  # type: ignore[union-attr]
            return own | {"state": packed, "settings": [piece.settings[k] for k in which]}
        own |= ends(self.task, piece, which)
        return own | (self._verdicts(piece, which) if self.outputs == "verdict" else {})

    def _verdicts(self, piece: Piece, which: list[int]) -> dict[str, Any]:
        """What is judged of every output of each unit."""
        found, place = piece.found, {int(k): j for j, k in enumerate(piece.some.keys)}
        assert found is not None
        ny = len(self.task.y)
        columns: dict[str, list[Any]] = {f"{name}{of}": [] for of in self.task.suffixes for name in VERDICT}
        for k in which:
            j = place[k]
            each = range(j * ny, (j + 1) * ny)
            own = found.lanes.part(each)
            programs = [found.programs[i] for i in each]
            runs = (
                [Track(programs[0], found.records.part(j), own[0])]
                if ny == 1
                else Outputs(programs, found.records.some(j, j + 1), own, {}, {}).values()
            )
            for run, of in zip(runs, self.task.suffixes, strict=True):
                truth = verdict(run)
                most = min(truth.parameters, key=lambda one: (not one.moves, np.nan_to_num(one.p_own, nan=1.0)))
                for name, value in zip(VERDICT, (truth.drifts, truth.p, truth.pays, most.name), strict=True):
                    columns[f"{name}{of}"].append(value)
        return columns


def _usable(code: Array, time: Array, last: Array, counts: Array) -> Array:
    """The rows that become samples, of rows in the order of unit and time; the others are counted."""
    untimed = np.isnat(time) if time.dtype.kind == "M" else ~np.isfinite(time)
    timed = np.flatnonzero(~untimed)
    again = np.zeros(len(timed), bool)
    again[1:] = (code[timed][1:] == code[timed][:-1]) & (time[timed][1:] == time[timed][:-1])
    again |= time[timed] == last[code[timed]]
    for place, rows in ((UNTIMED, np.flatnonzero(untimed)), (REPEATED, timed[again])):
        counts[:, place] += np.bincount(code[rows], minlength=len(counts))
    return timed[~again]
