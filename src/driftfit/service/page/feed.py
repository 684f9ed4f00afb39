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

from driftfit.engine.kernel import Array
from driftfit.service.control import packed
from driftfit.service.core.journal import Journal, Names
from driftfit.service.core.results import FIXED, Result, extremes_of

READ_SECONDS = 0.25
"""Seconds between two reads."""
DRIFT_SECONDS = 60.0
"""Seconds after which the parameters to which drift refers are renewed: drift is that of one to two minutes."""
RECENT_RESULTS = 512
"""Results of a watched unit that are kept."""
WATCHED_SECONDS = 120.0
"""Seconds without a request after which a unit is no longer watched."""
OVERVIEW_UNITS = 200
"""Units of the overview."""
SILENT_SECONDS = 60.0
"""Seconds without a result after which a unit is shown as silent."""
START_GROUPS = 400
"""Groups of results that are read when the page starts."""
EXPORT_ROWS = 2_000_000
"""Samples of one export at most."""
UNHEARD: dict[str, Any] = {
    "drift": 0.0, "alarm": False, "time": None, "age": None, "silent": True, "y": None, "y_hat": None, "ok": False,
    "theta": [],
}  # fmt: skip
"""What the overview shows of a unit whose last results are no longer stored."""


class Feed:
    """The state of the page."""

    def __init__(self, folder: Path, control: Path) -> None:
        self.control = control
        self.journal = Journal(folder, read_only=True)
        self.names = Names(self.journal)
        self.names.read()
        self.latest: dict[int, Result] = {}
        self.updated: dict[int, float] = {}
        self.fleet: list[dict[str, Any]] = []
        self.watched: dict[int, tuple[deque[Result], list[float]]] = {}
        self.status: dict[str, Any] = {"problem": "the engine has not answered yet"}
        self.answered = 0.0
        self._swept = time.monotonic()
        self._base: dict[int, tuple[float, list[float], list[float]]] = {}
        query = "select coalesce(min(first), 1) - 1 from (select first from result order by first desc limit ?)"
        self.at = int(self.journal.db.execute(query, (START_GROUPS,)).fetchone()[0])
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
            await asyncio.sleep(max(0.05, READ_SECONDS - (time.monotonic() - begun)))

    def look(self) -> None:
        """Read the results that are new."""
        for _ in range(20):
            groups = self.journal.outcomes(self.at)
            for group, parts, _, at in groups:
                self.at = group
                for part in parts:
                    for row in part.last().rows():
                        self.latest[row.unit] = row
                        self.updated[row.unit] = at
                    for unit, (kept, _) in self.watched.items():
                        kept.extend(part.some(np.flatnonzero(part.unit == unit)).rows())
            if len(groups) < 64:
                break
        if any(unit not in self.names.names for unit in self.latest):
            self.names.read()
        if time.monotonic() - self._swept > DRIFT_SECONDS:
            self._swept = time.monotonic()
            for unit in self.journal.evicted() & self.latest.keys():
                del self.latest[unit], self.updated[unit]
                self._base.pop(unit, None)
        since = time.monotonic() - WATCHED_SECONDS
        self.watched = {unit: one for unit, one in self.watched.items() if one[1][0] >= since}

    def drift(self, unit: int, row: Result) -> float:
        """The largest change of a parameter in the last minutes, in standard deviations."""
        theta, std, now = row.theta, row.std, time.monotonic()
        base = self._base.get(unit)
        if base is None or len(base[1]) != len(theta) or not all(map(math.isfinite, base[1])):
            base = (now, theta, theta)
        elif now - base[0] > DRIFT_SECONDS:
            base = (now, base[2], theta)
        self._base[unit] = base
        moved = [abs(a - b) / s for a, b, s in zip(theta, base[1], std, strict=False) if s > 0.0 and math.isfinite(s)]
        return max((one for one in moved if math.isfinite(one)), default=0.0)

    def rank(self) -> None:
        """The units that are shown first: trouble, alarms, drift, and last those whose results are no longer stored."""
        found = ((row.alarm, self.drift(unit, row), unit, row) for unit, row in self.latest.items())
        first = heapq.nlargest(OVERVIEW_UNITS, found, key=lambda one: (one[0], one[1]))
        now = time.time()
        names = self.names.names
        ranked = [self.line(unit, row, drift, now) for _, drift, unit, row in first if unit in names]
        bad = [self.shown(name, now) for name in self.trouble if name in self.names.about]
        known = {one["unit"] for one in bad}
        self.fleet = (bad + [one for one in ranked if one["unit"] not in known])[:OVERVIEW_UNITS]
        if len(self.fleet) < OVERVIEW_UNITS and len(self.latest) < len(names):
            gone = (name for unit, name in names.items() if unit not in self.latest and name not in known)
            self.fleet += [self.shown(name, now) for name in islice(gone, OVERVIEW_UNITS - len(self.fleet))]

    @property
    def trouble(self) -> dict[str, dict[str, str]]:
        return dict(self.status.get("trouble", {}))

    def shown(self, name: str, now: float) -> dict[str, Any]:
        """A unit of the overview, also one that was not heard of since results are stored."""
        unit = int(self.names.about[name]["number"])
        row = self.latest.get(unit)
        if row is None:
            return UNHEARD | {"unit": name, "trouble": list(self.trouble.get(name, {}))}
        return self.line(unit, row, self.drift(unit, row), now)

    def line(self, unit: int, row: Result, drift: float, now: float) -> dict[str, Any]:
        """A unit of the overview."""
        age, name = now - self.updated[unit], self.names.names[unit]
        return {
            "unit": name, "trouble": list(self.trouble.get(name, {})), "drift": round(drift, 2), "alarm": row.alarm,
            "time": row.time, "age": round(age, 1), "silent": age > SILENT_SECONDS, "y": row.y,
            "y_hat": row.y_hat, "ok": row.ok, "theta": row.theta,
        }  # fmt: skip

    def find(self, name: str) -> int | None:
        about = self.names.about.get(name)
        if about is None:
            self.names.read()
            about = self.names.about.get(name)
        return None if about is None else int(about["number"])

    async def recent(self, unit: int) -> list[Result]:
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
        rows: deque[Result] = deque(maxlen=RECENT_RESULTS)
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
            return dict(json.loads(await reader.readexactly(length)))
        finally:
            writer.close()

    @property
    def alive(self) -> bool:
        return time.monotonic() - self.answered < 10.0

    @property
    def healthy(self) -> bool:
        """Whether the engine answers and can write."""
        return self.alive and not self.status.get("problem")


