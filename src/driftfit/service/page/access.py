"""Access control: every request passes it first.

1. the host must be one under which the page is known (a name that someone points at 127.0.0.1 is not);
2. a request that changes something, and a WebSocket, must come from the page itself (Origin) or from a program;
3. each client has a rate; a body has a largest size;
4. where users are configured: a session cookie (SameSite=Strict), or a token in ``Authorization: Bearer``;
5. a sender may only post samples.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from functools import partial
from typing import Any
from urllib.parse import urlsplit

from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from driftfit.service.page.passwords import Sessions, token_fits
from driftfit.service.settings.options import PageOptions, UserOptions

COOKIE = "driftfit"
LOCAL = UserOptions("local", "operator", token="sha256$")
"""The user where none are configured."""
OPEN = ("/healthz", "/api/login", "/login", "/static/", "/favicon.ico")
"""Paths that need no user."""
SAMPLES = "/api/samples"
BURST = 4.0
"""Seconds of a client's rate that it may use at once."""
CLIENTS = 10_000
HEADERS = [
    (b"content-security-policy", b"default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
     b"frame-ancestors 'none'; base-uri 'none'; form-action 'self'"),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cache-control", b"no-store"),
]  # fmt: skip


class Rates:
    """Token buckets by client."""

    def __init__(self, rate: float, burst: float = BURST) -> None:
        self.rate, self.most = rate, rate * burst
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def allows(self, client: str) -> bool:
        """Whether the client may ask now."""
        now = time.monotonic()
        left, then = self._left.pop(client, (self.most, now))
        left = min(self.most, left + (now - then) * self.rate)
        self._left[client] = (left - (left >= 1.0), now)
        if len(self._left) > CLIENTS:
            self._left.popitem(last=False)
        return left >= 1.0


class TooLargeError(Exception):
    """A body beyond the largest size."""


class Access:
    """The middleware."""

    def __init__(self, app: ASGIApp, page: PageOptions, sessions: Sessions) -> None:
        self.app, self.page, self.sessions = app, page, sessions
        self.rates = Rates(page.requests)
        self.refused = 0
        names = {"localhost", "127.0.0.1", "[::1]", "::1", *page.names}
        self.hosts = names if page.host in ("0.0.0.0", "::") else names | {page.host}
        self.any_host = page.host in ("0.0.0.0", "::") and not page.names

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        connection = HTTPConnection(scope)
        problem = self.problem(connection)
        if problem is not None:
            self.refused += 1
            await self._refuse(scope, receive, send, *problem)
            return
        if scope["type"] == "websocket":
            await self.app(scope, receive, send)
            return
        state = {"started": False}

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                state["started"] = True
                message["headers"] = [*message.get("headers", []), *HEADERS]
            await send(message)

        try:
            await self.app(scope, self._bounded(receive), guarded)
        except TooLargeError:
            if not state["started"]:
                await self._refuse(scope, receive, send, 413, f"at most {self.page.body} bytes")

    def problem(self, connection: HTTPConnection) -> tuple[int, str] | None:
        """(status, reason) if the request is refused; otherwise its user is noted."""
        scope, headers = connection.scope, connection.headers
        client = scope["client"][0] if scope.get("client") else "local"
        if not self.rates.allows(client):
            return 429, "too many requests"
        host = headers.get("host", "")
        if not self.any_host and _without_port(host) not in self.hosts:
            return 421, "unknown host; add it to names = [...] in [page]"
        changes = scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD", "OPTIONS")
        origin = headers.get("origin")
        if changes and origin is not None and urlsplit(origin).netloc != host:
            return 403, "request from another site"
        length = headers.get("content-length", "0")
        if not length.isdigit() or int(length) > self.page.body:
            return 413, f"at most {self.page.body} bytes"
        user, path = self.user(connection), connection.url.path
        scope["user"], scope["still"] = user, partial(self.user, connection)
        if user is not None and COOKIE in connection.cookies and changes and origin is None:
            return 403, "a request with a cookie needs an Origin"
        if path.startswith(OPEN):
            return None
        if user is None:
            return 401, "log in, or send a token"
        if user.role == "sender" and path != SAMPLES and not path.startswith(f"{SAMPLES}/"):
            return 403, f"{user.name} is a sender, which may only post samples"
        return None

    def user(self, connection: HTTPConnection) -> UserOptions | None:
        """The user, by token or session."""
        if not self.page.user:
            return LOCAL
        scheme, _, token = connection.headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer" and token:
            for one in self.page.user:
                if one.token and token_fits(token, one.token):
                    return one
            return None
        return self.sessions.user(connection.cookies.get(COOKIE, ""), self.page.user)

    def _bounded(self, receive: Receive) -> Receive:
        total = 0

        async def counted() -> Message:
            nonlocal total
            message = await receive()
            total += len(message.get("body", b""))
            if total > self.page.body:
                raise TooLargeError
            return message

        return counted

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, status: int, reason: str) -> None:
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 4000 + status, "reason": reason})
            return
        wants_page = status == 401 and "text/html" in HTTPConnection(scope).headers.get("accept", "")
        headers: dict[str, Any] = {"location": "/login"} if wants_page else {}
        response = JSONResponse({"error": reason}, 303 if wants_page else status, headers)
        await response(scope, receive, send)


def _without_port(host: str) -> str:
    name, colon, port = host.rpartition(":")
    return name.lower() if colon and port.isdigit() else host.lower()
