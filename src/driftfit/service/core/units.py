"""The units of a service: found by topic, created when they appear, loaded from the database when they are needed."""

from __future__ import annotations

import time
from collections import Counter, OrderedDict
from collections.abc import Iterable
from typing import Any

import msgspec
import numpy as np

from driftfit.engine.kernel import Array
from driftfit.service.core.journal import Journal, Pending, Rows
from driftfit.service.core.section import CounterOf, Section, tally
from driftfit.service.core.unit import Unit
from driftfit.service.settings.config import UnitSettings
from driftfit.service.settings.matching import valid_name
from driftfit.service.sources.samples import NO_SIGNAL, Receipt, Samples, numbers_of, seconds_of

ROUTES = 200_000
"""Topics whose units are remembered, including those that have none."""
SAVED = 10.0
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
        """Add a message; False if it has no signal of the section."""
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
        column += cells
    elif count == 1:
        column.append(cells)
    else:
        column += [cells] * count


def _counter_of(one: Gathered, messages: Array) -> CounterOf:
    """Who counts sample k, which came in one of the messages."""
    return lambda k: one.counters[messages[k]]


class Units:
    """All units, by number and by topic."""

    def __init__(self, settings: tuple[UnitSettings, ...], journal: Journal, most: int) -> None:
        self.sections = [Section(k, one) for k, one in enumerate(settings)]
        self.settings, self.journal, self.most = settings, journal, most
        self.names: dict[str, int] = {}
        self.refused: Counter[str] = Counter()
        self._known: dict[int, tuple[str, int]] = {}
        self._units: dict[int, Unit] = {}
        self._routes: OrderedDict[str, tuple[Unit, ...]] = OrderedDict()
        self._saved: list[tuple[Array, float]] = [(np.zeros(0), 0.0) for _ in settings]
        """By section: samples that each unit may still send at once, and the time of that."""
        self._programs = journal.programs()
        self.since: dict[int, int] = {}
        """Number up to which samples are in the state of a unit that was loaded."""
        for unit, name, section, _, born, _ in journal.units():
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
        """The units in memory."""
        return list(self._units.values())

    def get(self, unit: int) -> Unit:
        """A unit by number, with the state that the database has of it."""
        found = self._units.get(unit)
        if found is None:
            name, section = self._known[unit]
            stored = self.journal.state(unit)
            found = self._units[unit] = self.sections[section].add(unit, name)
            if stored is not None:
                self.since[unit] = stored[0]
                try:
                    found.restore(stored[1], self._programs)
                except Exception as error:  # a state that cannot be read stops its unit, not the others
                    found.failure = f"its state cannot be read: {error}"[:500]
        return found

    def note_programs(self, pending: Pending) -> None:
        """Add to the next transaction what the states of this process are made with."""
        for tag, about in (one.streams.about for one in self.sections):
            if self._programs.get(tag) != about:
                self._programs[tag] = about
                pending.programs.append((tag, about))

    def of_topic(self, topic: str, pending: Pending, born: int) -> tuple[Unit, ...]:
        """The units of a topic; new ones are made."""
        route = self._routes.get(topic)
        if route is None:
            route = self._route(topic, pending, born)
            self._routes[topic] = route
            if len(self._routes) > ROUTES:
                self._routes.popitem(last=False)
        return route

    def _route(self, topic: str, pending: Pending, born: int) -> tuple[Unit, ...]:
        if not valid_name(topic):
            return ()
        found = []
        for section, settings in enumerate(self.settings):
            name = settings.match.unit(topic)
            if name is None:
                continue
            if not settings.match.name and len(self.settings) > 1:
                name = f"{name}:{settings.y}"
            unit = self.names.get(name)
            if unit is None:
                if len(self._known) >= self.most or len(name) > 500:
                    self.refused["too many units"] += 1
                    continue
                unit = self._new(name, section, topic, pending, born)
            if self._known[unit][1] != section:
                self.refused["two sections give one name"] += 1
                continue
            found.append(self.get(unit))
        return tuple(found)

    def _new(self, name: str, section: int, topic: str, pending: Pending, born: int) -> int:
        unit = next(reversed(self._known), 0) + 1
        made = self.sections[section].add(unit, name)
        settings = made.settings
        about = {"names": made.streams.program.names, "y": settings.y, "u": settings.u,
                 "parts": settings.match.match(topic), "model": repr(settings.model),
                 "tracker": repr(settings.tracker), "gate": settings.gate}  # fmt: skip
        pending.units.append((unit, name, section, topic, born, msgspec.json.encode(about).decode()))
        self._known[unit], self.names[name], self._units[unit] = (name, section), unit, made
        self.since[unit] = born
        return unit

    def admitted(self, messages: Iterable[tuple[Samples, Receipt | None]], pending: Pending, born: int) -> list[Rows]:
        """The samples of messages that enter the journal; those that units do not accept are counted."""
        gathered = [Gathered(one) for one in self.settings]
        for samples, receipt in messages:
            units = self.of_topic(samples.topic, pending, born)
            counter = None
            if receipt is not None:
                counter = receipt.left_out
                receipt.offered += samples.length * max(len(units), 1)
            if not units:
                tally((self.refused, counter), "no unit for the topic", samples.length)
            for unit in units:
                if not gathered[unit.streams.index].add(unit.place, samples, receipt):
                    tally((unit.rare, counter), NO_SIGNAL, samples.length)
        found = []
        for section, one in zip(self.sections, gathered, strict=True):
            if one.places:
                places, times, values = one.arrays()
                messages = np.repeat(np.arange(len(one.places)), one.lengths)
                paid = np.flatnonzero(self._paid(section, one)[messages])
                times = None if times is None else times[paid]
                found.append(section.admit(places[paid], times, values[paid], _counter_of(one, messages[paid])))
        return [rows for rows in found if rows is not None]

    def _paid(self, section: Section, one: Gathered) -> Array:
        """Which messages are within the rate of their units, on average over `SAVED` seconds."""
        rate, now = section.streams.settings.rate, time.monotonic()
        saved, then = self._saved[section.streams.index]
        most = np.full(section.streams.capacity, SAVED * rate)
        most[: len(saved)] = np.minimum(SAVED * rate, saved + (now - then) * rate)
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
