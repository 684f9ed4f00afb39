"""The engine: one thread that journals the samples that arrive, and then passes them to the trackers.

    gather -> admit -> commit (journal, positions, earlier results, states) -> acknowledge -> update -> results

A transaction contains whatever has arrived since the one before, which is `PACE_SECONDS` ago at least, so groups grow
with the load. It takes 1 to 10 ms; a sample costs a few microseconds more (`benchmarks/service.py`).
"""

from __future__ import annotations

import logging
import math
import sqlite3
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from driftfit.service.config import Config
from driftfit.service.connect.base import Batch
from driftfit.service.core.archive import Archive
from driftfit.service.core.journal import DAMAGED, Act, Group, Item, Journal, Pending, check_storable
from driftfit.service.core.unit import Out, Unit, rules_of
from driftfit.service.core.units import Units

log = logging.getLogger("driftfit.service")
STORE_SECONDS = 0.02
"""Seconds of one transaction that may go into storing states."""
IDLE_SECONDS = 0.25
"""Seconds that the engine waits for samples before it does other work."""
PACE_SECONDS, SLOWEST_PACE_SECONDS, PACE_FACTOR = 0.01, 0.025, 5.0
"""Seconds from one transaction to the next at least, and at least so many times what the last one took of the
processor: the fixed cost of a group, about a millisecond, would otherwise be most of the work."""
KEPT_GROUPS = 16
"""Groups of which the results are kept in memory."""
NAMED_TROUBLES = 100
"""Units with trouble that are named."""
GROUP_SECONDS = 60.0
"""Seconds that one group may take."""
RETRY_SECONDS = 1.0
"""Seconds between two attempts to write the journal."""


