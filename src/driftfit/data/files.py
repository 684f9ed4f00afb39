"""Files: CSV and Parquet, one or many, read with polars.

CSV is read as text, so that messages can name a cell that is not a number. Lines that begin with # are comments. The
header determines whether cells are separated by comma, semicolon or tab, or a line such as ``sep=;`` before it, which
spreadsheets write. Where semicolons separate cells, numbers may have decimal commas, and dots between thousands, also
whole numbers in a file where others have decimal commas. A column that occurs twice cannot be used. Text that is
neither UTF-8 nor UTF-16 with a byte order mark is taken as Windows-1252. If some of several files cannot be read, they
are left out with a warning and kept with their reasons.
"""

from __future__ import annotations

import glob
import io
import os
import re
import warnings
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import narwhals as nw
import numpy as np
import polars as pl

from driftfit.data.columns import MISSING, Columns, Wanted, convert, plain_names
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
    where = os.fspath(path)
    columns = convert(read_file(where, wanted, where), wanted, where, 1)
    return {**columns.numbers, **({time: columns.time} if time is not None and columns.time is not None else {})}


def read(data: Any, wanted: Wanted) -> tuple[Columns, dict[Hashable, str]]:
    """The wanted columns of a table, a file, or the concatenation of several files."""
    if not isinstance(data, str | os.PathLike | list | tuple):
        return convert(_frame(data), wanted, "the table", 0), {}
    paths = paths_of(data)
    if len(paths) == 1:
        return convert(read_file(paths[0], wanted, paths[0]), wanted, paths[0], 1), {}
    parts: dict[str, Columns] = {}
    failed: dict[Hashable, str] = {}
    for path in paths:
        try:
            frame = read_file(path, wanted, path)
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


def read_file(
    source: str | bytes, wanted: Wanted, where: str, separator: str | None = None, decimal: str = "."
) -> nw.DataFrame[Any]:
    """The wanted columns of one file, given by its path or its contents; `_csv` explains separator and decimal."""
    start = _start(source)
    parquet = start[:4] == b"PAR1" or (isinstance(source, str) and Path(source).suffix.lower() in (".parquet", ".pq"))
    try:
        if parquet:
            opened = io.BytesIO(source) if isinstance(source, bytes) else source
            names = list(pl.read_parquet_schema(opened))
            frame = pl.read_parquet(opened, columns=[name for name in names if name in wanted.names])
        else:
            names, frame = _csv(source, start, wanted, separator, decimal)
    except (pl.exceptions.PolarsError, UnicodeDecodeError) as error:
        text = " ".join(str(error).split())
        raise ValueError(f"{where} cannot be read as {'Parquet' if parquet else 'CSV'}: {text}") from None
    for name in (name for name in wanted.names if not (name == FILE and FILE in wanted.by)):
        if name not in names:
            raise ValueError(f"{where} has no column {name!r}: {near(name, names)}")
        if names.count(name) > 1:
            raise ValueError(f"{where} has {names.count(name)} columns {name!r}: rename those that are not meant.")
    if FILE in wanted.by and FILE not in names:
        frame = frame.with_columns(pl.lit(where).alias(FILE))
    if frame.height == 0:
        raise ValueError(f"{where} has a header but no rows.")
    return nw.from_native(frame, eager_only=True)


def _csv(
    source: str | bytes, start: bytes, wanted: Wanted, separator: str | None, decimal: str
) -> tuple[list[str], pl.DataFrame]:
    """(all column names, one that occurs twice as often as it occurs; the wanted columns as text).

    Without ``separator`` the header determines whether it is , ; or tab. ``decimal=","`` is for files that say so;
    with "." numbers may still have decimal commas where semicolons separate cells.
    """
    encoding = _encoding(start)
    text = start.decode(encoding, errors="replace").splitlines()
    header = next((line for line in text if not line.startswith("#")), "")
    declared = re.fullmatch(r"\ufeff?sep=(.)\s*", header, re.IGNORECASE)
    sign = declared[1] if declared else max(";\t" if decimal == "," else ",;\t", key=header.count)
    options: dict[str, Any] = {"infer_schema": False, "comment_prefix": "#", "separator": separator or sign}
    options |= {"encoding": encoding, "skip_rows": 1 if declared else 0}
    raw = pl.read_csv(source, n_rows=0, **options).columns
    cells = pl.read_csv(source, n_rows=1, has_header=False, **options).rows()[0]
    again = [str(cell) for k, cell in enumerate(cells) if cell in cells[:k]]  # polars gives these another name
    names = plain_names(raw, [name for name in wanted.names if name != FILE])
    chosen = {old: new for old, new in zip(raw, names, strict=True) if new in wanted.names}
    frame = pl.read_csv(source, columns=list(chosen), **options).rename(chosen)
    numbers = [frame[name] for name in wanted.numbers if name in frame.columns]
    if decimal == ",":
        frame = frame.with_columns(map(_points, numbers))
    elif options["separator"] == ";":
        commas = any(re.search(r"(^|;)[\s\"]*[+-]?[\d.]*,\d+[\s\"]*(;|$)", line) for line in text)
        frame = frame.with_columns(_with_points(column, commas) for column in numbers)
    whole = frame.select(pl.col(name).str.strip_chars() for name in wanted.by if name in frame.columns)
    return [*names, *again], frame.with_columns(_whole(column) for column in whole)


def _start(source: str | bytes) -> bytes:
    """The header and the first cells of a file."""
    if isinstance(source, bytes):
        return source[: 1 << 16]
    with open(source, "rb") as file:
        return file.read(1 << 16)


def _encoding(start: bytes) -> str:
    """The encoding of a file, judged by its header and its first cells."""
    if start.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    try:
        start[: start.rfind(b"\n") + 1 or None].decode("utf-8")
    except UnicodeDecodeError:
        return "windows-1252"
    return "utf8"


COMMA = r"^\s*[+-]?(\d+|\d{1,3}(\.\d{3})+)?(,\d*)?([eE][+-]?\d+)?\s*$"
"""A number with a decimal comma, perhaps with dots between thousands."""


GROUPED = r"^\s*[+-]?([1-9]\d{0,2}(\.\d{3})+|\d+)\s*$"
"""A whole number, perhaps with dots between thousands."""


def _with_points(text: pl.Series, commas: bool) -> pl.Series:
    """A column with decimal points instead of decimal commas, and without dots between thousands.

    In a file with decimal ``commas`` the dots of a column of whole numbers are between thousands too.
    """
    known = text.filter(~text.str.strip_chars().str.to_lowercase().is_in(MISSING))
    comma = known.str.contains(",", literal=True)
    if not comma.any():
        return _points(text) if commas and known.str.contains(GROUPED).all() else text
    if not known.filter(comma).str.contains(COMMA).all():
        return text
    if known.filter(~comma).str.contains(r"\.\d{0,2}$|\.\d{4,}").any():
        return text  # a mixture of both: the error message names the cell
    return _points(text)


def _points(text: pl.Series) -> pl.Series:
    """A column with a decimal point instead of a comma; points that group thousands are removed."""
    plain = text.str.replace_all(".", "", literal=True).str.replace(",", ".", literal=True)
    return plain.zip_with(text.str.contains(COMMA).fill_null(False), text)


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
