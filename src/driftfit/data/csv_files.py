"""CSV files, read as text so that messages can name a cell that is not a number.

Lines that begin with # are comments, unless their first cell is the error value of a spreadsheet, such as #N/A. The
header determines whether cells are separated by comma, semicolon, tab or bar, or a line such as ``sep=;`` before it,
which spreadsheets write. A row of units may follow it. Blank lines are left out; in a file of one column they are
missing readings, unless every line is followed by one. Separators at the end of a line are left out; a line with more
cells than the header is an error. Text that is neither UTF-8 nor UTF-16 is taken as Windows-1252.

With ``decimal=","`` numbers have a decimal comma, and dots between thousands: 1.234,5; nothing of it is guessed.
Columns are cells without blanks around them, null for those without a value (`driftfit.data.columns.present`).
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import polars as pl

from driftfit.data.columns import ERROR, FILE, HISTORIANS, Wanted, plain_names, present

PROBE_BYTES = 1 << 16
"""The bytes from which the separator and units are judged."""

RUN = r"^[=+\-@\t\r]"
"""How a text begins that spreadsheets run as a formula."""

DECLARED = re.compile(r"\ufeff?sep=(.)\s*$", re.IGNORECASE)
"""A first line with which spreadsheets say what separates cells."""

WHOLE_BYTES = 1 << 26
"""Bytes of a file up to which all columns are read: only then polars reports lines with more cells than the header."""

SEPARATORS = ",;\t|"
COMMENT = re.compile(rf"#(?!{ERROR[1:]}\s*([{SEPARATORS}]|$))", re.IGNORECASE)
VALUE = re.compile(r"[+-]?[.,]?\d(?!/[A-Za-z])")
"""How a number or a date begins, other than the unit 1/s."""


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
        return source[:PROBE_BYTES]
    with open(source, "rb") as file:
        return file.read(PROBE_BYTES)


def read_csv(source: str | bytes, wanted: Wanted) -> tuple[list[str], pl.DataFrame, dict[str, str]]:
    """The names of all columns of a CSV file, the wanted columns as text, and the units of a row of units.

    A name that several columns have is listed as often as it occurs. Without ``wanted.separator`` the header shows what
    separates cells.
    """
    content = source if isinstance(source, bytes) else Path(source).read_bytes()
    if encoding := _encoding(content[:PROBE_BYTES]):
        content = content.decode(encoding, errors="replace").encode()
    start = content[:PROBE_BYTES]
    end = b"\r" if b"\r" in start and b"\n" not in start else b"\n"
    lines = _lines(start)
    declared = DECLARED.match(lines[0]) if lines else None
    lines = lines[1:] if declared else lines
    signs = SEPARATORS[1:] if wanted.decimal == "," else SEPARATORS
    sign = wanted.separator or (declared[1] if declared else _separator(lines, signs))
    content = _mended(content, end, sign, alone=not any(sign in line for line in lines))
    options: dict[str, Any] = {"infer_schema": False, "comment_prefix": "#", "separator": sign}
    options |= {"eol_char": end.decode(), "skip_rows": 1 if declared else 0}
    raw = pl.read_csv(content, n_rows=0, truncate_ragged_lines=True, **options).columns
    copies = (re.fullmatch(r"(.*)_duplicated_\d+", name) for name in raw)  # as polars calls them
    again = [copy[1] for copy in copies if copy and copy[1] in raw]
    names = plain_names(raw, [name for name in wanted.names if name != FILE])
    chosen = {old: new for old, new in zip(raw, names, strict=True) if new in wanted.names}
    read = None if len(content) <= WHOLE_BYTES else list(chosen)
    try:
        every = pl.read_csv(content, columns=read, **options)
    except pl.exceptions.ComputeError as error:
        if "utf-8" in str(error):  # the first cells do not show the encoding
            return read_csv(content.decode("windows-1252", errors="replace").encode(), wanted)
        _check_widths(content, sign, len(raw))
        every = pl.read_csv(content, columns=read, truncate_ragged_lines=True, **options)
    units = _units(list(csv.reader(lines, delimiter=sign))[1:], names, wanted)
    frame = every.slice(bool(units)).select(list(chosen)).rename(chosen)
    if wanted.decimal == ",":
        words = (*HISTORIANS, *wanted.missing)
        frame = frame.with_columns(
            points(present(frame[name], words)) for name in wanted.signals if name in frame.columns
        )
    keys = frame.select(pl.col(name).str.strip_chars() for name in wanted.by if name in frame.columns)
    return [*names, *again], frame.with_columns(_whole(column) for column in keys), units


def _mended(content: bytes, end: bytes, sign: str, alone: bool) -> bytes:
    """A file in which error values at the beginnings of lines are quoted, so that they are no comments, and blank lines
    are left out unless they are missing readings of a column that is ``alone``.
    """
    after = rb"(?=[ \t]*(?:" + re.escape(sign.encode()) + rb"|[\r\n]|\Z))"
    content = re.sub(end + rb"(" + ERROR.encode() + rb")" + after, end + rb'"\1"', content, flags=re.IGNORECASE)
    if alone and any(line.strip() for line in content[:PROBE_BYTES].split(end)[1::2]):
        return content
    return re.sub(end + rb"[ \t\r]*(?=" + end + rb")", b"", content)


def _lines(start: bytes) -> list[str]:
    """The first lines of a file, without blank ones, comments, and one that the end of the probe cuts off."""
    lines = start.decode(errors="replace").removeprefix("\ufeff").splitlines()
    whole = lines[:-1] if len(start) == PROBE_BYTES and len(lines) > 1 else lines
    return [line for line in whole if line.strip() and not COMMENT.match(line)]


def _units(rows: Sequence[Sequence[str]], names: Sequence[str], wanted: Wanted) -> dict[str, str]:
    """The units of the wanted numbers, if the first line below the header holds them.

    It is such a line if it has no number and no cell that its column holds again.
    """
    first = [cell.strip() for cell in rows[0]] if len(rows) > 1 else []
    for k, cell in enumerate(first):
        again = (row[k].strip() == cell for row in rows[1:] if k < len(row))
        if cell and (VALUE.match(cell) or any(again)):
            return {}
    found = dict(zip(names, present(pl.Series(first, dtype=pl.String), (*HISTORIANS, *wanted.missing)), strict=False))
    return {name: unit.strip("[]() ") for name in wanted.numbers if (unit := found.get(name))}


def _encoding(start: bytes) -> str | None:
    """The encoding of a file, judged by its header and its first cells; None for UTF-8."""
    if start.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    if 0 in start[:2]:  # UTF-16 without a byte order mark: every other byte of plain letters is 0
        return "utf-16-be" if start[0] == 0 else "utf-16-le"
    try:
        start[: start.rfind(b"\n") + 1 or None].decode("utf-8")
    except UnicodeDecodeError:
        return "windows-1252"
    return None


def _separator(lines: Sequence[str], signs: str) -> str:
    """The sign that divides the header into cells, of which the next lines have as many."""

    def fit(sign: str) -> tuple[float, int]:
        width, *widths = [len(row) for row in csv.reader(lines[:50], delimiter=sign)] or [0]
        return (widths.count(width) / max(len(widths), 1) if width > 1 else 0.0), width

    return max(signs, key=fit)


def _check_widths(content: bytes, sign: str, width: int) -> None:
    """ValueError for the first row that has cells beyond the ``width`` of the header that are not empty."""
    with io.TextIOWrapper(io.BytesIO(content), "utf8") as file:
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


COMMA = r"^[+-]?(\d+|\d{1,3}(\.\d{3})+)?(,\d*)?([eE][+-]?\d+)?$"
"""A number with a decimal comma, perhaps with dots between thousands."""


def points(text: pl.Series) -> pl.Series:
    """A column with a decimal point instead of a comma; points that group thousands are removed."""
    plain = text.str.replace_all(".", "", literal=True).str.replace(",", ".", literal=True)
    return plain.zip_with(text.str.contains(COMMA).fill_null(False), text)
