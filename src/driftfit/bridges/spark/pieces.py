"""Pieces of a partition: the rows of some units, what became of them, and tables of it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from driftfit.bridges.spark.task import Series, Task, lists
from driftfit.data.storage import describe
from driftfit.engine.kernel import Array
from driftfit.run.lanes import Lane
from driftfit.run.live.alarm import LiveAlarm, check_rule
from driftfit.run.live.rule import FROZEN, AlarmRule
from driftfit.run.parallel_lanes import Advanced
from driftfit.run.program import Program
from driftfit.run.result import burn_in
from driftfit.run.warm_start import JointLayout

ARROW = {
    "double": pa.float64(), "boolean": pa.bool_(), "bigint": pa.int64(), "string": pa.string(), "binary": pa.binary(),
    "array<double>": pa.list_(pa.float64()),
}  # fmt: skip
COUNTS = ("samples", "used", "without_time", "repeated", "late")
"""Counts that a unit has."""
SAMPLES, USED, UNTIMED, REPEATED, LATE = range(len(COUNTS))
SQUARES, STANDARD, JUDGED = range(3)
"""Sums of each output: of e^2, of e^2 / s, and how many terms the latter has."""


class Sums(NamedTuple):
    """What is counted and summed up of U units."""

    counts: Array
    """(U, COUNTS)"""
    squares: Array
    """(U, ny, 3)"""

    @classmethod
    def of(cls, units: int, task: Task) -> Sums:
        return cls(np.zeros((units, len(COUNTS)), int), np.zeros((units, len(task.y), 3)))


class Piece(NamedTuple):
    """What was found in the rows of a table, with an entry for each of their units."""

    table: pa.Table
    first: Array
    """(U,): the first row of each unit."""
    settings: Sequence[str | None]
    joints: Sequence[JointLayout | str]
    reasons: Sequence[str | None]
    """Why a unit has no result."""
    last: Array
    """(U,): the time of its last sample."""
    sums: Sums
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


def add(sums: Sums, some: Series, found: Advanced) -> None:
    """Add the samples of the series to the sums of their units; a sample is used if one of its outputs is."""
    ok, e, s = (found.column(name).reshape(some.y.shape) for name in ("ok", "e", "s"))
    used = ok > 0.0
    judged = used & np.isfinite(s) & (s > 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        terms = {SQUARES: np.where(judged, e * e, 0.0), STANDARD: np.where(judged, e * e / s, 0.0), JUDGED: judged}
    for place, values in terms.items():
        sums.squares[some.keys, :, place] += np.add.reduceat(np.asarray(values, float), some.first)
    sums.counts[some.keys, USED] += np.add.reduceat(used.any(axis=1).astype(int), some.first)
    sums.counts[some.keys, SAMPLES] += some.length


def why(joints: Sequence[JointLayout | str], there: Array, sums: Sums) -> list[str | None]:
    """The reason why each unit has no result; None where it has one."""
    reasons: list[str | None] = [one if isinstance(one, str) else None for one in joints]
    for k in np.flatnonzero(~there | (sums.counts[:, SAMPLES] == 0)).tolist():
        if not there[k]:
            reasons[k] = "rows without a unit"
        elif reasons[k] is None:
            reasons[k] = "no row has a time"
    return reasons


def results(task: Task, found: Advanced) -> dict[str, pa.Array]:
    """The results at every sample, as `results_schema` names them."""
    with np.errstate(invalid="ignore"):
        std, deviation = np.sqrt(found.column("var")), np.sqrt(found.column("s"))
    own = {"prediction": found.column("y_hat"), "innovation": found.column("e"), "innovation_std": deviation}
    own["ok"] = found.column("ok") > 0.0
    columns = _by_output(task, own)
    return columns | parameters(task, found.column("theta"), std)


def _by_output(task: Task, own: Mapping[str, Array]) -> dict[str, pa.Array]:
    """A column for each output of values (N,) or (N, ny)."""
    return {
        f"{name}{of}": pa.array(np.ascontiguousarray(values.reshape(len(values), -1)[:, j]))
        for j, of in enumerate(task.suffixes)
        for name, values in own.items()
    }


def ends(task: Task, piece: Piece, which: Sequence[int]) -> dict[str, pa.Array]:
    """The parameters of units after their last sample, and what is summed up of their innovations."""
    theta, var = (
        np.array([piece.joints[k].field(piece.words[k], name) for k in which])  # type: ignore[union-attr]
        for name in ("theta", "var")
    )
    squares = piece.sums.squares[which]
    with np.errstate(invalid="ignore", divide="ignore"):
        rms, standardised = (np.sqrt(squares[..., j] / squares[..., JUDGED]) for j in (SQUARES, STANDARD))
        paths = parameters(task, theta, np.sqrt(var))
    return paths | _by_output(task, {"rms": rms, "standardised": standardised})


def parameters(task: Task, theta: Array, std: Array) -> dict[str, pa.Array]:
    """The columns of parameters (N, n) or (N, ny, n)."""
    columns: dict[str, pa.Array] = {}
    for j, (names, of) in enumerate(zip(task.names, task.suffixes, strict=True)):
        for what, every in (("theta", theta), ("std", std)):
            path = every.reshape(len(every), len(task.y), -1)[:, j]
            if task.arrays:
                columns[f"{what}{of}"] = lists(path)
            else:
                columns |= {f"{what}_{name}": pa.array(path[:, i].copy()) for i, name in enumerate(names)}
    return columns


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


def rules_of(task: Task, rule: Any) -> tuple[AlarmRule | None, ...]:
    """The rule of each output: one output has one, several have rules by their names; ValueError for anything else."""
    if rule is None or len(task.y) == 1:
        return (None if rule is None else check_rule(rule),)
    given = dict(rule) if isinstance(rule, Mapping) else {None: rule}
    if not given or any(name not in task.y for name in given):
        raise ValueError(
            f"spark.follow: give rules by the name of their output; got {rule!r}, and the outputs are "
            f"{', '.join(task.y)}."
        )
    return tuple(check_rule(given[name]) if name in given else None for name in task.y)


def collects(rules: Sequence[AlarmRule | None]) -> bool:
    """Whether a rule needs the samples as the tracker receives them."""
    return any(one is not None and one.kind in FROZEN for one in rules)


def alarms_schema(task: Task, rules: Sequence[AlarmRule | None]) -> dict[str, str]:
    """Columns and types of alarms."""
    watched = [of for of, one in zip(task.suffixes, rules, strict=False) if one is not None]
    return {f"{name}{of}": kind for of in watched for name, kind in (("alarm", "boolean"), ("cause", "string"))}


def alarms_of(schema: Mapping[str, str], causes: Sequence[Sequence[str | None]]) -> dict[str, list[Any]]:
    """The columns of `alarms_schema` from the causes of each watched output."""
    each = [column for one in causes for column in ([cause is not None for cause in one], list(one))]
    return dict(zip(schema, each, strict=True))


def watched(
    rules: Sequence[AlarmRule | None],
    joint: JointLayout,
    watch: str | None,
    earlier: int,
    lanes: Iterable[Lane],
    y: Array,
) -> tuple[list[list[str | None]], str]:
    """(the cause of the alarm of each watched output at every sample, what `watched` continues from).

    ``lanes`` has that of each output, and y (T, ny) the readings. After ``earlier`` samples without one, an alarm
    begins to watch.
    """
    before = json.loads(watch) if watch else [None] * len(rules)
    causes: list[list[str | None]] = []
    after: list[dict[str, Any] | None] = []
    for rule, program, state, (out, _, lane), own in zip(rules, joint.programs, before, lanes, y.T, strict=True):
        if rule is None:
            after.append(None)
            continue
        alarm = _alarm(rule, program, state, earlier)
        causes.append(alarm.take_many(out, lane, own, np.ones(len(out))))
        alarm.onsets()
        after.append({name: value for name, value in alarm.plain().items() if name != "rule"})
    return causes, json.dumps(after)


def _alarm(rule: AlarmRule, program: Program, state: Mapping[str, Any] | None, earlier: int) -> LiveAlarm:
    """An alarm from its state without the rule, or a new one after so many earlier samples."""
    if state is None:
        return LiveAlarm(rule, program.tracker, program.names, max(burn_in(program.model.n) - earlier, 0))
    return LiveAlarm.of({**state, "rule": describe(rule)}, program.tracker, program.names)
