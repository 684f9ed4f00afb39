"""Detect: alarms from a run, with a rate of false alarms that is set and not tuned.

    "band"          a parameter has left its reference band:      max((theta - high) / std, (low - theta) / std) > z
    "innovation"    the last W innovations are too large, or too one-sided, for what the run expects
    "probability"   the probability of a change, from a tracker that carries hypotheses (`Bank`), is above a limit

``every`` is the number of samples in which one false alarm may begin (an alarm that stays on counts once).

* band: z such that a Gaussian sequence begins to exceed it once in ``every`` times c samples, for c parameters watched.
  Successive errors of an estimate have the correlation 1 / (1 + d), d = mean (theta_t - theta_(t-1))^2 / var_t, since
  a step of the filter has the variance that it takes away. The rate holds for a parameter that stands at the very edge
  of its band, where the run's std is right; inside the band alarms are rarer.
* innovation: g = e / s; limits of the windowed sums of g^2 and of g from their exact rate of onsets
  (`driftfit.judges.onsets`), half of the rate for each. With ``reference`` the g are normal scores of the
  innovations among those of the reference, so that outliers and tails that were normal there are normal later.
* probability: the limit is found by simulation. Records with constant parameters are made from the run (its inputs,
  its parameters at ``at``, its innovations redrawn) and tracked; the limit is exceeded by onsets at the
  rate asked for. Any kind can be calibrated so, with ``calibrate=True``: it is slower, and does not lean on the std.

``p`` is the chance that a record without a fault gets as extreme as this one: from the same rates (the least of the
columns, 1 - P(first within) exp(-samples rate), times their number), or the share of the simulated records.

Nothing looks ahead of an alarm but the calibration. Verified by ``benchmarks/alarm_rates.py``. Cost: O(T), and as many
runs as 50 every / T for a calibration.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from driftfit.judges.alarm_statistics import STATISTICS, Reference, Watched
from driftfit.judges.calibrate import limit_of, null_records
from driftfit.judges.onsets import held, onsets
from driftfit.kernel import Array
from driftfit.result import Track
from driftfit.settings import numbers, one_of, whole
from driftfit.summary import Printed, facts, table_of
from driftfit.verdict import p_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KINDS = ("band", "innovation", "probability")


class Score(NamedTuple):
    """Alarms against labels of what was wrong."""

    events: int
    """Stretches of samples with a true label."""
    found: int
    """Stretches during which an alarm was on."""
    delay: float
    """Median samples from the beginning of a found stretch to its alarm."""
    false: int
    """Alarms that began outside all stretches, and ended before the next one."""
    normal: int
    """Samples outside all stretches that were judged."""


@dataclass(frozen=True)
class Alarms(Printed):
    """What `Track.detect` returns; printing it shows a table.

    Attributes
    ----------
    active : (T,) bool
        An alarm is on.
    onsets : (k,) int
        Samples at which one begins.
    statistic : (T, c)
        What is compared; NaN where there is nothing to judge.
    limits : (c,)
        What it is compared with.
    names : tuple of str
        What the columns are: parameters, "power" and "mean" of the innovations, or "probability".
    start : int
        First sample that is judged; what comes before is the start of the run, or the reference.
    p : number
        Chance of an extreme like the largest here without a fault; NaN where nothing was judged.
    """

    kind: str
    every: float
    active: Array
    onsets: Array
    statistic: Array
    limits: Array
    names: tuple[str, ...]
    start: int
    p: float
    run: Track = field(repr=False, compare=False)

    def cause(self, t: int) -> str:
        """The column that is furthest beyond its limit at sample t."""
        ratio = np.where(np.isfinite(self.statistic[t]), self.statistic[t] / self.limits, -np.inf)
        return self.names[int(np.argmax(ratio))]

    def score(self, labels: Any) -> Score:
        """Compare with labels (T,), true where something is wrong; ValueError for another length."""
        wrong = np.asarray(labels).astype(bool)
        if wrong.shape != self.active.shape:
            raise ValueError(f"score: labels have shape {wrong.shape}, but the record has {len(self.active)} samples.")
        first = onsets(wrong)
        last = np.array([t + int(np.argmin(np.append(wrong[t:], False))) for t in first], int)
        delays = []
        for a, b in zip(first, last, strict=True):
            on = np.flatnonzero(self.active[a:b])
            delays += [int(on[0])] if len(on) else []
        false = sum(not wrong[t] and not wrong[t : self._end(t)].any() for t in self.onsets)
        delay = float(np.median(delays)) if delays else float("nan")
        return Score(len(first), len(delays), delay, int(false), int(np.sum(~wrong[self.start :])))

    def span(self, t: int) -> tuple[str, str]:
        """First and last time of the alarm that began at t."""
        return self.run.time_text(t), self.run.time_text(self._end(t) - 1)

    def _end(self, t: int) -> int:
        """The sample after the alarm that began at t."""
        return t + int(np.argmin(np.append(self.active[t:], False)))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        judged = len(self.active) - self.start
        expected = judged / self.every
        yield facts(
            ("Alarm", f"{self.kind}, one false alarm in {self.every:g} samples"),
            ("Samples", f"{judged} judged from sample {self.start} on; {expected:.2g} false alarms expected"),
            ("Alarms", f"{len(self.onsets)}"),
            ("Chance", f"{p_text(self.p)} that a record without a fault gets as extreme as this one"),
        )
        table = table_of("Alarms", "from", "to", "cause", "statistic", "limit", names=3)
        for t in self.onsets[:20]:
            j = self.names.index(self.cause(int(t)))
            numbers = (f"{self.statistic[t, j]:.4g}", f"{self.limits[j]:.4g}")
            table.add_row(*self.span(int(t)), Text(self.names[j]), *numbers)
        yield table
        if len(self.onsets) > 20:
            yield Text(f" and {len(self.onsets) - 20} more", "dim")

    def plot(self, labels: Any = None) -> Figure:
        """Statistics over their limits, alarms marked; labels (T,) are shaded."""
        from driftfit.judges.plots import plot_alarms

        return plot_alarms(self, labels)


def detect(
    run: Track,
    kind: str = "band",
    *,
    every: float = 10_000.0,
    reference: Reference = None,
    window: int = 50,
    hold: int = 0,
    calibrate: bool = False,
    at: int = -1,
    seed: int = 0,
) -> Alarms:
    """Find alarms in a run.

    Parameters
    ----------
    run : Track
        What is watched.
    kind : "band", "innovation" or "probability"
        See the module.
    every : number
        Samples in which one false alarm may begin.
    reference : mapping from names to (low, high), or a number of samples
        For "band": where the parameters belong; or the first samples, whose range after the start of the run is the
        band. For "innovation": the first samples, which are normal. They are not judged.
    window : int
        Samples in the sums of "innovation", at least 4.
    hold : int
        An alarm stays on for so many samples after what caused it.
    calibrate : bool
        Find the limits by simulation from the run instead of from theory ("probability" always does).
    at : int
        The sample whose parameters are true in that simulation.
    seed : int
        Of that simulation.

    Raises
    ------
    ValueError
        For a kind that is unknown, a reference that does not fit, or a tracker that has not what the kind needs.
    """
    one_of("detect", "kind", kind, KINDS)
    every = numbers("detect", "every", every, ndim=0, low=1.0, strict=True)
    whole("detect", "window", window, 4)
    whole("detect", "hold", hold, 0)
    seen = STATISTICS[kind](run, every, reference, window)
    statistic, limits, names, start, likely = seen
    highest, judged = _highest(seen), int(np.isfinite(statistic[start:]).any(axis=1).sum())
    if calibrate or kind == "probability":
        made = [STATISTICS[kind](null, every, reference, window) for null in null_records(run, every, at, seed)]
        limits = limit_of(((part.statistic, part.start) for part in made), every)
        as_far = [np.max(_highest(part) / limits) >= np.max(highest / limits) for part in made]
        p = (1.0 + sum(as_far)) / (1.0 + len(made))
    else:
        p = likely(highest, judged) if likely is not None else float("nan")
    with np.errstate(invalid="ignore"):
        active = held((statistic > limits).any(axis=1) & (np.arange(len(run)) >= start), hold)
    return Alarms(
        kind, float(every), active, onsets(active), statistic, np.asarray(limits), names, start,
        p if judged else float("nan"), run,
    )  # fmt: skip


def _highest(seen: Watched) -> Array:
    """The largest value of each column, (c,), over the samples that are judged; -inf where there is none."""
    part = seen.statistic[seen.start :]
    return np.asarray(np.max(np.where(np.isfinite(part), part, -np.inf), axis=0, initial=-np.inf))
