"""One unit: what is seldom used of it; its stream is a row of the arrays of `driftfit.service.core.unit`.

Everything that changes the state comes from the journal in one order, so that the journal alone determines it: samples,
and actions (hold, reset, new limits, the rule of an alarm).
"""

from __future__ import annotations

import json
import math
import time as wall
from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import msgspec
import numpy as np

from driftfit.data.clock import Clock
from driftfit.data.late import HoldBack
from driftfit.data.storage import describe, rebuild
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.readings.gate import Gate
from driftfit.run.layout import unpacked
from driftfit.run.live.alarm import LiveAlarm
from driftfit.run.live.rule import AlarmRule
from driftfit.run.program import Program, programs_of, state_of
from driftfit.run.warm_start import End
from driftfit.service.config import UnitSettings, valid_ranges
from driftfit.service.core.journal import REMEDY
from driftfit.streams import Live
from driftfit.trackers.base import Tracker
from driftfit.tracking import track


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
        return dict(zip(self.settings.columns, map(tuple, self.streams.limits[self.place].tolist()), strict=True))

    @property
    def live(self) -> Live:
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
        """The facts that the page shows besides the results, of a `Bank` the present probabilities of its events."""
        weighs = self.streams.program.tracker.weighs and not self.failure
        now = self.live.hypotheses if weighs else None
        return {
            "counts": dict(self.counts), "failure": self.failure, "acknowledged": self.acknowledged,
            "unarmed": self.unarmed, "held": bool(self.streams.held[self.place]), "waiting": self.waiting,
            "limits": {name: [None if math.isinf(v) else v for v in pair] for name, pair in self.limits.items()},
            "hypotheses": None if now is None else dict(zip(now.names, now.lag_prob[0].tolist(), strict=False)),
        }  # fmt: skip

    def state(self) -> bytes:
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
        self.events.append([number, unit, wall.time(), kind, detail])


SAMPLES, USED = range(2)
"""Columns of the counts that every unit has."""


