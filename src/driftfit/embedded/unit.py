"""One C source file under construction: the functions translated so far, callees first, and tables of constants."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from driftfit.embedded.values import Value, field, joined, lifted
from driftfit.engine.kernel import Array

TYPES = {"real": "real", "int": "int", "long": "int64_t", "bool": "int", "flag": "int", "four": "four"}
"""C types of the kinds of numbers."""


class TranslationError(ValueError):
    """A step uses something that has no translation."""


@dataclass(frozen=True)
class Function:
    """One function in C: its text, the kinds of its results, and an upper bound of its operations."""

    name: str
    returns: tuple[str, ...]
    text: str
    operations: Counter[str]


class Unit:
    """The shared state of the functions of one file."""

    def __init__(self, record: Array, constant: frozenset[str], flags: frozenset[str]) -> None:
        self.record = record
        self.constant = constant
        """Fields that are assumed to keep the values that they start with."""
        self.flags = flags
        """Fields of one number that is assumed to be 0 or 1 at all times."""
        self.beyond: set[str] = set()
        """Fields that a translated function may set to other numbers than 0 and 1."""
        self.written: set[str] = set()
        """Fields that a translated function may write."""
        self.replaced: set[str] = set()
        """Fields that are replaced by their value in the text."""
        self.functions: dict[Any, Function] = {}
        self.tables: dict[str, str] = {}
        self.names: Counter[str] = Counter()
        self.largest = max((size for name in record.dtype.names or () for size in record[name].shape), default=1)
        """The largest extent in the record: the upper bound of loops about which nothing else is known."""

    def field(self, name: str) -> Value:
        """A field of the record."""
        return field(name, self.record[name][0], name in self.flags)

    def start_of(self, name: str) -> Any:
        """The value that every entry of a constant field has; None if there is no such value."""
        values = self.record[name][0].ravel()
        if name not in self.constant or len(np.unique(values.view(np.int64))) != 1:  # 0.0 is not -0.0
            return None
        self.replaced.add(name)
        return values[0].item()

    def table(self, values: Any) -> tuple[str, str]:
        """(name, kind) of a table of constants."""
        flat = [lifted(one) for one in np.ravel(values).tolist()]
        kind = joined(*(one.kind for one in flat))
        text = ", ".join(one.text for one in flat)
        body = f"static const {TYPES[kind]} %s[{len(flat)}] = {{{text}}};"
        return self.tables.setdefault(body, f"table_{len(self.tables) + 1}"), kind
