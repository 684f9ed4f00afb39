"""Files: CSV and Parquet, one or several, read with polars.

If some of several files cannot be read, they are left out with a warning and kept with their reasons. What is damaged
gives one error. CSV is read as text, so that messages can name a cell that is not a number.

Lines that begin with # are comments, unless their first cell is the error value of a spreadsheet, such as #N/A. The
header determines whether cells are separated by comma, semicolon, tab or bar, or a line such as ``sep=;`` before it,
which spreadsheets write. A row of units may follow it. Blank lines are left out; in a file of one column they are
missing readings, unless every line is followed by one. Separators at the end of a line are left out; a line with more
cells than the header is an error. Text that is neither UTF-8 nor UTF-16 is taken as Windows-1252.

With ``decimal=","`` numbers have a decimal comma, and dots between thousands: 1.234,5; nothing of it is guessed.
Columns are cells without blanks around them, null for those without a value (`driftfit.data.columns.present`)."""

from __future__ import annotations

import csv
import glob
import gzip
import io
import os
import re
import zlib
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import narwhals as nw
import numpy as np
import polars as pl

from driftfit.data.columns import ERROR, FILE, HISTORIANS, Columns, Wanted, convert, plain_names, present
from driftfit.data.limits import within
from driftfit.engine.kernel import Array
from driftfit.engine.settings import near, warn

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
    frame, words = every.slice(bool(units)).select(list(chosen)).rename(chosen), (*HISTORIANS, *wanted.missing)
    signals = [name for name in wanted.signals if name in frame.columns and wanted.decimal == ","]
    frame = frame.with_columns(points(present(frame[name], words)) for name in signals)
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


PLAIN = Wanted(())
"""Columns that are yet to be named, read without options."""


@dataclass(frozen=True)
class Files:
    """Files, which of their rows are used, and how they are read.

    ``paths`` is a path, a pattern or a list of them, or the content of a file. ``rows`` are the first and the last row
    of each file, counted from 1, and ``times`` the first and the last time; None is an open end. ``how`` says how their
    cells are read.
    """

    paths: Any
    rows: tuple[int, int | None] = (1, None)
    times: tuple[str | None, str | None] = (None, None)
    how: Wanted = PLAIN

    def columns(self, wanted: Wanted) -> tuple[Columns, dict[Hashable, str]]:
        """The wanted columns of all files, and the reasons why some of them cannot be read.

        A single one, or all of them, raise ValueError.
        """
        how = self.how
        wanted = replace(wanted, separator=how.separator, decimal=how.decimal, dates=how.dates)
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
            f"data must be a table (pandas, polars, pyarrow) or a path; got {type(data).__name__}."
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
        try:
            source = gzip.decompress(source if isinstance(source, bytes) else Path(source).read_bytes())
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            raise ValueError(f"{where} cannot be decompressed: {error}") from None
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
    for name in (name for name in wanted.names if name != FILE or FILE not in wanted.by):
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
    named = [any(isinstance(one, str) for one in column) for column in units]  # in some files by text, so in all
    return Columns(
        {name: np.concatenate([part.numbers[name] for part in parts.values()]) for name in first.numbers},
        np.concatenate(list(times.values())) if times else None,
        first.zone,
        [
            [str(one) if isinstance(one, int) else one for one in column] if text else column
            for column, text in zip(units, named, strict=True)
        ],
        sum(part.rows for part in parts.values()),
        first.units,
    )


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
