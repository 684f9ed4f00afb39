"""The local socket by which the page asks the engine (status, units, actions, samples), and the health check.

A message is a length, a header in JSON, a length and a body. The socket belongs to the user who runs the service, in a
folder that nobody else can enter. Each connection has a thread; at most `CONNECTIONS` are open.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import queue
import socket
import struct
import threading
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from driftfit.service.connect.base import ANSWER_SECONDS
from driftfit.service.connect.http import INCOMING, HttpSource
from driftfit.service.core.engine import Engine

log = logging.getLogger("driftfit.service")
CONNECTIONS, MESSAGE_BYTES = 64, 16 << 20
"""At a time, and of a message."""
HEALTH_CLIENTS, HEALTH_SECONDS = 100, 2.0
"""Clients of the health check at a time, and the time that each may take."""


class Control(threading.Thread):
    """Answers requests on the socket."""

    def __init__(self, engine: Engine, path: Path, status: Any) -> None:
        super().__init__(name="driftfit-control", daemon=True)
        self.engine, self.path, self.status = engine, path, status
        self.listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        path.unlink(missing_ok=True)
        self.listener.bind(str(path))
        path.chmod(0o600)
        self.listener.listen(CONNECTIONS)
        self._slots = threading.Semaphore(CONNECTIONS)

    def run(self) -> None:
        while True:
            try:
                connection, _ = self.listener.accept()
            except OSError:  # closed
                return
            self._slots.acquire()
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def close(self) -> None:
        self.listener.close()
        self.path.unlink(missing_ok=True)

    def _serve(self, connection: socket.socket) -> None:
        try:
            with connection, connection.makefile("rwb") as file:
                while (message := receive(file)) is not None:
                    try:
                        answer = self._answer(*message)
                    except Exception as error:
                        answer = {"error": f"{type(error).__name__}: {error}", "status": 400}
                    file.write(packed(answer))
                    file.flush()
        except (OSError, ValueError):
            pass
        finally:
            self._slots.release()

    def _answer(self, header: dict[str, Any], body: bytes) -> dict[str, Any]:
        do = header.get("do")
        if do == "status":
            return dict(self.status())
        if do == "samples":
            if not any(isinstance(one, HttpSource) for one in self.engine.config.sources):
                return {
                    "error": 'no source takes samples over HTTP; add [source.web] with kind = "http".',
                    "status": 404,
                }
            client, foreign = str(header.get("client", "")), self._foreign(header.get("units", ()))
            return INCOMING.offer(str(header.get("topic", "")), body, client, foreign)
        name = str(header.get("unit"))
        number = self.engine.units.names.get(name)
        if number is None:
            return {"error": f"there is no unit {name!r}", "status": 404}
        if do == "unit":
            return self.engine.units.seen(number).plain()
        if do == "act":
            problems: queue.Queue[str] = queue.Queue()
            self.engine.act(name, header["action"], problems.put)
            try:
                problem = problems.get(timeout=ANSWER_SECONDS)
            except queue.Empty:
                return {"error": "the journal does not answer", "status": 503}
            return {"error": problem, "status": 400} if problem else {"done": True}
        return {"error": f"unknown request {do!r}", "status": 400}

    def _foreign(self, allowed: Collection[str]) -> Callable[[str], list[str]]:
        """The function that names those units of a topic which a sender may not touch."""
        named = self.engine.units.named
        return lambda topic: [name for _, name in named(topic) if name not in allowed] if allowed else []


def receive(file: Any) -> tuple[dict[str, Any], bytes] | None:
    """The next message; None at the end."""
    parts = []
    for _ in range(2):
        length = file.read(4)
        if len(length) < 4:
            return None
        (count,) = struct.unpack(">I", length)
        if count > MESSAGE_BYTES:
            raise ValueError("too long")
        parts.append(file.read(count))
    return json.loads(parts[0]), parts[1]


def packed(header: dict[str, Any], body: bytes = b"") -> bytes:
    text = json.dumps(header).encode()
    return struct.pack(">I", len(text)) + text + struct.pack(">I", len(body)) + body


def health(status: Mapping[str, Any], alive: bool, named: bool) -> tuple[dict[str, Any], int]:
    """(the answer, its status of HTTP) by the status of a service; 503 if it takes no samples.

    It is degraded where units have failed, alarms are not armed, or sources and sinks are away. Not everyone may know
    their names: without ``named`` they are only counted.
    """
    problem = status.get("problem", "") if alive else "the engine does not answer"
    reasons = status.get("reasons", [])
    state = "failing" if problem else "degraded" if reasons else "healthy"
    told = reasons if named or not reasons else [f"{len(reasons)} units, sources or sinks; log in for their names"]
    return {"healthy": not problem, "state": state, "problem": problem, "reasons": told}, 503 if problem else 200


class Health(threading.Thread):
    """Answers every request on a port of 127.0.0.1, whatever the page does."""

    def __init__(self, port: int, ask: Callable[[], tuple[dict[str, Any], int]]) -> None:
        super().__init__(name="driftfit-health", daemon=True)
        self.port, self.ask = port, ask
        self._slots = asyncio.Semaphore(HEALTH_CLIENTS)

    def run(self) -> None:
        try:
            asyncio.run(self._serve())
        except OSError as error:
            log.error("health", extra={"detail": str(error)})

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._answer, "127.0.0.1", self.port, limit=1 << 14)
        async with server:
            await server.serve_forever()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        broken = (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError)
        with contextlib.closing(writer), contextlib.suppress(*broken):
            if self._slots.locked():
                return
            async with self._slots, asyncio.timeout(HEALTH_SECONDS):
                await reader.readuntil(b"\r\n\r\n")
                said, code = self.ask()
                body = json.dumps(said).encode()
                head = f"HTTP/1.1 {code} -\r\ncontent-type: application/json\r\ncontent-length: {len(body)}\r\n"
                writer.write(f"{head}connection: close\r\n\r\n".encode() + body)
                await writer.drain()
