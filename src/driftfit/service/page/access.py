"""Access control: every request passes it first.

1. the host must be one under which the page is known (a name that someone points at 127.0.0.1 is not);
2. a request that changes something, and a WebSocket, must come from the page itself (Origin) or from a program;
3. each client has a rate; a body has a largest size;
4. where users are configured: a session cookie (SameSite=Strict), or a token in ``Authorization: Bearer``;
5. a sender may only post samples.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import hmac
import secrets
import time
from collections import OrderedDict
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec
from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from driftfit.data.storage import replace_file
from driftfit.service.options import PageOptions, UserOptions

COOKIE = "driftfit"
LOCAL = UserOptions("local", "operator", token="sha256$")
"""The user where none are configured."""
OPEN = ("/healthz", "/api/login", "/login", "/static/", "/favicon.ico")
"""Paths that need no user."""
SAMPLES = "/api/samples"
BURST_SECONDS = 4.0
"""Seconds of a client's rate that it may use at once."""
KNOWN_CLIENTS = 10_000
HEADERS = [
    (b"content-security-policy", b"default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
     b"frame-ancestors 'none'; base-uri 'none'; form-action 'self'"),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cache-control", b"no-store"),
]  # fmt: skip


class Rates:
    """Token buckets by client."""

    def __init__(self, rate: float, burst: float = BURST_SECONDS) -> None:
        self.rate, self.most = rate, rate * burst
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def allows(self, client: str) -> bool:
        now = time.monotonic()
        left, then = self._left.pop(client, (self.most, now))
        left = min(self.most, left + (now - then) * self.rate)
        self._left[client] = (left - (left >= 1.0), now)
        if len(self._left) > KNOWN_CLIENTS:
            self._left.popitem(last=False)
        return left >= 1.0


class TooLargeError(Exception):
    """A body beyond the largest size."""


class Access:
    """The middleware."""

    def __init__(self, app: ASGIApp, page: PageOptions, sessions: Sessions) -> None:
        self.app, self.page, self.sessions = app, page, sessions
        self.rates = Rates(page.requests)
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
        name, colon, port = host.rpartition(":")
        if not self.any_host and (name if colon and port.isdigit() else host).lower() not in self.hosts:
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


SCRYPT_N, SCRYPT_R, SCRYPT_P = 1 << 14, 8, 1
"""Cost of scrypt: 16 MB and some fifty milliseconds."""
SESSION_SECONDS = 12 * 3600.0
"""Seconds for which a session is valid."""


def hashed(password: str) -> str:
    """The scrypt hash of a password, for the configuration."""
    if len(password) < 10:
        raise ValueError("a password needs at least 10 characters.")
    salt = secrets.token_bytes(16)
    parts = (base64.b64encode(one).decode() for one in (salt, _scrypt(password, salt, SCRYPT_N)))
    return "$".join(["scrypt", str(SCRYPT_N), *parts])


def _scrypt(password: str, salt: bytes, n: int) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, n=n, r=SCRYPT_R, p=SCRYPT_P, maxmem=64 << 20, dklen=32)


def password_fits(password: str, stored: str) -> bool:
    try:
        _, n, salt, key = stored.split("$")
        return hmac.compare_digest(_scrypt(password, base64.b64decode(salt), int(n)), base64.b64decode(key))
    except ValueError:
        return False


def new_token() -> list[str]:
    """A token for a program, and its hash for the configuration; it is random, so a fast hash is enough."""
    token = secrets.token_urlsafe(32)
    return [f"token (give it to the program): {token}", f"hash (for the configuration): {token_hash(token)}"]


def token_hash(token: str) -> str:
    return f"sha256${hashlib.sha256(token.encode()).hexdigest()}"


def token_fits(token: str, stored: str) -> bool:
    return hmac.compare_digest(token_hash(token), stored)


class Sessions:
    """Open sessions: random tokens, of which only hashes are stored.

    They are in the service's folder, so they outlive a restart of the page. An absent, empty or damaged file holds no
    session: everybody logs in again. A session ends at its logout, after `SESSION_SECONDS`, and when its user has
    another password.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / "sessions.json"
        self._open: dict[str, tuple[str, float]] = {}
        """By hash of the token: the hash of the user's name and password, and the end in seconds since 1970."""
        with contextlib.suppress(OSError, msgspec.DecodeError):
            self._open = msgspec.json.decode(self._path.read_bytes(), type=dict[str, tuple[str, float]])

    def new(self, user: UserOptions) -> str:
        """The token of a new session."""
        token, now = secrets.token_urlsafe(32), time.time()
        self._open = {one: about for one, about in self._open.items() if about[1] > now}
        self._open[token_hash(token)] = (_login_of(user), now + SESSION_SECONDS)
        self._store()
        return token

    def user(self, token: str, users: Iterable[UserOptions]) -> UserOptions | None:
        """The one of the users whose session this is."""
        login, until = self._open.get(token_hash(token), ("", 0.0))
        return next((one for one in users if _login_of(one) == login and until > time.time()), None)

    def end(self, token: str) -> None:
        if self._open.pop(token_hash(token), None) is not None:
            self._store()

    def _store(self) -> None:
        replace_file(self._path, lambda file: file.write(msgspec.json.encode(self._open)))


def _login_of(user: UserOptions) -> str:
    return token_hash(f"{user.name}\n{user.password}")
