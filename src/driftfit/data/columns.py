"""Columns of tables as arrays: numbers, times and missing values, for every kind of table.

Null, NaN, infinite and empty cells are missing, and so are the texts NA, N/A, NaN, null and None. Anything else that is
not a number raises an error that names its row and its text.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date
from typing import Any

import narwhals as nw
import numpy as np
import polars as pl

from driftfit.data.times.instants import DAY, zone_name
from driftfit.data.times.periods import EXAMPLES, periods
from driftfit.engine.kernel import Array
from driftfit.engine.settings import as_numbers, near

MISSING = ("", "na", "n/a", "nan", "null", "none", "#n/a", ".")
"""Cell contents that mean "no value", in lower case; spreadsheets write #N/A, SAS and central banks a dot."""


FILE = "file"
"""The name with which ``by`` refers to the file that a row comes from."""


@dataclass(frozen=True)
class Wanted:
    """The columns to read: numbers, perhaps a time, and the columns that identify the series."""

    numbers: tuple[str, ...]
    time: str | None = None
    by: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys([*self.numbers, *([self.time] if self.time else []), *self.by]))


@dataclass(frozen=True)
class Columns:
    """The selected columns of one table: numbers (N,), times (N,) or None with their zone, and one list per ``by``."""

    numbers: Mapping[str, Array]
    time: Array | None
    zone: str | None
    by: Sequence[Sequence[Any]]
    rows: int


def convert(frame: nw.DataFrame[Any], wanted: Wanted, where: str, base: int, rows: slice | None = None) -> Columns:
    """The wanted columns of one table as arrays; ``base`` is the number of its first row.

    Of ``rows`` alone every cell is read; but the dates of all rows show whether their day or month comes first.
    """
    names = plain_names(frame.columns, wanted.names)
    if names != frame.columns:
        frame = frame.rename(dict(zip(frame.columns, names, strict=True)))
    for name in wanted.names:
        if name not in frame.columns:
            raise ValueError(f"{where} has no column {name!r}: {near(name, frame.columns)}")
    dates = None if wanted.time is None else frame[wanted.time]
    first = day_first(_as_text(dates)) if dates is not None and _is_text(dates) else None
    if rows is not None:
        frame, base = frame[rows], base + (rows.start or 0)
    time, zone = (None, None)
    if wanted.time is not None:
        time, zone = times_of_column(frame[wanted.time], where, base, first)
    numbers = {name: numbers_of(frame[name], where, base) for name in wanted.numbers}
    return Columns(numbers, time, zone, [_units(frame[name]) for name in wanted.by], len(frame))


def plain_names(names: Sequence[str], wanted: Sequence[str]) -> list[str]:
    """The names of columns; if a wanted one is absent, without blanks around them and doubled quotes of a CSV header.

    Names that would be the same then stay as they are.
    """
    plain = [name.strip().replace('""', '"') for name in names]
    absent = not set(wanted) <= set(names)
    return [new if absent and plain.count(new) == 1 else old for old, new in zip(names, plain, strict=True)]


def _is_text(series: nw.Series[Any]) -> bool:
    return series.dtype in (nw.String, nw.Categorical) or isinstance(series.dtype, nw.Enum)


def _as_text(series: nw.Series[Any]) -> pl.Series:
    """Cells without surrounding blanks; null if they mean "no value"."""
    cells = [cell if isinstance(cell, str) else None for cell in series.cast(nw.String).to_list()]
    text = pl.Series(series.name, cells, dtype=pl.String).str.strip_chars()
    return text.zip_with(~text.str.to_lowercase().is_in(MISSING), pl.Series([None], dtype=pl.String))


def numbers_of(series: nw.Series[Any], where: str, base: int) -> Array:
    """A column as floats, with NaN for missing values."""
    if _is_text(series):
        return _numbers_of_text(_as_text(series), where, base)
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
    if len(wrong):
        raise ValueError(
            f"{where}, row {wrong[0] + base} of column {text.name!r} holds {text[wrong[0]]!r}, which is not a number "
            f"({_count(len(wrong))}); {_advice(text[wrong[0]], wrong.to_list() == [0] and base == 1)}."
        )
    return np.array(values.fill_null(np.nan).to_numpy())


def _count(wrong: int) -> str:
    return "1 such cell" if wrong == 1 else f"{wrong} such cells"


def _advice(cell: str, second_line: bool) -> str:
    """What to do about a cell that is not a number."""
    if re.search(r"\d[ ,'\u00a0\u2019\u202f]\d{3}", cell):
        return "write numbers without signs between thousands"
    if re.fullmatch(r"[+-]?\d*,\d+", cell):
        return "write numbers with a decimal point, or, on the command line, give --decimal ,"
    if second_line and not re.search(r"\d", cell):
        return "if this line holds units, put # before it"
    return "leave a cell empty where there is no value"


