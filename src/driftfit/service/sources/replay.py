"""Replay: a recorded file at a chosen speed, for trials and demonstrations.

``speed`` is in rows per second for a file without times, and a multiple of real time with ``time``; 0 is as fast as
possible. The position is the number of rows that were read, with a digest of the file; another file is read from its
start, and an event says so.
"""

from __future__ import annotations

import hashlib
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from driftfit.data.files import read_parquet
from driftfit.service.sources.contract import END, Batch, FileSource, Reader, Samples, seconds

BATCH_ROWS = 1000


@dataclass(frozen=True)
class Replay(FileSource):
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
    def __init__(self, options: Replay, table: pl.DataFrame, digest: str, position: list[Any]) -> None:
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
        noticed, self.noticed = self.noticed, ""
        return Batch(samples, position=[self.at, self.digest], noticed=noticed, arrived=time.monotonic())


def _plain(cell: Any) -> Any:
    """A date as text; anything else unchanged."""
    return cell.isoformat() if hasattr(cell, "isoformat") else cell
