"""Messages to open pages: two and a half times a second the overview, or the new results of one unit.

A page states what it shows: {"view": "fleet"} or {"view": "unit", "unit": "pump 7"}. Each viewer has a separate task,
which waits for that viewer only; one that is slow is sent less often.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from typing import Any

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from driftfit.service.page.feed import Feed
from driftfit.service.page.history import columns_of, latest

EVERY = 0.4
"""Seconds between two messages."""
LONGEST = 2000
"""Bytes of a message from a page."""


class Sockets:
    """The open pages."""

    def __init__(self, feed: Feed, most: int) -> None:
        self.feed, self.most = feed, most
        self.count = 0
        self._of: Counter[str] = Counter()
        """Open pages by client."""

    async def endpoint(self, socket: WebSocket) -> None:
        """Serve one page until it closes."""
        await socket.accept()
        client = socket.client.host if socket.client else "local"
        if self.count >= self.most or self._of[client] >= max(1, self.most // 2):
            await socket.close(4429, "too many open pages")
            return
        self.count += 1
        self._of[client] += 1
        view: dict[str, Any] = {"view": "fleet", "unit": "", "at": 0}
        sender = asyncio.create_task(self._send(socket, view))
        try:
            while True:
                text = await socket.receive_text()
                if len(text) > LONGEST:
                    break
                given = msgspec.json.decode(text, type=dict[str, str])
                view |= {"view": given.get("view", "fleet"), "unit": given.get("unit", ""), "at": 0}
        except (WebSocketDisconnect, msgspec.DecodeError, KeyError, RuntimeError):
            pass
        finally:
            self.count -= 1
            self._of -= Counter([client])
            sender.cancel()
            with contextlib.suppress(RuntimeError):  # it may be closed
                await socket.close(4400)

    async def _send(self, socket: WebSocket, view: dict[str, Any]) -> None:
        """Messages until the page is gone."""
        try:
            while socket.scope["still"]() is not None:
                message = await self._message(view)
                await socket.send_text(msgspec.json.encode(message).decode())
                await asyncio.sleep(EVERY)
            await socket.close(4401, "the session has ended")
        except (WebSocketDisconnect, RuntimeError):
            pass

    async def _message(self, view: dict[str, Any]) -> dict[str, Any]:
        feed = self.feed
        status = {name: feed.status.get(name) for name in ("samples", "units", "problem", "reasons", "p99")}
        status["alive"] = feed.healthy
        if view["view"] != "unit":
            return {"view": "fleet", "status": status, "units": feed.fleet}
        number = feed.find(view["unit"])
        if number is None:
            return {"view": "unit", "unit": view["unit"], "status": status, "missing": True}
        unit, after = view["unit"], view["at"]
        recent = await feed.recent(number)
        rows = [row for row in recent if row[0] > after]
        columns = columns_of(rows).T.tolist() if rows else []
        if after == 0:
            columns = (await asyncio.to_thread(latest, feed.journal, number, recent)).T.tolist()
        if unit == view["unit"] and rows:
            view["at"] = max(row[0] for row in rows)
        on = rows[-1][10] if rows else None
        return {"view": "unit", "unit": unit, "status": status, "columns": columns, "alarm": on}
