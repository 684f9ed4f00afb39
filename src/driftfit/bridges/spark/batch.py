"""Batch: a table of many units, each with the bits of `driftfit.track` on one machine.

`repartition` brings the rows of a unit together, `sortWithinPartitions` puts them in order, and every partition is read
once (`mapInArrow`), in pieces of 64,000 rows that end where a unit ends, whose units run in the lanes of tiles. A unit
with more rows is run in parts, so memory does not depend on its length.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa

from driftfit.bridges.spark.frames import by_unit, rows_of, task_of
from driftfit.bridges.spark.units import (
    COUNTS,
    JUDGED,
    SAMPLES,
    SQUARES,
    STANDARD,
    Done,
    Task,
    Units,
    by_output,
    chunks,
    parameters,
    parameters_schema,
    results,
    results_schema,
)
from driftfit.data import late
from driftfit.engine.settings import one_of
from driftfit.judge.fleet_verdict import COLUMNS, Judgement, coverage
from driftfit.judge.verdict import verdict
from driftfit.models.base import Model
from driftfit.run.fleet import Outputs
from driftfit.run.result import Track
from driftfit.trackers.base import Tracker

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
    return by_unit(rows, task, partial(_work, task, outputs, made), made)


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


def _work(
    task: Task, outputs: str, schema: Mapping[str, str], batches: Iterator[pa.RecordBatch]
) -> Iterator[pa.RecordBatch]:
    """What a partition runs."""
    part = Partition(task, outputs, schema)
    for table, more in chunks(batches, task.by, parts=outputs != "verdict"):
        for found in part.run(table, more):
            yield from found.to_batches()


class Partition:
    """The units of a partition, one piece after the other."""

    def __init__(self, task: Task, outputs: str, schema: Mapping[str, str]) -> None:
        self.task, self.outputs, self.schema = task, outputs, schema
        self._going: Units | None = None
        """The part before of a unit that is cut into parts."""

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
        theta, var = (
            np.array([units.joint(k).field(units.words[k], name) for k in which]) for name in ("theta", "var")
        )
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
