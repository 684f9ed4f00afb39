"""Detect: alarms from a run, at a set rate of false alarms.

    "glr"     likelihood ratio of a change in the last 8 to 384 samples, against a frozen model of the reference
    "band"    a parameter has left its permitted range:    max((theta - high) / std, (low - theta) / std) > z

``every`` is the number of samples in which one false alarm may begin (an alarm that stays on counts once).

* glr: the model of the reference is estimated once and kept (`driftfit.judge.alarms.frozen`), so no tracker can absorb
  a fault before it is noticed; the tracker gives the regressors only. Whether the reference itself is constant is
  tested first (`Alarms.doubt`). Limits come from records that this model makes (`driftfit.judge.alarms.bootstrap`).
  `Alarms.change` says which parameter moved, by how much and since when, and what would explain it as well. Where the
  samples are not those of a regression, as with hidden states, the innovations of the tracker are judged, over their
  standard deviations: whether their mean moved from that of the reference, or their size.
* band: for parameters that may move within limits. z such that a parameter at the very edge of its band exceeds it once
  in ``every`` samples, if the run's std is correct (`driftfit.judge.alarms.band`).

An alarm ends where all statistics are below the limits that false alarms would pass twice as often. The result is
in ``run.detect(...).rule`` (`driftfit.run.live.rule.AlarmRule`), a small frozen object: `Live.detect` watches a stream
by it, and ``other.detect(rule)`` another record.

``p`` is the probability that a record without a fault is as extreme as this one, from the same rates: 1 - exp(-samples
rate), at the rate at which the most extreme statistic is exceeded.

Verified by ``benchmarks/alarms.py``. Cost: O(T), and the simulation of 64 records.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.engine.kernel import Array
from driftfit.engine.settings import marks, numbers, one_of, plain, whole
from driftfit.judge.alarms.band import band
from driftfit.judge.alarms.bootstrap import RECORDS, limits, simulated
from driftfit.judge.alarms.reference import Reference, doubt, in_samples, least, modelled, rows_of, with_offset
from driftfit.judge.plots import plot_alarms
from driftfit.judge.verdict import p_text
from driftfit.run.live.alarm import Change, change_of
from driftfit.run.live.likelihood_ratio import scan
from driftfit.run.live.reference_model import FINDINGS, KEPT, NOISE_FACTOR, UNLIKE, Y, memory_of
from driftfit.run.live.rule import KINDS, OFFSET, AlarmRule, check_fits
from driftfit.run.program import Program
from driftfit.run.result import Track, burn_in
from driftfit.show.text import Printed, facts, table_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


ROW = {"from": str, "to": str, "cause": str, "statistic": float, "limit": float}
OF_CHANGE = {"size": float, "low": float, "high": float, "since": str, "instead": str}
"""Columns of `Alarms.table` with their types; the second are those of "glr"."""

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
        For "glr": the numbers that `change` reads.
    unseen : int
        For "glr": samples that are not judged, because a regressor moves that did not in the reference, or
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

    @property
    def doubt(self) -> str:
        """What speaks against the reference; empty if nothing does."""
        return self.rule.doubt

    def cause(self, t: int) -> str:
        """What changed, as known at sample t: of "glr" a parameter, "noise", or "not known yet"; of "band" the
        parameter that is furthest beyond its limit."""
        change = self.change(t)
        return self.names[self.rule.cause(self.statistic[t])] if change is None else change.name

    def change(self, t: int) -> Change | None:
        """Of "glr" while an alarm is on: what changed, by how much and since when, as known at sample t."""
        return change_of(self.rule, self.findings[t], t) if len(self.findings) else None

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

    def clearest(self, t: int) -> int:
        """The sample at which the alarm that began at t shows most, while its beginning is remembered."""
        statistic = self.statistic[t : min(self._end(t), t + KEPT // 2)]
        return t + int(np.argmax(np.max(np.nan_to_num(statistic) / self.limits, axis=1)))

    def row(self, t: int) -> tuple[Any, ...]:
        """The alarm that began at t as a row of `table`, as it is known where it is clearest."""
        at = self.clearest(t)
        j, change = self.rule.cause(self.statistic[at]), self.change(at)
        row = (*self.span(t), self.cause(at), float(self.statistic[at, j]), float(self.rule.limits[j]))
        return row if change is None else (*row, *change[1:4], self.run.time_text(change.since), change.instead)

    @property
    def table(self) -> Any:
        """One row per alarm, as a polars table: ``from``, ``to``, ``cause``, and the ``statistic`` that is furthest
        beyond its ``limit``; for "glr" also ``size``, ``low``, ``high``, ``since`` and ``instead`` of `change`.
        """
        import polars

        columns = ROW | (OF_CHANGE if self.kind == "glr" else {})
        return polars.DataFrame([self.row(int(t)) for t in self.onsets], columns, orient="row")

    @property
    def heads(self) -> tuple[str, ...]:
        """Heads of `cells`."""
        return (*ROW, *(("size", "+-", "since") if self.kind == "glr" else ()))

    def cells(self, t: int) -> tuple[str, ...]:
        """The alarm that began at t in text, as results print it."""
        first, last, cause, statistic, limit, *rest = self.row(t)
        cells = (first, last, cause, f"{statistic:.4g}", f"{limit:.4g}")
        if not rest:
            return cells
        size, low, high, since, instead = rest
        known = (f"{size:.3g}", f"{0.5 * (high - low):.2g}") if size == size else ("", "")
        return (*cells[:2], f"{cause} or {instead}" if instead else cause, *cells[3:], *known, since)

    def _end(self, t: int) -> int:
        """The sample after the alarm that began at t."""
        return t + int(np.argmin(np.append(self.active[t:], False)))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        judged = max(len(self.active) - self.start - self.unseen, 0)
        expected = judged / self.every
        chance = "is the probability that a record without a fault is this extreme"
        limits = ", ".join(f"{name} {limit:.4g}" for name, limit in zip(self.names, self.limits, strict=True))
        yield facts(
            ("Alarm", f"{self.kind}, one false alarm in {self.every:g} samples"),
            *self._real_rate(),
            *([("Reference", self.doubt)] if self.doubt else []),
            ("Limits", limits),
            ("Samples", f"{judged} judged from sample {self.start} on; {expected:.2g} false alarms expected")
            if judged
            else (
                "Samples",
                f"none is judged: the run has {len(self.active)}, and the first {self.start} do not count",
            ),
            *(
                [("Not judged", f"{self.unseen} samples: a regressor moves that did not in the reference, or hardly")]
                if self.unseen
                else []
            ),
            ("Alarms", f"{len(self.onsets)}"),
            *([] if np.isnan(self.p) else [("p-value", f"{p_text(self.p)} {chance}")]),
        )
        table = table_of("Alarms", *self.heads, names=3)
        for t in map(int, self.onsets[:20]):
            table.add_row(*map(Text, self.cells(t)))
        yield table
        if len(self.onsets) > 20:
            yield Text(f" and {len(self.onsets) - 20} more", "dim")

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
    seed: int = 0,
    records: int = RECORDS,
    start: int | None = None,
) -> Alarms:
    """Find alarms in a run.

    Parameters
    ----------
    run : Track
        The run to be watched.
    kind : "glr" or "band", or an AlarmRule
        See the module. A rule, ``alarms.rule`` of another run, contains its limits and settings.
    every : number
        Samples in which one false alarm may begin.
    reference : mapping from names to (low, high), a number of samples, or (from, to)
        For "glr": a segment that is normal; if there is none the first third of the record, of a short one up to three
        quarters.
        For "band": the normal range of the parameters, or a segment of the record, whose range after the start of the
        run is the band. A segment is a number of first samples, or an interval of time without its end: dates if the
        record has them, otherwise numbers as in ``run.time`` (without times: samples). Neither the segment nor what
        comes before it is judged.
    seed : int
        Seed of the simulation of "glr".
    records : int
        Its records, at least 8: fewer take less time, and give limits that are less accurate.
    start : int or None
        With a rule: the first sample that is judged. None: the first after the start of the run, or the very first
        after a warm start.

    Raises
    ------
    ValueError
        For an unknown kind, a reference that does not fit, or a tracker that does not support the kind.
    """
    if not isinstance(run, Track):
        raise TypeError(f"detect: the run comes first, as in detect(run, 'band'); got {run!r}.")
    if isinstance(kind, AlarmRule):
        return judged(run, kind, start)
    asked, reference = asked_for(kind, every), in_samples(run, reference)
    records = whole("detect", "records", records, 8)
    if kind == "band":
        return judged(run, *band(run, asked, reference))
    rule, normal, start, rows = modelled(run, asked, reference)
    found, growth, unsure = limits(simulated(normal, seed, records), rule.every)
    rule = replace(rule, limits=plain(found), growth=plain(growth), unsure=unsure)
    return judged(run, replace(rule, doubt=doubt(run, start - len(normal.rows), start)), start, rows)


def asked_for(kind: str, every: float) -> AlarmRule:
    """A rule without names and limits; ValueError for settings that are wrong."""
    one_of("detect", "kind", kind, KINDS)
    return AlarmRule(kind, numbers("detect", "every", every, ndim=0, low=1.0, strict=True), (), ())


def check_alarm(program: Program, asked: AlarmRule, reference: int) -> None:
    """Raise ValueError if no ``reference`` first samples can set the alarm, whatever these are."""
    model, kind = program.model, asked.kind
    own = model.names if model.hidden is None and len(program.names) == model.n else (OFFSET,)
    check_fits(replace(asked, parameters=own), program.tracker, program.names)
    begun, normal = burn_in(model.n), least(kind, model.n)
    if reference < begun + normal:
        raise ValueError(
            f'detect: "{kind}" needs a reference of {begun + normal} samples: {begun} are the start of the run, and '
            f"{normal} normal ones come after them; got {reference}."
        )


def judged(run: Track, rule: AlarmRule, start: int | None = None, rows: Array | None = None) -> Alarms:
    """Alarms of a run by a rule; ``start`` as for `detect`, ``rows`` are those of the run, if they are known."""
    check_fits(rule, run.tracker, run.names)
    if start is None:
        start = burn_in(run.model.n) if run.start is None else 0
    findings, unseen = np.zeros((0, 0)), 0
    if rule.kind == "band":
        columns = rule.columns(run.names)
        statistic = rule.outside(run.theta[:, columns], run.std[:, columns])
    else:
        findings, unseen = findings_of(rule, rows_of(run) if rows is None else rows, start)
        statistic = findings[:, : len(rule.names)]
    count, p = int(np.isfinite(statistic[start:]).any(axis=1).sum()), float("nan")
    if count:
        p = chance_of(rule, highest(statistic, start), count)
    active = rule.active(np.where((np.arange(len(run)) >= start)[:, None], statistic, np.nan))
    return Alarms(rule, active, onsets(active), statistic, start, p, run, findings, unseen)


def findings_of(rule: AlarmRule, rows: Array, start: int) -> tuple[Array, int]:
    """The findings of "glr" (T, k), NaN before ``start``; and how many samples were not judged because they excite what
    the reference did not, or hardly. ``rows`` are those of the run.
    """
    n, model, rows = len(rule.parameters), rule.reference, with_offset(rows, rule)
    findings, use = np.full((len(rows), FINDINGS), np.nan), np.zeros(len(rows), np.int8)
    rows[start:, n + Y] = rule.drawn(rows[start:, :n], rows[start:, n + Y], rows[start:, n + NOISE_FACTOR], 0)
    scan(rows[start:], model, memory_of(model), findings[start:], use[start:])
    return findings, int(np.sum(use == UNLIKE))


def highest(statistic: Array, start: int) -> Array:
    """The largest value of each column, (c,), over the judged samples; -inf if there is none."""
    part = statistic[start:]
    return np.asarray(np.max(np.where(np.isfinite(part), part, -np.inf), axis=0, initial=-np.inf))


def chance_of(rule: AlarmRule, highest: Array, samples: int) -> float:
    """The probability that so many samples without a fault reach these highest values (c,)."""
    beyond = np.max((np.maximum(highest, 0.0) ** 2 - np.square(rule.limits)) / np.array(rule.growth))
    return float(-np.expm1(-samples / rule.every * np.exp(-beyond)))


def onsets(active: Array) -> Array:
    """Samples at which an alarm begins, from whether it is on (T,)."""
    return np.flatnonzero(active & ~np.append(False, active[:-1]))
