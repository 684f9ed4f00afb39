"""Threads that run sources and sinks: each is opened, used, and opened again after a pause when it fails."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from dataclasses import replace
from typing import Any

from driftfit.service.connect.base import END, Batch, Outcome, Reader, RefusedError, Sink, Source, Writer
from driftfit.service.core.engine import Engine, quantiles
from driftfit.service.core.journal import Journal, Names
from driftfit.service.core.results import Results

log = logging.getLogger("driftfit.service")
FIRST_PAUSE, LONGEST_PAUSE = 1.0, 60.0
EVENT_TRIES = 10
"""How often an event is written that the receiver refuses, which takes five minutes."""
READ_SECONDS = 0.5
"""Seconds for which a source may block."""


class WorkerThread(threading.Thread):
    """A thread that works until it is stopped, and begins again after a pause when something fails."""

    what = ""

    def __init__(self, engine: Engine, name: str) -> None:
        super().__init__(name=f"driftfit-{self.what}-{name}", daemon=True)
        self.engine, self.label = engine, name
        self.state, self.count, self.failures = "starting", 0, 0
        self.stopping = threading.Event()

    def run(self) -> None:
        pause = FIRST_PAUSE
        while not self.stopping.is_set():
            begun = time.monotonic()
            try:
                self.work()
                self.state = "ended"
                return
            except BaseException as error:  # whatever a broker or a driver raises, panics of Rust among them
                self.failures += 1
                self.state = f"away: {type(error).__name__}: {error}"[:300]
                log.warning(f"{self.what} away", extra={"name_of": self.label, "detail": self.state})
            pause = FIRST_PAUSE if time.monotonic() - begun > LONGEST_PAUSE else min(2.0 * pause, LONGEST_PAUSE)
            self.stopping.wait(pause)

    def work(self) -> None:
        """Open and use it until it ends or `stopping` is set."""
        raise NotImplementedError

    def status(self) -> dict[str, Any]:
        return {"state": self.state, "count": self.count, "failures": self.failures}

    def reasons(self) -> list[str]:
        return [f"{self.what} {self.label} is {self.state}"] if self.state.startswith("away") else []

    def stop(self) -> None:
        self.stopping.set()


class SourceThread(WorkerThread):
    """Reads one source into the intake."""

    what = "source"

    def __init__(self, engine: Engine, source: Source) -> None:
        super().__init__(engine, source.name)
        self.source = source
        self.position = engine.positions.get(f"source:{source.name}")

    def work(self) -> None:
        """Read until the source ends; after a failure continue after the last batch that was passed on."""
        reader: Reader = self.source.open(self.position)
        self.state = "running"
        try:
            while not self.stopping.is_set():
                noticed, reader.noticed = reader.noticed, ""
                batch = Batch([], noticed=noticed) if noticed else reader.read(READ_SECONDS)
                if batch is END:
                    return
                if batch is not None:
                    if not self.engine.intake.put(self.source.name, batch):
                        return
                    if batch.position is not None:
                        self.position = batch.position
                    self.count += sum(one.length for one in batch.samples)
        finally:
            reader.close()


class SinkThread(WorkerThread):
    """Hands stored results to one sink."""

    what = "sink"

    def __init__(self, engine: Engine, sink: Sink) -> None:
        super().__init__(engine, sink.name)
        self.sink = sink
        self.at = int(engine.positions.get(f"sink:{sink.name}", 0))
        self.latencies: deque[float] = deque(maxlen=2000)
        """Seconds from the arrival of the oldest sample of a group until it is written."""
        self._arrived: list[float] = []
        self._written: set[str] = set()
        """Events of the present batch that are written or set aside."""
        self._tries = self.set_aside = 0

    def work(self) -> None:
        journal = Journal(self.engine.journal.path.parent, read_only=True)
        writer: Writer | None = None
        try:
            names = Names(journal)
            self._arrived.clear()
            writer = self.sink.open()
            self.state = "running"
            while (batch := self._next(journal, names)) is not None:
                outcome, upto = batch
                self._write(writer, outcome)
                self.at = self.engine.progress[self.sink.name] = upto
                self.count += len(outcome)
                now = time.time()
                self.latencies.extend(now - at for at in self._arrived)
                self._arrived.clear()
        finally:
            if writer is not None:
                writer.close()
            journal.close()

    def _write(self, writer: Writer, batch: Outcome) -> None:
        """Write a batch; what is refused again and again is set aside, and those behind it go on."""
        if not self.sink.one_by_one:
            if batch.parts or batch.events:
                writer.write(batch)
            return
        for event in (one for one in batch.events if one.key not in self._written):
            try:
                writer.write(replace(batch, parts=[], events=[event]))
            except RefusedError as error:
                self._tries += 1
                if self._tries < EVENT_TRIES:
                    raise
                self.set_aside += 1
                detail = {"sink": self.label, "why": str(error), "tries": self._tries, **event._asdict()}
                self.engine.tell(event.unit, "undelivered", detail)
            self._tries = 0
            self._written.add(event.key)
        self._written.clear()

    def _next(self, journal: Journal, names: Names) -> tuple[Outcome, int] | None:
        """The next batch for the sink, and the last group in it; None when the thread is to end."""
        begun = time.monotonic()
        results: list[Results] = []
        events: list[Any] = []
        count, first, upto = 0, 0, self.at
        while True:
            groups = self.engine.after(upto, journal)
            for group, parts, happened, at in groups:
                first = first or group
                results += parts
                count += sum(len(one.number) for one in parts)
                events += happened
                upto = group
                self._arrived.append(at)
            late = time.monotonic() - begun >= self.sink.gather or count >= self.sink.most
            if (results or events) and (late or self.stopping.is_set()):
                return names.outcome(first, results, events), upto
            if self.stopping.is_set():
                return None
            if not groups:
                with self.engine.news:
                    self.engine.news.wait(0.2)

    def reasons(self) -> list[str]:
        """Also what was set aside."""
        aside = f"sink {self.label}: {self.set_aside} events were refused and are set aside"
        return super().reasons() + [aside] * bool(self.set_aside)

    def status(self) -> dict[str, Any]:
        return super().status() | {"at": self.at, "set_aside": self.set_aside, **quantiles(self.latencies)}
