"""CSV files, read as text so that messages can name a cell that is not a number.

Lines that begin with # are comments, unless their first cell is the error value of a spreadsheet, such as #N/A. The
header determines whether cells are separated by comma, semicolon, tab or bar, or a line such as ``sep=;`` before it,
which spreadsheets write. A row of units may follow it. Blank lines are left out; in a file of one column they are
missing readings, unless every line is followed by one. Separators at the end of a line are left out; a line with more
cells than the header is an error. Text that is neither UTF-8 nor UTF-16 is taken as Windows-1252.

Numbers may have a decimal comma, and dots between thousands: 1.234,5. Columns are cells without blanks around them,
null for those without a value (`driftfit.data.columns.present`).
"""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import polars as pl

from driftfit.data.columns import ERROR, FILE, HISTORIANS, Wanted, plain_names, present
from driftfit.data.instants import is_date

PROBE_BYTES = 1 << 16
"""The bytes from which the separator, the decimal sign and units are judged."""

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
    separates cells. With ``wanted.decimal`` of "," every number may have a decimal comma, with "." none; without it
    those of a file whose cells are not separated by commas.
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
    rows = list(csv.reader(lines, delimiter=sign))[1:]
    units = _units(rows, names, wanted)
    every, rows = every.slice(bool(units)), rows[bool(units) :]
    frame = every.select(list(chosen)).rename(chosen)
    words = (*HISTORIANS, *wanted.missing)
    numbers = [present(frame[name], words) for name in wanted.signals if name in frame.columns]
    if wanted.decimal == ",":
        frame = frame.with_columns(map(points, numbers))
    elif wanted.decimal is None and sign != ",":
        others = every.get_columns() if read is None else _columns(rows)
        frame = frame.with_columns(with_points(numbers, (present(other, words) for other in others)))
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


def _columns(rows: Sequence[Sequence[str]]) -> list[pl.Series]:
    """Columns of cells, of lines that may differ in length."""
    return [pl.Series(str(k), cells) for k, cells in enumerate(itertools.zip_longest(*rows, fillvalue=""))]


def _units(rows: Sequence[Sequence[str]], names: Sequence[str], wanted: Wanted) -> dict[str, str]:
    """The units of the wanted numbers, if the first line below the header holds them.

    It is such a line if it has no number, no date, and no cell that its column holds again.
    """
    first = [cell.strip() for cell in rows[0]] if len(rows) > 1 else []
    for k, cell in enumerate(first):
        again = (row[k].strip() == cell for row in rows[1:] if k < len(row))
        if cell and (VALUE.match(cell) or is_date(cell) or any(again)):
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

GROUPED = r"^[+-]?([1-9]\d{0,2}(\.\d{3})+|\d+)$"
"""A whole number, perhaps with dots between thousands."""

POINT = r"^[+-]?\d*\.(\d{0,2}|\d{4,})([eE][+-]?\d+)?$"
"""A number with a decimal point, which cannot be between thousands."""


def with_points(columns: Sequence[pl.Series], others: Iterable[pl.Series]) -> list[pl.Series]:
    """Columns of a file with decimal points instead of decimal commas, and without dots between thousands.

    ``others`` are all columns of the file, or the beginning of each: decimal commas in one of them say that the dots in
    columns of whole numbers are between thousands, and a decimal point that commas may be between thousands. If there
    are both, or text among the decimal commas, such dots raise a ValueError.
    """
    if not any(map(_doubtful, columns)):
        return [_with_points(column, False, False) for column in columns]
    every = [column.drop_nulls() for column in [*columns, *others]]
    pointed = any(column.str.contains(POINT).any() for column in every)
    commas = [column for column in every if (column.str.contains(COMMA) & column.str.contains(",", literal=True)).any()]
    pure = bool(commas) and not pointed and all(column.str.contains(COMMA).all() for column in commas)
    for column in columns if commas and not pure else ():
        if _doubtful(column) and not column.str.contains(",", literal=True).any():
            dot = column.filter(column.str.contains(".", literal=True).fill_null(False))[0]
            raise ValueError(
                f"the dot in {dot} of column {column.name!r} may be a decimal point or stand between thousands: "
                f"the file has decimal commas and {'decimal points' if pointed else 'text among them'}. Give "
                "--decimal , or --decimal . on the command line, or pass the table that "
                "polars.read_csv(.., decimal_comma=True) reads."
            )
    return [_with_points(column, pure, pointed) for column in columns]


def _doubtful(text: pl.Series) -> bool:
    """Whether only other columns can show if all signs of a column are decimal ones or between thousands."""
    known = text.drop_nulls()
    commas = known.filter(known.str.contains(",", literal=True))
    if len(commas):
        return bool(commas.str.contains(r",\d{3}$").all())
    return bool(known.str.contains(".", literal=True).any() and known.str.contains(GROUPED).all())


def points(text: pl.Series) -> pl.Series:
    """A column with a decimal point instead of a comma; points that group thousands are removed."""
    plain = text.str.replace_all(".", "", literal=True).str.replace(",", ".", literal=True)
    return plain.zip_with(text.str.contains(COMMA).fill_null(False), text)


def _with_points(text: pl.Series, commas: bool, pointed: bool) -> pl.Series:
    """One column of a file in which others have decimal ``commas``, or some cells are ``pointed``."""
    known = text.drop_nulls()
    comma = known.filter(known.str.contains(",", literal=True))
    if not len(comma):
        return points(text) if commas and known.str.contains(GROUPED).all() else text
    mixed = not comma.str.contains(COMMA).all() or known.str.contains(POINT).any()
    if mixed or (pointed and comma.str.contains(r",\d{3}$").all()):
        return text  # the error message names the cell
    return points(text)
