"""Results of a bank of hypotheses besides parameters: probabilities, evidence, alarms, events, the mixture.

Everything is causal unless stated otherwise: row t contains the probabilities after sample t. Once events were decided,
probabilities are conditional on the decisions.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from driftfit.bank.bank import Bank
from driftfit.bank.layout import COUNTER
from driftfit.bank.memory import SINGLE
from driftfit.bank.reduction import Decide
from driftfit.bank.results.events import Event, Probabilities, all_of, runs
from driftfit.bank.results.mixture import Mixture, mixture_of, undecided
from driftfit.bank.results.pictures import plot_hypotheses
from driftfit.bank.results.smoothed import SmoothedMixture
from driftfit.engine.kernel import Array
from driftfit.engine.settings import warn
from driftfit.run.result import Track
from driftfit.smooth.changes import dated

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Alarm(NamedTuple):
    """A window alarm: the threshold of the probability, the samples ``at`` which it began, and where it is ``on``,
    (T,) bool.
    """

    threshold: float
    at: Array
    on: Array


class Decision(NamedTuple):
    """A joint event that was decided: the first ``sample`` that it affects, the sample after which it was ``decided``,
    and its probability at that time.
    """

    sample: int
    decided: int
    event: int
    prob: float


class Hypotheses:
    """The events of a run of a `Bank`; `Track.hypotheses` makes it.

    Attributes
    ----------
    names : tuple of str
        Names of the joint events (change, sensor), H of them.
    lags : tuple of int
        Levels of the tree, counted back, whose probabilities are reported: all W that the reduction remembers, or, if
        these are more than eight, the newest seven and the oldest.
    lag_prob : (T, len(lags), H)
        lag_prob[t, k] are the probabilities of the events lags[k] levels before t, given the data up to t; NaN before
        the first event.
    window : (T,)
        Probability of at least one change in the newest W levels.
    evidence : (T,)
        Log density of each sample given earlier ones.
    leaves : (T,)
        Leaves after growth.
    kept : (T,)
        Weight of the leaves that were kept from the previous sample; the remainder to 1 was dropped.
    """

    def __init__(self, run: Track) -> None:
        if not run.tracker.weighs:
            raise ValueError(f"hypotheses: {type(run.tracker).__name__} has no hypotheses; track with a Bank.")
        self.run = run
        self.tracker: Bank = run.tracker  # type: ignore[assignment]
        self._report = run.written("report")
        self.evidence, self.window, self.kept, self.leaves = map(self._reported, SINGLE)
        self.names = self.tracker.event_names
        self.lags = self.tracker.reported_levels
        self.sensors = len(self.tracker.all_sensors)
        if self.impossible:
            warn(
                f"{self.impossible} samples were impossible under every hypothesis of the bank and were not used. Give "
                "each event that may happen a probability above 0 in transition= and prob=.",
                UserWarning,
            )

    def __repr__(self) -> str:
        return f"Hypotheses of {len(self.run)} samples: {', '.join(self.names)}; {self.tracker!r}"

    def _reported(self, name: str) -> Array:
        return self.tracker.reported(self._report, name)

    @cached_property
    def lag_prob(self) -> Array:
        p = self._reported("lag_prob").copy()
        p[p.sum(axis=2) < 0.5] = np.nan
        return np.asarray(p)

    def prob(self, lag: int = 0) -> Array:
        """(T, H): probabilities of the events at the samples themselves, given ``lag`` further levels of the tree.

        Row t belongs to the event first visible in sample t; NaN at the end, where later samples are missing.
        """
        if lag not in self.lags:
            allowed = ", ".join(str(k) for k in self.lags)
            raise ValueError(f"prob: lag must be one of {allowed} for this reduction; got {lag}.")
        p = np.full((len(self.run), len(self.names)), np.nan)
        p[: max(len(p) - lag, 0)] = self.lag_prob[lag:, self.lags.index(lag)]
        return p

    @property
    def mode_prob(self) -> Array:
        """(T, H): probabilities of the present event, `prob` at lag 0."""
        return self.prob(0)

    @property
    def change_prob(self) -> Array:
        """(T,): probability of a change at each sample, given as many later samples as the bank remembers."""
        return np.asarray(1.0 - self.latest[:, : self.sensors].sum(axis=1))

    @cached_property
    def latest(self) -> Array:
        """(T, H): probabilities of the event of each sample, given as many later samples as the bank remembers."""
        p, oldest = self.prob(self.lags[-1]), self.lags[-1]
        now = self.tracker.array(self.run.model, self.run.state, "lag_prob")
        for k in range(min(oldest, len(p))):
            p[len(p) - 1 - k] = now[k] if now[k].sum() > 0.5 else np.nan
        return p

    @property
    def log_evidence(self) -> float:
        """The sum of the evidence: the log density of the record, under the approximations made."""
        return float(self.evidence.sum())

    @property
    def impossible(self) -> int:
        """Number of samples that no leaf allowed; they were not used."""
        return int(self.run.state["counters"][COUNTER.impossible])

    @property
    def rates(self) -> dict[str, float]:
        """Prior probability of each change at the next sample: as given, or as learned until the end of the record."""
        row = self.tracker.array(self.run.model, self.run.state, "chain")[0]
        return dict(zip(self.tracker.change_names, row.reshape(-1, self.sensors).sum(axis=1).tolist(), strict=True))

    @cached_property
    def decisions(self) -> list[Decision]:
        """Decided events, in order; empty for reductions that do not decide."""
        found = self._reported("decided")
        return [
            Decision(int(t - found[t, k, 1]), int(t), int(found[t, k, 0]), float(found[t, k, 2]))
            for t, k in zip(*np.nonzero(found[:, :, 0] >= 0.0), strict=True)
        ]

    def finish(self) -> list[Decision]:
        """The decisions that `Decide` would make about the open events, the oldest first, each given the earlier ones.

        It also works if the record is shorter than the depth; empty for reductions that do not decide.
        """
        reduce = self.tracker.reduction
        if not isinstance(reduce, Decide) or not len(self.run):
            return []
        found = undecided(self.tracker, self.run, self.run.lane(-1), reduce.losses(len(self.names)))
        return [Decision(sample, len(self.run) - 1, event, prob) for sample, event, prob in found]

    @cached_property
    def smoothed(self) -> SmoothedMixture:
        """The record smoothed over all hypotheses, given the faults of sensors that say nothing about theta."""
        return SmoothedMixture(self.run, self.found())

    def events(self, threshold: float = 0.5) -> list[Event]:
        """Changes and sensor faults whose probability exceeds the threshold, sorted by time.

        Changes, their dates and sizes come from the whole record (`smoothed`), faults from the filter. Changes of a
        bank in which one forgets or resets are as `found`, since there is nothing to smooth.
        """
        found = self.found(threshold)
        if any(change.forgets for change in self.tracker.all_changes):
            return found
        faults, known = ([event for event in found if event.kind == kind] for kind in ("sensor", "change"))
        smoothed, names, W = self.smoothed, self.tracker.change_names, self.lags[-1] + 1
        spans = [event.span for event in known]
        path, prior = smoothed.mixture, smoothed.prior[:, :1]
        changes = dated(self.run, path.events, path.increment, prior, names, threshold, W, spans)
        return sorted(faults + changes, key=lambda event: event.span.date)

    def changes(self, threshold: float = 0.5) -> list[Event]:
        """`events` without the faults."""
        return [event for event in self.events(threshold) if event.kind == "change"]

    def found(self, threshold: float = 0.5) -> list[Event]:
        """`events` at the time of their detection: with the dates of the leaves, and without shifts."""
        bank, time = self.tracker, self.run.time
        given = Probabilities(
            self.latest, self.window, self.run.ok, self.lags[-1] + 1, bank.change_names, bank.sensor_names
        )  # fmt: skip
        early = [self._early(event, threshold) for event in all_of(given, threshold)]
        return [event.timed(lambda sample: time[sample]) for event in early]

    def _early(self, event: Event, threshold: float) -> Event:
        """A fault may have been detected earlier than the last sample at which it was remembered."""
        if event.kind == "change":
            return event
        j, date = self.tracker.sensor_names.index(event.name), event.span.date
        for k, lag in enumerate(self.lags):
            if date + lag < len(self.run) and self.lag_prob[date + lag, k, j :: self.sensors].sum() > threshold:
                return replace(event, span=event.span._replace(known=date + lag))
        return event

    def table(self, threshold: float = 0.5) -> Any:
        """`events` as a polars table, with the change of every parameter and its standard error."""
        import polars as pl

        names = self.run.names
        rows = [{**event.row(names), "sample": event.span.date} for event in self.events(threshold)]
        return pl.DataFrame(rows, infer_schema_length=None)

    def alarm(self, threshold: float | None = None, rate: float | None = None, reference: Track | None = None) -> Alarm:
        """Alarm while the window probability exceeds a threshold.

        Give the threshold, or the allowed rate of false alarms per sample. With ``reference``, a run of the same bank
        over a record without changes, the threshold is the smallest one with at most that rate there. Without one it is
        the smallest one at which the bank itself expects at most that rate, sum (1 - p) over its alarms.
        """
        if (threshold is None) == (rate is None):
            raise ValueError("alarm: give either threshold= or rate= (false alarms per sample).")
        if threshold is None:
            assert rate is not None
            threshold = self._threshold(rate, reference)
        on = self.window > threshold
        return Alarm(float(threshold), np.array([a for a, _ in runs(on)], int), on)

    def _threshold(self, rate: float, reference: Track | None) -> float:
        window = self.window if reference is None else Hypotheses(reference).window
        for level in np.unique(np.r_[0.0, np.round(window, 4), 1.0]):
            at = [a for a, _ in runs(window > level)]
            false = len(at) if reference is not None else float(np.sum(1.0 - window[at]))
            if false <= rate * len(window) and (reference is not None or level >= rate):
                return float(level)
        return 1.0

    def mixture(self, t: int = -1) -> Mixture:
        """The leaves after sample t; replays the record up to t."""
        return mixture_of(self.tracker, self.run, self.run.lane(t))

    def plot(self, threshold: float = 0.5, level: float = 0.95, ax: Any = None) -> Figure:
        """Parameters with bands, the probabilities of events stacked below them, events marked.

        ``ax`` as for `Track.plot`.
        """
        return plot_hypotheses(self.run, self.latest, self.names, self.found(threshold), level, ax)
