"""Alarms on a stream: the rule of a reference run, applied sample by sample, bit-equal to `Track.detect` on the record.

It needs the memory of the sums of "glr", and of its last samples. Cost: some ten microseconds per sample in addition
to the update, fifty while an alarm is on.
A `Change` says what an alarm with a frozen reference model found: what changed, by how much and since when.
"""

from __future__ import annotations

from base64 import b64decode, b64encode
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from driftfit.data.instants import instant
from driftfit.data.storage import describe, rebuild
from driftfit.engine.kernel import Array
from driftfit.run.live.conformal import quantile
from driftfit.run.live.likelihood_ratio import scan
from driftfit.run.live.reference_model import (
    FINDINGS,
    INSTEAD,
    LENGTH,
    NOISE_FACTOR,
    ROW,
    SCALE,
    SIZE,
    STD,
    WHICH,
    Y,
    judgeable,
    memory_of,
)
from driftfit.run.live.rule import AlarmRule, check_fits
from driftfit.trackers.base import Tracker

ONSETS_KEPT = 256
"""Number of onsets that are kept until `onsets` is called."""
UNKNOWN = "not known yet"
"""The cause of an alarm while too few samples show it."""


class Onset(NamedTuple):
    """Where an alarm began."""

    sample: int
    """Index of the sample in the stream."""
    time: Any
    """Its time, if the stream has times."""
    cause: str
    """The parameter whose change explains the last samples best, or "noise", or `UNKNOWN`; of "band" the parameter."""
    statistic: float
    limit: float


class LiveAlarm:
    """A rule that watches a stream; `Live.detect` makes it.

    Attributes
    ----------
    rule : AlarmRule
        What is compared with which limits.
    active : bool
        Whether the alarm is on.
    begun : bool
        Whether it began at the last sample.
    statistic : (c,)
        The statistics, in the order of ``rule.names``; NaN where there is nothing to judge.
    samples : int
        Number of samples since the rule was given to the stream, including those that were not judged.
    first : int
        Index of the first of them in the stream.
    """

    def __init__(self, rule: AlarmRule, tracker: Tracker, names: Sequence[str], wait: int = 0, first: int = 0) -> None:
        check_fits(rule, tracker, names)
        self.rule = rule
        self.active = self.begun = False
        self.statistic = np.full(len(rule.names), np.nan)
        self.samples, self.first = 0, first
        self._tracker, self._columns = tracker, rule.columns(names)
        self._wait, self._judged = wait, 0
        self._onsets: deque[Onset] = deque(maxlen=ONSETS_KEPT)
        self._findings = np.full((1, FINDINGS), np.nan)
        if rule.kind == "glr":
            self._frozen = rule.reference
            self._memory = memory_of(self._frozen)

    def __repr__(self) -> str:
        return f"LiveAlarm({self.rule!r}, {'on' if self.active else 'off'} after {self.samples} samples)"

    @property
    def cause(self) -> str:
        """What changed, as known now: of "glr" a parameter, "noise", or "not known yet"; of "band" the parameter."""
        change = self.change
        return self.rule.names[self.rule.cause(self.statistic)] if change is None else change.name

    @property
    def change(self) -> Change | None:
        """For "glr" while the alarm is on: what changed, by how much and since which sample of the stream."""
        return change_of(self.rule, self._findings[0], self.first + self.samples - 1)

    def onsets(self) -> list[Onset]:
        """The alarms that began since the last call; at most the last 256."""
        found = list(self._onsets)
        self._onsets.clear()
        return found

    def take_many(self, rows: Array, lane: int, y: Array, noise: Array, time: Array | None = None) -> list[str | None]:
        """Judge T samples that a lane has processed; the cause of the alarm wherever it is on.

        Parameters
        ----------
        rows : (T,) of the driver's output, or the tile after a single sample
            For "glr" the rows must contain the samples as well (`driftfit.run.columns.COLLECTED`).
        lane : int
        y : (T,)
            The readings as they were given.
        noise : (T,)
            Factors of the noise variance.
        time : (T,) or None
        """
        T, first = len(rows), min(self._wait, len(rows))
        statistic, findings = self._compare(rows[first:], lane, y[first:], noise[first:])
        on = np.zeros(T, bool)
        on[first:] = self.rule.active(statistic, self.active)
        if not self.active and not on.any():  # nothing begins or ends
            self._wait, self.samples, self.begun = self._wait - first, self.samples + T, False
            if first < T:
                self._show(statistic[-1], findings[-1:])
            return [None] * T
        causes: list[str | None] = []
        for t in range(T):
            if t >= first:
                self._show(statistic[t - first], findings[t - first : t - first + 1])
            self._note(t >= first, bool(on[t]), None if time is None else instant(time[t]))
            causes.append(self.cause if self.active else None)
        return causes

    def _note(self, judged: bool, on: bool, time: Any) -> None:
        """Count a sample whose statistic is known, and whether the alarm is on."""
        self.begun, self.active = on and not self.active, on
        self._wait -= not judged
        if self.begun:
            j = self.rule.cause(self.statistic)
            onset = (self.cause, float(self.statistic[j]), self.rule.limits[j])
            self._onsets.append(Onset(self.first + self.samples, time, *onset))
        self.samples += 1

    def _show(self, statistic: Array, findings: Array) -> None:
        """Store the last statistic."""
        self.statistic = statistic.copy()
        self._findings[...] = findings

    def _compare(self, rows: Array, lane: int, y: Array, noise: Array) -> tuple[Array, Array]:
        """(statistics (T, c) after samples, findings of a frozen model)."""
        rule, T = self.rule, len(rows)
        findings = np.full((T, FINDINGS), np.nan)
        if rule.kind == "band":
            theta, var = (rows[name][:, self._columns, lane] for name in ("theta", "var"))
            return rule.outside(theta, np.sqrt(var)), findings
        samples = np.ones((T, len(rule.parameters) + len(ROW)))
        known = {"y": rows["y"][:, lane], "ok": judgeable(rows, lane, y, noise), "noise": noise}
        known["dt"] = rows["dt"][:, lane]
        if rule.of_innovations:
            known |= innovations(rows["e"][:, lane], rows["s"][:, lane], known["ok"])
        else:
            phi = rows["phi"][..., lane]
            samples[:, : phi.shape[1]] = phi
        for place, name in enumerate(ROW, len(rule.parameters)):
            samples[:, place] = known[name]
        n = len(rule.parameters)
        samples[:, n + Y] = rule.drawn(samples[:, :n], samples[:, n + Y], samples[:, n + NOISE_FACTOR], self._judged)
        self._judged += T
        scan(samples, self._frozen, self._memory, findings, np.zeros(T, np.int8))
        return findings[:, : len(rule.names)], findings

    def plain(self) -> dict[str, Any]:
        """The state as plain data."""
        return {
            "rule": describe(self.rule), "active": self.active, "begun": self.begun, "samples": self.samples,
            "statistic": self.statistic.tolist(), "wait": self._wait, "judged": self._judged, "first": self.first,
            "onsets": [list(onset) for onset in self._onsets],
            "memory": [b64encode(part.tobytes()).decode() for part in self._memory] if self.rule.kind == "glr" else [],
        }  # fmt: skip

    @classmethod
    def of(cls, state: Mapping[str, Any], tracker: Tracker, names: Sequence[str]) -> LiveAlarm:
        """The inverse of `plain`."""
        alarm = cls(rebuild(state["rule"], AlarmRule), tracker, names, state["wait"], state["first"])
        alarm.active, alarm.begun, alarm.samples = state["active"], state["begun"], state["samples"]
        alarm.statistic, alarm._judged = np.array(state["statistic"], float), state["judged"]
        alarm._onsets.extend(Onset(*onset) for onset in state["onsets"])
        if alarm.rule.kind == "glr":
            stored = [np.frombuffer(b64decode(one)) for one in state["memory"]]
            if [one.size for one in stored] != [part.size for part in alarm._memory]:
                raise ValueError(
                    "the state of the alarm was saved by another version of driftfit: make the rule again, "
                    "run.detect(...).rule, and give it to a stream that was saved without alarms."
                )
            for part, values in zip(alarm._memory, stored, strict=True):
                part[...] = values.reshape(part.shape)
            alarm._findings[0] = alarm._memory.findings
        return alarm


