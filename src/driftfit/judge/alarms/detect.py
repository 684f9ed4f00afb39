"""Detect: alarms from a run, at a set rate of false alarms.

    "glr"           likelihood ratio of a change in the last 8 to 384 samples, against a frozen model of the reference
    "cusum"         cumulated scores of that model: one sum up and one down for each parameter and for the noise
    "band"          a parameter has left its reference band:      max((theta - high) / std, (low - theta) / std) > z
    "innovation"    the last W innovations are too large, or too one-sided, for what the run expects
    "probability"   the probability of a change, from a tracker that carries hypotheses (`Bank`), is above a limit

``every`` is the number of samples in which one false alarm may begin (an alarm that stays on counts once).

* glr, cusum: the model of the reference is estimated once and kept (`driftfit.judge.alarms.frozen`), so no tracker can
  absorb a fault before it is noticed; the tracker gives the regressors only. Limits by a bootstrap of the reference
  (`driftfit.judge.alarms.bootstrap`). They show which parameter moved, by how much and since when: `Alarms.change`.
* band: z such that a Gaussian sequence begins to exceed it once in ``every`` times c samples, for c parameters watched.
  Successive errors of an estimate have the correlation 1 / (1 + d), d = mean (theta_t - theta_(t-1))^2 / var_t, since
  a step of the filter has the variance that it removes. The rate holds for a parameter at the very edge of its band, if
  the run's std is correct; inside the band alarms are rarer.
* innovation: g = e / s; limits of the windowed sums of g^2 and of g from their exact rate of onsets
  (`driftfit.judge.alarms.onsets`), half of the rate for each. With ``reference`` the g are normal scores of the
  innovations among those of the reference, so that outliers and tails that were normal there count as normal later.
* probability: the limit is found by simulation. Records with constant parameters are simulated from the run (its
  inputs, its parameters at ``at``, its innovations redrawn) and tracked; onsets exceed the limit at the given rate. Any
  kind can be calibrated in this way, with ``calibrate=True``: it is slower, and does not rely on the std.

The result is in ``run.detect(...).rule`` (`driftfit.run.live.rule.AlarmRule`), a small frozen object: `Live.detect`
watches a stream by it, and ``other.detect(rule)`` another record.

docs/alarms.md compares the kinds. A tracker that estimates its own drift mistakes a fault for drift and follows it:
its innovations are soon normal again, so "innovation" gives an alarm, if at all, in the first samples of the fault.

``p`` is the probability that a record without a fault is as extreme as this one: from the same rates (the smallest of
the columns, 1 - P(first within) exp(-samples rate), times their number), or the share of the simulated records.

Only the calibration looks ahead. Verified by ``benchmarks/alarm_rates.py``. Cost: O(T), and 50 every / T runs
for a calibration.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.engine.kernel import Array
from driftfit.engine.settings import marks, numbers, one_of, whole
from driftfit.judge.alarms.bootstrap import RECORDS
from driftfit.judge.alarms.calibration import check_played, limits_of, null_records
from driftfit.judge.alarms.onsets import held, onsets
from driftfit.judge.alarms.reference import burn, in_samples, least
from driftfit.judge.alarms.statistics import (
    Reference,
    chance_of,
    findings_of,
    highest,
    rule_of,
    samples_of,
    statistic_of,
)
from driftfit.judge.plots import plot_alarms
from driftfit.judge.regressors import refuse_hidden
from driftfit.judge.verdict import p_text
from driftfit.run.live.alarm import Change, change_of
from driftfit.run.live.rule import FROZEN, KINDS, AlarmRule, check_fits, value_text
from driftfit.run.program import Program
from driftfit.run.result import Track, burn_in
from driftfit.show.text import Printed, facts, table_of
from driftfit.trackers.base import Tracker

if TYPE_CHECKING:
    from matplotlib.figure import Figure


ROW = {"from": str, "to": str, "cause": str, "statistic": float, "limit": float}
OF_CHANGE = {"size": float, "low": float, "high": float, "since": str}
"""Columns of `Alarms.table` with their types; the second are those of alarms with a frozen reference model."""

FAR = 2.5
"""The real rate is printed if false alarms may be this many times as frequent as set."""


class Score(NamedTuple):
    """Alarms compared with labels of faults."""

    events: int
    """Intervals of samples with a true label."""
    found: int
    """Intervals in which an alarm began."""
    delay: float
    """Median number of samples from the beginning of such an interval to its first alarm."""
    false: int
    """Alarms that began outside all intervals, even if they were still on when the next interval began."""
    normal: int
    """Judged samples outside all intervals."""


@dataclass(frozen=True)
class Alarms(Printed):
    """The result of `Track.detect`; printing it shows a table.

    Attributes
    ----------
    rule : AlarmRule
        What is compared with which limits; `Live.detect` takes it, and `Track.detect` of other runs.
    active : (T,) bool
        Whether an alarm is on.
    onsets : (k,) int
        Samples at which an alarm begins.
    statistic : (T, c)
        The statistics that are compared; NaN where there is nothing to judge.
    start : int
        First sample that is judged; the samples before it are the start of the run, or the reference.
    p : number
        Probability of an extreme like the largest here without a fault; NaN if nothing was judged.
    findings : (T, k)
        For "glr" and "cusum": the numbers that `change` reads; otherwise without columns.
    unseen : int
        For "glr" and "cusum": samples that are not judged, because a regressor moves that did not in the reference, or
        hardly.
    """

    rule: AlarmRule
    active: Array
    onsets: Array
    statistic: Array
    start: int
    p: float
    run: Track = field(repr=False, compare=False)
    findings: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False, compare=False)
    unseen: int = 0

    @property
    def kind(self) -> str:
        """Kind of alarm."""
        return self.rule.kind

    @property
    def every(self) -> float:
        """Samples in which one false alarm may begin."""
        return self.rule.every

    @property
    def limits(self) -> Array:
        """The limits of the columns, (c,)."""
        return np.array(self.rule.limits)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns, as in the rule."""
        return self.rule.names

    def cause(self, t: int) -> str:
        """The column that is furthest beyond its limit at sample t; of "glr" the parameter that moved, or "noise"."""
        change = self.change(t)
        return self.names[self.rule.cause(self.statistic[t])] if change is None else change.name

    def change(self, t: int) -> Change | None:
        """For "glr" and "cusum": what changed, by how much and since when, as known at sample t; otherwise None."""
        return change_of(self.rule, self.findings[t], t) if self.kind in FROZEN else None

    def score(self, labels: Any) -> Score:
        """Compare with labels (T,), true where something is wrong; ValueError for another length, or other values."""
        wrong = marks("score", labels, len(self.active))
        first = onsets(wrong)
        last = np.array([t + int(np.argmin(np.append(wrong[t:], False))) for t in first], int)
        delays = []
        for a, b in zip(first, last, strict=True):
            begun = self.onsets[(self.onsets >= a) & (self.onsets < b)]
            delays += [int(begun[0] - a)] if len(begun) else []
        delay = float(np.median(delays)) if delays else float("nan")
        false, normal = int(np.sum(~wrong[self.onsets])), int(np.sum(~wrong[self.start :]))
        return Score(len(first), len(delays), delay, false, normal)

    def span(self, t: int) -> tuple[str, str]:
        """First and last time of the alarm that began at t."""
        return self.run.time_text(t), self.run.time_text(self._end(t) - 1)

    def row(self, t: int) -> tuple[Any, ...]:
        """The alarm that began at t as a row of `table`."""
        j, change = self.rule.cause(self.statistic[t]), self.change(t)
        row = (*self.span(t), self.cause(t), float(self.statistic[t, j]), float(self.rule.limits[j]))
        return row if change is None else (*row, *change[1:4], self.run.time_text(change.since))

    @property
    def table(self) -> Any:
        """One row per alarm, as a polars table: ``from``, ``to``, ``cause``, and the ``statistic`` that is furthest
        beyond its ``limit``; for "glr" and "cusum" also ``size``, ``low``, ``high`` and ``since`` of `change`.
        """
        import polars

        columns = ROW | (OF_CHANGE if self.kind in FROZEN else {})
        return polars.DataFrame([self.row(int(t)) for t in self.onsets], columns, orient="row")

    @property
    def heads(self) -> tuple[str, ...]:
        """Heads of `cells`."""
        return (*ROW, *(("size", "+-", "since") if self.kind in FROZEN else ()))

    def cells(self, t: int) -> tuple[str, ...]:
        """The alarm that began at t in text, as results print it."""
        first, last, cause, *numbers = self.row(t)
        statistic, limit = (value_text(self.kind, number) for number in numbers[:2])
        sizes: tuple[str, ...] = ()
        if self.kind in FROZEN:
            size, low, high, since = numbers[2:]
            # the likelihood ratio does not always name the cause that a sum has
            known = size == size
            sizes = (f"{size:.3g}", f"{0.5 * (high - low):.2g}", since) if known else ("", "", "")
        return (first, last, cause, statistic, limit, *sizes)

    def _end(self, t: int) -> int:
        """The sample after the alarm that began at t."""
        return t + int(np.argmin(np.append(self.active[t:], False)))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        judged = max(len(self.active) - self.start - self.unseen, 0)
        expected = judged / self.every
        chance = "is the probability that a record without a fault is this extreme"
        limits = (f"{name} {self.rule.limit_text(j)}" for j, name in enumerate(self.names))
        yield facts(
            ("Alarm", f"{self.kind}, one false alarm in {self.every:g} samples"),
            *self._real_rate(),
            ("Limits", f"{', '.join(limits)}{' (by simulation)' if self.rule.simulated else ''}"),
            ("Samples", f"{judged} judged from sample {self.start} on; {expected:.2g} false alarms expected")
            if judged
            else (
                "Samples",
                f"none is judged: the run has {len(self.active)}, and the first {self.start} do not count",
            ),
            *self._not_judged(),
            ("Alarms", f"{len(self.onsets)}"),
            *([] if np.isnan(self.p) else [("p-value", f"{p_text(self.p)} {chance}")]),
        )
        table = table_of("Alarms", *self.heads, names=3)
        for t in map(int, self.onsets[:20]):
            table.add_row(*map(Text, self.cells(t)))
        yield table
        if len(self.onsets) > 20:
            yield Text(f" and {len(self.onsets) - 20} more", "dim")

    def _not_judged(self) -> list[tuple[str, str]]:
        """The line on the samples that are unlike all of the reference, if there are some."""
        why = f"{self.unseen} samples: a regressor moves that did not in the reference, or hardly"
        return [("Not judged", why)] if self.unseen else []

    def _real_rate(self) -> list[tuple[str, str]]:
        """The line on the real rate, if it may be far above the one that is set."""
        low, high = self.rule.real_rate
        if low > self.every / FAR:
            return []
        least, most = (float(f"{one:.2g}") for one in (low, high))
        return [("Rate", f"one in {least:.10g} to {most:.10g} samples in 95 % of streams with such a reference")]

    def plot(self, labels: Any = None, ax: Any = None) -> Figure:
        """Statistics over their limits, alarms marked; labels (T,) are shaded. ``ax`` as for `Track.plot`."""
        wrong = None if labels is None else marks("plot", labels, len(self.active))
        return plot_alarms(self.run, self.rule, self.statistic, self.active, self.start, wrong, ax)


