"""CSV files, read as text so that messages can name a cell that is not a number.

Lines that begin with # are comments. The header determines whether cells are separated by comma, semicolon or tab, or a
line such as ``sep=;`` before it, which spreadsheets write. Separators at the end of a line are left out; a line with
more cells than the header is an error. Text that is neither UTF-8 nor UTF-16 is taken as Windows-1252.
"""

from __future__ import annotations

import csv
import io
import itertools
import os
import re
from collections.abc import Sequence
from typing import Any

import polars as pl

from driftfit.data.columns import FILE, Wanted, plain_names
from driftfit.data.formats.decimal_commas import points, with_points

PROBE = 1 << 16
"""The bytes from which the separator, the encoding and the decimal sign are judged."""

RUN = r"^[=+\-@\t\r]"
"""How a text begins that spreadsheets run as a formula."""

DECLARED = re.compile(r"\ufeff?sep=(.)\s*$", re.IGNORECASE)
"""A first line with which spreadsheets say what separates cells."""

CHECKED = 1 << 26
"""Bytes of a file up to which all columns are read: only then polars reports lines with more cells than the header."""


def without_formulas(table: pl.DataFrame) -> pl.DataFrame:
    """A table for spreadsheets: a text or name that they would run begins with an apostrophe.

    A text that is a number, as in "-5", is none of them.
    """

    def quoted(column: pl.Series) -> pl.Series:
        texts = column.cast(pl.String)
        runs = texts.str.contains(RUN) & texts.cast(pl.Float64, strict=False).is_null()
        return ("'" + texts).zip_with(runs.fill_null(False), texts).alias(column.name)

    texts = [quoted(column) for column in table if column.dtype in (pl.String, pl.Categorical, pl.Enum)]
    names = quoted(pl.Series(values=table.columns, dtype=pl.String))
    return table.with_columns(texts).rename(dict(zip(table.columns, names, strict=True)))


def start_of(source: str | bytes) -> bytes:
    """The header and the first cells of a file, given by its path or its contents."""
    if isinstance(source, bytes):
        return source[:PROBE]
    with open(source, "rb") as file:
        return file.read(PROBE)


def read_csv(
    source: str | bytes, wanted: Wanted, separator: str | None, decimal: str
) -> tuple[list[str], pl.DataFrame]:
    """Return the names of all columns of a CSV file, and the wanted columns as text.

    A name that several columns have is listed as often as it occurs. Without ``separator`` the header shows whether
    cells are separated by a comma, a semicolon or a tab. With ``decimal=","`` every number may have a decimal comma;
    with "." only those of a file whose cells are separated by semicolons.
    """
    start = start_of(source)
    encoding = _encoding(start)
    lines = _lines(start, encoding)
    declared = DECLARED.match(lines[0]) if lines else None
    lines = lines[1:] if declared else lines
    sign = separator or (declared[1] if declared else _separator(lines, ";\t" if decimal == "," else ",;\t"))
    end = "\r" if b"\r" in start and b"\n" not in start else "\n"
    options: dict[str, Any] = {"infer_schema": False, "comment_prefix": "#", "separator": sign, "eol_char": end}
    options |= {"encoding": encoding, "skip_rows": 1 if declared else 0}
    raw = pl.read_csv(source, n_rows=0, truncate_ragged_lines=True, **options).columns
    copies = (re.fullmatch(r"(.*)_duplicated_\d+", name) for name in raw)  # as polars calls them
    again = [copy[1] for copy in copies if copy and copy[1] in raw]
    names = plain_names(raw, [name for name in wanted.names if name != FILE])
    chosen = {old: new for old, new in zip(raw, names, strict=True) if new in wanted.names}
    read = None if _size(source) <= CHECKED else list(chosen)
    try:
        every = pl.read_csv(source, columns=read, **options)
    except pl.exceptions.ComputeError:
        _check_widths(source, encoding, sign, len(raw))
        every = pl.read_csv(source, columns=read, truncate_ragged_lines=True, **options)
    frame = every.select(list(chosen)).rename(chosen)
    numbers = [frame[name] for name in dict.fromkeys((*wanted.numbers, wanted.time)) if name in frame.columns]
    if decimal == ",":
        frame = frame.with_columns(map(points, numbers))
    elif sign == ";":
        others = every if read is None else _cells(lines, sign)
        frame = frame.with_columns(with_points(numbers, others.get_columns()))
    units = frame.select(pl.col(name).str.strip_chars() for name in wanted.by if name in frame.columns)
    return [*names, *again], frame.with_columns(_whole(column) for column in units)


def _size(source: str | bytes) -> int:
    return len(source) if isinstance(source, bytes) else os.path.getsize(source)


def _lines(start: bytes, encoding: str) -> list[str]:
    """The first lines of a file, without blank ones, comments, and one that the end of the probe cuts off."""
    lines = start.decode(encoding, errors="replace").removeprefix("\ufeff").splitlines()
    whole = lines[:-1] if len(start) == PROBE and len(lines) > 1 else lines
    return [line for line in whole if line.strip() and not line.startswith("#")]


def _cells(lines: Sequence[str], sign: str) -> pl.DataFrame:
    """The cells of the first lines of a file below the header."""
    rows = list(csv.reader(lines, delimiter=sign))[1:]
    return pl.DataFrame(
        [pl.Series(str(k), cells) for k, cells in enumerate(itertools.zip_longest(*rows, fillvalue=""))]
    )


def _encoding(start: bytes) -> str:
    """The encoding of a file, judged by its header and its first cells."""
    if start.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    if 0 in start[:2]:  # UTF-16 without a byte order mark: every other byte of plain letters is 0
        return "utf-16-be" if start[0] == 0 else "utf-16-le"
    try:
        start[: start.rfind(b"\n") + 1 or None].decode("utf-8")
    except UnicodeDecodeError:
        return "windows-1252"
    return "utf8"


def _separator(lines: Sequence[str], signs: str) -> str:
    """The sign that divides the header into cells, of which the next lines have as many."""

    def fit(sign: str) -> tuple[float, int]:
        width, *widths = [len(row) for row in csv.reader(lines[:50], delimiter=sign)] or [0]
        return (widths.count(width) / max(len(widths), 1) if width > 1 else 0.0), width

    return max(signs, key=fit)


def _check_widths(source: str | bytes, encoding: str, sign: str, width: int) -> None:
    """ValueError for the first row that has cells beyond the ``width`` of the header that are not empty."""
    with io.TextIOWrapper(io.BytesIO(source) if isinstance(source, bytes) else open(source, "rb"), encoding) as file:
        rows = csv.reader(
            (line for line in file if not line.startswith("#") and not DECLARED.match(line)), delimiter=sign
        )
        header = next((row for row in rows if row), [])
        for k, row in enumerate(rows, 1):
            if any(cell.strip() for cell in row[width:]):
                raise ValueError(
                    f"row {k} has {len(row)} cells, but the header ({', '.join(header)[:60]}) has {width}. Quote cells "
                    "that contain the separator, and put # before lines that are not part of the table."
                )


def _whole(text: pl.Series) -> pl.Series:
    """A column that names units. In a file of text it has no type; it becomes integers if every cell is one."""
    whole = text.cast(pl.Int64, strict=False)
    return whole if whole.cast(pl.String).eq_missing(text).all() else text