class Streams:
    """A unit has a place, which is its row in the arrays.

    Attributes
    ----------
    words : (capacity, W)
        The states of units that have ``begun``.
    last, newest : (capacity,)
        Times of the last sample that was processed, and of the newest that came; NaN without one.
    held : (capacity,) bool
        Whether an operator has stopped the learning.
    limits : (capacity, 1 + m, 2)
        Valid ranges of the signals.
    counted : (capacity, 2)
        Samples that came, and that were used.
    numbers : (capacity,)
        Numbers of the units.
    """

    def __init__(self, index: int, settings: UnitSettings) -> None:
        self.index, self.settings = index, settings
        (self.program,) = programs_of(settings.model, settings.tracker, settings.model.m, settings.gate)
        self.clock = Clock.of(settings.dt)
        width = len(settings.columns)
        self.count = 0
        self.free: list[int] = []
        """Places of units that were removed."""
        self.words: Array = np.zeros((0, self.program.layout.size), np.int64)
        self.begun: Array = np.zeros(0, bool)
        self.last: Array = np.zeros(0)
        self.newest: Array = np.zeros(0)
        self.held: Array = np.zeros(0, bool)
        self.limits: Array = np.zeros((0, width, 2))
        self.counted: Array = np.zeros((0, 2), np.int64)
        self.numbers: Array = np.zeros(0, np.int32)
        self.waiting = HoldBack(settings.hold_back, 1 + width)
        self._own_limits = np.array([settings.limits.get(name, (-math.inf, math.inf)) for name in settings.columns])
        self._places: Array = np.zeros(0, np.int64)

    @property
    def capacity(self) -> int:
        return len(self.begun)

    def add(self, number: int) -> int:
        """The place of a new unit."""
        place = self.free.pop() if self.free else self.count
        self.count = max(self.count, place + 1)
        if place == self.capacity:
            capacity = max(8, 2 * place)
            for name in ("words", "begun", "last", "newest", "held", "limits", "counted", "numbers"):
                old = getattr(self, name)
                new = np.zeros((capacity, *old.shape[1:]), old.dtype)
                if name in ("last", "newest"):
                    new[...] = math.nan
                new[: len(old)] = old
                setattr(self, name, new)
        if number >= len(self._places):
            more = max(number + 1, 2 * len(self._places)) - len(self._places)
            self._places = np.concatenate([self._places, np.full(more, -1)])
        self.limits[place] = self._own_limits
        self.numbers[place], self._places[number] = number, place
        return place

    def remove(self, place: int) -> None:
        """Make room for another unit."""
        self.clear(place)
        self.counted[place], self._places[self.numbers[place]] = 0, -1
        self.free.append(place)

    def places(self, numbers: Array) -> Array:
        """Places of units by their numbers; -1 for those that are not there."""
        known = np.full(len(numbers), -1)
        there = numbers < len(self._places)
        known[there] = self._places[numbers[there]]
        return known

    def stream(self, place: int) -> Live:
        settings, before = self.settings, None
        if self.begun[place]:
            tile, last = self.program.tile(), float(self.last[place])
            self.program.layout.put(tile, 0, self.words[place])
            before = End((self.program,), (state_of(tile),), None if math.isnan(last) else last)
        live = Live(settings.model, settings.tracker, dt=settings.dt, warm_start=before, gate=settings.gate)
        live.hold(bool(self.held[place]))
        return live

    def continue_from(self, place: int, live: Live) -> None:
        """Let the state of a unit be that of a stream."""
        (state,) = live.end().states
        self.words[place] = self.program.layout.taken(self.program.tile(state))[0]
        self.begun[place] = True

    def clear(self, place: int) -> None:
        """A unit at its start."""
        self.begun[place], self.held[place] = False, False
        self.last[place] = self.newest[place] = math.nan
        self.waiting.put(place, np.zeros(0), np.zeros((0, self.waiting.rows.shape[1])))

    @cached_property
    def about(self) -> tuple[bytes, str]:
        """(the fingerprint of states, what made them)."""
        gate = self.program.gate
        described = {"model": describe(self.settings.model), "tracker": describe(self.settings.tracker)}
        described["gate"] = {} if gate is None else gate.settings()
        return self.program.layout.tag, json.dumps(described)

    def packed(self, place: int) -> list[Any]:
        time, rows = self.waiting.of(place)
        state = self.program.layout.pack(self.words[place]) if self.begun[place] else b""
        return [state, self.last[place].item(), self.newest[place].item(), bool(self.held[place]),
                self.limits[place].tobytes(), self.counted[place].tolist(), time.tobytes(), rows.tobytes()]  # fmt: skip

    def unpack(self, place: int, packed: Sequence[Any], programs: Mapping[bytes, str]) -> None:
        """The inverse of `packed`. A state that other settings of the tracker made is carried over."""
        state, self.last[place], self.newest[place], self.held[place], limits, counted, time, rows = packed
        self.limits[place], self.counted[place] = np.frombuffer(limits).reshape(-1, 2), counted
        times = np.frombuffer(time)
        if len(times):
            self.waiting.put(place, times, np.frombuffer(rows).reshape(len(times), -1))
        if not state:
            return
        tag, _ = unpacked(state)
        if tag == self.program.layout.tag or tag not in programs:
            self.words[place] = self.program.layout.unpack(state)
        else:
            made = json.loads(programs[tag])
            gate = Gate.from_settings(made["gate"]) if made["gate"] else None
            old = Program(rebuild(made["model"], Model), rebuild(made["tracker"], Tracker), gate=gate)
            if gate != self.program.gate:
                raise ValueError(f"it was made with gate={gate!r}, not {self.program.gate!r}; {REMEDY}.")
            end, settings = End((old,), (state_of(old.unpack(state)),), None), self.settings
            live = Live(settings.model, settings.tracker, dt=settings.dt, warm_start=end, gate=settings.gate)
            self.continue_from(place, live)
        self.begun[place] = True


def rules_of(settings: UnitSettings, rows: Array) -> dict[str, Any]:
    """The action that gives a unit its rules; ``rows`` (N, 2 + m) are time, y, u of the reference."""
    alarm = settings.alarm
    assert alarm is not None
    rules, refused = [], {}
    try:
        time = None if settings.time is None else rows[:, 0]
        run = track(
            settings.model, settings.tracker, rows[:, 1], rows[:, 2:], time=time, dt=settings.dt, gate=settings.gate
        )
    except Exception as error:
        return {"do": "calibrated", "rules": [], "refused": dict.fromkeys(alarm.on, str(error))}
    for kind in alarm.on:
        try:
            rules.append(describe(run.detect(kind, every=alarm.each, reference=len(rows)).rule))
        except Exception as error:
            refused[kind] = str(error)
    return {"do": "calibrated", "rules": rules, "on": list(alarm.on), "refused": refused, "samples": len(rows)}