def detect(
    run: Track,
    kind: str | AlarmRule = "glr",
    *,
    every: float = 10_000.0,
    reference: Reference = None,
    window: int = 50,
    hold: int = 0,
    calibrate: bool = False,
    at: int = -1,
    seed: int = 0,
    records: int = RECORDS,
    start: int | None = None,
) -> Alarms:
    """Find alarms in a run.

    Parameters
    ----------
    run : Track
        The run to be watched.
    kind : "glr", "cusum", "band", "innovation" or "probability", or an AlarmRule
        See the module. A rule, ``alarms.rule`` of another run, contains its limits and settings.
    every : number
        Samples in which one false alarm may begin.
    reference : mapping from names to (low, high), a number of samples, or (from, to)
        For "glr" and "cusum": a segment that is normal; if there is none the first third of the record, of a short one
        up to three quarters.
        For "band": the normal range of the parameters, or a segment of the record, whose range after the start of the
        run is the band. For "innovation": a segment that is normal. A segment is a number of first samples, or an
        interval of time without its end: dates if the record has them, otherwise numbers as in ``run.time`` (without
        times: samples). Neither the segment nor what comes before it is judged.
    window : int
        Samples in the sums of "innovation", at least 4.
    hold : int
        Number of samples for which an alarm stays on after its cause.
    calibrate : bool
        Find the limits by simulation from the run instead of from theory ("probability" always does).
    at : int
        The sample whose parameters are the true ones in that simulation.
    seed : int
        Seed of that simulation, and of the bootstrap of "glr" and "cusum".
    records : int
        Simulated records of that bootstrap, at least 8: fewer take less time, and give limits that are less accurate.
    start : int or None
        With a rule: the first sample that is judged. None: the first after the start of the run, or the very first
        after a warm start.

    Warns
    -----
    UserWarning
        For "innovation" with a tracker that estimates its own drift (`AdaptiveKalman`) and therefore follows a fault:
        the record is judged by "glr" instead.

    Raises
    ------
    ValueError
        For an unknown kind, a reference that does not fit, or a tracker that does not support the kind.
    """
    if not isinstance(run, Track):
        raise TypeError(f"detect: the run comes first, as in detect(run, 'band'); got {run!r}.")
    if isinstance(kind, AlarmRule):
        return judged(run, kind, start)
    asked = asked_for(kind, every, window, hold)
    if judged_by(kind, run.tracker) != kind:
        _warn_of_following(run)
        asked = replace(asked, kind="glr")
    reference = in_samples(run, reference)
    rule, first = rule_of(run, asked, reference, seed, whole("detect", "records", records, 8))
    if asked.kind in FROZEN or (not calibrate and kind != "probability"):
        return judged(run, rule, first)
    made = []
    for null in null_records(run, asked.every, at, seed):
        own, begin = rule_of(null, asked, reference, seed)
        made.append((statistic_of(null, own, begin), begin))
    (limits,) = limits_of(made, asked.every)
    alarms = judged(run, replace(rule, limits=tuple(limits.tolist()), simulated=True), first)
    extreme = highest(alarms.statistic, first)
    as_far = [np.max(highest(*one) / limits) >= np.max(extreme / limits) for one in made]
    p = (1.0 + sum(as_far)) / (1.0 + len(made)) if np.isfinite(extreme).any() else float("nan")
    return replace(alarms, p=p)


