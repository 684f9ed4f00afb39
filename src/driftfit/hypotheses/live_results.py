"""What a bank of hypotheses tells in a stream: probabilities now, events as they are decided, the mixture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from driftfit.hypotheses.events import Event, Told, all_of
from driftfit.hypotheses.memory import SINGLE
from driftfit.hypotheses.mixture import Mixture, mixture_of
from driftfit.hypotheses.table import CLOCK, IMPOSSIBLE, REPORTED_TO
from driftfit.kernel import Array

if TYPE_CHECKING:
    from driftfit.live import Live
    from driftfit.trackers.bank import Bank


class LiveHypotheses:
    """What a stream with a `Bank` says of events now; `Live.hypotheses` makes it.

    ``lag_prob`` (W, H), ``window``, ``evidence``, ``leaves``, ``kept`` and ``impossible`` are those of `Hypotheses`
    after the last sample.
    """

    def __init__(self, live: Live) -> None:
        self._live = live
        self.tracker: Bank = live.tracker  # type: ignore[assignment]
        self._lane = live.lane()
        self.names = self.tracker.event_names
        told = {name: self.tracker.told(self._lane["report"], name) for name in ("lag_prob", *SINGLE)}
        self.lag_prob: Array = told["lag_prob"].copy()
        self.evidence, self.window, self.kept, self.leaves = (float(told[name]) for name in SINGLE)
        self.impossible = int(self._lane["many"][IMPOSSIBLE])

    def mixture(self) -> Mixture:
        """The leaves now: what control works with."""
        return mixture_of(self.tracker, self._live, self._lane)

    def events(self, threshold: float = 0.5) -> list[Event]:
        """Events that were decided since this was asked last: all that can be known of them is known.

        A stream remembers the last 256 samples, so ask more often than that.
        """
        many, bank = self._lane["many"], self.tracker
        ring = bank.array(self._live.model, self._lane, "ring")
        now, W = int(many[CLOCK]), len(self.lag_prob)
        at = np.arange(max(0, now - len(ring)), now)
        rows = ring[at % len(ring)]
        first = int(at[0]) - W + 1 if len(at) else 0
        window = np.r_[np.zeros(W - 1), rows[:, 0]]
        latest = np.vstack([rows[:, 1:], np.zeros((W - 1, rows.shape[1] - 1))])
        told = Told(latest, window, W, bank.change_names, bank.sensor_names)
        found = [event.moved(first) for event in all_of(told, threshold)]
        busy = window[-1] > threshold
        done = [event for event in found if many[REPORTED_TO] <= event.date and event.last < now - W + 1 and not busy]
        if not busy:
            many[REPORTED_TO] = max(now - W + 1, many[REPORTED_TO])
        return done
