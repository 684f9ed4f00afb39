"""The units of a section [[unit]] as rows of arrays: what arrives is sorted, judged and run for all of them at once.

Samples with times wait until the newest time of their unit is ``hold_back`` after them, and are then processed in the
order of their times (`driftfit.run.states.late`). What is late, repeated, without a time, or far in the future is
counted and does not enter the journal (`Section.admit`). What the journal has is processed in the lanes of tiles
(`driftfit.run.states.advance`), so the states are those of `track` on the journal's rows, bit for bit.
"""

from __future__ import annotations

import json
import math
import time as wall
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from driftfit.data.clock import Clock
from driftfit.data.known import INTERVAL, NOISE, Known
from driftfit.data.record import Records
from driftfit.data.storage import describe, rebuild
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.run.live.interventions import HELD
from driftfit.run.live.rule import FROZEN
from driftfit.run.program import Program, programs_of, state_of
from driftfit.run.states import late
from driftfit.run.states.advance import Advanced, advance
from driftfit.run.states.layout import unpacked
from driftfit.run.warm_start import End
from driftfit.service.core.blocks import Blocks
from driftfit.service.core.journal import Rows
from driftfit.service.core.results import ALARM, OK, THETA, Results
from driftfit.service.core.unit import Out, Unit
from driftfit.service.settings.config import UnitSettings
from driftfit.streams import Live
from driftfit.trackers.base import Tracker

AHEAD = 86_400.0
"""A time so many seconds ahead of both the last sample and this machine's clock is refused: it would make every later
sample late."""
REFUSED = {late.LATE: "late", late.REPEATED: "duplicate", late.UNTIMED: "no time"}
"""How samples are counted that do not enter the journal."""
SAMPLES, USED = range(2)
"""Columns of the counts that every unit has."""


