"""Alarms on a stream: the rule of a reference run, applied sample by sample, bit-equal to `Track.detect` on the record.

It needs the memory of the window, or of the sums of "glr". Cost: some ten microseconds per sample in addition to the
update.
A `Change` says what an alarm with a frozen reference model found: what changed, by how much and since when.
"""

from __future__ import annotations

from base64 import b64decode, b64encode
from collections import deque
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from driftfit.data.instants import instant
from driftfit.data.storage import describe, rebuild
from driftfit.engine.kernel import Array, Driver
from driftfit.run.live.likelihood_ratio import scan
from driftfit.run.live.reference_model import (
    NOISE_FACTOR,
    NOISE_WINDOW,
    RATIO,
    RAW,
    ROW,
    SCALE,
    SIZE,
    SPREAD,
    STD,
    WHICH,
    WINDOW,
    Y,
    judgeable,
    memory_of,
)
from driftfit.run.live.rule import FROZEN, AlarmRule, change_probability, check_fits
from driftfit.trackers.base import Tracker

ONSETS_KEPT = 256
"""Number of onsets that are kept until `onsets` is called."""


class Onset(NamedTuple):
    """Where an alarm began."""

    sample: int
    """Index of the sample in the stream."""
    time: Any
    """Its time, if the stream has times."""
    cause: str
    """The column that is furthest beyond its limit."""
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
        self._wait, self._left, self._judged = wait, 0, 0
        self._scores: deque[float] = deque(maxlen=rule.window)
        self._onsets: deque[Onset] = deque(maxlen=ONSETS_KEPT)
        if rule.kind in FROZEN:
            self._frozen = rule.reference
            self._memory = memory_of(self._frozen)
            self._row = np.ones((1, len(rule.parameters) + len(ROW)))
            self._findings = self._memory.findings[None].copy()

    def __repr__(self) -> str:
        return f"LiveAlarm({self.rule!r}, {'on' if self.active else 'off'} after {self.samples} samples)"

    @property
    def cause(self) -> str:
        """The column that is now furthest beyond its limit; of "glr" the parameter that moved, or "noise"."""
        change = self.change
        return self.rule.names[self.rule.cause(self.statistic)] if change is None else change.name

    @property
    def change(self) -> Change | None:
        """For "glr" and "cusum": what changed, by how much and since which sample of the stream; otherwise None."""
        if self.rule.kind not in FROZEN:
            return None
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
            For "glr" and "cusum" the rows must contain the samples as well (`driftfit.run.columns.COLLECTED`).
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
        on[first:] = self.rule.exceeded(statistic)
        if not self._left and not on.any():  # nothing begins or ends
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
        before = self.active
        self._wait -= not judged
        self._left = self.rule.hold + 1 if on else max(self._left - 1, 0)
        self.active = self._left > 0
        self.begun = self.active and not before
        if self.begun:
            j = self.rule.cause(self.statistic)
            onset = (self.cause, float(self.statistic[j]), self.rule.limits[j])
            self._onsets.append(Onset(self.first + self.samples, time, *onset))
        self.samples += 1

    def _show(self, statistic: Array, findings: Array) -> None:
        """Store the last statistic."""
        self.statistic = statistic.copy()
        if self.rule.kind in FROZEN:
            self._findings[...] = findings

    def _compare(self, rows: Array, lane: int, y: Array, noise: Array) -> tuple[Array, Array]:
        """(statistics (T, c) after samples, findings of a frozen model)."""
        rule, T = self.rule, len(rows)
        findings = np.empty((T, 0))
        if rule.kind in FROZEN:
            samples, phi = np.ones((T, self._row.shape[1])), rows["phi"][..., lane]
            samples[:, : phi.shape[1]] = phi
            known = {"y": rows["y"][:, lane], "ok": judgeable(rows, lane, y, noise)}
            known |= {"noise": noise, "dt": rows["dt"][:, lane]}
            for place, name in enumerate(ROW, len(rule.parameters)):
                samples[:, place] = known[name]
            self._draw(samples)
            findings = np.empty((T, self._findings.shape[1]))
            scan(samples, self._frozen, self._memory, findings, np.zeros(T, np.int8))
            return findings[:, rule.entries], findings
        if rule.kind == "band":
            theta, var = (rows[name][:, self._columns, lane] for name in ("theta", "var"))
            return rule.outside(theta, np.sqrt(var)), findings
        if rule.kind == "probability":
            each = ({name: rows[name][t, ..., lane] for name in self._tracker.outputs} for t in range(T))
            return np.array([change_probability(self._tracker, one) for one in each]).reshape(T, 1), findings
        return self._moving(rule.scores(rows["e"][:, lane], np.sqrt(rows["s"][:, lane]))), findings

    def _draw(self, rows: Array) -> None:
        """Draw readings of a coarse sensor again within their step."""
        n = len(self.rule.parameters)
        noise = rows[:, n + NOISE_FACTOR]
        rows[:, n + Y] = self.rule.drawn(rows[:, :n], rows[:, n + Y], noise, self._judged)
        self._judged += len(rows)

    def _moving(self, g: Array) -> Array:
        """Power and mean (T, 2) over the last scores at every sample, repeated where g (T,) is not finite."""
        fine = np.isfinite(g)
        count, window = len(self._scores), self.rule.window
        every = np.concatenate([np.array(self._scores), g[fine]])
        self._scores.extend(g[fine].tolist())
        # row k is the statistic after k further scores; the first row is the statistic before them
        after = np.tile(self.statistic, (int(fine.sum()) + 1, 1))
        first = max(window - count, 1)
        if first < len(after):
            moving(every[count + first - window :], window, after[first:])
        return np.asarray(after[np.cumsum(fine)])

    def plain(self) -> dict[str, Any]:
        """The state as plain data."""
        return {
            "rule": describe(self.rule), "active": self.active, "begun": self.begun, "samples": self.samples,
            "statistic": self.statistic.tolist(), "wait": self._wait, "left": self._left, "judged": self._judged,
            "first": self.first, "scores": list(self._scores), "onsets": [list(onset) for onset in self._onsets],
            "memory": [b64encode(part.tobytes()).decode() for part in self._memory] if self.rule.kind in FROZEN else [],
        }  # fmt: skip

    @classmethod
    def of(cls, state: Mapping[str, Any], tracker: Tracker, names: Sequence[str]) -> LiveAlarm:
        """The inverse of `plain`."""
        alarm = cls(rebuild(state["rule"], AlarmRule), tracker, names, state["wait"], state["first"])
        alarm.active, alarm.begun, alarm.samples = state["active"], state["begun"], state["samples"]
        alarm.statistic = np.array(state["statistic"], float)
        alarm._left, alarm._judged = state["left"], state["judged"]
        alarm._scores.extend(state["scores"])
        alarm._onsets.extend(Onset(*onset) for onset in state["onsets"])
        for part, stored in zip(alarm._memory if state["memory"] else (), state["memory"], strict=True):
            part[...] = np.frombuffer(b64decode(stored)).reshape(part.shape)
        if state["memory"]:
            alarm._findings[0] = alarm._memory.findings
        return alarm