def times_of_column(
    series: nw.Series[Any], where: str, base: int, first: bool | None = None
) -> tuple[Array, str | None]:
    """(numbers or datetime64 in UTC, zone); NaN or NaT for rows without a time.

    ``first``: whether dates such as 1/2/2024 begin with the day; None: the column shows it.
    """
    if _is_text(series):
        text = _as_text(series)
        compact = bool(text.drop_nulls().str.contains(f"^{DAY}$").all()) and text.null_count() < len(text)
        if not compact and text.cast(pl.Float64, strict=False).is_null().eq(text.is_null()).all():
            return _numbers_of_text(text, where, base), None
        series = nw.from_native(_dates_of_text(text, where, base, first), series_only=True)
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
    dates = [None if str(cell) in ("NaT", "<NA>", "nan") else cell for cell in cells]
    zones = {getattr(one, "tzinfo", None) for one in dates if isinstance(one, date)}
    if not zones:
        return None
    for k, one in enumerate(dates):
        if one is not None and not isinstance(one, date):
            raise ValueError(f"{where} {k + base} of the time holds {one!r}, which is not a date, as other rows do.")
    if None not in zones:
        dates = [None if one is None else one.astimezone(UTC).replace(tzinfo=None) for one in dates]
    elif len(zones) > 1:
        raise ValueError(f"{where}s of the time have dates with a zone and dates without; give all of them one.")
    names = {zone_name(zone) for zone in zones if zone is not None}
    return np.array(dates, dtype="datetime64[us]"), names.pop() if len(names) == 1 else "UTC" if names else None


DAY_FIRST = r"^(\d{1,2})([./-])(\d{1,2})[./-](\d{4})(?:[ T]+(\d{1,2}:\d{2}(?::\d{2}(?:\.\d+)?)?))?$"
"""31.1.2024, 31/01/2024 12:00, 1/31/2024: day, separator, month (or the reverse), year, time of day."""


def day_first(text: pl.Series) -> bool | None:
    """Whether dates that end with the year begin with the day; None if no cell shows it.

    With dots the day is first. With another separator a number above 12 shows which of the two it is.
    """
    dates = text.filter(text.str.contains(DAY_FIRST).fill_null(False))
    first, second = (dates.str.extract(DAY_FIRST, k).cast(pl.Int64) for k in (1, 3))
    if (len(dates) and (dates.str.extract(DAY_FIRST, 2) == ".").all()) or (first > 12).any():
        return True
    return False if (second > 12).any() else None


def year_first(text: pl.Series, where: str, begins: bool | None = None) -> pl.Series:
    """Dates that end with the year, or have no hyphens (20240131), as 2024-01-31; other columns as they are.

    ``begins``: whether they begin with the day; None: the column shows it, or ValueError.
    """
    known = text.drop_nulls()
    if len(known) and known.str.contains(f"^{DAY}$").all():
        return text.str.replace(r"^(....)(..)(..)$", "$1-$2-$3")
    if not len(known) or not known.str.contains(DAY_FIRST).all():
        return text
    first, second = (text.str.extract(DAY_FIRST, k).cast(pl.Int64) for k in (1, 3))
    begins = day_first(known) if begins is None else begins
    if begins is None:
        raise ValueError(
            f"{where}: the dates of column {text.name!r}, such as {known[0]!r}, may have the day or the month first, "
            "and none of them shows which; write them as 2024-01-31."
        )
    day, month = (first, second) if begins else (second, first)
    parts = pl.DataFrame({
        "year": text.str.extract(DAY_FIRST, 4), "month": month.cast(pl.String).str.zfill(2),
        "day": day.cast(pl.String).str.zfill(2), "clock": text.str.extract(DAY_FIRST, 5).fill_null("00:00:00"),
    })  # fmt: skip
    parts = parts.with_columns(clock=pl.when(pl.col("clock").str.count_matches(":") == 1).then(pl.col("clock") + ":00")
                               .otherwise(pl.col("clock")).str.replace(r"^(\d):", "0$1:"))  # fmt: skip
    dates = parts.select(pl.format("{}-{}-{} {}", "year", "month", "day", "clock")).to_series()
    return dates.alias(text.name).zip_with(text.is_not_null(), pl.Series([None], dtype=pl.String))


def _dates_of_text(text: pl.Series, where: str, base: int, first: bool | None) -> pl.Series:
    begin = periods(text.to_list())
    try:
        if begin is None:
            dates = year_first(text, where, first).str.to_datetime(time_unit="us", strict=False)
        else:
            dates = pl.Series(text.name, begin)
    except pl.exceptions.ComputeError:  # the first cells contain no date from which to infer the format
        dates = pl.Series(text.name, [None] * len(text), dtype=pl.Datetime("us"))
    wrong = (dates.is_null() & text.is_not_null()).arg_true()
    if len(wrong):
        raise ValueError(
            f"{where}, row {wrong[0] + base} of column {text.name!r} holds {text[wrong[0]]!r}, which is neither a "
            "number nor a date in the form of the column's first cells (2024-01-31, 2024-01-31 12:00:00, or a period "
            f"as in {EXAMPLES})."
        )
    return dates


def _units(series: nw.Series[Any]) -> list[Any]:
    """The unit of every row, or None, in the type of the column: the parts of a table agree on it."""
    if not _is_text(series):
        return [None if value is None or value != value else value for value in series.to_list()]
    return _as_text(series).to_list()