def column_names(about: Any) -> list[str]:
    return [*FIXED, *about["names"], *(f"std {name}" for name in about["names"])]


def reduced(
    journal: Journal, unit: int, recent: list[Result], start: float, stop: float, points: int
) -> dict[str, Any]:
    """(low, high, mean) of every column between two times, each (k, c), and the number of samples.

    A range with at most ``2 points`` samples is reduced sample by sample. Beyond that whole blocks are represented by
    their extremes, so a million samples cost the reading of 16,000 short rows.
    """
    query = "select coalesce(sum(count), 0) from block where unit = ? and stop >= ? and start <= ?"
    if journal.db.execute(query, (unit, start, stop)).fetchone()[0] <= 2 * points:
        values = samples(journal, unit, recent, start, stop)
        parts = np.array_split(values, min(points, len(values)) or 1)
        return _as_lists([(extremes_of(part), len(part)) for part in parts if len(part)])
    found, end = [], -1
    where = "where unit = ? and stop >= ? and start <= ? order by first"
    for _, _, last, _, _, count, extremes, _ in journal.rows("block", where, unit, start, stop):
        found.append((np.frombuffer(extremes).reshape(3, -1), count))
        end = max(end, last)
    if tail := [row for row in recent if row.number > end and start <= _time(row) <= stop]:
        found.append((extremes_of(columns_of(tail)), len(tail)))
    if len(found) > points:
        places = np.array_split(np.arange(len(found)), points)
        found = [_joined([found[k] for k in one]) for one in places]
    return _as_lists(found)


def samples(journal: Journal, unit: int, recent: list[Result], start: float, stop: float) -> Array:
    """All columns (T, c) between two times."""
    parts, end = [], -1
    where = "where unit = ? and first in (select first from block where unit = ? and stop >= ? and start <= ?)"
    for _, _, last, count, rows, _ in journal.rows("history", f"{where} order by first", unit, unit, start, stop):
        parts.append(np.frombuffer(rows).reshape(count, -1))
        end = max(end, last)
        if sum(map(len, parts)) > EXPORT_ROWS:
            raise ValueError(f"more than {EXPORT_ROWS} samples; ask for a shorter range.")
    if tail := [row for row in recent if row.number > end]:
        parts.append(columns_of(tail))
    if not parts:
        return np.zeros((0, len(FIXED)))
    values = np.vstack(parts)
    return values[(values[:, 0] >= start) & (values[:, 0] <= stop)]


def newest_blocks(journal: Journal, unit: int, recent: list[Result], blocks: int = 10) -> Array:
    """All columns (T, c) of the last blocks, and of the samples after them."""
    found = [*journal.rows("history", "where unit = ? order by first desc limit ?", unit, blocks)][::-1]
    end = max((row[2] for row in found), default=-1)
    parts = [np.frombuffer(row[4]).reshape(row[3], -1) for row in found]
    if tail := [row for row in recent if row.number > end]:
        parts.append(columns_of(tail))
    return np.vstack(parts) if parts else np.zeros((0, 0))