@Driver
def moving(g: Array, window: int, into: Array) -> None:
    """Sums of g^2 and absolute sums of g (k, 2) over windows of g (k + window - 1,), added from the oldest on."""
    for k in range(into.shape[0]):
        power, mean = 0.0, 0.0
        for j in range(window):
            power += g[k + j] * g[k + j]
            mean += g[k + j]
        into[k, 0], into[k, 1] = power, abs(mean)


def check_rule(rule: Any) -> AlarmRule:
    """Raise an error for anything that is not a rule."""
    if not isinstance(rule, AlarmRule):
        raise TypeError(
            "Live.detect: pass the rule of a reference run, as in run.detect('innovation', reference=500).rule; "
            f"got {type(rule).__name__}."
        )
    return rule


TWO_SIDED_95 = NormalDist().inv_cdf(0.975)


class Change(NamedTuple):
    """A change in the window with the largest likelihood ratio, with a band of 95 %.

    Of a parameter, ``size`` is the difference from its value in the reference; of the noise, the factor of its standard
    deviation; it is NaN where the window with the largest likelihood ratio names another cause. ``since`` is the first
    of the used samples in that window. At the onset of an alarm the size is somewhat too large, because the noise of a
    window that is beyond its limit tends to be on its side.
    """

    name: str
    size: float
    low: float
    high: float
    since: int


def change_of(rule: AlarmRule, findings: Array, t: int) -> Change:
    """The change that the statistics ``findings`` of sample t show."""
    model = rule.reference
    cause = rule.names[rule.cause(findings[rule.entries])]
    if cause == "noise" and np.isfinite(findings[RATIO]):
        L = findings[NOISE_WINDOW]
        error = 0.5 * np.sqrt(model.numbers[SPREAD] / L) / model.numbers[RAW]
        size, half = findings[RATIO], TWO_SIDED_95 * findings[RATIO] * error
    elif np.isfinite(findings[WHICH]) and (
        rule.kind == "glr" or cause in ("noise", rule.parameters[int(findings[WHICH])])
    ):
        which, L = int(findings[WHICH]), findings[WINDOW]
        unit = model.numbers[SCALE] / model.unit[which]
        cause, size, half = rule.parameters[which], findings[SIZE] * unit, TWO_SIDED_95 * findings[STD] * unit
    else:
        return Change(cause, np.nan, np.nan, np.nan, t)
    return Change(cause, float(size), float(size - half), float(size + half), max(t + 1 - int(L), 0))
