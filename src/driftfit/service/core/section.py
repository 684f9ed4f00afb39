"""The units of a section [[unit]]: what arrives is sorted, judged and run for all of them at once.

Samples with times wait until the newest time of their unit is ``hold_back`` after them, and are then processed in the
order of their times (`driftfit.data.late`). What is late, repeated, without a time, or far in the future is
counted and does not enter the journal (`Section.admit`). What the journal has is processed in the lanes of tiles
(`driftfit.run.parallel_lanes`), so the states are those of `track` on the journal's rows, bit for bit.
"""

from __future__ import annotations

import math
import time as wall
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from driftfit.data import late
from driftfit.data.record import Known, Records
from driftfit.engine.drivers import INTERVAL, NOISE
from driftfit.engine.kernel import Array
from driftfit.readings import gate
from driftfit.readings.left_out import SAID
from driftfit.run.live.stream import HELD
from driftfit.run.parallel_lanes import FEWEST_LANES, Advanced, advance
from driftfit.service.config import UnitSettings
from driftfit.service.core.journal import Rows
from driftfit.service.core.results import ALARM, OK, THETA, TIME, Y_HAT, Blocks, Results, Y
from driftfit.service.core.unit import SAMPLES, USED, Out, Streams, Unit

COLUMNS = ("y_hat", "e", "s", "theta", "var", "ok")
"""Fields of a tracker's output, in the order of the results; the last becomes a flag."""
REFUSED = {late.LATE: "late", late.REPEATED: "duplicate", late.UNTIMED: "no time"}
"""How samples are counted that do not enter the journal."""


Counters = Sequence[Counter[str] | None]
"""Who count what is left out; for samples, who counts each of them besides its unit."""


def tally(counters: Counters, reason: str, count: int) -> None:
    """Count samples that are left out, by all of these counters."""
    for one in counters:
        if one is not None:
            one[reason] += count


