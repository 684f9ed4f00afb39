"""Options of the service, its page, sources and sinks, built from tables of a TOML file; and patterns of topics.

A source or sink is a class in a file of the folder ``connect``; being there is being registered.
"""

from __future__ import annotations

import os
import pkgutil
import typing
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, is_dataclass
from functools import cached_property
from importlib import import_module
from inspect import isabstract, signature
from pathlib import Path
from string import Formatter
from typing import Any, TypeVar

import msgspec

from driftfit.engine.settings import near
from driftfit.service.connect.base import Connector

Made = TypeVar("Made")


class Secret:
    """A password or token, which is never printed: { env = "NAME" } or { file = "path" } in the configuration."""

    def __init__(self, value: str) -> None:
        self._value = value

    def __repr__(self) -> str:
        return "Secret(...)"

    @property
    def value(self) -> str:
        return self._value

    @classmethod
    def of(cls, given: Any) -> Secret:
        """From the environment or a file; ValueError for a password in the configuration itself."""
        if isinstance(given, dict) and given.keys() == {"env"}:
            if given["env"] not in os.environ:
                raise ValueError(f"the environment has no variable {given['env']}; set it before the service starts.")
            return cls(os.environ[given["env"]])
        if isinstance(given, dict) and given.keys() == {"file"}:
            return cls(Path(given["file"]).read_text(encoding="utf-8").strip())
        raise ValueError('passwords are not written in the file: write { env = "NAME" } or { file = "PATH" }.')


@dataclass(frozen=True)
class ServiceOptions:
    """The section [service]."""

    folder: str = "driftfit-service"
    """Where journal, states and results are stored."""
    group: int = 5000
    """Most samples of one transaction."""
    queue: int = 50_000
    """Most samples that wait for the journal; sources hold back beyond that."""
    snapshot: float = 30.0
    """Seconds after which a changed state is stored."""
    keep: float = 7.0
    """Days for which the journal stays in the database before it is exported to Parquet."""
    results: float = 1.0
    """Days for which results wait for sinks that are away."""
    history: float = 365.0
    """Days for which the page's history is kept."""
    audit: bool = False
    """Whether the groups of the journal are a chain of digests, which `driftfit journal verify` checks."""
    units: int = 100_000
    """Most units; topics beyond that are refused and counted."""
    new_units: int = 1_000
    """Most units that one client, or one source where clients are not told apart, may make in a minute."""
    log: str = "info"


@dataclass(frozen=True)
class UserOptions:
    """A section [[page.user]]."""

    name: str
    role: str = "viewer"
    """viewer, operator, or sender, which may only post samples"""
    password: str = ""
    """scrypt hash, as `driftfit serve --hash` prints it."""
    token: str = ""
    """SHA-256 hash of a token, as `driftfit serve --token` prints it."""
    units: list[str] = field(default_factory=list)
    """Names of the units of which a sender may post samples; empty: of all."""

    def __post_init__(self) -> None:
        if self.role not in ("viewer", "operator", "sender"):
            raise ValueError(f"user {self.name}: role must be viewer, operator or sender; got {self.role!r}.")
        if self.units and self.role != "sender":
            raise ValueError(f"user {self.name}: units are those of a sender; a {self.role} has all of them.")
        if not self.password.startswith("scrypt$") and not self.token.startswith("sha256$"):
            raise ValueError(f"user {self.name}: give password or token as printed by `driftfit serve --hash`.")


@dataclass(frozen=True)
class PageOptions:
    """The section [page]."""

    host: str = "127.0.0.1"
    port: int = 8765
    enabled: bool = True
    health: int = 0
    """Port of the health check, on 127.0.0.1; 0: a thousand above that of the page."""
    names: list[str] = field(default_factory=list)
    """Host names under which browsers may reach the page, besides the host itself."""
    certificate: str = ""
    key: str = ""
    behind_proxy: bool = False
    """Whether a proxy on this machine ends TLS."""
    requests: float = 50.0
    """Requests a second of one client, on average."""
    body: int = 4 << 20
    """Most bytes of a request."""
    viewers: int = 100
    """Most pages that are open at the same time."""
    user: list[UserOptions] = field(default_factory=list)

    def __post_init__(self) -> None:
        if bool(self.certificate) != bool(self.key):
            raise ValueError("page: certificate and key belong together.")
        if not self.local and not self.user:
            raise ValueError(
                f"page: host {self.host!r} can be reached from other machines, which needs [[page.user]] with a "
                "password or token; `driftfit serve --hash` prints one. Or leave host at 127.0.0.1."
            )
        if not self.local and not self.certificate and not self.behind_proxy:
            raise ValueError(
                f"page: host {self.host!r} needs certificate and key for TLS, or behind_proxy = true if a proxy "
                "on this machine ends TLS."
            )
        if not 0 <= self.port < 65536:
            raise ValueError(f"page: port must be 0 to 65535; got {self.port}.")

    @property
    def local(self) -> bool:
        """Whether only this machine can reach the page."""
        return self.host in ("127.0.0.1", "::1", "localhost")