def asked_for(kind: str, every: float, window: int = 50, hold: int = 0) -> AlarmRule:
    """A rule without names and limits; ValueError for settings that are wrong."""
    one_of("detect", "kind", kind, KINDS)
    every = numbers("detect", "every", every, ndim=0, low=1.0, strict=True)
    return AlarmRule(kind, every, (), (), whole("detect", "hold", hold, 0), whole("detect", "window", window, 4))


def judged_by(kind: str, tracker: Tracker) -> str:
    """The kind by which runs of a tracker are judged where a kind is asked for."""
    return "glr" if kind == "innovation" and tracker.adapts else kind


def check_alarm(program: Program, asked: AlarmRule, reference: int) -> None:
    """Raise ValueError if no ``reference`` first samples can set the alarm, whatever these are."""
    model, kind = program.model, judged_by(asked.kind, program.tracker)
    check_fits(replace(asked, kind=kind, parameters=model.names), program.tracker, program.names)
    if kind in FROZEN:
        refuse_hidden(f'detect "{kind}"', model, 'kind="innovation" or "band"')
    if kind == "probability":
        check_played(model)
    begun, normal = burn_in(model.n), least(kind, model.n)
    if reference < begun + normal:
        raise ValueError(
            f'detect: "{kind}" needs a reference of {begun + normal} samples: {begun} are the start of the run, and '
            f"{normal} normal ones come after them; got {reference}."
        )


