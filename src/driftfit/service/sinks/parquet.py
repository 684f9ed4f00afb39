"""Parquet: a folder of files, each with the results of a minute or of 100,000 samples, for pandas, polars, DuckDB.

A file is named by its first group and moved into place when it is complete; one that is written again after a crash
replaces itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import polars as pl

from driftfit.data.storage import replace_file
from driftfit.service.core.results import ALARM, OK, Results
from driftfit.service.sinks.contract import Outcome, Sink, Writer

TYPES: dict[str, Any] = {
    "number": pl.Int64, "unit": pl.String, "time": pl.Float64, "y": pl.Float64, "y_hat": pl.Float64, "e": pl.Float64,
    "s": pl.Float64, "ok": pl.Boolean, "theta": pl.List(pl.Float64), "std": pl.List(pl.Float64), "alarm": pl.Boolean,
}  # fmt: skip


@dataclass(frozen=True)
class Parquet(Sink):
    """A folder of files."""

    path: str
    seconds: float = 60.0
    """Time that one file covers."""
    most: ClassVar[int] = 100_000

    @property
    def gather(self) -> float:
        return self.seconds

    def open(self) -> Writer:
        Path(self.path).mkdir(parents=True, exist_ok=True)
        return _Parquet(Path(self.path))


class _Parquet(Writer):
    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def write(self, batch: Outcome) -> None:
        """One file, complete or not at all."""
        if not len(batch):
            return
        table = pl.concat([table_of(batch, part) for part in batch.parts])
        replace_file(self.folder / f"results-{batch.group:016d}.parquet", table.write_parquet)


def table_of(batch: Outcome, part: Results) -> pl.DataFrame:
    columns = {name: part.values[:, k] for k, name in enumerate(("time", "y", "y_hat", "e", "s"))}
    given = {"number": part.number, "unit": [batch.names[k] for k in part.unit.tolist()], **columns}
    given |= {"ok": (part.flags & OK) > 0, "alarm": (part.flags & ALARM) > 0}
    given |= {"theta": part.theta.tolist(), "std": part.std.tolist()}
    return pl.DataFrame(given, schema_overrides=TYPES).with_columns(pl.col("time").fill_nan(None)).select(*TYPES)
