"""Patterns of topics: ``plant/{pump}/sensors`` matches plant/7/sensors, with pump = 7.

A name in braces matches one level of a topic, the part between two slashes. Names of units come from outside: they
are bounded in length and contain no control characters.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from string import Formatter

LONGEST = 200
"""Characters of a topic and of the name of a unit."""


@dataclass(frozen=True)
class Pattern:
    """A pattern of topics, and how units are named by what it matches."""

    text: str
    name: str = ""
    """Template such as "pump {pump}"; empty: the matched parts, or the topic if the pattern has none."""

    def __post_init__(self) -> None:
        fields = self.fields
        if not self.text or len(self.text) > LONGEST:
            raise ValueError(f"match must have 1 to {LONGEST} characters; got {len(self.text)}.")
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
    def _compiled(self) -> re.Pattern[str]:
        parts = (
            re.escape(fixed) + (f"(?P<{field}>[^/]+)" if field is not None else "")
            for fixed, field, _, _ in Formatter().parse(self.text)
        )
        return re.compile("".join(parts))

    def match(self, topic: str) -> dict[str, str] | None:
        """The parts of a topic that match; None if it does not fit."""
        found = self._compiled.fullmatch(topic)
        return None if found is None else found.groupdict()

    def unit(self, topic: str) -> str | None:
        """The name of the unit to which a topic belongs; None if the pattern does not fit."""
        found = self.match(topic)
        if found is None:
            return None
        return self.name.format_map(found) if self.name else "/".join(found.values()) or topic


def _fields(text: str) -> list[str]:
    try:
        return [field for _, field, _, _ in Formatter().parse(text) if field is not None]
    except ValueError as error:
        raise ValueError(f"{text!r}: {error}; braces enclose a name, such as plant/{{pump}}/sensors.") from None


def valid_name(topic: str) -> bool:
    """Whether a topic from outside may name a unit."""
    return 0 < len(topic) <= LONGEST and topic.isprintable()
