"""The units of a service: found by topic, created when they appear, loaded from the database when they are needed."""

from __future__ import annotations

import logging
import time
from collections import Counter, OrderedDict
from collections.abc import Collection, Iterable
from typing import Any

import msgspec
import numpy as np

from driftfit.engine.kernel import Array
from driftfit.service.config import UnitSettings
from driftfit.service.connect.base import NO_SIGNAL, TOO_MANY_NEW, Receipt, Samples, numbers_of, seconds_of
from driftfit.service.core.journal import Journal, Pending, Rows
from driftfit.service.core.section import Section, tally
from driftfit.service.core.unit import SAMPLES, Unit
from driftfit.service.options import NAME_CHARACTERS, ServiceOptions

log = logging.getLogger("driftfit.service")
Message = tuple[str, Samples, Receipt | None]
"""(client, samples, receipt)"""
FEW_SAMPLES, QUIET_SECONDS = 10, 600.0
"""A unit that has had fewer samples, and none in so many seconds, is evicted."""
KNOWN_TOPICS = 200_000
"""Topics whose units are remembered, including those that have none."""
UNREADABLE = "its state cannot be read"
RATE_SECONDS = 10.0
"""Seconds over which the rate of a unit is averaged."""


class Gathered:
    """What arrived for a section in some messages: a list for each column, one message after the other."""

    def __init__(self, settings: UnitSettings) -> None:
        self.time, self.time_unit = settings.time, settings.time_unit
        self.places: list[int] = []
        self.lengths: list[int] = []
        self.columns: dict[str, list[Any]] = {name: [] for name in settings.columns}
        self.times: list[Any] = []
        self.counters: list[Counter[str] | None] = []
        """Who counts what is left out of each message besides the unit."""

    def add(self, place: int, samples: Samples, receipt: Receipt | None) -> bool:
        given, count = samples.columns, samples.length
        if self.columns.keys().isdisjoint(given):
            return False
        self.places.append(place)
        self.lengths.append(count)
        self.counters.append(None if receipt is None else receipt.left_out)
        if receipt is not None:
            receipt.note_missing(samples, self.columns)
        for name, column in self.columns.items():
            _extend(column, given.get(name), count)
        if self.time is not None:
            _extend(self.times, given.get(self.time), count)
        return True

    def arrays(self) -> tuple[Array, Array | None, Array]:
        """(places (N,), times (N,), values (N, 1 + m))."""
        places = np.repeat(self.places, self.lengths)
        values = np.column_stack([numbers_of(column) for column in self.columns.values()])
        return places, None if self.time is None else seconds_of(self.times, self.time_unit), values


def _extend(column: list[Any], cells: Any, count: int) -> None:
    if isinstance(cells, list):
        if len(cells) != count:  # it would move the samples of the messages behind it
            raise ValueError(f"a list of {len(cells)} values in a message of {count} samples.")
        column += cells
    elif count == 1:
        column.append(cells)
    else:
        column += [cells] * count


