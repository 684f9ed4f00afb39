"""Connections to the page: those that do not send their requests give way to those that do.

A connection waits until its request is complete, and after an answer for the next one. It may wait for `PATIENCE`
seconds. Where one client, or all together, have more that wait than they may, the one that has waited longest ends;
those whose bodies are on their way end last.
"""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

PATIENCE = 30.0
"""Seconds for a request, with its headers and its body, and between two."""
OF_CLIENT, OF_ALL = 50, 250
"""Connections that may wait."""


class Connection(H11Protocol):
    """A connection."""

    since = 0.0

    @property
    def waits(self) -> bool:
        """Whether the client has to send something."""
        sent = self.cycle is not None and not self.cycle.response_complete and not self.cycle.more_body
        return not sent and not self.transport.is_closing()

    @property
    def uploads(self) -> bool:
        """Whether the body of a request is on its way."""
        return self.cycle is not None and not self.cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:
        """End the one that has waited longest where there are too many."""
        super().connection_made(transport)
        self.since = self.loop.time()
        self.loop.call_later(PATIENCE, self._look)
        every: list[Any] = [one for one in self.connections if isinstance(one, Connection) and one.waits]
        own = [one for one in every if one.client and self.client and one.client[0] == self.client[0]]
        for most, found in ((OF_CLIENT, own), (OF_ALL, every)):
            if len(found) > most:
                min(found, key=lambda one: (one.uploads, one.since)).transport.abort()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        self.since = self.loop.time()
        super().on_response_complete()

    def _look(self) -> None:
        """End after `PATIENCE`; a connection that became a WebSocket is another's."""
        if self not in self.connections:
            return
        left = self.since + PATIENCE - self.loop.time()
        if self.waits and left <= 0.0:
            self.transport.abort()
        else:
            self.loop.call_later(max(left, 1.0), self._look)
