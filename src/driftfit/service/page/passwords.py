"""Passwords and tokens: stored only as hashes, compared in constant time; sessions are signed and expire."""

from __future__ import annotations

import base64
import hashlib
import hmac
import os
import secrets
import time
from pathlib import Path

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
    """Signed sessions; the key is in the service's folder, so they outlive a restart of the page."""

    def __init__(self, folder: Path) -> None:
        path = folder / "session.key"
        if not path.exists():
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(secrets.token_bytes(32))
        self._key = path.read_bytes()

    def new(self, user: str) -> str:
        """A session of a user."""
        text = base64.urlsafe_b64encode(f"{user}\n{time.time() + SESSION:.0f}".encode()).decode()
        return f"{text}.{self._sign(text)}"

    def user(self, session: str) -> str | None:
        """The user of a valid session."""
        text, _, signature = session.rpartition(".")
        if not hmac.compare_digest(self._sign(text).encode(), signature.encode()):
            return None
        try:
            user, _, until = base64.urlsafe_b64decode(text).decode().partition("\n")
            return user if float(until) > time.time() else None
        except ValueError:
            return None

    def _sign(self, text: str) -> str:
        return hmac.new(self._key, text.encode(), hashlib.sha256).hexdigest()