def kinds(base: type[Connector]) -> dict[str, Any]:
    """All sources or all sinks, by kind, once the files of the folder ``connect`` are imported."""
    package = import_module("driftfit.service.connect")
    for one in pkgutil.iter_modules(package.__path__):
        import_module(f"{package.__name__}.{one.name}")
    return {one.kind(): one for one in _below(base) if not isabstract(one)}


def _below(base: type[Any]) -> Iterator[type[Any]]:
    for one in base.__subclasses__():
        yield one
        yield from _below(one)


def build(kind: type[Made], given: dict[str, Any]) -> Made:
    """A dataclass from a table; ValueError for an unknown, missing or wrong option, also of a table in it."""
    known = typing.get_type_hints(kind)
    for key, value in given.items():
        if key not in known or key not in signature(kind).parameters:
            raise ValueError(f"there is no option {key!r}; {near(key, list(signature(kind).parameters))}")
        for inner in typing.get_args(known[key]):
            for one in value if is_dataclass(inner) and isinstance(value, list) else ():
                build(inner, one)
    return converted(given, kind)


def converted(value: Any, hint: type[Made]) -> Made:
    """A value of a table in the type of an option."""
    try:
        made: Made = msgspec.convert(value, hint, dec_hook=lambda kind, given: kind.of(given))
    except msgspec.ValidationError as error:
        raise ValueError(str(error).replace(" - at `$.", " - in `").replace("Object", "the table")) from None
    return made


NAME_CHARACTERS = 200
"""Characters of a topic and of the name of a unit."""


@dataclass(frozen=True)
class Pattern:
    """A pattern of topics, and how units are named by what it matches.

    ``plant/{pump}/sensors`` matches plant/7/sensors, with pump = 7. A name in braces matches one or more characters of
    a level, which is what is between two slashes; the first of several in a level as many as possible. Names of units
    come from outside: they are bounded in length and contain no control characters.
    """

    text: str
    name: str = ""
    """Template such as "pump {pump}"; empty: the matched parts, or the topic if the pattern has none."""

    def __post_init__(self) -> None:
        fields = [field for level in self.text.split("/") for field in _fields(level)]
        if not self.text or len(self.text) > NAME_CHARACTERS:
            raise ValueError(f"match must have 1 to {NAME_CHARACTERS} characters; got {len(self.text)}.")
        if len(set(fields)) < len(fields) or not all(field.isidentifier() for field in fields):
            raise ValueError(f"match {self.text!r}: give each part in braces a name of its own, such as {{pump}}.")
        unknown = [field for field in _fields(self.name) if field not in fields]
        if unknown:
            raise ValueError(f"name {self.name!r}: the pattern {self.text!r} has no part {{{unknown[0]}}}.")

    @property
    def fields(self) -> list[str]:
        """Names of the parts in braces."""
        return _fields(self.text)

    @cached_property
    def _levels(self) -> list[tuple[list[str], list[str]]]:
        """By level: the texts before, between and after its names, and the names."""
        found = []
        for level in self.text.split("/"):
            texts, names = [""], []
            for text, name, *_ in Formatter().parse(level):
                texts[-1] += text
                if name is not None:
                    names.append(name)
                    texts.append("")
            found.append((texts, names))
        return found

    def match(self, topic: str) -> dict[str, str] | None:
        """The parts of a topic that match; None if it does not fit. The time is linear in its length."""
        levels, found = topic.split("/"), dict.fromkeys(self.fields, "")
        if len(levels) != len(self._levels):
            return None
        for level, (texts, names) in zip(levels, self._levels, strict=True):
            if (given := _parts_of(level, texts, names)) is None:
                return None
            found |= given
        return found

    def unit(self, topic: str) -> str | None:
        """The name of the unit to which a topic belongs; None if the pattern does not fit."""
        found = self.match(topic)
        if found is None:
            return None
        return self.name.format_map(found) if self.name else "/".join(found.values()) or topic


def _parts_of(level: str, texts: Sequence[str], names: Sequence[str]) -> dict[str, str] | None:
    """What the names of a level match. From its end, each text is as far to the right as it can be, so that the name
    before it gets as much as it can.
    """
    found, low, end = {}, len(texts[0]), len(level) - len(texts[-1])
    if not names:
        return {} if level == texts[0] else None
    if not level.startswith(texts[0]) or not level.endswith(texts[-1]):
        return None
    for k in reversed(range(len(names))):
        at = level.rfind(texts[k], low, max(end - 1, 0)) if k else 0
        begin = at + len(texts[k])
        if at < 0 or begin >= end:
            return None
        found[names[k]], end = level[begin:end], at
    return found


def _fields(text: str) -> list[str]:
    try:
        return [field for _, field, _, _ in Formatter().parse(text) if field is not None]
    except ValueError as error:
        raise ValueError(f"{text!r}: {error}; braces enclose a name, such as plant/{{pump}}/sensors.") from None
