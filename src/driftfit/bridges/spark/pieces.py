"""Pieces of a partition: the rows of some units, what became of them, and tables of it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from driftfit.bridges.spark.task import Series, Task, lists
from driftfit.data.storage import describe
from driftfit.engine.kernel import Array
from driftfit.run.live.alarm import LiveAlarm
from driftfit.run.live.rule import AlarmRule
from driftfit.run.program import Program
from driftfit.run.result import burn_in
from driftfit.run.states.advance import Advanced

ARROW = {
    "double": pa.float64(), "boolean": pa.bool_(), "bigint": pa.int64(), "string": pa.string(), "binary": pa.binary(),
    "array<double>": pa.list_(pa.float64()),
}  # fmt: skip
COUNTS = ("samples", "used", "without_time", "repeated", "late")
"""Counts that a unit has."""
SAMPLES, USED, UNTIMED, REPEATED, LATE = range(len(COUNTS))
SQUARES, STANDARD, JUDGED = range(len(COUNTS), len(COUNTS) + 3)
"""Sums of e^2, of e^2 / s, and how many terms the latter has."""
SUMS = len(COUNTS) + 3


class Piece(NamedTuple):
    """What was found in the rows of a table, with an entry for each of their units."""

    table: pa.Table
    first: Array
    """(U,): the first row of each unit."""
    settings: Sequence[str | None]
    programs: Sequence[Program | str]
    reasons: Sequence[str | None]
    """Why a unit has no result."""
    last: Array
    """(U,): the time of its last sample."""
    sums: Array
    """(U, SUMS)"""
    some: Series
    found: Advanced | None
    words: Mapping[int, Array]
    """Its state."""


def named(table: pa.Table, by: Sequence[str]) -> Array:
    """Which rows have a unit."""
    there = np.ones(table.num_rows, bool)
    for name in by:
        there &= pc.is_valid(table.column(name)).to_numpy()
    return there


def add(sums: Array, some: Series, found: Advanced) -> None:
    """Add the samples of the series to the sums of their units."""
    ok, e, s = (found.column(name) for name in ("ok", "e", "s"))
    used = ok > 0.0
    judged = used & np.isfinite(s) & (s > 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        terms = {USED: used, SQUARES: np.where(judged, e * e, 0.0), STANDARD: np.where(judged, e * e / s, 0.0)}
    for place, values in {**terms, JUDGED: judged}.items():
        sums[some.keys, place] += np.add.reduceat(np.asarray(values, float), some.first)
    sums[some.keys, SAMPLES] += some.length


def why(programs: Sequence[Program | str], there: Array, sums: Array) -> list[str | None]:
    """The reason why each unit has no result; None where it has one."""
    reasons: list[str | None] = [one if isinstance(one, str) else None for one in programs]
    for k in np.flatnonzero(~there | (sums[:, SAMPLES] == 0)).tolist():
        if not there[k]:
            reasons[k] = "rows without a unit"
        elif reasons[k] is None:
            reasons[k] = "no row has a time"
    return reasons


def results(task: Task, found: Advanced) -> dict[str, pa.Array]:
    """The results at every sample, as `Program.schema` names them."""
    with np.errstate(invalid="ignore"):
        std, deviation = np.sqrt(found.column("var")), np.sqrt(found.column("s"))
    own = {"prediction": found.column("y_hat"), "innovation": found.column("e"), "innovation_std": deviation}
    columns = {name: pa.array(values) for name, values in own.items()} | {"ok": pa.array(found.column("ok") > 0.0)}
    return columns | parameters(task, found.column("theta"), std)


def ends(task: Task, piece: Piece, which: Sequence[int]) -> dict[str, pa.Array]:
    """The parameters of units after their last sample."""
    programs = [piece.programs[k] for k in which]
    theta, var = (
        np.array([one.layout.field(piece.words[k], name) for k, one in zip(which, programs, strict=True)])  # type: ignore[union-attr]
        for name in ("theta", "var")
    )
    with np.errstate(invalid="ignore"):
        return parameters(task, theta.reshape(len(which), -1), np.sqrt(var).reshape(len(which), -1))


def parameters(task: Task, theta: Array, std: Array) -> dict[str, pa.Array]:
    """The columns of parameters (N, n)."""
    if task.arrays:
        return {"theta": lists(theta), "std": lists(std)}
    paths = (("theta", theta), ("std", std))
    return {f"{what}_{name}": pa.array(path[:, i].copy()) for i, name in enumerate(task.names) for what, path in paths}


def instants(values: Array, like: pa.DataType) -> pa.Array:
    """Times as a column of a type; NaN and NaT are null."""
    if values.dtype.kind != "M":
        return pa.array(values, mask=np.isnan(values))
    return pa.array(values.astype("M8[us]").view(np.int64), mask=np.isnat(values)).cast(like)


def filled(columns: Mapping[str, Any], schema: Mapping[str, str], like: pa.Table) -> pa.Table:
    """A table with all columns of a schema, null where there are none; keys and times have the types of ``like``."""
    count = len(next(iter(columns.values())))
    made = {}
    for name, kind in schema.items():
        arrow = like.schema.field(name).type if name in like.schema.names else ARROW[kind]
        column = columns.get(name)
        made[name] = pa.nulls(count, arrow) if column is None else column if isinstance(column, pa.ChunkedArray) else (
            column if isinstance(column, pa.Array) else pa.array(column, arrow))  # fmt: skip
    return pa.table(made)


def alarm_of(rule: AlarmRule, program: Program, watch: str | None, earlier: int) -> LiveAlarm:
    """The alarm of a unit, from what `watch_of` wrote, or after so many earlier samples without one."""
    if watch is None:
        return LiveAlarm(rule, program.tracker, program.names, max(burn_in(program.model.n) - earlier, 0))
    return LiveAlarm.of({**json.loads(watch), "rule": describe(rule)}, program.tracker, program.names)


def watch_of(alarm: LiveAlarm) -> str:
    """The state of an alarm, without its rule."""
    alarm.onsets()
    return json.dumps({name: value for name, value in alarm.plain().items() if name != "rule"})
