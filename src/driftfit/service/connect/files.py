"""Files: one that grows, and one that was recorded.

tail      A CSV file (with a header line) or a file of JSON lines that grows; also one that is replaced (rotated). The
          position is the byte up to which complete lines were read, with a digest of what is before it, so a restart
          continues there. A line is read once it ends; a longer one than 1 MB is refused.
replay    A recorded file at a chosen speed, for trials and demonstrations: rows per second for a file without times, a
          multiple of real time with ``time``; 0 is as fast as possible. The position is the number of rows that were
          read, with a digest of the file.

A file that has other bytes before the position, or fewer, was cut or is another one: it is read from its start, and an
event says so.
"""

from __future__ import annotations

import csv
import hashlib
import math
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from driftfit.data.files import read_parquet
from driftfit.service.connect.base import END, Batch, FileSource, Reader, Samples, by_topic, decode, seconds

PIECE_BYTES = 1 << 20
"""Most bytes that are read at once, and of one line."""
DIGEST_BYTES = 1 << 16
"""Bytes before the position by which a file is recognised."""
BATCH_ROWS = 1000
"""Rows of a recorded file that are read at once."""
POLL_SECONDS = 0.05
"""Time between two looks at a file that does not grow."""


@dataclass(frozen=True)
class TailSource(FileSource):
    """A file that grows."""

    separator: str = ","

    def open(self, position: Any) -> Reader:
        return _Tail(self, position)


class _Tail(Reader):
    def __init__(self, options: TailSource, position: Any) -> None:
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
        self.at = self.file.tell()
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


@dataclass(frozen=True)
class ReplaySource(FileSource):
    """A recorded file."""

    time: str = ""
    speed: float = 0.0

    def check(self) -> None:
        if not Path(self.path).exists():
            raise ValueError(f"replay: there is no file {self.path}.")
        if not self.speed >= 0.0:
            raise ValueError(f"replay: speed must be at least 0 (0: as fast as possible); got {self.speed}.")
        columns = pl.scan_parquet(self.path) if self.path.endswith(".parquet") else pl.scan_csv(self.path)
        known = columns.collect_schema().names()
        for name in (self.by, self.time):
            if name and name not in known:
                raise ValueError(f"replay: {self.path} has no column {name!r}; it has {', '.join(known)}.")

    def open(self, position: Any) -> Reader:
        table = read_parquet(self.path, self.path)[1] if self.path.endswith(".parquet") else pl.read_csv(self.path)
        with open(self.path, "rb") as file:
            digest = hashlib.file_digest(file, "blake2b").hexdigest()
        return _Replay(self, table, digest, position or [0, digest])


class _Replay(Reader):
    def __init__(self, options: ReplaySource, table: pl.DataFrame, digest: str, position: list[Any]) -> None:
        self.options, self.table, self.digest = options, table, digest
        self.at = position[0] if position[1] == digest else 0
        self.noticed = "" if position[1] == digest else f"{options.path} is another file: it is read from its start."
        self.clock = [seconds(_plain(cell), 1.0) for cell in table[options.time]] if options.time else []
        self.begun, self.first = time.monotonic(), self.at

    def _due(self) -> int:
        """Rows up to which it is time."""
        speed, passed = self.options.speed, time.monotonic() - self.begun
        if speed == 0.0:
            return len(self.table)
        if not self.clock:
            return self.first + 1 + math.floor(passed * speed)
        upto, end = self.at, self.clock[self.first] + passed * speed
        while upto < len(self.clock) and not self.clock[upto] > end:
            upto += 1
        return upto

    def read(self, wait: float) -> Batch | None:
        if self.at >= len(self.table):
            return END
        until = time.monotonic() + wait
        while (due := min(self._due(), len(self.table), self.at + BATCH_ROWS)) <= self.at:
            if time.monotonic() >= until:
                return None
            time.sleep(0.01)
        piece, self.at = self.table[self.at : due], due
        by = self.options.by
        parts = piece.partition_by(by, maintain_order=True) if by else [piece]
        samples = [
            Samples(
                self.options.topic_of(part[by][0] if by else ""), len(part),
                {name: [_plain(cell) for cell in part[name]] for name in part.columns},
            )
            for part in parts
        ]  # fmt: skip
        return Batch(samples, position=[self.at, self.digest], arrived=time.monotonic())


def _plain(cell: Any) -> Any:
    """A date as text; anything else unchanged."""
    return cell.isoformat() if hasattr(cell, "isoformat") else cell
