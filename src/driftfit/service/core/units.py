"""The units of a service: found by topic, created when they appear, loaded from the database when they are needed."""

from __future__ import annotations

import time
from collections import Counter, OrderedDict
from typing import Any

import msgspec

from driftfit.service.core.journal import Journal, Pending
from driftfit.service.core.unit import Unit
from driftfit.service.settings.config import UnitSettings
from driftfit.service.settings.matching import valid_name
from driftfit.service.sources.samples import Samples, number, seconds

ROUTES = 200_000
"""Topics whose units are remembered, including those that have none."""


class Units:
    """All units, by number and by topic."""

    def __init__(self, settings: tuple[UnitSettings, ...], journal: Journal, most: int) -> None:
        self.settings, self.journal, self.most = settings, journal, most
        self.names: dict[str, int] = {}
        self.refused: Counter[str] = Counter()
        self._known: dict[int, tuple[str, int]] = {}
        self._units: dict[int, Unit] = {}
        self._routes: OrderedDict[str, tuple[int, ...]] = OrderedDict()
        self._tokens: dict[int, tuple[float, float]] = {}
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
    def resident(self) -> list[Unit]:
        """The units in memory."""
        return list(self._units.values())

    def get(self, unit: int) -> Unit:
        """A unit by number, with the state that the database has of it."""
        found = self._units.get(unit)
        if found is None:
            name, section = self._known[unit]
            stored = self.journal.state(unit)
            if stored is None:
                found = Unit(unit, name, self.settings[section])
            else:
                self.since[unit] = stored[0]
                found = self._revived(unit, name, self.settings[section], stored[1])
            self._units[unit] = found
        return found

    def _revived(self, unit: int, name: str, settings: UnitSettings, state: bytes) -> Unit:
        try:
            return Unit.of(unit, name, settings, state)
        except Exception as error:  # a state that cannot be read stops its unit, not the others
            found = Unit(unit, name, settings)
            found.failure, found.live = f"its state cannot be read: {error}"[:500], None
            return found

    def of_topic(self, topic: str, pending: Pending, born: int) -> tuple[int, ...]:
        """Numbers of the units of a topic; new units are made."""
        route = self._routes.get(topic)
        if route is None:
            route = self._route(topic, pending, born)
            self._routes[topic] = route
            if len(self._routes) > ROUTES:
                self._routes.popitem(last=False)
        return route

    def _route(self, topic: str, pending: Pending, born: int) -> tuple[int, ...]:
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
            found.append(unit)
        return tuple(found)

    def _new(self, name: str, section: int, topic: str, pending: Pending, born: int) -> int:
        unit = next(reversed(self._known), 0) + 1
        settings = self.settings[section]
        made = Unit(unit, name, settings)
        assert made.live is not None
        about = {"names": made.live.names, "y": settings.y, "u": settings.u, "parts": settings.match.match(topic),
                 "model": repr(settings.model), "tracker": repr(settings.tracker)}  # fmt: skip
        pending.units.append((unit, name, section, topic, born, msgspec.json.encode(about).decode()))
        self._known[unit], self.names[name], self._units[unit] = (name, section), unit, made
        self.since[unit] = born
        return unit

    def admitted(self, unit: Unit, samples: Samples) -> tuple[list[float] | None, list[list[float]]]:
        """The rows of a message that a unit takes; samples that it does not accept are counted."""
        if not self._paid(unit, samples.length):
            unit.counts["flood"] += samples.length
            return None, []
        settings, columns, count = unit.settings, samples.columns, samples.length
        if not any(name in columns for name in settings.columns):
            unit.counts["no signal"] += count
            return None, []
        rows = [
            list(row) for row in zip(*(_numbers(columns.get(name), count) for name in settings.columns), strict=True)
        ]
        if settings.time is None:
            return None, rows
        cells = columns.get(settings.time)
        cells = cells if isinstance(cells, list) else [cells] * count
        return unit.admit([seconds(cell, settings.time_unit) for cell in cells], rows)

    def _paid(self, unit: Unit, count: int) -> bool:
        """Whether a unit keeps to its rate, on average over ten seconds."""
        now, rate = time.monotonic(), unit.settings.rate
        left, then = self._tokens.get(unit.number, (10.0 * rate, now))
        left = min(10.0 * rate, left + (now - then) * rate)
        paid = left >= count
        self._tokens[unit.number] = (left - count if paid else left, now)
        return paid


def _numbers(cells: Any, count: int) -> list[float]:
    """A column of a message as numbers."""
    if isinstance(cells, list):
        return [cell if type(cell) is float else number(cell) for cell in cells]
    return [number(cells)] * count
