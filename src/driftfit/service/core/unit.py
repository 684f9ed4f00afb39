"""One unit: a stream, its late samples, limits, alarms, and its history for the page.

Everything that changes the state comes from the journal in one order, so that the journal alone determines it: samples,
and actions (hold, reset, new limits, the rule of an alarm). Samples with times wait until the newest time is
``hold_back`` after them, and are then processed in the order of their times. With W the newest time minus hold_back

    time <= W          late: counted, and not journaled (`admit`)
    time among those that wait    duplicate: likewise
    otherwise          journaled; processed once time <= W

so the states are those of `track` on the journal's rows, bit for bit.
"""

from __future__ import annotations

import heapq
import math
import time as wall
import zlib
from array import array
from collections import Counter
from typing import Any

import msgspec
import numpy as np

from driftfit.data.storage import rebuild
from driftfit.run.live.rule import AlarmRule
from driftfit.service.core.blocks import Blocks
from driftfit.service.settings.config import UnitSettings, valid_range
from driftfit.streams import Live

AHEAD = 86_400.0
"""A time so many seconds ahead of both the last sample and this machine's clock is refused: it would make every later
sample late."""

MANY = 16
"""Samples from which on one call of the stream is faster than one for each of them."""

Sample = tuple[float | None, int, list[float]]
"""(time, number in the journal, y and u)."""