def quantiles(seconds: Iterable[float]) -> dict[str, float | None]:
    """Median and 99th percentile; None without any."""
    found = sorted(seconds)
    return {f"p{k}": found[len(found) * k // 100] if found else None for k in (50, 99)}


class Engine:
    """A service without sources and sinks."""

    def __init__(self, config: Config, folder: Path) -> None:
        self.config = config
        self.journal = Journal(folder)
        self.intake = Intake(config.service.queue)
        self.units = Units(config.units, self.journal, config.service)
        self.positions = self.journal.positions()
        self.progress: dict[str, int] = {}
        """The last group that each sink has written."""
        self.news = threading.Condition()
        """Notified when there are results."""
        self.problem = ""
        self.samples = 0
        self._stepped = time.monotonic()
        self.last_stored = 0
        """The last group whose results were stored by this process."""
        self.next, self._head = self.journal.number("next"), self.journal.head()
        self._fresh: deque[Group] = deque()
        """The newest results, so that sinks need not wait until these are stored."""
        self._elsewhere = self.next - 1
        """The number up to which results are in the database only."""
        self.latencies: deque[float] = deque(maxlen=2000)
        """Seconds from the arrival of a batch to the results of its samples."""
        self._told: deque[tuple[str, str, dict[str, Any]]] = deque()
        self._dirty: OrderedDict[int, tuple[int, float]] = OrderedDict()
        """By unit: the number from which on the log has what its stored state does not, and when that came."""
        self._pending = Pending()
        self._pool = ThreadPoolExecutor(1, "driftfit-calibrate")
        self._archive = Archive(config.service, folder, self._pool)
        self._stop = threading.Event()
        self.recovered = self._recover()

    def _recover(self) -> int:
        """Bring all states to the end of the log; the number of samples that were processed again."""
        unstored, again = self.journal.number("results from"), 0
        for first, items in self.journal.groups(self.journal.number("needed from")):
            out, number = Out(), first
            for item in items:
                again += self._apply(number, item, out, replay=True)
                number += item.length
            if first >= unstored:
                self._pending.add_results(Group(first, out.results, out.events, time.time()))
            self._pending.blocks += out.blocks
            self.units.note_trouble({unit for _, unit, *_ in out.events if unit}, self._pending)
        for unit in self.units.resident:
            self._ask_for_limits(unit)
        return again

    def _apply(self, number: int, item: Item, out: Out, replay: bool = False) -> int:
        """Pass an entry of the log to its units, without what their stored states contain already; how much it was."""
        if isinstance(item, Act):
            if replay and number < self._since(item.unit):
                return 0
            unit = self.units.get(item.unit)
            self._touched([item.unit], number)
            unit.act(number, item.action, out)
            return 1
        own, done = np.unique(item.unit), None
        if replay:
            since = np.array([self._since(one) for one in own.tolist()])
            done = number + np.arange(item.length) < since[np.searchsorted(own, item.unit)]
            own = np.unique(item.unit[~done])
        self._touched(own.tolist(), number)
        section = self.units.sections[item.section]
        try:
            section.process(number, item, out, done)
        except Exception as error:  # what is not foreseen for one unit: the others of the service go on
            log.exception("engine")
            for one in own.tolist():
                self.units.get(one).fail(number, error, out)
        return item.length - (0 if done is None else int(done.sum()))

    def _since(self, unit: int) -> float:
        """The number up to which samples are in the stored state of a unit; all are in that of one that was evicted."""
        if unit not in self.units.since:
            return math.inf
        self.units.get(unit)
        return self.units.since[unit]

    def _touched(self, units: list[int], number: int) -> None:
        """Note that the states of units changed from a number on."""
        since = number, time.monotonic()
        for unit in units:
            self._dirty.setdefault(unit, since)

    def prepare(self) -> None:
        """Compile what the first samples need; on a new computer that takes some seconds."""
        self.problem = "the trackers are compiled once for this computer"
        for section in self.units.sections:
            section.prepare()
        self.problem = ""

    def run(self) -> None:
        """Work until `stop`."""
        while not self._stop.is_set():
            begun, used = time.monotonic(), time.thread_time()
            self.step(IDLE_SECONDS)
            pace = min(max(PACE_SECONDS, PACE_FACTOR * (time.thread_time() - used)), SLOWEST_PACE_SECONDS)
            self._stop.wait(begun + pace - time.monotonic())
        if not self.problem:  # otherwise nothing more may be written: sources send again what was not acknowledged
            self.step(0.0)
            self._store_states(everything=True)
            self._commit()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def stop(self) -> None:
        """Let `run` return after the samples that have arrived are stored."""
        self._stop.set()
        self.intake.close()

    def close(self) -> None:
        """Store the positions of the sinks, and close the journal."""
        if not self.problem:
            self._commit()
        self.journal.close()

    def step(self, wait: float) -> int:
        """Take, journal and process the batches that have arrived; the number of samples."""
        self._stepped = time.monotonic()
        arrived = self.intake.take(self.config.service.group, 0.0 if self._pending else wait)
        self.units.evict(self._dirty, self._pending)
        first, items = self.next, self._admit(arrived)
        oldest = min((batch.arrived for _, batch in arrived.batches if batch.arrived), default=time.monotonic())
        now = time.time() - (time.monotonic() - oldest)
        if items:
            self._pending.add_group(first, items, now)
            if self.config.service.audit:
                self._head = self._pending.add_link(self._head)
            self.next += sum(item.length for item in items)
        self._store_states()
        self._archive.forget(self._pending, self.journal, self._sinks_at())
        if not self._commit():
            return 0
        for _, batch in arrived.batches:
            try:
                batch.acknowledge()
            except Exception:  # the sender asks again
                log.exception("acknowledgement")
        refusals = self._process(first, items, now) if items else {}
        number = self.next - sum(action.unit in self.units.names for action in arrived.actions)
        for action in arrived.actions:
            known = action.unit in self.units.names
            action.done(refusals.get(number, "") if known else f"there is no unit {action.unit!r}")
            number += known
        done = time.monotonic()
        self.latencies.extend(done - batch.arrived for _, batch in arrived.batches if batch.arrived)
        return self.next - first

    def _admit(self, arrived: Arrived) -> list[Item]:
        """The entries of the next group."""
        for source, batch in arrived.batches:
            self.units.refused["unreadable"] += batch.refused
            if batch.noticed:
                self.tell("", "source", {"source": source, "noticed": batch.noticed})
            if batch.position is not None:
                self._pending.positions[f"source:{source}"] = batch.position
        messages = ((one.client or source, samples, one.receipt) for source, one in arrived.batches
                    for samples in one.samples)  # fmt: skip
        admitted, names = self.units.admitted(messages, self._pending, self.next), self.units.names
        return [*admitted, *(Act(names[one.unit], one.what) for one in arrived.actions if one.unit in names)]

    def _process(self, first: int, items: list[Item], now: float) -> dict[int, str]:
        """Update the units of a group; its results become part of the next transaction.

        Returns by number why actions were refused.
        """
        out, number = Out(), first
        while self.units.unreadable:
            unit = self.units.unreadable.pop()
            out.event(first, unit, "failed", {"error": self.units.get(unit).failure})
        while DAMAGED:
            table, row = DAMAGED.popleft()
            out.event(first, 0, "damaged", {"table": table, "row": row})
        for item in items:
            self._apply(number, item, out)
            number += item.length
        group = Group(first, out.results, out.events, now)
        self._pending.add_results(group)
        self._pending.blocks += out.blocks
        if group.parts or group.events:
            with self.news:  # sinks may see results that are not stored yet: what they follow from is in the journal
                self._fresh.append(group)
                while len(self._fresh) > KEPT_GROUPS:
                    self._elsewhere = self._fresh.popleft().first
                self.news.notify_all()
        for unit in out.to_calibrate:
            self._ask_for_limits(self.units.get(unit))
        self.samples += sum(len(one.number) for one in out.results)
        self.units.note_trouble({unit for _, unit, *_ in out.events if unit}, self._pending)
        for _, unit, _, kind, detail in out.events:
            bad = kind == "failed" or (kind == "calibrated" and detail.get("refused"))
            name = self.units.get(unit).name if unit else ""
            log.log(logging.ERROR if bad else logging.INFO, kind, extra={"unit": name, "detail": detail})
        return {number: detail["refused"] for number, *_, detail in out.events if "refused" in detail}

    def after(self, group: int, stored: Journal) -> list[Group]:
        """The results after a group, some of them if there are many."""
        with self.news:
            if group >= self._elsewhere:
                return [one for one in self._fresh if one.first > group]
        return stored.outcomes(group)

    def _ask_for_limits(self, unit: Unit) -> None:
        """Find the limits of a unit's alarms in another thread; they come back as an action in the journal."""
        alarm = unit.settings.alarm
        width = 2 + len(unit.settings.u)
        if alarm is None or unit.calibrated or unit.asked or len(unit.reference) < alarm.reference * width:
            return
        unit.asked = True
        rows = np.array(unit.reference).reshape(-1, width)

        def find() -> None:
            self.act(unit.name, rules_of(unit.settings, rows))

        self._pool.submit(find)

    def act(self, unit: str, what: dict[str, Any], done: Callable[[str], None] = lambda problem: None) -> None:
        """Put an action on a unit into the journal."""
        try:
            check_storable(what)
        except ValueError as error:
            log.error("refused", extra={"unit": unit, "detail": str(error)})
            done(str(error))
            return
        self.intake.act(Action(unit, what, done))

    def tell(self, unit: str, kind: str, detail: dict[str, Any]) -> None:
        """Note an event that no sample caused, for the page and the log; from any thread. A unit "" is none."""
        log.log(logging.ERROR if unit else logging.WARNING, kind, extra={"unit": unit, "detail": detail})
        self._told.append((unit, kind, detail))

    def _store_states(self, everything: bool = False) -> None:
        """Add the states that have been waiting longest to the next transaction."""
        begin, now = time.perf_counter(), time.monotonic()
        # states contain every sample that was processed, which is all before the present group
        upto = self._pending.log[0] if self._pending.log is not None else self.next
        if self._dirty:
            self.units.note_programs(self._pending)
        while self._dirty and (everything or time.perf_counter() - begin < STORE_SECONDS):
            number, (_, since) = next(iter(self._dirty.items()))
            if not everything and now - since < self.config.service.snapshot:
                break
            del self._dirty[number]
            unit = self.units.get(number)
            self._pending.snapshots.append((number, upto, unit.state()))
            self._pending.blocks += self.units.sections[unit.streams.index].blocks.flush(unit.place, number)
        needed = next(iter(self._dirty.values()))[0] if self._dirty else upto
        if self._pending:
            self._pending.meta["needed from"] = str(needed)

    def _commit(self) -> bool:
        """Write the next transaction; wait while that is impossible. False if the service was stopped meanwhile."""
        for name, upto in self.progress.copy().items():
            if self.positions.get(f"sink:{name}") != upto:
                self._pending.positions[f"sink:{name}"] = upto
        while self._told:
            unit, kind, detail = self._told.popleft()
            self._pending.add_event(self.next - 1, self.units.names.get(unit, 0), time.time(), kind, detail)
        if not self._pending:
            return True
        while True:
            try:
                self._pending.commit(self.journal.db)
                break
            except sqlite3.Error as error:
                if not self.problem:
                    log.error("journal", extra={"detail": str(error)})
                self.problem = f"the journal cannot be written: {error}; sources are held back."
                if self._stop.wait(RETRY_SECONDS):
                    return False
        self.problem = ""
        self.positions |= self._pending.positions
        self.last_stored = max([self.last_stored, *(first for first, *_ in self._pending.results)])
        self._pending = Pending()
        return True

    def _sinks_at(self) -> int:
        """The last group that all sinks have written."""
        found = [self.positions.get(f"sink:{sink.name}", 0) for sink in self.config.sinks]
        return min(found, default=self.next)

    @property
    def alive(self) -> bool:
        return bool(self.problem) or time.monotonic() - self._stepped < GROUP_SECONDS

    def status(self) -> dict[str, Any]:
        trouble = self.units.troubled()
        shown = dict(islice(trouble.items(), NAMED_TROUBLES))
        return quantiles(self.latencies) | {
            "samples": self.samples, "next": self.next, "units": len(self.units), "waiting": self.intake.waiting,
            "held_back": self.intake.held_back, "refused": dict(self.units.refused), "problem": self.problem,
            "failed": sum("failed" in what for what in trouble.values()), "trouble": shown, "troubled": len(trouble),
            "reasons": [f"{unit}: {what} ({why})" for unit, found in shown.items() for what, why in found.items()]
            + [f"{len(trouble) - NAMED_TROUBLES} more units"] * (len(trouble) > NAMED_TROUBLES),
            "dirty": len(self._dirty), "recovered": self.recovered, "positions": dict(self.positions),
            "left_out": self.units.left_out,
        }  # fmt: skip


class Action(NamedTuple):
    """An action on a unit, by an operator or by the service itself."""

    unit: str
    what: dict[str, Any]
    done: Callable[[str], None] = lambda problem: None
    """Called when it was carried out, with "" or the reason why that was not possible."""


class Arrived(NamedTuple):
    """Batches and actions that are journaled together."""

    batches: list[tuple[str, Batch]]
    actions: list[Action]


class Intake:
    """A bounded queue of samples, in which `put` holds back fast sources, and an unbounded one of the few actions."""

    def __init__(self, most: int) -> None:
        self.most = most
        self.waiting = 0
        """Samples that wait."""
        self.held_back = 0
        """How often a source had to wait."""
        self._batches: deque[tuple[str, Batch]] = deque()
        self._actions: deque[Action] = deque()
        self._changed = threading.Condition()
        self._closed = False

    def put(self, source: str, batch: Batch) -> bool:
        """Add a batch once there is room; False if the service stops first."""
        count = _size(batch)
        with self._changed:
            if self.waiting and self.waiting + count > self.most:
                self.held_back += 1
            while self.waiting and self.waiting + count > self.most and not self._closed:
                self._changed.wait()
            if self._closed:
                return False
            self._batches.append((source, batch))
            self.waiting += count
            self._changed.notify_all()
        return True

    def act(self, action: Action) -> None:
        with self._changed:
            self._actions.append(action)
            self._changed.notify_all()

    def take(self, most: int, wait: float) -> Arrived:
        """The batches that have arrived, up to about ``most`` samples; empty after ``wait`` seconds."""
        until = time.monotonic() + wait
        with self._changed:
            while not (self._batches or self._actions or self._closed):
                left = until - time.monotonic()
                if left <= 0.0 or not self._changed.wait(left):
                    break
            batches, count = [], 0
            while self._batches and count < most:
                batches.append(self._batches.popleft())
                count += _size(batches[-1][1])
            self.waiting -= count
            actions = list(self._actions)
            self._actions.clear()
            self._changed.notify_all()
        return Arrived(batches, actions)

    def close(self) -> None:
        """Release everyone who waits."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


def _size(batch: Batch) -> int:
    return max(1, sum(one.length for one in batch.samples))
