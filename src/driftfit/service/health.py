"""Whether the service works, for supervisors: on a socket of its own, in the process of the engine."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any

log = logging.getLogger("driftfit.service")
PATIENCE = 2.0
"""Seconds for which a client may take."""
MOST = 100
"""Clients at a time."""
Answer = tuple[dict[str, Any], int]


def health(status: Mapping[str, Any], alive: bool, named: bool) -> Answer:
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

    def __init__(self, port: int, ask: Callable[[], Answer]) -> None:
        super().__init__(name="driftfit-health", daemon=True)
        self.port, self.ask = port, ask
        self._slots = asyncio.Semaphore(MOST)

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
            async with self._slots, asyncio.timeout(PATIENCE):
                await reader.readuntil(b"\r\n\r\n")
                said, code = self.ask()
                body = json.dumps(said).encode()
                head = f"HTTP/1.1 {code} -\r\ncontent-type: application/json\r\ncontent-length: {len(body)}\r\n"
                writer.write(f"{head}connection: close\r\n\r\n".encode() + body)
                await writer.drain()