def columns_of(rows: list[Result]) -> Array:
    """Results as an array (count, 5 + 2 n); where samples have no times their numbers are used."""
    values = np.array([[_time(row), row.y, row.y_hat, row.e, row.s, *row.theta, *row.std] for row in rows])
    with np.errstate(invalid="ignore"):
        values[:, 4] = np.sqrt(values[:, 4])
    return values


def _time(row: Result) -> float:
    return float(row.number if row.time is None else row.time)


def _joined(blocks: list[tuple[Array, int]]) -> tuple[Array, int]:
    """Neighbouring blocks as one."""
    stack, counts = np.stack([one for one, _ in blocks]), [count for _, count in blocks]
    fine, weight = np.isfinite(stack[:, 2]), np.array(counts, float)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(fine, stack[:, 2] * weight, 0.0).sum(axis=0) / np.where(fine, weight, 0.0).sum(axis=0)
    low = np.where(fine, stack[:, 0], np.inf).min(axis=0)
    high = np.where(fine, stack[:, 1], -np.inf).max(axis=0)
    return np.where(fine.any(axis=0), np.stack([low, high, mean]), np.nan), sum(counts)


def _as_lists(found: list[tuple[Array, int]]) -> dict[str, Any]:
    kinds = ("low", "high", "mean")
    columns = {kind: np.stack([one[k] for one, _ in found]).T.tolist() if found else [] for k, kind in enumerate(kinds)}
    return {"count": sum(count for _, count in found), **columns}


def metrics_of(feed: Feed, viewers: int) -> str:
    """Numbers for Prometheus, in its text format."""
    status, trouble = feed.status, feed.trouble.items()
    latency = {'quantile="0.5"': status.get("p50"), 'quantile="0.99"': status.get("p99")}
    unarmed = {f'unit="{_label(unit)}",what="{_label(what)}",why="{_label(why)}"': 1
               for unit, found in trouble for what, why in found.items()}  # fmt: skip
    found: list[tuple[str, str, str, Any]] = [
        ("up", "gauge", "Whether the engine answers and can write its journal.", int(feed.healthy)),
        ("samples_total", "counter", "Samples that were processed.", status.get("samples", 0)),
        ("units", "gauge", "Units.", status.get("units", 0)),
        ("units_failed", "gauge", "Units that have failed.", status.get("failed", 0)),
        ("trouble", "gauge", "What does not work in units, at most 100 of them.", unarmed),
        ("units_in_alarm", "gauge", "Units whose alarm is on.", sum(row.alarm for row in feed.latest.values())),
        ("waiting_samples", "gauge", "Samples that wait for the journal.", status.get("waiting", 0)),
        ("held_back_total", "counter", "How often a source was held back.", status.get("held_back", 0)),
        ("viewers", "gauge", "Open pages.", viewers),
        ("latency_seconds", "gauge", "From arrival to result, of recent batches.", latency),
        ("refused_total", "counter", "What was refused, by reason.", _labelled("reason", status.get("refused", {}))),
        ("left_out_total", "counter", "Samples that gates left out, by reason.",
         _labelled("reason", status.get("left_out", {}))),
    ]  # fmt: skip
    for what in ("source", "sink"):
        runners: dict[str, Any] = status.get(f"{what}s", {})
        up = {name: int(one["state"] == "running") for name, one in runners.items()}
        count, failures = ({name: one[key] for name, one in runners.items()} for key in ("count", "failures"))
        found += [
            (f"{what}_up", "gauge", f"Whether the {what} is connected.", _labelled(what, up)),
            (f"{what}_samples_total", "counter", f"Samples of the {what}.", _labelled(what, count)),
            (f"{what}_failures_total", "counter", f"Failures of the {what}.", _labelled(what, failures)),
        ]
    aside = {name: one["set_aside"] for name, one in status.get("sinks", {}).items()}
    about = "Events that were refused and set aside."
    found.append(("sink_set_aside_total", "counter", about, _labelled("sink", aside)))
    lines = []
    for name, kind, about, values in found:
        lines += [f"# HELP driftfit_{name} {about}", f"# TYPE driftfit_{name} {kind}"]
        if isinstance(values, dict):
            lines += [f"driftfit_{name}{{{key}}} {value}" for key, value in values.items() if value is not None]
        else:
            lines.append(f"driftfit_{name} {values}")
    return "".join(f"{line}\n" for line in lines)


def _labelled(label: str, values: dict[str, Any]) -> dict[str, Any]:
    return {f'{label}="{_label(key)}"': value for key, value in values.items()}


def _label(value: str) -> str:
    return value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