class Unit:
    """A unit of the service."""

    def __init__(self, number: int, name: str, settings: UnitSettings) -> None:
        self.number, self.name, self.settings = number, name, settings
        self.live: Live | None = settings.live()
        self.limits = [settings.limits.get(one, (-math.inf, math.inf)) for one in settings.columns]
        self.newest = -math.inf
        self.waiting: list[tuple[float, int, list[float]]] = []
        self.counts: Counter[str] = Counter()
        self.failure = ""
        self.acknowledged = True
        self.reference = array("d")
        """The first samples, from which the limits of alarms are found: time and row, one after the other."""
        self.calibrated = settings.alarm is None
        self.seen = 0
        self.last: list[Any] | None = None
        self.blocks = Blocks(number)
        self._bind()

    def _bind(self) -> None:
        lane = {} if self.live is None else self.live.lane()
        self._theta, self._var = lane.get("theta"), lane.get("var")
        self._bounded = any(one != (-math.inf, math.inf) for one in self.limits)

    def admit(self, times: list[float], rows: list[list[float]]) -> tuple[list[float], list[list[float]]]:
        """The samples that may enter the journal; the others are counted."""
        kept_times: list[float] = []
        kept_rows: list[list[float]] = []
        newest, wait = self.newest, self.settings.hold_back
        known = {one[0] for one in self.waiting}
        limit = max(wall.time(), newest) + AHEAD
        for t, row in zip(times, rows, strict=True):
            if not math.isfinite(t):
                self.counts["no time"] += 1
            elif t > limit:
                self.counts["time in the future"] += 1
            elif t in known:
                self.counts["duplicate"] += 1
            elif t <= newest - wait:
                self.counts["duplicate" if t == newest else "late"] += 1
            else:
                newest = max(newest, t)
                limit = max(limit, newest + AHEAD)
                if wait:
                    known.add(t)
                kept_times.append(t)
                kept_rows.append(row)
        return kept_times, kept_rows

    def take(self, first: int, times: list[float] | None, rows: list[list[float]], out: Out) -> None:
        """Process samples of the journal."""
        self.counts["samples"] += len(rows)
        if self.failure:
            return
        try:
            self._process(self._released(first, times, rows), out)
        except Exception as error:  # whatever the error is, the other units continue
            self.fail(first, error, out)

    def fail(self, number: int, error: Exception, out: Out) -> None:
        """Stop this unit until an operator restarts it."""
        self.failure = f"{type(error).__name__}: {error}"[:500]
        self.live = None
        self.waiting.clear()
        out.event(number, self.number, "failed", {"error": self.failure})

    def _released(self, first: int, times: list[float] | None, rows: list[list[float]]) -> list[Sample]:
        """The samples that are to be processed now, in their order."""
        if times is None:
            return [(None, first + k, row) for k, row in enumerate(rows)]
        released: list[Sample] = []
        for k, (t, row) in enumerate(zip(times, rows, strict=True)):
            heapq.heappush(self.waiting, (t, first + k, row))
            self.newest = max(self.newest, t)
            while self.waiting and self.waiting[0][0] <= self.newest - self.settings.hold_back:
                released.append(heapq.heappop(self.waiting))
        return released

    def _process(self, samples: list[Sample], out: Out) -> None:
        """Update the stream, with many samples in one call, which gives the same bits in a tenth of the time."""
        live = self.live
        assert live is not None
        if self._bounded:
            samples = [(time, number, self._within(row)) for time, number, row in samples]
        if len(samples) < MANY or live.alarms:
            for sample in samples:
                self._step(sample, out)
            return
        values = np.array([row for _, _, row in samples])
        times = None if samples[0][0] is None else np.array([time for time, _, _ in samples])
        found = live.update_many(values[:, 0], values[:, 1:], times)
        columns = found.prediction, found.innovation, found.innovation_var, found.ok, found.theta, found.std
        for sample, *results in zip(samples, *(column.tolist() for column in columns), strict=True):
            self._tell(sample, results, False, out)

    def _step(self, sample: Sample, out: Out) -> None:
        """One sample."""
        time, number, row = sample
        live = self.live
        assert live is not None
        u: Any = row[1] if len(row) == 2 else row[1:]
        step = live.update(row[0], u if len(row) > 1 else None, time=time)
        on = False
        for alarm in live.alarms:
            if alarm.begun:
                for onset in alarm.onsets():
                    self.acknowledged = False
                    detail = {"kind": alarm.rule.kind, "cause": onset.cause, "statistic": onset.statistic}
                    out.event(number, self.number, "alarm", detail | {"limit": onset.limit, "time": time})
            on = on or alarm.active
        theta = self._theta.tolist() if self._theta is not None else []
        std = [math.sqrt(v) if v >= 0.0 else math.nan for v in self._var.tolist()] if self._var is not None else []
        self._tell(sample, [*step, theta, std], on, out)

    def _tell(self, sample: Sample, results: list[Any], on: bool, out: Out) -> None:
        """Pass on the results of a sample: y_hat, e, s, ok, theta, std, and whether an alarm is on."""
        time, number, row = sample
        self.counts["used"] += results[3]
        if self.last is not None and self.last[10] and not on:
            out.event(number, self.number, "over", {"time": time})
        result = [number, self.number, time, row[0], *results, on]
        self.last = result
        self.seen += 1
        self.blocks.add(result)
        out.results.append(result)
        if not self.calibrated:
            self._remember(time, row, out)

    def _within(self, row: list[float]) -> list[float]:
        """A row without the values outside their ranges."""
        found = list(row)
        for k, (low, high) in enumerate(self.limits):
            if row[k] < low or row[k] > high:
                found[k] = math.nan
                self.counts[f"{self.settings.columns[k]} outside its limits"] += 1
        return found

    def _remember(self, time: float | None, row: list[float], out: Out) -> None:
        """Keep the samples of the reference; when they are complete, ask for the limits of the alarms."""
        alarm = self.settings.alarm
        assert alarm is not None
        width = len(row) + 1
        if len(self.reference) < alarm.reference * width:
            self.reference.extend((math.nan if time is None else time, *row))
            if len(self.reference) == alarm.reference * width:
                out.to_calibrate.append(self.number)

    def act(self, number: int, action: dict[str, Any], out: Out) -> None:
        """Carry out an action of an operator, or of the service itself; problems become an event."""
        what = action["do"]
        detail: dict[str, Any] = {key: value for key, value in action.items() if key != "rules"}
        try:
            self._act(what, action)
        except Exception as error:
            detail["refused"] = str(error)[:500]
        out.event(number, self.number, "calibrated" if what == "calibrated" else "action", detail)

    def _act(self, what: str, action: dict[str, Any]) -> None:
        if what == "restart":
            self.live, self.failure = self.settings.live(), ""
            self.last, self.reference = None, array("d")
            self.calibrated = self.settings.alarm is None
            self.waiting.clear()
            self._bind()
            return
        if what == "acknowledge":
            self.acknowledged = True
            return
        if what == "limits":
            names = self.settings.columns
            found = {name: valid_range(name, bounds, names) for name, bounds in action["limits"].items()}
            self.limits = [found.get(name, old) for name, old in zip(names, self.limits, strict=True)]
            self._bind()
            return
        if self.live is None:
            raise ValueError("the unit has failed; restart it.")
        if what == "hold":
            self.live.hold(bool(action["on"]))
        elif what == "reset":
            self.live.reset(action.get("which"), p=action.get("p"), theta=action.get("theta"))
        elif what == "calibrated":
            for rule in action["rules"]:
                self.live.detect(rebuild(rule, AlarmRule), wait=0)
            self.calibrated = True
            self.reference = array("d")
        else:
            raise ValueError(f"there is no action {what!r}.")

    def plain(self) -> dict[str, Any]:
        """The facts that the page shows besides the results."""
        live = self.live
        return {
            "counts": dict(self.counts), "failure": self.failure, "acknowledged": self.acknowledged,
            "calibrated": self.calibrated, "held": live is not None and live.held, "waiting": len(self.waiting),
            "ignored": 0 if live is None else live.ignored,
            "limits": {name: [None if math.isinf(v) else v for v in pair]
                       for name, pair in zip(self.settings.columns, self.limits, strict=True)},
            "hypotheses": self._hypotheses(),
        }  # fmt: skip

    def _hypotheses(self) -> dict[str, float] | None:
        """Present probabilities of the events of a `Bank`; None for other trackers."""
        if self.live is None or not self.live.tracker.weighs:
            return None
        now = self.live.hypotheses
        return dict(zip(now.names, now.lag_prob[0].tolist(), strict=False))

    def state(self) -> bytes:
        """The state as bytes."""
        live = b"" if self.live is None else zlib.compress(self.live.to_bytes(), 1)
        kept = [live, self.newest, self.waiting, dict(self.counts), self.failure, self.acknowledged, self.calibrated,
                self.reference.tobytes(), self.limits, self.last, self.seen]  # fmt: skip
        packed: bytes = msgspec.msgpack.encode(kept)
        return packed

    @classmethod
    def of(cls, number: int, name: str, settings: UnitSettings, state: bytes) -> Unit:
        """The inverse of `state`."""
        live, newest, waiting, counts, *rest = msgspec.msgpack.decode(state)
        unit = cls.__new__(cls)
        unit.number, unit.name, unit.settings = number, name, settings
        unit.live = Live.from_bytes(zlib.decompress(live)) if live else None
        unit.newest, unit.waiting = newest, [(t, n, row) for t, n, row in waiting]
        unit.counts = Counter(counts)
        unit.failure, unit.acknowledged, unit.calibrated, reference, limits, unit.last, unit.seen = rest
        unit.reference = array("d")
        unit.reference.frombytes(reference)
        unit.limits = [(low, high) for low, high in limits]
        unit.blocks = Blocks(number)
        unit._bind()
        return unit


class Out:
    """Results and events of processing a group."""

    def __init__(self) -> None:
        self.results: list[list[Any]] = []
        self.events: list[list[Any]] = []
        self.to_calibrate: list[int] = []

    def event(self, number: int, unit: int, kind: str, detail: dict[str, Any]) -> None:
        """Note an event."""
        self.events.append([number, unit, wall.time(), kind, detail])
