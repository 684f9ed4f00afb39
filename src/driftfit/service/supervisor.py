"""The service as a process: engine, threads of sources and sinks, control socket, and the page in another process.

Each source and sink is opened, used, and opened again after a pause when it fails.
"""

from __future__ import annotations

import fcntl
import gc
import json
import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from driftfit.engine import __version__
from driftfit.service.config import Config, read
from driftfit.service.connect.base import END, Batch, Outcome, Reader, RefusedError, Sink, Source, Writer
from driftfit.service.control import Control, Health, health
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


PRIVATE = "driftfit-"
"""How the names of folders in the temporary directory begin."""
DEMO = Path(__file__).parent / "demo.toml"
LOOK_SECONDS = 1.0
"""Time between two looks at the page's process."""
STOP_SECONDS = 10.0
"""For this time sinks may write stored results when the service stops."""


class JsonLines(logging.Formatter):
    """A log line as a JSON object."""

    def format(self, record: logging.LogRecord) -> str:
        extra = {key: record.__dict__[key] for key in ("unit", "name_of", "detail") if key in record.__dict__}
        line = {"at": round(record.created, 3), "level": record.levelname.lower(), "message": record.getMessage()}
        if record.exc_info:
            line["error"] = self.formatException(record.exc_info)
        return json.dumps(line | extra, default=str)


def cut_the_tail() -> None:
    """Shorten the longest times from arrival to result.

    Threads change every 0.5 ms instead of 5: the engine releases the interpreter some twenty times for a group, and
    would wait so long each time while a source decodes. The garbage collector passes over modules and routines, which
    stay; to look through them takes 0.1 s.
    """
    sys.setswitchinterval(0.0005)
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


class Service:
    """A running service; `run` returns after `stop`, or a signal."""

    def __init__(self, config: Config, folder: Path) -> None:
        self.config, self.folder = config, folder
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._lock = open(folder / "lock", "a+", encoding="utf-8")  # noqa: SIM115  (held as long as the service runs)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ValueError(f"another service uses the folder {folder}; stop it, or use another folder.") from None
        self.begun = time.time()
        self.engine = Engine(config, folder)
        if self.engine.recovered:
            log.info("recovered", extra={"detail": {"samples": self.engine.recovered}})
        self._private = self._made_private()
        self.control = Control(self.engine, self._private / "control", self.status)
        port = config.page.health or (config.page.port + 1000) % 65_536
        self.health = Health(port, lambda: health(self.status(), self.engine.alive, named=True))
        self.sources = [SourceThread(self.engine, one) for one in config.sources]
        self.sinks = [SinkThread(self.engine, one) for one in config.sinks]
        self.page: subprocess.Popen[bytes] | None = None
        self.page_starts = 0
        self._stopping = threading.Event()

    def _made_private(self) -> Path:
        """A folder for the control socket; the lock names it, so that the next start removes what a kill has left."""
        self._lock.seek(0)
        left, made = Path(self._lock.read().strip()), tempfile.mkdtemp(prefix=PRIVATE)
        if left.name.startswith(PRIVATE) and left.parent == Path(made).parent:
            shutil.rmtree(left, ignore_errors=True)
        self._lock.truncate(0)
        self._lock.write(made)
        self._lock.flush()
        return Path(made)

    def status(self) -> dict[str, Any]:
        """Numbers for the page, `/metrics` and `/healthz`."""
        found = self.engine.status()
        found["reasons"] += [why for one in (*self.sources, *self.sinks) for why in one.reasons()]
        return found | {
            "sources": {one.label: one.status() for one in self.sources},
            "sinks": {one.label: one.status() for one in self.sinks},
            "since": self.begun, "version": __version__, "page_starts": self.page_starts,
        }  # fmt: skip

    def run(self, signals: bool = True) -> None:
        if signals:
            for one in (signal.SIGTERM, signal.SIGINT):
                signal.signal(one, lambda *_: self.stop())
        runners: list[WorkerThread] = [*self.sources, *self.sinks]
        self.control.start()
        self.health.start()
        keeper = threading.Thread(target=self._keep, daemon=True)
        keeper.start()
        self.engine.prepare()
        for runner in runners:
            runner.start()
        cut_the_tail()
        notify("READY=1")
        log.info("running", extra={"detail": {"units": len(self.engine.units), "folder": str(self.folder)}})
        try:
            self.engine.run()
        finally:
            self._close(runners)
            keeper.join(STOP_SECONDS)
            self._end_page()

    def stop(self) -> None:
        self._stopping.set()
        for one in self.sources:
            one.stop()
        self.engine.stop()

    def _close(self, runners: list[WorkerThread]) -> None:
        self._stopping.set()
        with self.engine.news:
            self.engine.news.notify_all()
        for runner in runners:
            runner.stop()
        until = time.monotonic() + STOP_SECONDS
        for runner in runners:
            runner.join(max(0.1, until - time.monotonic()))
        self.control.close()
        self.engine.close()
        shutil.rmtree(self._private, ignore_errors=True)
        self._lock.close()
        log.info("stopped")

    def _keep(self) -> None:
        """Start the page, and start it again when it dies; tell systemd that the service lives."""
        pause, at = LOOK_SECONDS, 0.0
        while not self._stopping.is_set():
            if self.config.page.enabled and (self.page is None or self.page.poll() is not None):
                if self.page is not None and time.monotonic() - at < 60.0:
                    pause = min(2.0 * pause, 30.0)
                    self._stopping.wait(pause)
                    if self._stopping.is_set():
                        break
                at = time.monotonic()
                self._start_page()
            notify("WATCHDOG=1")
            self._stopping.wait(LOOK_SECONDS)

    def _start_page(self) -> None:
        given = {
            "page": asdict(self.config.page), "folder": str(self.folder), "control": str(self.control.path),
            "level": self.config.service.log,
        }  # fmt: skip
        self.page = subprocess.Popen([sys.executable, "-m", "driftfit.service.page"], stdin=subprocess.PIPE)
        self.page_starts += 1
        assert self.page.stdin is not None
        try:
            self.page.stdin.write(json.dumps(given).encode() + b"\n")
            self.page.stdin.flush()  # it stays open: the page ends when this process does
        except OSError as error:
            log.error("page", extra={"detail": str(error)})

    def _end_page(self) -> None:
        if self.page is None:
            return
        self.page.terminate()
        try:
            self.page.wait(5.0)
        except subprocess.TimeoutExpired:
            self.page.kill()
            self.page.wait()
        if self.page.stdin is not None:
            self.page.stdin.close()


