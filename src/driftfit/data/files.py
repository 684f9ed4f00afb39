"""Files: CSV and Parquet, one or many, read with polars.

CSV is read as text, so that messages can name a cell that is not a number. Lines that begin with # are comments. The
header determines whether cells are separated by comma, semicolon or tab, or a line such as ``sep=;`` before it, which
spreadsheets write. Where semicolons separate cells, numbers may have decimal commas, and dots between thousands. Text
that is neither UTF-8 nor UTF-16 with a byte order mark is taken as Windows-1252. If some of several files cannot be
read, they are left out with a warning and kept with their reasons.
"""

from __future__ import annotations

import glob
import os
import re
import warnings
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import narwhals as nw
import numpy as np
import polars as pl

from driftfit.data.columns import Columns, Wanted, convert, plain_names
from driftfit.engine.kernel import Array
from driftfit.engine.settings import near

FILE = "file"
"""The name with which ``by`` refers to the file that a row comes from."""


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
    wanted = Wanted(tuple(names), time)
    columns = convert(_file(os.fspath(path), wanted), wanted, os.fspath(path), 1)
    return {**columns.numbers, **({time: columns.time} if time is not None and columns.time is not None else {})}


def read(data: Any, wanted: Wanted) -> tuple[Columns, dict[Hashable, str]]:
    """The wanted columns of a table, a file, or the concatenation of several files."""
    if not isinstance(data, str | os.PathLike | list | tuple):
        return convert(_frame(data), wanted, "the table", 0), {}
    paths = paths_of(data)
    if len(paths) == 1:
        return convert(_file(paths[0], wanted), wanted, paths[0], 1), {}
    parts: dict[str, Columns] = {}
    failed: dict[Hashable, str] = {}
    for path in paths:
        try:
            frame = _file(path, wanted)
        except (ValueError, OSError) as error:
            failed[path] = str(error)
            continue
        parts[path] = convert(frame, wanted, path, 1)
    if not parts:
        raise ValueError(f"none of the {len(paths)} files can be read; the first: {failed[paths[0]]}")
    if failed:
        warnings.warn(
            f"{len(failed)} of {len(paths)} files cannot be read: {next(iter(failed.values()))}", stacklevel=4
        )
    return _together(parts), failed


def _frame(data: Any) -> nw.DataFrame[Any]:
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
        text = os.fspath(entry)
        found = sorted(glob.glob(text, recursive=True)) if glob.has_magic(text) else [text]
        if not found:
            raise ValueError(f"no file matches {text}.")
        paths += found
    return paths


def _file(path: str, wanted: Wanted) -> nw.DataFrame[Any]:
    """The wanted columns of one file."""
    parquet = Path(path).suffix.lower() in (".parquet", ".pq")
    try:
        if parquet:
            names = list(pl.read_parquet_schema(path))
            frame = pl.read_parquet(path, columns=[name for name in names if name in wanted.names])
        else:
            names, frame = _csv(path, wanted)
    except (pl.exceptions.PolarsError, UnicodeDecodeError) as error:
        text = " ".join(str(error).split())
        raise ValueError(f"{path} cannot be read as {'Parquet' if parquet else 'CSV'}: {text}") from None
    for name in (name for name in wanted.names if name not in names and not (name == FILE and FILE in wanted.by)):
        raise ValueError(f"{path} has no column {name!r}: {near(name, names)}")
    if FILE in wanted.by and FILE not in names:
        frame = frame.with_columns(pl.lit(path).alias(FILE))
    if frame.height == 0:
        raise ValueError(f"{path} has a header but no rows.")
    return nw.from_native(frame, eager_only=True)


def _csv(path: str, wanted: Wanted) -> tuple[list[str], pl.DataFrame]:
    """(all column names, the wanted columns as text); the header determines whether the separator is , ; or tab."""
    encoding = _encoding(path)
    with open(path, encoding=encoding, errors="replace") as file:
        header = next((line for line in file if not line.startswith("#")), "")
    declared = re.fullmatch(r"\ufeff?sep=(.)\s*", header, re.IGNORECASE)
    separator = declared[1] if declared else max(",;\t", key=header.count)
    options: dict[str, Any] = {"infer_schema": False, "comment_prefix": "#", "separator": separator}
    options |= {"encoding": encoding, "skip_rows": 1 if declared else 0}
    raw = pl.read_csv(path, n_rows=0, **options).columns
    names = plain_names(raw, [name for name in wanted.names if name != FILE])
    chosen = {old: new for old, new in zip(raw, names, strict=True) if new in wanted.names}
    frame = pl.read_csv(path, columns=list(chosen), **options).rename(chosen)
    if separator == ";":
        frame = frame.with_columns(_with_points(frame[name]) for name in wanted.numbers if name in frame.columns)
    whole = frame.select(pl.col(name).str.strip_chars() for name in wanted.by if name in frame.columns)
    return names, frame.with_columns(_whole(column) for column in whole)


def _encoding(path: str) -> str:
    """The encoding of a file, judged by its header and its first cells."""
    with open(path, "rb") as file:
        start = file.read(1 << 16)
    if start.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    try:
        start[: start.rfind(b"\n") + 1 or None].decode("utf-8")
    except UnicodeDecodeError:
        return "windows-1252"
    return "utf8"


COMMA = r"^\s*[+-]?(\d+|\d{1,3}(\.\d{3})+)?(,\d*)?([eE][+-]?\d+)?\s*$"
"""A number with a decimal comma, perhaps with dots between thousands."""


def _with_points(text: pl.Series) -> pl.Series:
    """A column with decimal points instead of decimal commas; a column without commas is returned unchanged."""
    comma = text.str.contains(",", literal=True)
    if not comma.any() or not text.filter(comma).str.contains(COMMA).all():
        return text
    if text.filter(~comma).str.contains(r"\.\d{0,2}$|\.\d{4,}").any():
        return text  # a mixture of both: the error message names the cell
    return text.str.replace_all(".", "", literal=True).str.replace(",", ".", literal=True)


def _whole(text: pl.Series) -> pl.Series:
    """A column that names units. In a file of text it has no type; it becomes integers if every cell is one."""
    whole = text.cast(pl.Int64, strict=False)
    return whole if whole.cast(pl.String).eq_missing(text).all() else text


def _together(parts: Mapping[str, Columns]) -> Columns:
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
    )


def _of_one_type(units: list[Any]) -> list[Any]:
    """The names of units as text in all files, if some files name units by text and others by integers."""
    if not any(isinstance(unit, str) for unit in units):
        return units
    return [str(unit) if isinstance(unit, int) else unit for unit in units]
