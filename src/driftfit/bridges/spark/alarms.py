"""Alarms on Spark: the rules of outputs, and what they say of a unit's samples."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from driftfit.bridges.spark.task import Task
from driftfit.data.storage import describe
from driftfit.engine.kernel import Array
from driftfit.run.lanes import Lane
from driftfit.run.live.alarm import LiveAlarm, check_rule
from driftfit.run.live.rule import AlarmRule
from driftfit.run.result import burn_in
from driftfit.run.warm_start import JointLayout


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
    return any(one is not None and one.kind == "glr" for one in rules)


def alarms_schema(task: Task, rules: Sequence[AlarmRule | None]) -> dict[str, str]:
    """Columns and types of alarms."""
    watched = [of for of, one in zip(task.suffixes, rules, strict=False) if one is not None]
    return {f"{name}{of}": kind for of in watched for name, kind in (("alarm", "boolean"), ("cause", "string"))}


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
        if state is None:
            alarm = LiveAlarm(rule, program.tracker, program.names, max(burn_in(program.model.n) - earlier, 0))
        else:
            alarm = LiveAlarm.of({**state, "rule": describe(rule)}, program.tracker, program.names)
        causes.append(alarm.take_many(out, lane, own, np.ones(len(out))))
        alarm.onsets()
        after.append({name: value for name, value in alarm.plain().items() if name != "rule"})
    return causes, json.dumps(after)