class Section:
    """All units of a section; a unit has a place, which is its row in the arrays."""

    def __init__(self, index: int, settings: UnitSettings) -> None:
        self.index, self.settings = index, settings
        (self.program,) = programs_of(settings.model, settings.tracker, settings.model.m)
        self.clock = Clock.of(settings.dt)
        width = len(settings.columns)
        self.units: list[Unit] = []
        self.words: Array = np.zeros((0, self.program.layout.size), np.int64)
        """(capacity, W): the states."""
        self.begun: Array = np.zeros(0, bool)
        self.last: Array = np.zeros(0)
        """Time of the last sample that was processed, NaN without one."""
        self.newest: Array = np.zeros(0)
        self.held: Array = np.zeros(0, bool)
        self.limits: Array = np.zeros((0, width, 2))
        self.counted: Array = np.zeros((0, 2), np.int64)
        self.numbers: Array = np.zeros(0, np.int32)
        """The units' numbers."""
        self.waiting = late.HoldBack(settings.hold_back, 1 + width)
        self.blocks = Blocks(THETA + 2 * self.program.model.n)
        self._own_limits = np.array([settings.limits.get(name, (-math.inf, math.inf)) for name in settings.columns])
        self._places: Array = np.zeros(0, np.int64)

    def add(self, number: int, name: str) -> Unit:
        """A new unit."""
        place = len(self.units)
        if place == len(self.begun):
            self._grow(max(8, 2 * place))
        if number >= len(self._places):
            more = max(number + 1, 2 * len(self._places)) - len(self._places)
            self._places = np.concatenate([self._places, np.full(more, -1)])
        self.limits[place] = self._own_limits
        self.numbers[place], self._places[number] = number, place
        unit = Unit(number, name, self, place)
        self.units.append(unit)
        return unit

    def _grow(self, capacity: int) -> None:
        for name, start in (("words", 0), ("begun", False), ("last", math.nan), ("newest", math.nan), ("held", False),
                            ("limits", 0.0), ("counted", 0), ("numbers", 0)):  # fmt: skip
            old = getattr(self, name)
            new = np.full((capacity, *old.shape[1:]), start, old.dtype) if start else np.zeros(
                (capacity, *old.shape[1:]), old.dtype)  # fmt: skip
            new[: len(old)] = old
            setattr(self, name, new)
        self.blocks.grow(capacity)

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
        live = Live(settings.model, settings.tracker, dt=settings.dt, warm_start=before)
        live.hold(bool(self.held[place]))
        return live

    def continue_from(self, place: int, live: Live) -> None:
        """Let the state of a unit be that of a stream."""
        (state,) = live.end().states
        self.words[place] = self.program.layout.taken(self.program.tile(state))[0]
        self.begun[place] = True

    def clear(self, place: int) -> None:
        """A unit at its start."""
        self.begun[place], self.last[place], self.held[place] = False, math.nan, False
        self.waiting.put(place, np.zeros(0), np.zeros((0, self.waiting.rows.shape[1])))

    def about(self) -> tuple[bytes, str]:
        """(the fingerprint of states, what made them)."""
        described = {"model": describe(self.settings.model), "tracker": describe(self.settings.tracker)}
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
            old = Program(rebuild(made["model"], Model), rebuild(made["tracker"], Tracker))
            end = End((old,), (state_of(old.unpack(state)),), None)
            live = Live(self.settings.model, self.settings.tracker, dt=self.settings.dt, warm_start=end)
            self.continue_from(place, live)
        self.begun[place] = True

    def admit(self, places: Array, time: Array | None, values: Array) -> Rows | None:
        """The samples (N,) that enter the journal, sorted by unit and time; the others are counted."""
        if time is None:
            order = np.argsort(places, kind="stable")
        else:
            self._refuse("time in the future", places, far := self._too_far(places, time))
            kept = np.flatnonzero(~far)
            order, fate = self.waiting.judge(places[kept], time[kept], self.newest)
            order = kept[order]
            for code, name in REFUSED.items():
                self._refuse(name, places[kept], fate == code)
        if not len(order):
            return None
        time = None if time is None else time[order]
        return Rows(self.index, self.numbers[places[order]], time, values[order])

    def _too_far(self, places: Array, time: Array) -> Array:
        """Which times are too far in the future: after a gap of more than a day, beyond the newest and this clock."""
        now = wall.time()
        far = time > np.fmax(self.newest[places], now) + AHEAD
        for place in np.unique(places[far]).tolist():
            newest = max(now, float(np.nan_to_num(self.newest[place], nan=-math.inf)))
            own = np.flatnonzero(places == place)
            for k in own[np.argsort(time[own])].tolist():
                far[k] = time[k] > newest + AHEAD
                newest = newest if far[k] or math.isnan(time[k]) else max(newest, time[k])
        return np.asarray(far)

    def _refuse(self, name: str, places: Array, which: Array) -> None:
        for place in places[which].tolist():
            self.units[place].rare[name] += 1

    def process(self, first: int, rows: Rows, out: Out, done: Array | None = None) -> None:
        """Process samples of the journal, the first of which has the number ``first``.

        ``done`` (N,) says which of them are in the stored states already.
        """
        number = first + np.arange(rows.length)
        places = self.places(rows.unit)
        if done is not None:
            rows, number, places = rows.some(~done), number[~done], places[~done]
        np.add.at(self.counted[:, SAMPLES], places, 1)
        failed = np.array([bool(self.units[place].failure) for place in np.unique(places).tolist()])
        if failed.any():
            fine = ~failed[np.unique(places, return_inverse=True)[1]]
            rows, number, places = rows.some(fine), number[fine], places[fine]
        time, values = rows.time, rows.values
        if time is not None:  # numbers of samples are exact as floats
            every = np.column_stack([number, values])
            places, time, every = self.waiting.take(places, time, every, self.newest)
            number, values = every[:, 0].astype(np.int64), every[:, 1:]
        if len(places):
            self._run(places, time, self._within(places, values), number, out)

    def _within(self, places: Array, values: Array) -> Array:
        """Values, NaN where they are outside their ranges."""
        low, high = self.limits[places, :, 0], self.limits[places, :, 1]
        outside = (values < low) | (values > high)
        if not outside.any():
            return values
        for row, column in np.argwhere(outside).tolist():
            self.units[places[row]].rare[f"{self.settings.columns[column]} outside its limits"] += 1
        return np.where(outside, math.nan, values)

    def _run(self, places: Array, time: Array | None, values: Array, number: Array, out: Out) -> None:
        """Update the states by samples that are sorted by place; if that fails, unit by unit."""
        first = np.flatnonzero(np.append(True, places[1:] != places[:-1]))
        length = np.diff(np.append(first, len(places)))
        own = places[first]
        known = self._known(places, own, first, time)
        collected = any(alarm.rule.kind in FROZEN for k in own.tolist() for alarm in self.units[k].alarms)
        keys = tuple(own.tolist())
        records = Records(keys, first, length, values[:, 0], values[:, 1:], Known(known), time)
        try:
            found = advance([self.program] * len(own), records, self.words[own], self.begun[own], 1, collected)
        except Exception as error:  # whatever it is, the other units continue
            if len(own) == 1:
                self.units[own[0]].fail(int(number[0]), error, out)
                return
            for a, b in zip(first.tolist(), (first + length).tolist(), strict=True):
                part = slice(a, b)
                self._run(places[part], None if time is None else time[part], values[part], number[part], out)
            return
        self.words[own], self.begun[own] = found.states(), True
        if time is not None:
            self.last[own] = time[first + length - 1]
        self._tell(found, Rows(self.index, places, time, values), known[:, NOISE], number, out)

    def _known(self, places: Array, own: Array, first: Array, time: Array | None) -> Array:
        """What is known of the samples (N, 3), or of all of them (1, 3)."""
        held = self.held[places]
        known = np.ones((1 if time is None and not held.any() else len(places), 3))
        if time is not None:
            before = np.roll(time, 1)
            before[first] = np.where(np.isnan(self.last[own]), time[first], self.last[own])
            gaps = self.clock.between(before, time)
            gaps[first[np.isnan(self.last[own])]] = 1.0
            known[:, INTERVAL] = gaps
        if held.any():
            known[held] = HELD
        return known

    def _tell(self, found: Advanced, rows: Rows, noise: Array, number: Array, out: Out) -> None:
        """Pass on results; ``rows`` have places for units."""
        places, records = rows.unit, found.records
        with np.errstate(invalid="ignore"):
            std = np.sqrt(found.column("var"))
        time = np.full(len(places), math.nan) if rows.time is None else rows.time
        heads = np.column_stack([time, rows.values[:, 0], *(found.column(name) for name in ("y_hat", "e", "s"))])
        values = np.concatenate([heads, found.column("theta"), std], axis=1)
        flags = (found.column("ok") > 0.0).astype(np.uint8) * np.uint8(OK)
        np.add.at(self.counted[:, USED], places, flags)
        lanes = None
        for k, place in enumerate(records.keys):
            unit = self.units[place]  # type: ignore[index]
            if unit.calibrated and not unit.alarms:
                continue
            lanes = found.lanes() if lanes is None else lanes
            part = slice(int(records.first[k]), int(records.first[k] + records.length[k]))
            own = None if rows.time is None else rows.time[part]
            if unit.alarms:
                job, lane = lanes[k]
                factors = np.broadcast_to(noise, len(places))[part]
                on = unit.watch(job.out[: len(factors)], lane, factors, own, number[part], out)
                flags[part] |= np.array(on, np.uint8) * np.uint8(ALARM)
            if not unit.calibrated:
                unit.remember(own, rows.values[part], out)
        results = Results(number, self.numbers[places], flags, values)
        out.results.append(results)
        out.blocks += self.blocks.add(places, results)