def judged(run: Track, rule: AlarmRule, start: int | None = None) -> Alarms:
    """Alarms of a run by a rule; ``start`` as for `detect`."""
    check_fits(rule, run.tracker, run.names)
    if start is None:
        start = burn(run) if run.start is None else 0
    findings, unseen = np.zeros((0, 0)), 0
    if rule.kind in FROZEN:
        findings, unseen = findings_of(run, rule, start, samples_of(run))
    statistic = findings[:, rule.entries] if rule.kind in FROZEN else statistic_of(run, rule, start)
    count = int(np.isfinite(statistic[start:]).any(axis=1).sum())
    p = chance_of(run, rule)(highest(statistic, start), count) if count else float("nan")
    active = held(rule.exceeded(statistic) & (np.arange(len(run)) >= start), rule.hold)
    return Alarms(rule, active, onsets(active), statistic, start, p, run, findings, unseen)


def _warn_of_following(run: Track) -> None:
    """Warn that the innovations of a tracker that adapts are normal again soon after a fault."""
    warnings.warn(
        f"detect: {type(run.tracker).__name__} estimates its own drift and noise, so it follows a fault: its "
        "innovations are soon normal again, and a slow fault is hardly visible in them. The record is judged by "
        'detect("glr") instead, against a model of the reference that does not adapt. For the innovations themselves, '
        "track with settings that are fitted to the reference and then kept, tune(model, Kalman(), ...).tracker.",
        UserWarning,
        stacklevel=4,
    )