def innovations(e: Array, s: Array, ok: Array) -> dict[str, Array]:
    """The columns of `ROW` for innovations e (T,) with variances s (T,), which have no regressors."""
    fine = (ok > 0.0) & np.isfinite(e) & (s > 0.0) & np.isfinite(s)
    return {"y": np.where(fine, e, 0.0), "noise": np.where(fine, s, 1.0), "ok": np.where(fine, ok, 0.0)}


def check_rule(rule: Any) -> AlarmRule:
    """Raise an error for anything that is not a rule."""
    if not isinstance(rule, AlarmRule):
        raise TypeError(
            "Live.detect: pass the rule of a reference run, as in run.detect(reference=500).rule; "
            f"got {type(rule).__name__}."
        )
    return rule


class Change(NamedTuple):
    """The change that explains the last samples best, at most 384 of them, with a band of 95 %.

    Of a parameter, ``size`` is the difference from its value in the reference; of the noise, the factor of its standard
    deviation. ``since`` is the first sample after it, if all since then were used. ``instead`` is what else explains
    them as well; empty if nothing does. While the change is less than four samples old, the name is "not known yet" and
    the numbers are NaN.
    """

    name: str
    size: float
    low: float
    high: float
    since: int
    instead: str = ""


def change_of(rule: AlarmRule, findings: Array, t: int) -> Change | None:
    """The change that the findings of sample t show; None if no statistic is beyond its end."""
    which, size, std, L, other = findings[[WHICH, SIZE, STD, LENGTH, INSTEAD]]
    if np.isnan(L):
        return None
    since, names = max(t + 1 - int(L), 0), (*rule.parameters, "noise")
    if np.isnan(which):
        return Change(UNKNOWN, np.nan, np.nan, np.nan, since)
    name, model = names[int(which)], rule.reference
    unit = 1.0 if name == "noise" else model.numbers[SCALE] / model.unit[int(which)]
    half, instead = quantile(0.95) * std, "" if np.isnan(other) else names[int(other)]
    return Change(name, float(unit * size), float(unit * (size - half)), float(unit * (size + half)), since, instead)
