"""Tail: a CSV file (with a header line) or a file of JSON lines that grows; also one that is replaced (rotated).

The position is the byte up to which complete lines were read, with a digest of what is before it, so a restart
continues there. Where a file has other bytes before the position, or fewer, it was cut or is another one: it is read
from its start, and an event says so. A line is read once it ends; a longer one than 1 MB is refused.
"""

from __future__ import annotations

import csv
import hashlib
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from driftfit.service.sources.contract import Batch, FileSource, Reader, Samples, by_topic, decode

PIECE_BYTES = 1 << 20
"""Most bytes that are read at once, and of one line."""
DIGEST_BYTES = 1 << 16
"""Bytes before the position by which a file is recognised."""
POLL_SECONDS = 0.05
"""Time between two looks at a file that does not grow."""


@dataclass(frozen=True)
class Tail(FileSource):
    """A file that grows."""

    separator: str = ","

    def open(self, position: Any) -> Reader:
        return _Tail(self, position)


class _Tail(Reader):
    def __init__(self, options: Tail, position: Any) -> None:
        self.options = options
        self.path = Path(options.path)
        self._open(position)

    def _open(self, position: Any) -> None:
        self.file = open(self.path, "rb", buffering=0)  # noqa: SIM115  (closed by `close`)
        json_lines = self.path.suffix.lower() in (".jsonl", ".ndjson", ".json")
        head = b"\n" if json_lines else self.file.readline(PIECE_BYTES)
        if not head.endswith(b"\n"):
            self.file.close()
            raise ValueError(f"{self.path} has no complete header line yet.")
        self.header = None if json_lines else self._cells(head)
        self.at, self.noticed = self.file.tell(), ""
        self.before = self._read(self.at, 0)
        if position is not None and position[0] != self.at:
            before = self._read(position[0], 0)
            if _digest(before) == position[1]:
                self.at, self.before = position[0], before
            else:
                self.noticed = f"{self.path} does not continue at byte {position[0]}: it is read from its start."

    def _read(self, at: int, count: int) -> bytes:
        """Some bytes before ``at``, and ``count`` bytes from there on, in one piece: another may write meanwhile."""
        begin = max(0, at - DIGEST_BYTES)
        self.file.seek(begin)
        return self.file.read(at - begin + count)

    def _cells(self, line: bytes) -> list[str]:
        text = line.decode("utf-8-sig", "replace").strip("\r\n")
        return next(csv.reader([text], delimiter=self.options.separator), [])

    def read(self, wait: float) -> Batch | None:
        until = time.monotonic() + wait
        while True:
            if self.noticed:
                noticed, self.noticed = self.noticed, ""
                return Batch([], noticed=noticed)
            renamed = self._renamed()  # what was written to the old file before is read below
            found = self._read(self.at, PIECE_BYTES)
            if not found.startswith(self.before):
                self.close()
                self._open((self.at, ""))
                continue
            piece = found[len(self.before) :]
            end = piece.rfind(b"\n") + 1
            lines = piece[:end]
            if not end and len(piece) == PIECE_BYTES:
                end = PIECE_BYTES  # no line is so long
            elif not end and renamed:
                lines, end = piece, len(piece)
            if end:
                self.at, self.before = self.at + end, found[: len(self.before) + end][-DIGEST_BYTES:]
                return self._batch(lines)
            if renamed:
                self.close()
                self._open(None)
            elif time.monotonic() >= until:
                return None
            else:
                time.sleep(POLL_SECONDS)

    def _renamed(self) -> bool:
        """Whether another file has the name now."""
        try:
            return os.stat(self.path).st_ino != os.fstat(self.file.fileno()).st_ino
        except FileNotFoundError:
            return False

    def _batch(self, piece: bytes) -> Batch:
        rows: list[tuple[str, dict[str, Any]]] = []
        samples: list[Samples] = []
        refused = 0 if piece else 1
        for line in filter(bytes.strip, piece.splitlines()):
            try:
                found = self._samples(line)
            except ValueError:
                refused += 1
                continue
            if found.length > 1:
                samples.append(found)
            else:
                rows.append((found.topic, dict(found.columns)))
        position = [self.at, _digest(self.before)]
        return Batch(samples + by_topic(rows), position=position, refused=refused, arrived=time.monotonic())

    def _samples(self, line: bytes) -> Samples:
        """The samples of a line; ValueError if it cannot be read."""
        if self.header is None:
            found = decode("", line)
        else:
            found = Samples("", 1, dict(zip(self.header, self._cells(line), strict=True)))
        return found._replace(topic=self.options.topic_of(found.columns.get(self.options.by, "")))

    def close(self) -> None:
        self.file.close()


def _digest(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()
