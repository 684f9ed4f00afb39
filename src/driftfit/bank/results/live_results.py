"""Results of a bank of hypotheses in a stream: present probabilities, decided events, the mixture."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from driftfit.bank.bank import Bank
from driftfit.bank.layout import COUNTER, SAMPLE, SAMPLE_HEAD
from driftfit.bank.memory import SINGLE
from driftfit.bank.results.events import Event, Probabilities, all_of
from driftfit.bank.results.mixture import Mixture, mixture_of
from driftfit.engine.kernel import Array
from driftfit.run.live.live import Live


class LiveHypotheses:
    """The present results of a stream with a `Bank`; `Live.hypotheses` makes it.

    ``lag_prob`` (len(lags), H), ``window``, ``evidence``, ``leaves``, ``kept`` and ``impossible`` are those of
    `Hypotheses` after the last sample.
    """

    def __init__(self, live: Live) -> None:
        if not live.tracker.weighs:
            raise ValueError(f"hypotheses: {type(live.tracker).__name__} has no hypotheses; track with a Bank.")
        self._live = live
        self.tracker: Bank = live.tracker  # type: ignore[assignment]
        self._lane = live.lane()
        self.names = self.tracker.event_names
        reported = {name: self.tracker.reported(self._lane["report"], name) for name in ("lag_prob", *SINGLE)}
        self.lag_prob: Array = reported["lag_prob"].copy()
        self.evidence, self.window, self.kept, self.leaves = (float(reported[name]) for name in SINGLE)
        self.impossible = int(self._lane["counters"][COUNTER.impossible])

    def mixture(self) -> Mixture:
        """The present leaves, for use in control."""
        return mixture_of(self.tracker, self._live, self._lane)

    def events(self, threshold: float = 0.5) -> list[Event]:
        """Events that were decided since the last call; their information is final.

        A stream remembers the last 256 samples, so call this more often than that.
        """
        many, bank = self._lane["counters"], self.tracker
        ring = bank.array(self._live.model, self._lane, "ring")
        now, W = int(many[COUNTER.clock]), bank.reported_levels[-1] + 1
        at = np.arange(max(0, now - len(ring)), now)
        rows = ring[at % len(ring)]
        first = int(at[0]) - W + 1 if len(at) else 0
        window, used = np.r_[np.zeros(W - 1), rows[:, 0]], np.r_[np.ones(W - 1, bool), rows[:, 1] > 0.0]
        latest = np.vstack([rows[:, SAMPLE_HEAD:], np.zeros((W - 1, len(self.names)))])
        given = Probabilities(latest, window, used, W, bank.change_names, bank.sensor_names)
        found = [replace(event, span=event.span.moved(first)) for event in all_of(given, threshold)]
        busy, reported = window[-1] > threshold, int(many[COUNTER.reported_to])
        done = [event for event in found if reported <= event.span.date and event.span.last < now - W + 1 and not busy]
        if not busy:
            many[COUNTER.reported_to] = max(now - W + 1, reported)
        return [event.timed(lambda sample: self._time(ring, sample)) for event in done]

    def _time(self, ring: Array, sample: int) -> Any:
        """The time of a sample of the ring; its number if the stream has no times."""
        back = float(self._lane["sample"][SAMPLE.elapsed] - ring[sample % len(ring), 2])
        time = self._live.before(back)
        return sample if time is None else time