class Units:
    """All units, by number and by topic."""

    def __init__(self, settings: tuple[UnitSettings, ...], journal: Journal, options: ServiceOptions) -> None:
        self.sections = [Section(k, one) for k, one in enumerate(settings)]
        self.settings, self.journal, self.options = settings, journal, options
        self.names: dict[str, int] = {}
        self.refused: Counter[str] = Counter()
        self._known: dict[int, tuple[str, int]] = {}
        self._units: dict[int, Unit] = {}
        self._routes: OrderedDict[str, tuple[Unit, ...]] = OrderedDict()
        self._saved: list[tuple[Array, float]] = [(np.zeros(0), 0.0) for _ in settings]
        """By section: samples that each unit may still send at once, and the time of that."""
        self._programs = journal.programs()
        self.trouble = {unit: msgspec.json.decode(what) for unit, what in journal.db.execute("select * from trouble")}
        """By unit: what does not work, and why; also of those that are not in memory."""
        self.unreadable: list[int] = []
        """Units that have failed because their states cannot be read, which is yet to be an event."""
        self._made: Counter[str] = Counter()
        """New units by client, since the minute began."""
        self._minute = self._swept = time.monotonic()
        self._few: dict[int, int] = {}
        """By unit: samples at the last sweep, of those that had few."""
        self._last = 0
        self.since: dict[int, int] = {}
        """Number up to which samples are in the state of a unit that was loaded."""
        evicted = journal.evicted()
        for unit, name, section, _, born, _ in journal.units():
            self._last = unit
            if unit in evicted:
                continue
            if section >= len(settings):
                raise ValueError(
                    f"the folder has the unit {name!r} of section [[unit]] number {section + 1}, which is not in the "
                    "configuration; keep the order of the sections, or use another folder."
                )
            self._known[unit] = (name, section)
            self.names[name] = unit
            self.since[unit] = born

    def __len__(self) -> int:
        return len(self._known)

    @property
    def left_out(self) -> dict[str, int]:
        """What the gates of all units left out since the service began, by reason."""
        return dict(sum((section.left_out for section in self.sections), Counter()))

    @property
    def resident(self) -> list[Unit]:
        return list(self._units.values())

    def get(self, unit: int) -> Unit:
        """A unit by number, with the state that the database has of it."""
        if unit not in self._units:
            self._units[unit] = self._read(unit, self.sections[self._known[unit][1]])
            if self._units[unit].failure.startswith(UNREADABLE):
                self.unreadable.append(unit)
        return self._units[unit]

    def seen(self, unit: int) -> Unit:
        """A unit for another thread to look at: one that is not in memory is read from the database by itself."""
        section = self._known[unit][1]
        return self._units.get(unit) or self._read(unit, Section(section, self.settings[section]))

    def _read(self, unit: int, section: Section) -> Unit:
        """A new unit of a section, in the state that the database has of it."""
        found, stored = section.add(unit, self._known[unit][0]), self.journal.state(unit)
        if stored is not None:
            self.since[unit] = stored[0]
            try:
                found.restore(stored[1], self._programs)
            except Exception as error:  # a state that cannot be read stops its unit, not the others
                found.failure = f"{UNREADABLE}: {error}"[:500]
        return found

    def note_trouble(self, units: Iterable[int], pending: Pending) -> None:
        """Add to the next transaction what does not work in units, where that has changed."""
        for number in units:
            now = self.get(number).trouble
            if now != self.trouble.get(number, {}):
                self.trouble[number] = now
                what = msgspec.json.encode(now).decode()
                pending.forget.append(("insert or replace into trouble values (?, ?)", (number, what)))

    def troubled(self) -> dict[str, dict[str, str]]:
        """By name: what does not work, and why."""
        found = self.trouble.copy()  # another thread asks
        return {self._known[unit][0]: what for unit, what in found.items() if what}

    def note_programs(self, pending: Pending) -> None:
        """Add to the next transaction what the states of this process are made with."""
        for tag, about in (one.streams.about for one in self.sections):
            if self._programs.get(tag) != about:
                self._programs[tag] = about
                pending.programs.append((tag, about))

    def of_topic(self, topic: str, client: str, pending: Pending, born: int) -> tuple[tuple[Unit, ...], str]:
        """(the units of a topic, why there may be more later); new ones are made."""
        if topic in self._routes:
            return self._routes[topic], ""
        found, why = [], ""
        for section, name in self.named(topic):
            unit = self.names.get(name)
            if unit is None:
                if refusal := self._refusal(name, client):
                    why = refusal
                    continue
                unit = self._again(name, pending) or self._new(name, section, topic, pending, born)
            if self._known[unit][1] != section:
                self.refused["two sections give one name"] += 1
                continue
            found.append(self.get(unit))
        if not why:
            self._routes[topic] = tuple(found)
        if len(self._routes) > KNOWN_TOPICS:
            self._routes.popitem(last=False)
        return tuple(found), why

    def named(self, topic: str) -> list[tuple[int, str]]:
        """(section, name) of the units to which a topic belongs."""
        found, valid = [], 0 < len(topic) <= NAME_CHARACTERS and topic.isprintable()
        for section, settings in enumerate(self.settings if valid else ()):
            name = settings.match.unit(topic)
            if name is not None:
                alone = settings.match.name or len(self.settings) == 1
                found.append((section, name if alone else f"{name}:{settings.y}"))
        return found

    def _refusal(self, name: str, client: str) -> str:
        """Why a client may not make a unit now."""
        if (now := time.monotonic()) - self._minute > 60.0:
            self._made.clear()
            self._minute = now
        if len(self._known) >= self.options.units or len(name) > 500:
            return "too many units"
        self._made[client] += 1
        return TOO_MANY_NEW if self._made[client] > self.options.new_units else ""

    def _again(self, name: str, pending: Pending) -> int:
        """The number of a unit that was evicted and is there again; 0 if there was none of this name."""
        query = "select id, section, born from unit where name = ?"
        unit, section, born = self.journal.db.execute(query, (name,)).fetchone() or (0, 0, 0)
        if unit:
            self._known[unit], self.names[name], self.since[unit] = (name, section), unit, born
            pending.forget.append(("delete from evicted where unit = ?", (unit,)))
        return unit

    def evict(self, unstored: Collection[int], pending: Pending) -> None:
        """Forget units that have had few samples, and none since the last sweep; ``unstored`` have a state that the
        database does not. With their next sample they are there again, as they were.
        """
        if time.monotonic() - self._swept < QUIET_SECONDS:
            return
        self._swept, few, gone = time.monotonic(), {}, set()
        for unit in self.resident:
            count = int(unit.streams.counted[unit.place, SAMPLES])
            if count < FEW_SAMPLES and unit.number not in unstored and not unit.trouble:
                few[unit.number] = count
                if self._few.get(unit.number) == count:
                    gone.add(unit.number)
        self._few = few
        for number in gone:
            unit = self._units.pop(number)
            name, section = self._known.pop(number)
            del self.names[name], self.since[number]
            pending.blocks += self.sections[section].remove(unit)
            pending.forget.append(("insert or ignore into evicted values (?)", (number,)))
        for topic in [topic for topic, found in self._routes.items() if any(one.number in gone for one in found)]:
            del self._routes[topic]

    def _new(self, name: str, section: int, topic: str, pending: Pending, born: int) -> int:
        unit = self._last = self._last + 1
        made = self.sections[section].add(unit, name)
        settings = made.settings
        about = {"names": made.streams.program.names, "y": settings.y, "u": settings.u,
                 "parts": settings.match.match(topic), "model": repr(settings.model),
                 "tracker": repr(settings.tracker), "gate": settings.gate}  # fmt: skip
        pending.units.append((unit, name, section, topic, born, msgspec.json.encode(about).decode()))
        self._known[unit], self.names[name], self._units[unit] = (name, section), unit, made
        self.since[unit] = born
        return unit

    def admitted(self, messages: Iterable[Message], pending: Pending, born: int) -> list[Rows]:
        """The samples of messages that enter the journal; those that units do not accept are counted."""
        messages = list(messages)
        try:
            return self._admitted(messages, pending, born)
        except Exception:  # what one of them has is not foreseen: the others go on
            if len(messages) > 1:
                return [rows for one in messages for rows in self.admitted([one], pending, born)]
            log.exception("message")
            ((_, samples, receipt),) = messages
            tally((self.refused, None if receipt is None else receipt.left_out), "not understood", samples.length)
            return []

    def _admitted(self, messages: list[Message], pending: Pending, born: int) -> list[Rows]:
        gathered = [Gathered(one) for one in self.settings]
        for client, samples, receipt in messages:
            units, why = self.of_topic(samples.topic, client, pending, born)
            counter = None
            if receipt is not None:
                counter = receipt.left_out
                receipt.offered += samples.length * max(len(units), 1)
            if not units or why:
                tally((self.refused, counter), why or "no unit for the topic", samples.length)
            for unit in units:
                if not gathered[unit.streams.index].add(unit.place, samples, receipt):
                    tally((unit.rare, counter), NO_SIGNAL, samples.length)
        found = []
        for section, one in zip(self.sections, gathered, strict=True):
            if one.places:
                places, times, values = one.arrays()
                which = np.repeat(np.arange(len(one.places)), one.lengths)
                paid = np.flatnonzero(self._paid(section, one)[which])
                times = None if times is None else times[paid]
                counters = [one.counters[k] for k in which[paid].tolist()]
                found.append(section.admit(places[paid], times, values[paid], counters))
        return [rows for rows in found if rows is not None]

    def _paid(self, section: Section, one: Gathered) -> Array:
        """Which messages are within the rate of their units, on average over `RATE_SECONDS` seconds."""
        rate, now = section.streams.settings.rate, time.monotonic()
        saved, then = self._saved[section.streams.index]
        most = np.full(section.streams.capacity, RATE_SECONDS * rate)
        most[: len(saved)] = np.minimum(RATE_SECONDS * rate, saved + (now - then) * rate)
        places, lengths = np.array(one.places), np.array(one.lengths)
        left = most - np.bincount(places, lengths, len(most))
        paid = np.ones(len(places), bool)
        for k in np.flatnonzero(left[places] < 0.0).tolist():  # one message after the other, where a unit has too many
            place, count = one.places[k], one.lengths[k]
            paid[k] = most[place] >= count
            if paid[k]:
                most[place] -= count
            else:
                tally((section.units[place].rare, one.counters[k]), "flood", count)
        self._saved[section.streams.index] = np.where(left < 0.0, most, left), now
        return paid
