"""In which line of a TOML file a key is written, for messages; `tomllib` does not report it."""

from __future__ import annotations

import re
from typing import Any

HEADER = re.compile(r"\s*(\[\[?)\s*([^\]]+?)\s*\]")
KEY = re.compile(r"\s*((?:[\w-]+|\"[^\"]*\"|'[^']*')(?:\s*\.\s*(?:[\w-]+|\"[^\"]*\"|'[^']*'))*)\s*=")

Path = tuple[Any, ...]
"""Keys, and numbers for the entries of an array of tables: ("unit", 0, "model")."""


class Lines:
    """The lines of a file, by path of the key."""

    def __init__(self, text: str) -> None:
        self._lines: dict[Path, int] = {(): 1}
        counts: dict[Path, int] = {}
        table: Path = ()
        for number, line in enumerate(text.splitlines(), 1):
            if header := HEADER.match(line):
                table = _parts(header[2])
                if header[1] == "[[":
                    counts[table] = counts.get(table, -1) + 1
                    table = (*table, counts[table])
                self._lines[table] = number
            elif key := KEY.match(line):
                self._lines.setdefault((*table, *_parts(key[1])), number)

    def of(self, path: Path) -> int:
        """The line of a key, or of the nearest table that contains it."""
        while path not in self._lines:
            path = path[:-1]
        return self._lines[path]


def _parts(text: str) -> Path:
    return tuple(part.strip().strip("\"'") for part in text.split("."))
