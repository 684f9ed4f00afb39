"""Columns of tables as arrays: numbers, times and missing values, for every kind of table.

Null, NaN, infinite and empty cells are missing, and so are the texts in `MISSING`, the error values of spreadsheets
(`ERROR`), among numbers and times the states of plant historians (`HISTORIANS`), and the texts that the user names.
Anything else that is not a number raises an error that names its row and its text.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date
from typing import Any

import narwhals as nw
import numpy as np
import polars as pl

from driftfit.data.instants import DAY, EXAMPLES, dates, periods, zone_name
from driftfit.engine.kernel import Array
from driftfit.engine.settings import ABSENT, as_numbers, near

MISSING = ("", "na", "n/a", "nan", "null", "none", ".", "-")
"""Cell contents that mean "no value", in lower case; SAS and central banks write a dot."""

HISTORIANS = (
    "bad", "bad data", "bad input", "bad output", "calc failed", "comm fail", "i/o timeout", "intf shut", "no data",
    "no result", "no sample", "not connect", "out of serv", "over range", "pt created", "scan off", "scan timeout",
    "shutdown", "under range",
)  # fmt: skip
"""States that plant historians write instead of a reading, in lower case (the system digital states of PI)."""

ERROR = r"#(?:[^\s,;|]*[!?]|N/A(?: N/A)?|N/D|NV|GETTING_DATA|##+)"
"""Error values of spreadsheets in several languages: #DIV/0! #N/A #NV #NAME? #WERT! #####."""

FILE = "file"
"""The name with which ``by`` refers to the file that a row comes from."""


@dataclass(frozen=True)
class Wanted:
    """The columns to read: numbers, perhaps a time, and the columns that identify the series; and how they are read.

    ``missing`` are further texts that mean "no value". In CSV files ``separator`` divides lines into cells, and
    ``decimal`` is the decimal sign, "." or ",". ``dates`` is the form of dates as in Python, "%d.%m.%Y %H:%M"; None:
    the year is first.
    """

    numbers: tuple[str, ...]
    time: str | None = None
    by: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    separator: str | None = None
    decimal: str = "."
    dates: str | None = None

    @property
    def signals(self) -> tuple[str, ...]:
        """The columns of numbers, and that of the time."""
        return tuple(dict.fromkeys([*self.numbers, *([self.time] if self.time else [])]))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys([*self.signals, *self.by]))


@dataclass(frozen=True)
class Columns:
    """The selected columns of one table: numbers (N,), times (N,) or None with their zone, and one list per ``by``."""

    numbers: Mapping[str, Array]
    time: Array | None
    zone: str | None
    by: Sequence[Sequence[Any]]
    rows: int
    units: Mapping[str, str] = field(default_factory=dict)
    """Units of numbers, of a file that has a row of them."""


def convert(frame: nw.DataFrame[Any], wanted: Wanted, where: str, base: int, rows: slice | None = None) -> Columns:
    """The wanted columns of a table, or of some of its ``rows``, as arrays; ``base`` is the number of its first row."""
    names = plain_names(frame.columns, wanted.names)
    if names != frame.columns:
        frame = frame.rename(dict(zip(frame.columns, names, strict=True)))
    for name in wanted.names:
        if name not in frame.columns:
            raise ValueError(f"{where} has no column {name!r}: {near(name, frame.columns)}")
    if rows is not None:
        frame, base = frame[rows], base + (rows.start or 0)
    time, zone = (None, None)
    if wanted.time is not None:
        time, zone = times_of_column(frame[wanted.time], where, base, wanted.dates, wanted.missing)
    numbers = {name: numbers_of(frame[name], where, base, wanted.missing) for name in wanted.numbers}
    keys = [  # in the type of the column: the parts of a table agree on it
        _as_text(one, wanted.missing).to_list() if _is_text(one) else _values(one.to_list())
        for one in (frame[name] for name in wanted.by)
    ]
    return Columns(numbers, time, zone, keys, len(frame))


def plain_names(names: Sequence[str], wanted: Sequence[str]) -> list[str]:
    """The names of columns; if a wanted one is absent, without blanks around them and doubled quotes of a CSV header.

    Names that would be the same then stay as they are.
    """
    plain = [name.strip().replace('""', '"') for name in names]
    absent = not set(wanted) <= set(names)
    return [new if absent and plain.count(new) == 1 else old for old, new in zip(names, plain, strict=True)]


def _is_text(series: nw.Series[Any]) -> bool:
    return series.dtype in (nw.String, nw.Categorical) or isinstance(series.dtype, nw.Enum)


def _as_text(series: nw.Series[Any], missing: Sequence[str]) -> pl.Series:
    """Cells without surrounding blanks; null if they mean "no value"."""
    text = series.cast(nw.String)
    native: Any = text.to_native()
    if not isinstance(native, pl.Series):
        cells = [cell if isinstance(cell, str) else None for cell in text.to_list()]
        native = pl.Series(series.name, cells, dtype=pl.String)
    return present(native, missing)


def present(text: pl.Series, missing: Sequence[str]) -> pl.Series:
    """Cells without surrounding blanks; null if they mean "no value", also if they are one of the texts ``missing``."""
    text = text.str.strip_chars()
    none = text.str.to_lowercase().is_in([*MISSING, *(word.strip().lower() for word in missing)])
    none |= text.str.contains(f"(?i)^{ERROR}$").fill_null(False)
    return text.zip_with(~none, pl.Series([None], dtype=pl.String))


