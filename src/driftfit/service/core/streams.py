"""The streams of the units of a section as rows of arrays: states, times, limits, counts, and samples that wait."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from driftfit.data.clock import Clock
from driftfit.data.late import HoldBack
from driftfit.data.storage import describe, rebuild
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.readings.gate import Gate
from driftfit.run.layout import unpacked
from driftfit.run.program import Program, programs_of, state_of
from driftfit.run.warm_start import End
from driftfit.service.core.journal import REMEDY
from driftfit.service.settings.config import UnitSettings
from driftfit.streams import Live
from driftfit.trackers.base import Tracker

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
        """Units for which there is room."""
        return len(self.begun)

    def add(self, number: int) -> int:
        """The place of a new unit."""
        place = self.free.pop() if self.free else self.count
        self.count = max(self.count, place + 1)
        if place == self.capacity:
            self._grow(max(8, 2 * place))
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

    def _grow(self, capacity: int) -> None:
        for name in ("words", "begun", "last", "newest", "held", "limits", "counted", "numbers"):
            old = getattr(self, name)
            new = np.zeros((capacity, *old.shape[1:]), old.dtype)
            if name in ("last", "newest"):
                new[...] = math.nan
            new[: len(old)] = old
            setattr(self, name, new)

    def places(self, numbers: Array) -> Array:
        """Places of units by their numbers; -1 for those that are not there."""
        known = np.full(len(numbers), -1)
        there = numbers < len(self._places)
        known[there] = self._places[numbers[there]]
        return known

    def stream(self, place: int) -> Live:
        """The stream of a unit, as a copy."""
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
        """The state of a unit as plain data."""
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
