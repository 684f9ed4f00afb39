"""The process of the page; the service starts it and sends it its settings on standard input."""

from __future__ import annotations

import asyncio
import json
import os
import sys
import threading
from pathlib import Path
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from driftfit.service.options import PageOptions, build
from driftfit.service.page.access import Sessions
from driftfit.service.page.app import Page
from driftfit.service.page.feed import Feed


def main() -> None:
    """Serve until the service ends, which closes the standard input."""
    given = json.loads(sys.stdin.readline())
    options = build(PageOptions, given["page"])
    folder = Path(given["folder"])
    threading.Thread(target=_watch, daemon=True).start()
    page = Page(options, Feed(folder, Path(given["control"])), Sessions(folder))
    uvicorn.run(
        page.app(), host=options.host, port=options.port, log_level="warning", access_log=False, server_header=False,
        proxy_headers=options.behind_proxy, ssl_certfile=options.certificate or None, ssl_keyfile=options.key or None,
        http=Connection, limit_concurrency=500, timeout_keep_alive=10, timeout_graceful_shutdown=3, ws_max_size=4096,
        h11_max_incomplete_event_size=65536,
    )  # fmt: skip


def _watch() -> None:
    while sys.stdin.read(1):
        pass
    os._exit(0)


WAIT_SECONDS = 30.0
"""For a request, with its headers and its body, and between two."""
WAITING_OF_CLIENT, WAITING_OF_ALL = 50, 250
"""Connections that may wait."""


class Connection(H11Protocol):
    """Connections that do not send their requests give way to those that do.

    A connection waits until its request is complete, and after an answer for the next one, for `WAIT_SECONDS` at most.
    Where one client, or all together, have more that wait than they may, the one that has waited longest ends; those
    whose bodies are on their way end last.
    """

    since = 0.0

    @property
    def waits(self) -> bool:
        """Whether the client has to send something."""
        sent = self.cycle is not None and not self.cycle.response_complete and not self.cycle.more_body
        return not sent and not self.transport.is_closing()

    def connection_made(self, transport: asyncio.Transport) -> None:
        """End the one that has waited longest where there are too many; those with a body on its way end last."""
        super().connection_made(transport)
        self.since = self.loop.time()
        self.loop.call_later(WAIT_SECONDS, self._look)
        every: list[Any] = [one for one in self.connections if isinstance(one, Connection) and one.waits]
        own = [one for one in every if one.client and self.client and one.client[0] == self.client[0]]
        for most, found in ((WAITING_OF_CLIENT, own), (WAITING_OF_ALL, every)):
            if len(found) > most:
                longest = min(found, key=lambda one: (bool(one.cycle and not one.cycle.response_complete), one.since))
                longest.transport.abort()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        self.since = self.loop.time()
        super().on_response_complete()

    def _look(self) -> None:
        """End after `WAIT_SECONDS`; a connection that became a WebSocket is another's."""
        if self not in self.connections:
            return
        left = self.since + WAIT_SECONDS - self.loop.time()
        if self.waits and left <= 0.0:
            self.transport.abort()
        else:
            self.loop.call_later(max(left, 1.0), self._look)


main()
