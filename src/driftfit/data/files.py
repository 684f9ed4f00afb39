"""Files: CSV (`driftfit.data.csv_files`) and Parquet, one or several, read with polars.

If some of several files cannot be read, they are left out with a warning and kept with their reasons. What is damaged
gives one error.
"""

from __future__ import annotations

import csv
import glob
import gzip
import io
import os
import zlib
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import narwhals as nw
import numpy as np
import polars as pl

from driftfit.data.columns import FILE, Columns, Wanted, convert
from driftfit.data.csv_files import read_csv, start_of
from driftfit.data.limits import within
from driftfit.engine.kernel import Array
from driftfit.engine.settings import near, warn

OTHER = {
    b"PK\x03\x04": "an Excel workbook or a ZIP archive",
    b"\xd0\xcf\x11\xe0": "an Excel workbook",
    b"\x89HDF": "an HDF5 file",
    b"SQLite format": "an SQLite database",
    b"MATLAB 5.0": "a MATLAB file",
}
"""The first bytes of files that are often passed instead."""


def read_columns(path: str | os.PathLike[str], names: Sequence[str], time: str | None = None) -> dict[str, Array]:
    """Columns of a CSV or Parquet file as arrays (T,): floats, and for ``time`` perhaps datetime64 (in UTC).

    Raises
    ------
    ValueError
        For a column that the file does not have (with the nearest names), and for a cell that is not a number (with
        its row, counted from 1 after the header, and its text).
    OSError
        If the file cannot be read.
    """
    where = os.fspath(path)
    columns = Files(where).one(where, Wanted(tuple(names), time), where)
    return {**columns.numbers, **({time: columns.time} if time is not None and columns.time is not None else {})}


@dataclass(frozen=True)
class Files:
    """Files, which of their rows are used, and how they are read.

    ``paths`` is a path, a pattern or a list of them, or the content of a file. ``rows`` are the first and the last row
    of each file, counted from 1, and ``times`` the first and the last time; None is an open end. The other fields are
    those of `Wanted`.
    """

    paths: Any
    rows: tuple[int, int | None] = (1, None)
    times: tuple[str | None, str | None] = (None, None)
    separator: str | None = None
    decimal: str = "."
    dates: str | None = None

    def columns(self, wanted: Wanted) -> tuple[Columns, dict[Hashable, str]]:
        """The wanted columns of all files, and the reasons why some of them cannot be read.

        A single one, or all of them, raise ValueError.
        """
        wanted = replace(wanted, separator=self.separator, decimal=self.decimal, dates=self.dates)
        sources = {"stdin": self.paths} if isinstance(self.paths, bytes) else {one: one for one in paths_of(self.paths)}
        parts: dict[str, Columns] = {}
        failed: dict[Hashable, str] = {}
        for name, source in sources.items():
            try:
                parts[name] = self.one(source, wanted, name)
            except (ValueError, OSError) as error:
                if len(sources) == 1:
                    raise
                failed[name] = str(error)
        if not parts:
            raise ValueError(f"none of the {len(sources)} files can be read; the first: {next(iter(failed.values()))}")
        if failed:
            warn(f"{len(failed)} of {len(sources)} files cannot be read: {next(iter(failed.values()))}", UserWarning)
        return self._between(together(parts)), failed

    def one(self, source: str | bytes, wanted: Wanted, where: str) -> Columns:
        """The rows of one file, given by its path or its content; ``where`` is named in errors."""
        frame, units = read_file(source, wanted, where)
        first, last = self.rows
        if len(frame) < first:
            raise ValueError(f"{where} has no row {first}.")
        return replace(convert(frame, wanted, where, 1, slice(first - 1, last)), units=units)

    def _between(self, found: Columns) -> Columns:
        """The rows between the first and the last time."""
        if found.time is None or self.times == (None, None):
            return found
        keep = np.flatnonzero(within([self.times], found.time, found.time, found.zone, "--from, --to"))
        if not len(keep):
            raise ValueError("no row is between --from {} and --to {}.".format(*(one or "..." for one in self.times)))
        numbers = {name: column[keep] for name, column in found.numbers.items()}
        units = [[column[k] for k in keep.tolist()] for column in found.by]
        return Columns(numbers, found.time[keep], found.zone, units, len(keep), found.units)


def read(data: Any, wanted: Wanted) -> tuple[Columns, dict[Hashable, str]]:
    """The wanted columns of a table or of files, and the reasons why some files cannot be read."""
    if isinstance(data, str | os.PathLike | list | tuple):
        data = Files(data)
    if isinstance(data, Files):
        return data.columns(wanted)
    return convert(table_frame(data), wanted, "the table", 0), {}


