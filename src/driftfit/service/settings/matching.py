"""Patterns of topics: ``plant/{pump}/sensors`` matches plant/7/sensors, with pump = 7.

A name in braces matches one or more characters of a level, which is what is between two slashes; the first of several
in a level as many as possible. Names of units come from outside: they are bounded in length and contain no control
characters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from string import Formatter

NAME_CHARACTERS = 200
"""Characters of a topic and of the name of a unit."""


@dataclass(frozen=True)
class Pattern:
    """A pattern of topics, and how units are named by what it matches."""

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


def valid_name(topic: str) -> bool:
    """Whether a topic from outside may name a unit."""
    return 0 < len(topic) <= NAME_CHARACTERS and topic.isprintable()
