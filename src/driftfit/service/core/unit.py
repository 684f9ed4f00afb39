"""One unit: what is seldom used of it; its stream is a row of the arrays of `driftfit.service.core.streams`.

Everything that changes the state comes from the journal in one order, so that the journal alone determines it: samples,
and actions (hold, reset, new limits, the rule of an alarm).
"""

from __future__ import annotations

import math
import time as wall
from array import array
from collections import Counter
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from driftfit.data.storage import rebuild
from driftfit.engine.kernel import Array
from driftfit.run.live.alarm import LiveAlarm
from driftfit.run.live.rule import AlarmRule
from driftfit.service.core.streams import Streams
from driftfit.service.settings.config import UnitSettings, valid_ranges
from driftfit.streams import Live


class Unit:
    """A unit of the service, at a place of its streams."""

    def __init__(self, number: int, name: str, streams: Streams, place: int) -> None:
        self.number, self.name, self.streams, self.place = number, name, streams, place
        self.rare: Counter[str] = Counter()
        """How often something happened, other than samples that came and were used."""
        self.failure = ""
        self.acknowledged = True
        self.reference = array("d")
        """The first samples, from which the limits of alarms are found: time and row, one after the other."""
        self.asked = False
        """Whether this process looks for the limits."""
        self.unarmed: dict[str, str] | None = None if self.settings.alarm else {}
        """By kind: why an alarm could not be set; None while the limits are not known."""
        self.alarms: list[LiveAlarm] = []
        self.alarmed = False
        """Whether an alarm was on after the last sample."""

    @property
    def settings(self) -> UnitSettings:
        """Those of its streams."""
        return self.streams.settings

    @property
    def calibrated(self) -> bool:
        """Whether the limits of the alarms are known, or there are no alarms."""
        return self.unarmed is not None

    @property
    def trouble(self) -> dict[str, str]:
        """What does not work here, and why."""
        failed = {"failed": self.failure} if self.failure else {}
        return failed | {f"alarm {kind} is not armed": why for kind, why in (self.unarmed or {}).items()}

    @property
    def counts(self) -> Counter[str]:
        """How often what happened."""
        samples, used = self.streams.counted[self.place].tolist()
        return Counter({name: count for name, count in (("samples", samples), ("used", used)) if count}) + self.rare

    @property
    def limits(self) -> dict[str, tuple[float, float]]:
        """Valid ranges by signal."""
        return dict(zip(self.settings.columns, map(tuple, self.streams.limits[self.place].tolist()), strict=True))

    @property
    def live(self) -> Live:
        """Its stream, as a copy."""
        return self.streams.stream(self.place)

    @property
    def waiting(self) -> int:
        """Samples that wait for late ones."""
        return len(self.streams.waiting.of(self.place)[0])

    def fail(self, number: int, error: Exception, out: Out) -> None:
        """Stop this unit until an operator restarts it."""
        self.failure = f"{type(error).__name__}: {error}"[:500]
        self.streams.clear(self.place)
        out.event(number, self.number, "failed", {"error": self.failure})

    def remember(self, time: Array | None, rows: Array, out: Out) -> None:
        """Keep the samples of the reference; when they are complete, ask for the limits of the alarms."""
        alarm = self.settings.alarm
        assert alarm is not None
        width = rows.shape[1] + 1
        missing = alarm.reference - len(self.reference) // width
        first = np.full(len(rows), math.nan) if time is None else time
        self.reference.frombytes(np.column_stack([first, rows])[:missing].tobytes())
        if len(rows) >= missing and not self.asked:
            out.to_calibrate.append(self.number)

    def watch(
        self, rows: Array, lane: int, y: Array, noise: Array, time: Array | None, number: Array, out: Out
    ) -> list[bool]:
        """Judge results for readings y by its alarms; whether one is on after each sample."""
        on = np.zeros(len(rows), bool)
        for alarm in self.alarms:
            before = alarm.samples
            on |= np.array([cause is not None for cause in alarm.take_many(rows, lane, y, noise, time)])
            for onset in alarm.onsets():
                self.acknowledged = False
                detail = {"kind": alarm.rule.kind, "cause": onset.cause, "statistic": onset.statistic}
                place = int(number[onset.sample - before])
                out.event(place, self.number, "alarm", detail | {"limit": onset.limit, "time": onset.time})
        for t in np.flatnonzero(np.append(self.alarmed, on[:-1]) & ~on).tolist():
            out.event(int(number[t]), self.number, "over", {"time": None if time is None else float(time[t])})
        self.alarmed = bool(on[-1])
        found: list[bool] = on.tolist()
        return found

    def act(self, number: int, action: Mapping[str, Any], out: Out) -> None:
        """Carry out an action of an operator, or of the service itself; problems become an event."""
        what = action["do"]
        detail: dict[str, Any] = {key: value for key, value in action.items() if key != "rules"}
        try:
            self._act(what, action)
        except Exception as error:
            detail["refused"] = str(error)[:500]
        out.event(number, self.number, "calibrated" if what == "calibrated" else "action", detail)

    def _act(self, what: str, action: Mapping[str, Any]) -> None:
        streams, place = self.streams, self.place
        if what == "restart":
            streams.clear(place)
            self.failure, self.reference, self.alarms, self.alarmed = "", array("d"), [], False
            self.asked, self.unarmed = False, None if self.settings.alarm else {}
        elif what == "acknowledge":
            self.acknowledged = True
        elif what == "limits":
            names = self.settings.columns
            for name, bounds in valid_ranges(action["limits"], names).items():
                streams.limits[place, names.index(name)] = bounds
        elif self.failure:
            raise ValueError("the unit has failed; restart it.")
        elif what == "hold":
            if not isinstance(on := action.get("on"), bool):
                raise ValueError(f"hold: on must be true or false; got {on!r}.")
            streams.held[place] = on
        elif what == "reset":
            live = self.live
            live.reset(action.get("which"), p=action.get("p"), theta=action.get("theta"))
            streams.continue_from(place, live)
        elif what == "calibrated":
            rules = [rebuild(rule, AlarmRule) for rule in action["rules"]]
            program = streams.program
            self.alarms = [LiveAlarm(rule, program.tracker, program.names) for rule in rules]
            self.unarmed, self.reference = dict(action.get("refused", {})), array("d")
        else:
            raise ValueError(f"there is no action {what!r}.")

    def plain(self) -> dict[str, Any]:
        """The facts that the page shows besides the results."""
        return {
            "counts": dict(self.counts), "failure": self.failure, "acknowledged": self.acknowledged,
            "unarmed": self.unarmed, "held": bool(self.streams.held[self.place]), "waiting": self.waiting,
            "limits": {name: [None if math.isinf(v) else v for v in pair] for name, pair in self.limits.items()},
            "hypotheses": self._hypotheses(),
        }  # fmt: skip

    def _hypotheses(self) -> dict[str, float] | None:
        """Present probabilities of the events of a `Bank`; None for other trackers."""
        if self.failure or not self.streams.program.tracker.weighs:
            return None
        now = self.live.hypotheses
        return dict(zip(now.names, now.lag_prob[0].tolist(), strict=False))

    def state(self) -> bytes:
        """The state as bytes."""
        alarms = [alarm.plain() for alarm in self.alarms]
        kept = [self.streams.packed(self.place), dict(self.rare), self.failure, self.acknowledged, self.unarmed,
                self.reference.tobytes(), alarms, self.alarmed]  # fmt: skip
        packed: bytes = msgspec.msgpack.encode(kept)
        return packed

    def restore(self, state: bytes, programs: Mapping[bytes, str]) -> None:
        """The inverse of `state`; ``programs`` describe what made states, by their fingerprint."""
        packed, rare, *rest, reference, alarms, self.alarmed = msgspec.msgpack.decode(state)
        self.failure, self.acknowledged, self.unarmed = rest
        self.rare, self.reference = Counter(rare), array("d")
        self.reference.frombytes(reference)
        program = self.streams.program
        self.alarms = [LiveAlarm.of(alarm, program.tracker, program.names) for alarm in alarms]
        self.streams.unpack(self.place, packed, programs)


class Out:
    """Results, events and blocks of the history that processing a group gives."""

    def __init__(self) -> None:
        self.results: list[Any] = []
        self.events: list[list[Any]] = []
        self.blocks: list[tuple[Any, ...]] = []
        self.to_calibrate: list[int] = []

    def event(self, number: int, unit: int, kind: str, detail: Mapping[str, Any]) -> None:
        """Note an event."""
        self.events.append([number, unit, wall.time(), kind, detail])