def numbers_of(series: nw.Series[Any], where: str, base: int, missing: Sequence[str] = ()) -> Array:
    """A column as floats, with NaN for missing values."""
    if _is_text(series):
        return _numbers_of_text(_as_text(series, (*HISTORIANS, *missing)), where, base)
    if series.dtype == nw.Object:  # decimals, None and other Python objects in one column
        return as_numbers(f"{where}, column {series.name!r}", series.to_list())
    if series.dtype == nw.Unknown and series.null_count() == len(series):  # a column in which nothing was ever written
        return np.full(len(series), np.nan)
    if not (series.dtype.is_numeric() or series.dtype == nw.Boolean):
        raise ValueError(f"{where}: column {series.name!r} is of type {series.dtype}, which is not a number.")
    return np.asarray(series.cast(nw.Float64).to_numpy(), dtype=float)


def _numbers_of_text(text: pl.Series, where: str, base: int) -> Array:
    values = text.cast(pl.Float64, strict=False)
    wrong = (values.is_null() & text.is_not_null()).arg_true()
    if count := len(wrong):
        cell, cells = text[wrong[0]], "1 such cell" if count == 1 else f"{count} such cells"
        raise ValueError(
            f"{where}, row {wrong[0] + base} of column {text.name!r} holds {cell!r}, which is not a number ({cells}); "
            f"{_advice(cell, wrong.to_list() == [0] and base == 1)}."
        )
    return np.array(values.fill_null(np.nan).to_numpy())


def _advice(cell: str, second_line: bool) -> str:
    """What to do about a cell that is not a number."""
    if re.search(r"\d[ ,'\u00a0\u2019\u202f]\d{3}", cell):
        return "write numbers without signs between thousands"
    if re.fullmatch(r"[+-]?[\d.]*,\d+", cell):
        return (
            "for decimal commas give --decimal , on the command line, or pass the table that "
            "polars.read_csv(.., decimal_comma=True) reads"
        )
    if second_line and not re.search(r"\d", cell):
        return "if this line holds units, put # before it"
    return "leave a cell empty where there is no value; a category needs a column of 0 and 1 for each of its values"


def times_of_column(
    series: nw.Series[Any], where: str, base: int, form: str | None = None, missing: Sequence[str] = ()
) -> tuple[Array, str | None]:
    """(numbers or datetime64 in UTC, zone); NaN or NaT for rows without a time. ``form`` is that of dates as text."""
    if _is_text(series):
        text = _as_text(series, (*HISTORIANS, *missing))
        compact = bool(text.drop_nulls().str.contains(f"^{DAY}$").all()) and text.null_count() < len(text)
        if form is None and not compact and text.cast(pl.Float64, strict=False).is_null().eq(text.is_null()).all():
            return _numbers_of_text(text, where, base), None
        series = nw.from_native(_dates_of_text(text, where, base, form), series_only=True)
    native: Any = series.to_native()
    if str(getattr(native, "dtype", "")).startswith("period["):  # pandas: periods, which narwhals does not know
        return np.asarray(native.dt.to_timestamp().to_numpy()), None
    if (
        hasattr(native, "dt") and getattr(native.dtype, "tz", None) is not None
    ):  # narwhals does not support all zones of pandas
        return np.asarray(native.dt.tz_convert(None).to_numpy()), zone_name(native.dtype.tz)
    if series.dtype == nw.Object and (found := _dates_of_objects(series.to_list(), f"{where}, row", base)) is not None:
        return found
    if series.dtype == nw.Date:
        series = series.cast(nw.Datetime("us"))
    if not isinstance(series.dtype, nw.Datetime):
        return numbers_of(series, where, base), None
    zone = series.dtype.time_zone
    if zone is not None:
        series = series.dt.convert_time_zone("UTC").dt.replace_time_zone(None)
    return np.asarray(series.to_numpy()), None if zone is None else zone_name(zone)


def _dates_of_objects(cells: list[Any], where: str, base: int) -> tuple[Array, str | None] | None:
    """Dates, or datetimes of any zones, as databases and pandas give them; None if no cell holds one."""
    days = _values(cells)
    zones = {getattr(one, "tzinfo", None) for one in days if isinstance(one, date)}
    if not zones:
        return None
    for k, one in enumerate(days):
        if one is not None and not isinstance(one, date):
            raise ValueError(f"{where} {k + base} of the time holds {one!r}, which is not a date, as other rows do.")
    if None not in zones:
        days = [None if one is None else one.astimezone(UTC).replace(tzinfo=None) for one in days]
    elif len(zones) > 1:
        raise ValueError(f"{where}s of the time have dates with a zone and dates without; give all of them one.")
    names = {zone_name(zone) for zone in zones if zone is not None}
    return np.array(days, dtype="datetime64[us]"), names.pop() if len(names) == 1 else "UTC" if names else None


def _dates_of_text(text: pl.Series, where: str, base: int, form: str | None) -> pl.Series:
    begin = None if form else periods(text.to_list())
    found = dates(text, form) if begin is None else pl.Series(text.name, begin)
    wrong = (found.is_null() & text.is_not_null()).arg_true()
    if len(wrong):
        form = form or f"2024-01-31, 2024-01-31 12:00:00, or a period as in {EXAMPLES}"
        raise ValueError(
            f"{where}, row {wrong[0] + base} of column {text.name!r} holds {text[wrong[0]]!r}, which is neither a "
            f"number nor a date in the form {form}; for another give --dates '%d.%m.%Y %H:%M' on the command line, "
            f"or pass the table with polars.col({text.name!r}).str.to_datetime('%d.%m.%Y %H:%M')."
        )
    return found


def _values(cells: Iterable[Any]) -> list[Any]:
    """Cells, with None for those without a value."""
    return [None if str(cell) in (*ABSENT, "nan") else cell for cell in cells]