class Section:
    """All units of a section."""

    def __init__(self, index: int, settings: UnitSettings) -> None:
        self.streams = Streams(index, settings)
        self.units: dict[int, Unit] = {}
        """By their places."""
        self.left_out: Counter[str] = Counter()
        """What the gates left out since the service began, by reason."""
        self.blocks = Blocks(THETA + 2 * self.streams.program.model.n)

    def add(self, number: int, name: str) -> Unit:
        unit = Unit(number, name, self.streams, self.streams.add(number))
        if unit.place == self.blocks.capacity:
            self.blocks.grow(self.streams.capacity)
        self.units[unit.place] = unit
        return unit

    def remove(self, unit: Unit) -> list[tuple[Any, ...]]:
        """Forget a unit; the rows of the table ``block`` for the rest of its history."""
        del self.units[unit.place]
        self.streams.remove(unit.place)
        return self.blocks.flush(unit.place, unit.number)

    def prepare(self) -> None:
        """Compile what the first samples need, so that they do not wait; lanes only if there are units for them."""
        for count in (1, FEWEST_LANES) if len(self.units) >= FEWEST_LANES else (1,):
            trial = Section(self.streams.index, self.streams.settings)
            for k in range(count):
                trial.add(k, "")
            number = np.arange(count, dtype=np.int32)
            time = None if self.streams.settings.time is None else np.zeros(count)
            values = np.zeros((count, len(self.streams.settings.columns)))
            trial.process(0, Rows(self.streams.index, number, time, values), Out())

    def admit(self, places: Array, time: Array | None, values: Array, counters: Counters) -> Rows | None:
        """The samples (N,) that enter the journal, sorted by unit and time; the others are counted."""
        if time is None:
            order = np.argsort(places, kind="stable")
        else:
            far = time > np.fmax(self.streams.newest[places], wall.time()) + self.streams.settings.ahead
            self._refuse("time in the future", places, np.flatnonzero(far), counters)
            kept = np.flatnonzero(~far)
            order, fate = self.streams.waiting.judge(places[kept], time[kept], self.streams.newest)
            order = kept[order]
            for code, name in REFUSED.items():
                self._refuse(name, places, kept[fate == code], counters)
        if not len(order):
            return None
        time = None if time is None else time[order]
        return Rows(self.streams.index, self.streams.numbers[places[order]], time, values[order])

    def _refuse(self, name: str, places: Array, which: Array, counters: Counters) -> None:
        for k in which.tolist():
            tally((self.units[places[k]].rare, counters[k]), name, 1)

    def process(self, first: int, rows: Rows, out: Out, done: Array | None = None) -> None:
        """Process samples of the journal, the first of which has the number ``first``.

        ``done`` (N,) says which of them are in the stored states already.
        """
        number = first + np.arange(rows.length)
        places = self.streams.places(rows.unit)
        if done is not None:
            rows, number, places = rows.some(~done), number[~done], places[~done]
        np.add.at(self.streams.counted[:, SAMPLES], places, 1)
        failed = np.array([bool(self.units[place].failure) for place in np.unique(places).tolist()])
        if failed.any():
            fine = ~failed[np.unique(places, return_inverse=True)[1]]
            rows, number, places = rows.some(fine), number[fine], places[fine]
        time, values = rows.time, rows.values
        if time is not None:  # numbers of samples are exact as floats
            every = np.column_stack([number, values])
            places, time, every = self.streams.waiting.take(places, time, every, self.streams.newest)
            number, values = every[:, 0].astype(np.int64), every[:, 1:]
        if len(places):
            self._run(places, time, self._within(places, values), number, out)

    def _within(self, places: Array, values: Array) -> Array:
        """Values, NaN where they are outside their ranges."""
        low, high = self.streams.limits[places, :, 0], self.streams.limits[places, :, 1]
        outside = (values < low) | (values > high)
        if not outside.any():
            return values
        for row, column in np.argwhere(outside).tolist():
            self.units[places[row]].rare[f"{self.streams.settings.columns[column]} outside its limits"] += 1
        return np.where(outside, math.nan, values)

    def _run(self, places: Array, time: Array | None, values: Array, number: Array, out: Out) -> None:
        """Update the states by samples that are sorted by place; if that fails, unit by unit."""
        first = np.flatnonzero(np.append(True, places[1:] != places[:-1]))
        length = np.diff(np.append(first, len(places)))
        own = places[first]
        known = self._known(places, own, first, time)
        collected = any(alarm.rule.kind == "glr" for k in own.tolist() for alarm in self.units[k].alarms)
        records = Records(tuple(own.tolist()), first, length, values[:, 0], values[:, 1:], Known(known), time)
        try:
            programs, words = [self.streams.program] * len(own), self.streams.words[own]
            found = advance(programs, records, words, self.streams.begun[own], 1, collected)
        except Exception as error:  # whatever it is, the other units continue
            if len(own) == 1:
                self.units[own[0]].fail(int(number[0]), error, out)
                return
            for a, b in zip(first.tolist(), (first + length).tolist(), strict=True):
                part = slice(a, b)
                self._run(places[part], None if time is None else time[part], values[part], number[part], out)
            return
        refused = self._refused_before(own)
        self.streams.words[own], self.streams.begun[own] = found.states(), True
        if self.streams.program.gate is not None:  # what gates left out, of the samples and of the first ones of units
            reason, first_refused = found.reasons(), self._refused_before(own) - refused
            for k in np.flatnonzero((reason != gate.USED) & (reason % gate.SIGNAL != gate.AT_START)).tolist():
                self._count(places[k], reason.item(k), 1)
            for k in np.flatnonzero(first_refused > 0).tolist():
                self._count(own[k], gate.AT_START, first_refused.item(k))
        if time is not None:
            self.streams.last[own] = time[first + length - 1]
        self._tell(found, Rows(self.streams.index, places, time, values), known[:, NOISE], number, out)

    def _refused_before(self, own: Array) -> Array:
        """How many first samples of units (K,) their gates refused."""
        if self.streams.program.gate is None:
            return np.zeros(len(own), int)
        words = self.streams.program.layout.field(self.streams.words[own], "gate_refused")[:, 0]
        return np.where(self.streams.begun[own], words, 0)

    def _count(self, place: int, code: int, count: int) -> None:
        tally((self.units[place].rare, self.left_out), SAID[code % gate.SIGNAL][0].lower(), count)

    def _known(self, places: Array, own: Array, first: Array, time: Array | None) -> Array:
        """What is known of the samples (N, 3), or of all of them (1, 3)."""
        held = self.streams.held[places]
        known = np.ones((1 if time is None and not held.any() else len(places), 3))
        if time is not None:
            known[:, INTERVAL] = self.streams.clock.continued(time, first, self.streams.last[own])
        if held.any():
            known[held] = HELD
        return known

    def _tell(self, found: Advanced, rows: Rows, noise: Array, number: Array, out: Out) -> None:
        """Pass on results; ``rows`` have places for units."""
        places, records = rows.unit, found.records
        values = np.empty((len(places), self.blocks.columns))
        values[:, TIME] = math.nan if rows.time is None else rows.time
        values[:, Y] = rows.values[:, 0]
        given = np.empty((len(places), values.shape[1] - Y_HAT + 1))
        found.columns(COLUMNS, given)
        values[:, Y_HAT:] = given[:, :-1]
        std = values[:, THETA + self.streams.program.model.n :]
        with np.errstate(invalid="ignore"):
            np.sqrt(std, out=std)
        flags = (given[:, -1] > 0.0).astype(np.uint8) * np.uint8(OK)
        np.add.at(self.streams.counted[:, USED], places, flags)
        for k, place in enumerate(places[records.first].tolist()):
            unit = self.units[place]
            if unit.calibrated and not unit.alarms:
                continue
            part = slice(int(records.first[k]), int(records.first[k] + records.length[k]))
            own = None if rows.time is None else rows.time[part]
            if unit.alarms:
                rows_of, _, lane = found.lanes[k]
                factors = np.broadcast_to(noise, len(places))[part]
                readings = records.y.reshape(len(places))[part]
                try:
                    on = unit.watch(rows_of, lane, readings, factors, own, number[part], out)
                except Exception as error:  # whatever it is, the other units continue
                    unit.fail(int(number[part][0]), error, out)
                    continue
                flags[part] |= np.array(on, np.uint8) * np.uint8(ALARM)
            if not unit.calibrated:
                unit.remember(own, rows.values[part], out)
        results = Results(number, self.streams.numbers[places], flags, values)
        out.results.append(results)
        out.blocks += self.blocks.add(places, results)
