"""Tail: a CSV file (with a header line) or a file of JSON lines that grows; also one that is replaced (rotated).

The position is the byte up to which complete lines were read, with the number of the file, so a restart continues
there. A line is read once it ends; a longer one than 1 MB is refused.
"""

from __future__ import annotations

import csv
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from driftfit.service.sources.contract import FileSource, Reader
from driftfit.service.sources.samples import Batch, Samples, decode

PIECE = 1 << 20
"""Most bytes that are read at once, and of one line."""
LOOK = 0.05
"""Seconds between two looks at a file that does not grow."""


@dataclass(frozen=True)
class Tail(FileSource):
    """A file that grows."""

    separator: str = ","

    def open(self, position: Any) -> Reader:
        """Continue after the lines that were read."""
        return _Tail(self, position)


class _Tail(Reader):
    def __init__(self, options: Tail, position: Any) -> None:
        self.options = options
        self.path = Path(options.path)
        self._open(position)

    def _open(self, position: Any) -> None:
        self.file = open(self.path, "rb")  # noqa: SIM115  (closed by `close`)
        self.inode = os.fstat(self.file.fileno()).st_ino
        json_lines = self.path.suffix.lower() in (".jsonl", ".ndjson", ".json")
        self.header = None if json_lines else self._cells(self.file.readline())
        if position is not None and position[0] == self.inode and position[1] <= os.path.getsize(self.path):
            self.file.seek(position[1])

    def _cells(self, line: bytes) -> list[str]:
        text = line.decode("utf-8-sig", "replace").strip("\r\n")
        return next(csv.reader([text], delimiter=self.options.separator), [])

    def read(self, wait: float) -> Batch | None:
        """Complete lines that have been added."""
        until = time.monotonic() + wait
        while True:
            begin = self.file.tell()
            piece = self.file.read(PIECE)
            end = piece.rfind(b"\n") + 1
            self.file.seek(begin + (end or (len(piece) if len(piece) == PIECE else 0)))
            if end or len(piece) == PIECE:
                return self._batch(piece[:end])
            if self._replaced():
                self.close()
                self._open(None)
            elif time.monotonic() >= until:
                return None
            else:
                time.sleep(LOOK)

    def _replaced(self) -> bool:
        """Whether another file has the name now, or this one was cut."""
        try:
            now = os.stat(self.path)
        except FileNotFoundError:
            return False
        return now.st_ino != self.inode or now.st_size < self.file.tell()

    def _batch(self, piece: bytes) -> Batch:
        rows: dict[str, list[dict[str, Any]]] = {}
        samples: list[Samples] = []
        refused = 0 if piece else 1
        for line in piece.splitlines():
            if not line.strip():
                continue
            if self.header is None:
                try:
                    found = decode("", line)
                except ValueError:
                    refused += 1
                    continue
                topic = self._topic(found.columns)
                if found.length > 1:
                    samples.append(found._replace(topic=topic))
                    continue
                row = dict(found.columns)
            else:
                cells = self._cells(line)
                if len(cells) != len(self.header):
                    refused += 1
                    continue
                row = dict(zip(self.header, cells, strict=True))
                topic = self._topic(row)
            rows.setdefault(topic, []).append(row)
        for topic, many in rows.items():
            names = {name for row in many for name in row}
            samples.append(Samples(topic, len(many), {name: [row.get(name) for row in many] for name in names}))
        position = [self.inode, self.file.tell()]
        return Batch(samples, position=position, refused=refused, arrived=time.monotonic())

    def _topic(self, row: Any) -> str:
        return self.options.topic_of(row.get(self.options.by, ""))

    def close(self) -> None:
        """Close the file."""
        self.file.close()
