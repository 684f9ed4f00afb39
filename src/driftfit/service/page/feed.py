"""The data of the page: it follows the stored results of the journal, as a sink does, and asks the engine for the rest.

It runs in the page's process and reads the database, so viewers never slow the tracking. Memory: the last result of
every unit, and the recent results of the units that someone looks at.
"""

from __future__ import annotations

import asyncio
import heapq
import json
import math
import time
from collections import deque
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from driftfit.service.control import packed
from driftfit.service.core.journal import Journal, Names

TICK = 0.25
"""Seconds between two reads."""
CHECK = 60.0
"""Seconds after which the parameters to which drift refers are renewed: drift is that of one to two minutes."""
RECENT = 512
"""Results of a watched unit that are kept."""
FORGET = 120.0
"""Seconds without a request after which a unit is no longer watched."""
SHOWN = 200
"""Units of the overview."""
SILENT = 60.0
"""Seconds without a result after which a unit is shown as silent."""
BACK = 400
"""Groups of results that are read when the page starts."""


class Feed:
    """The state of the page."""

    def __init__(self, folder: Path, control: Path) -> None:
        self.control = control
        self.journal = Journal(folder, read_only=True)
        self.names = Names(self.journal)
        self.names.read()
        self.latest: dict[int, list[Any]] = {}
        self.updated: dict[int, float] = {}
        self.fleet: list[dict[str, Any]] = []
        self.events: deque[list[Any]] = deque(maxlen=200)
        self.watched: dict[int, tuple[deque[list[Any]], list[float]]] = {}
        self.status: dict[str, Any] = {"problem": "the engine has not answered yet"}
        self.answered = 0.0
        self.count = 0
        self._swept = time.monotonic()
        self._base: dict[int, tuple[float, list[float], list[float]]] = {}
        query = "select coalesce(min(first), 1) - 1 from (select first from result order by first desc limit ?)"
        self.at = int(self.journal.db.execute(query, (BACK,)).fetchone()[0])
        self.lock = asyncio.Lock()

    async def run(self) -> None:
        """Follow the journal for ever."""
        while True:
            begun = time.monotonic()
            await asyncio.to_thread(self.look)
            self.rank()
            try:
                self.status = await self.ask({"do": "status"})
                self.answered = time.monotonic()
            except (OSError, asyncio.IncompleteReadError, ValueError):
                pass
            await asyncio.sleep(max(0.05, TICK - (time.monotonic() - begun)))

    def look(self) -> None:
        """Read the results that are new."""
        for _ in range(20):
            groups = self.journal.outcomes(self.at)
            for group, parts, events, at in groups:
                self.at = group
                self.count += sum(len(part.number) for part in parts)
                for part in parts:
                    for row in part.last().rows():
                        self.latest[row[1]] = row
                        self.updated[row[1]] = at
                    for unit, (kept, _) in self.watched.items():
                        kept.extend(part.some(np.flatnonzero(part.unit == unit)).rows())
                self.events.extend(events)
            if len(groups) < 64:
                break
        if any(unit not in self.names.names for unit in self.latest):
            self.names.read()
        if time.monotonic() - self._swept > CHECK:
            self._swept = time.monotonic()
            for unit in self.journal.evicted() & self.latest.keys():
                del self.latest[unit], self.updated[unit]
                self._base.pop(unit, None)
        for unit in [unit for unit, (_, asked) in self.watched.items() if time.monotonic() - asked[0] > FORGET]:
            del self.watched[unit]

    def drift(self, unit: int, row: list[Any]) -> float:
        """The largest change of a parameter in the last minutes, in standard deviations."""
        theta, std, now = row[8], row[9], time.monotonic()
        base = self._base.get(unit)
        if base is None or len(base[1]) != len(theta) or not all(map(math.isfinite, base[1])):
            base = (now, theta, theta)
        elif now - base[0] > CHECK:
            base = (now, base[2], theta)
        self._base[unit] = base
        moved = [abs(a - b) / s for a, b, s in zip(theta, base[1], std, strict=False) if s > 0.0 and math.isfinite(s)]
        return max((one for one in moved if math.isfinite(one)), default=0.0)

    def rank(self) -> None:
        """The units that are shown first: trouble, alarms, drift, and last those whose results are no longer stored."""
        found = ((row[10], self.drift(unit, row), unit, row) for unit, row in self.latest.items())
        first = heapq.nlargest(SHOWN, found, key=lambda one: (one[0], one[1]))
        now = time.time()
        names = self.names.names
        ranked = [self.line(unit, row, drift, now) for _, drift, unit, row in first if unit in names]
        bad = [self.shown(name, now) for name in self.trouble if name in self.names.about]
        known = {one["unit"] for one in bad}
        self.fleet = (bad + [one for one in ranked if one["unit"] not in known])[:SHOWN]
        if len(self.fleet) < SHOWN and len(self.latest) < len(names):
            gone = (name for unit, name in names.items() if unit not in self.latest and name not in known)
            self.fleet += [self.shown(name, now) for name in islice(gone, SHOWN - len(self.fleet))]

    @property
    def trouble(self) -> dict[str, dict[str, str]]:
        """By unit: what does not work, and why."""
        return dict(self.status.get("trouble", {}))

    def shown(self, name: str, now: float) -> dict[str, Any]:
        """A unit of the overview, also one that was not heard of since results are stored."""
        unit = int(self.names.about[name]["number"])
        row = self.latest.get(unit)
        if row is None:
            return unheard(name) | {"trouble": list(self.trouble.get(name, {}))}
        return self.line(unit, row, self.drift(unit, row), now)

    def line(self, unit: int, row: list[Any], drift: float, now: float) -> dict[str, Any]:
        """A unit of the overview."""
        age, name = now - self.updated[unit], self.names.names[unit]
        return {
            "unit": name, "trouble": list(self.trouble.get(name, {})), "drift": round(drift, 2), "alarm": row[10],
            "time": row[2], "age": round(age, 1), "silent": age > SILENT, "y": finite(row[3]), "y_hat": finite(row[4]),
            "ok": row[7], "theta": [finite(one) for one in row[8]],
        }  # fmt: skip

    def find(self, name: str) -> int | None:
        """The number of a unit."""
        about = self.names.about.get(name)
        if about is None:
            self.names.read()
            about = self.names.about.get(name)
        return None if about is None else int(about["number"])

    async def recent(self, unit: int) -> list[list[Any]]:
        """The last results of a unit, which is watched from now on."""
        if unit not in self.watched:
            async with self.lock:
                if unit not in self.watched:
                    await asyncio.to_thread(self._watch, unit)
        rows, asked = self.watched[unit]
        asked[0] = time.monotonic()
        return list(rows)

    def _watch(self, unit: int) -> None:
        """Read the results that are not yet in blocks of the history."""
        row = self.journal.db.execute("select last from block where unit = ? order by first desc limit 1", (unit,))
        found = row.fetchone()
        after = max(0, (found[0] if found else 0) - 1)
        start = self.journal.db.execute("select coalesce(max(first), 0) - 1 from result where first <= ?", (after,))
        at = int(start.fetchone()[0])
        rows: deque[list[Any]] = deque(maxlen=RECENT)
        end = self.at
        while at < end and (groups := self.journal.outcomes(at)):
            for group, parts, *_ in groups:
                at = group
                for part in parts if group <= end else []:
                    rows.extend(part.some(np.flatnonzero(part.unit == unit)).rows())
        self.watched[unit] = (rows, [time.monotonic()])

    async def ask(self, header: dict[str, Any], body: bytes = b"") -> dict[str, Any]:
        """A question to the engine; OSError if it does not answer."""
        reader, writer = await asyncio.open_unix_connection(str(self.control))
        try:
            writer.write(packed(header, body))
            await writer.drain()
            length = int.from_bytes(await reader.readexactly(4), "big")
            answer = json.loads(await reader.readexactly(length))
            return dict(answer)
        finally:
            writer.close()

    @property
    def alive(self) -> bool:
        """Whether the engine answers."""
        return time.monotonic() - self.answered < 10.0

    @property
    def healthy(self) -> bool:
        """Whether the engine answers and can write."""
        return self.alive and not self.status.get("problem")


def unheard(name: str) -> dict[str, Any]:
    """A unit of the overview that was silent since before the page started, and for longer than results are stored."""
    return {
        "unit": name, "trouble": [], "drift": 0.0, "alarm": False, "time": None, "age": None, "silent": True, "y": None,
        "y_hat": None, "ok": False, "theta": [],
    }  # fmt: skip


def finite(value: Any) -> Any:
    """NaN and infinity as None, which JSON can represent."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