def notify(text: str) -> None:
    """Tell systemd, if it started the service."""
    address = os.environ.get("NOTIFY_SOCKET")
    if address:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as one:
            one.sendto(text.encode(), address.replace("@", "\0", 1))


def configured(file: Path, port: int | None, folder: Path | None) -> tuple[Config, Path]:
    """(the configuration, the folder of the data), as changed by the command line."""
    config = read(file)
    if port is not None:
        config = replace(config, page=replace(config.page, port=port))
    return config, folder or Path(config.service.folder)


def described(config: Config) -> str:
    lines = [f"The configuration is valid: {len(config.sources)} sources, {len(config.units)} sections of units, "
             f"{len(config.sinks)} sinks."]  # fmt: skip
    for unit in config.units:
        inputs = ", ".join(unit.u) or "its own past"
        lines.append(
            f"  {unit.match.text}: {unit.y} from {inputs}, {unit.model!r}, {unit.tracker!r}"
            + ("" if unit.gate else ", without a gate")
        )
    return "\n".join(lines)


def greeting(config: Config, folder: Path) -> str:
    page = config.page
    scheme = "https" if page.certificate else "http"
    where = f"{scheme}://{page.host}:{page.port}/" if page.enabled else "no page"
    return f"driftfit serve: {where}  (data in {folder}; Ctrl-C stops)"


def rebuild(folder: Path) -> None:
    """Let the service compute all states again from its journal."""
    Journal(folder, rebuild=True).close()


def run(config: Config, folder: Path) -> None:
    handler = logging.StreamHandler()
    handler.setFormatter(JsonLines())
    log.handlers[:] = [handler]
    log.setLevel(config.service.log.upper())
    log.propagate = False
    Service(config, folder).run()
