"""Passwords, tokens and sessions: stored only as hashes, and compared in constant time."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import hmac
import secrets
import time
from collections.abc import Iterable
from pathlib import Path

import msgspec

from driftfit.data.storage import replace_file
from driftfit.service.settings.options import UserOptions

N, R, P = 1 << 14, 8, 1
"""Cost of scrypt: 16 MB and some fifty milliseconds."""
SESSION = 12 * 3600.0
"""Seconds for which a session is valid."""


def hashed(password: str) -> str:
    """The scrypt hash of a password, for the configuration."""
    if len(password) < 10:
        raise ValueError("a password needs at least 10 characters.")
    salt = secrets.token_bytes(16)
    return f"scrypt${N}${base64.b64encode(salt).decode()}${base64.b64encode(_scrypt(password, salt, N)).decode()}"


def _scrypt(password: str, salt: bytes, n: int) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, n=n, r=R, p=P, maxmem=64 << 20, dklen=32)


def password_fits(password: str, stored: str) -> bool:
    """Whether a password has the stored hash."""
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
    """The hash of a token."""
    return f"sha256${hashlib.sha256(token.encode()).hexdigest()}"


def token_fits(token: str, stored: str) -> bool:
    """Whether a token has the stored hash."""
    return hmac.compare_digest(token_hash(token), stored)


class Sessions:
    """Open sessions: random tokens, of which only hashes are stored.

    They are in the service's folder, so they outlive a restart of the page. An absent, empty or damaged file holds no
    session: everybody logs in again. A session ends at its logout, after `SESSION` seconds, and when the password of
    its user is another one.
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
        self._open[token_hash(token)] = (_login_of(user), now + SESSION)
        self._store()
        return token

    def user(self, token: str, users: Iterable[UserOptions]) -> UserOptions | None:
        """The one of the users whose session this is."""
        login, until = self._open.get(token_hash(token), ("", 0.0))
        return next((one for one in users if _login_of(one) == login and until > time.time()), None)

    def end(self, token: str) -> None:
        """Log out."""
        if self._open.pop(token_hash(token), None) is not None:
            self._store()

    def _store(self) -> None:
        replace_file(self._path, lambda file: file.write(msgspec.json.encode(self._open)))


def _login_of(user: UserOptions) -> str:
    return token_hash(f"{user.name}\n{user.password}")