def table_frame(data: Any) -> nw.DataFrame[Any]:
    """A table as narwhals sees it; ValueError for what is none."""
    try:
        frame = nw.from_native(data)
    except TypeError:
        raise ValueError(
            f"data must be a table (pandas, polars, pyarrow) or a path; got a {type(data).__name__}."
        ) from None
    return frame.collect() if isinstance(frame, nw.LazyFrame) else frame


def paths_of(data: Any) -> list[str]:
    """The files given by a path, a pattern, or a list of both, sorted by name."""
    paths: list[str] = []
    for entry in data if isinstance(data, list | tuple) else [data]:
        if not isinstance(entry, str | os.PathLike):
            raise ValueError(f"data must be a table or a list of paths; got a list with a {type(entry).__name__}.")
        text = os.fspath(entry)
        found = sorted(glob.glob(text, recursive=True)) if glob.has_magic(text) else [text]
        if not found:
            raise ValueError(f"no file matches {text}.")
        paths += found
    return paths


def read_file(source: str | bytes, wanted: Wanted, where: str) -> tuple[nw.DataFrame[Any], dict[str, str]]:
    """The wanted columns of one file, all of them if none is named, by its path or contents, with a row of units.

    `read_csv` says how CSV is read.
    """
    if (start := start_of(source)).startswith(b"\x1f\x8b"):
        source = gunzipped(source if isinstance(source, bytes) else Path(source).read_bytes(), where)
        start = start_of(source)
    if kind := next((kind for first, kind in OTHER.items() if start.startswith(first)), None):
        raise ValueError(f"{where} is {kind}; write its table to a CSV or Parquet file.")
    units: dict[str, str] = {}
    parquet = start[:4] == b"PAR1" or (isinstance(source, str) and Path(source).suffix.lower() in (".parquet", ".pq"))
    if parquet:
        names, frame = read_parquet(source, where, wanted.names)
    else:
        try:
            names, frame, units = read_csv(source, wanted)
        except (pl.exceptions.PolarsError, csv.Error, ValueError) as error:
            raise ValueError(f"{where} cannot be read as CSV: {' '.join(str(error).split())}") from None
    if not wanted.names:
        return read_file(source, replace(wanted, numbers=tuple(names)), where)
    for name in (name for name in wanted.names if not (name == FILE and FILE in wanted.by)):
        if name not in names:
            raise ValueError(f"{where} has no column {name!r}: {near(name, names)}")
        if names.count(name) > 1:
            raise ValueError(f"{where} has {names.count(name)} columns {name!r}: rename those that are not meant.")
    if FILE in wanted.by and FILE not in names:
        frame = frame.with_columns(pl.lit(where).alias(FILE))
    if frame.height == 0:
        raise ValueError(f"{where} has a header but no rows.")
    return nw.from_native(frame, eager_only=True), units


def together(parts: Mapping[str, Columns]) -> Columns:
    """Concatenate files; their times must be of one kind."""
    times = {path: part.time for path, part in parts.items() if part.time is not None}
    kinds = {time.dtype.kind: path for path, time in times.items()}
    if len(kinds) > 1:
        raise ValueError(f"the times of {kinds['f']} are numbers, but those of {kinds['M']} are dates.")
    first = next(iter(parts.values()))
    units = [[value for part in parts.values() for value in part.by[k]] for k in range(len(first.by))]
    return Columns(
        {name: np.concatenate([part.numbers[name] for part in parts.values()]) for name in first.numbers},
        np.concatenate(list(times.values())) if times else None,
        first.zone,
        [_of_one_type(column) for column in units],
        sum(part.rows for part in parts.values()),
        first.units,
    )


def _of_one_type(units: list[Any]) -> list[Any]:
    """The names of units as text in all files, if some files name units by text and others by integers."""
    if not any(isinstance(unit, str) for unit in units):
        return units
    return [str(unit) if isinstance(unit, int) else unit for unit in units]


def gunzipped(data: bytes, where: str) -> bytes:
    """The contents of a file of gzip."""
    try:
        return gzip.decompress(data)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise ValueError(f"{where} cannot be decompressed: {error}") from None


def read_parquet(
    source: str | bytes, where: str, wanted: Collection[str] | None = None
) -> tuple[list[str], pl.DataFrame]:
    """(the names of all columns, the wanted ones) of a Parquet file."""
    try:
        opened = pl.scan_parquet(io.BytesIO(source) if isinstance(source, bytes) else source)
        names = opened.collect_schema().names()
        chosen = names if wanted is None else [name for name in names if name in wanted]
        return names, opened.select(chosen).collect()
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException) as error:
        raise ValueError(f"{where} cannot be read as Parquet: {' '.join(str(error).split())[:300]}") from None
