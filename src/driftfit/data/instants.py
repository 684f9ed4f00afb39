"""Times and dates as users give them: as floats, or as datetime64 in UTC with the name of their zone.

Dates in text have the year first, or the form that the reader is given; what may be the day and what the month is never
guessed:

2024-01-31  2024-01-31 12:00:00  2024/01/31 9:30  20240131

Periods in text, as statistical offices and pandas write them; the time of a period is its first moment:

1970Q1  1970-Q1  1970 Q1  1970:1Q  Q1 1970  1Q1970                           quarters
2020M03  2020-M3  2020 Mar  March 2020  Mar-2020  2020-03  03/2020           months
2020-W05  2020W05  2020 W5  2020-W05-3                                       weeks of ISO 8601, and days of these
2020H1  2020-S2                                                              half-years
2020-01-27/2020-02-02                                                        a period by its first and last day
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, date, datetime, timedelta
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import polars as pl

from driftfit.engine.kernel import Array
from driftfit.engine.settings import ABSENT, warn


def dates(text: pl.Series, form: str | None = None) -> pl.Series:
    """The dates of a column of text without blanks around it, in a form or with the year first; null for others."""
    if form is None and text.drop_nulls().str.contains(f"^{DAY}$").all():
        form = "%Y%m%d"
    if form is None:
        text = text.zip_with(text.str.contains(YEAR_FIRST).fill_null(False), pl.Series([None], dtype=pl.String))
    try:
        return text.str.to_datetime(form, time_unit="us", strict=False)
    except pl.exceptions.ComputeError:  # no cell from which to infer the form
        return pl.Series(text.name, [None] * len(text), dtype=pl.Datetime("us"))


_SEP = r"[\s:./_-]*"
_YEAR, _NAMED = r"(?P<year>\d{4})", r"(?P<name>[A-Za-z]{3,9})\.?"
_STEPS = tuple(
    (re.compile(pattern, re.IGNORECASE), months)
    for pattern, months in (
        (rf"{_YEAR}{_SEP}q(?P<part>[1-4])", 3),
        (rf"{_YEAR}{_SEP}(?P<part>[1-4])q", 3),
        (rf"q(?P<part>[1-4]){_SEP}{_YEAR}", 3),
        (rf"(?P<part>[1-4])q{_SEP}{_YEAR}", 3),
        (rf"{_YEAR}{_SEP}m(?P<part>\d\d?)", 1),
        (rf"{_YEAR}[-/](?P<part>\d\d?)", 1),
        (rf"(?P<part>\d\d?)[-/]{_YEAR}", 1),
        (rf"{_YEAR}{_SEP}[hs](?P<part>[12])", 6),
    )
)
_MONTHS = tuple(re.compile(pattern) for pattern in (rf"{_YEAR}{_SEP}{_NAMED}", rf"{_NAMED}{_SEP}{_YEAR}"))
_WEEK = re.compile(rf"{_YEAR}{_SEP}w(?P<week>\d\d?)(?:-?(?P<day>[1-7]))?", re.IGNORECASE)
_RANGE = re.compile(r"(\d{4}-\d\d-\d\d)/(\d{4}-\d\d-\d\d)")
_NAMES = (
    "january", "february", "march", "april", "may", "june", "july", "august", "september", "october", "november",
    "december",
)  # fmt: skip
EXAMPLES = "'1970 Q1', '2020M03', 'Mar 2020', '2020-W05'"


def span(text: str) -> tuple[date, date] | None:
    """The first day of a period, and the day after its last; None if the text is not one."""
    text = text.strip()
    try:
        for pattern, months in _STEPS:
            if found := pattern.fullmatch(text):
                return _months(int(found["year"]), months * (int(found["part"]) - 1), months)
        if found := _WEEK.fullmatch(text):
            first = date.fromisocalendar(int(found["year"]), int(found["week"]), int(found["day"] or 1))
            return first, first + timedelta(1 if found["day"] else 7)
        if found := _RANGE.fullmatch(text):
            return date.fromisoformat(found[1]), date.fromisoformat(found[2]) + timedelta(1)
        for pattern in _MONTHS:
            if found := pattern.fullmatch(text):
                which = [k for k, name in enumerate(_NAMES) if name.startswith(found["name"].lower())]
                return _months(int(found["year"]), which[0], 1) if len(which) == 1 else None
    except ValueError:  # month 13, week 60
        pass
    return None


def _months(year: int, before: int, count: int) -> tuple[date, date]:
    """``count`` months of a year, after the first ``before`` ones."""
    after = before + count
    return date(year, before + 1, 1), date(year + after // 12, after % 12 + 1, 1)


def periods(texts: Sequence[str | None]) -> Array | None:
    """Beginnings of periods, datetime64 (T,), NaT where a text is not a period; None if the first one is not."""
    known = next((text for text in texts if text is not None), None)
    if known is None or span(known) is None:
        return None
    found = {text: None if text is None else span(text) for text in set(texts)}
    days = [np.datetime64("NaT", "us") if (one := found[text]) is None else one[0] for text in texts]
    return np.array(days, dtype="datetime64[us]")


def instant(time: Any) -> Any:
    """One time as a float, or as datetime64 in UTC if it is a date; NaN if it is not known."""
    if str(time) in ABSENT:
        return float("nan")
    if isinstance(time, int | float | np.number) and not isinstance(time, np.timedelta64):
        return float(time)
    if hasattr(time, "to_datetime64"):  # a pandas time, in UTC if it has a zone
        return time.to_datetime64()
    if isinstance(time, datetime) and time.tzinfo is not None:
        time = time.astimezone(UTC).replace(tzinfo=None)
    if isinstance(time, str):
        return _of_texts([time])[0]
    return _by_days(np.asarray(time, dtype="datetime64" if isinstance(time, np.datetime64) else "datetime64[us]"))[()]


def instants(time: Any) -> tuple[Array, str | None]:
    """(times (T,) as floats or as datetime64 in UTC, their zone) of an array or a sequence."""
    axis = np.asarray(time)
    if axis.dtype.kind in "iuf":
        return axis.astype(float), None
    if axis.dtype.kind == "M":
        return _by_days(axis), None
    if axis.dtype.kind in "UT" or (axis.dtype.kind == "O" and axis.size and isinstance(axis.flat[0], str)):
        return _of_texts(axis.ravel().tolist()).reshape(axis.shape), None
    if axis.dtype.kind == "O" and axis.size and isinstance(axis.flat[0], datetime) and axis.flat[0].tzinfo is not None:
        zone = zone_name(axis.flat[0].tzinfo)
        flat = [one.astimezone(UTC).replace(tzinfo=None) for one in axis.flat]
        return np.array(flat, dtype="datetime64[us]").reshape(axis.shape), zone
    return np.asarray(time, dtype="datetime64[us]"), None


def _of_texts(texts: Sequence[str]) -> Array:
    """Dates in the form of ISO 8601, or beginnings of periods."""
    found = periods(texts)
    days: Any = found
    if found is None:
        days = [np.datetime64("NaT", "us")] * len(texts)
        for k, text in enumerate(texts):
            with suppress(ValueError):
                days[k] = np.datetime64(with_hyphens(text), "us")
    for text, day in zip(texts, days, strict=True):
        if np.isnat(day) and text.strip().lower() != "nat":
            raise ValueError(
                f"time: {text!r} is not a date; write 2024-01-31, 2024-01-31 12:00:00, or a period as in {EXAMPLES}."
            )
    return np.asarray(days, dtype="datetime64[us]")


YEAR_FIRST = r"^\d{4}[-/.]"
DAY = r"(?:1[89]|2[01])\d\d(?:0[1-9]|1[0-2])(?:0[1-9]|[12]\d|3[01])"
"""A day without hyphens, 20240131, which ISO 8601 permits."""


def with_hyphens(text: str) -> str:
    """A day without hyphens, 20240131, with them; NaT for other digits that are not a year, as NumPy takes them."""
    plain = text.strip()
    if not plain.isdigit() or len(plain) == 4:
        return plain or "NaT"
    return f"{plain[:4]}-{plain[4:6]}-{plain[6:]}" if re.fullmatch(DAY, plain) else "NaT"


def in_zone(table: pl.DataFrame, time: str, zone: str | None) -> pl.DataFrame:
    """A table whose times, in UTC, are shown in a zone; unchanged without one."""
    shown = pl.col(time).dt.replace_time_zone("UTC").dt.convert_time_zone(zone or "UTC")
    return table if zone is None else table.with_columns(shown)


def zone_name(zone: Any) -> str:
    """The name of a time zone, from a tzinfo or text; a fixed offset of whole hours has a name, others become UTC."""
    name = next((str(getattr(zone, key)) for key in ("key", "zone") if getattr(zone, key, None)), str(zone))
    try:
        ZoneInfo(name)
        return name
    except (ValueError, OSError, KeyError):  # no zone has this name
        pass
    offset = re.fullmatch(r"(?:UTC)?([+-]\d\d):00", name)
    return f"Etc/GMT{-int(offset[1]):+d}" if offset and int(offset[1]) else "UTC"


def _by_days(axis: Array) -> Array:
    """Dates in units of at most a day, because nothing can be divided by a month."""
    coarse = np.datetime_data(axis.dtype)[0] in ("Y", "M", "W", "generic")
    return axis.astype("datetime64[D]") if coarse else axis


PAIRS = ((1, 12), (1, 31), (0, 23), (0, 59), (0, 59))
"""Month, day, hour, minute and second: the least and largest numbers that two digits of a written time hold."""


def warn_of_written_numbers(time: Array) -> None:
    """Warn if numeric times, such as 20240131 or 202401, are all written like dates, perhaps with a time of day.

    Their differences are not those of the calendar: from 31 January to 1 February there are 70. Without a carry, as
    within one month of days, they are.
    """
    known = time[np.isfinite(time)] if time.dtype.kind == "f" else time[:0]
    if len(known) < 3 or not 1e5 <= known[0] < 1e14 or np.ptp(known // 100.0) == 0:
        return
    rest, written = known, known == np.rint(known)
    for low, high in reversed(PAIRS[: len(f"{known[0]:.0f}") // 2 - 2]):
        rest, pair = rest // 100.0, rest % 100.0
        written &= (pair >= low) & (pair <= high)
    if (written & (rest >= 1800) & (rest < 2200)).all():
        warn(
            f"time: the numbers {known[0]:.0f}, {known[1]:.0f}, .. look like dates, but their differences are not "
            "those of the calendar, and drift scales with them. Give dates, such as 2024-01-31, 2024-01 or the text "
            "'20240131', with dt= their nominal interval, or dt='label' if samples are one step apart."
        )


def warn_of_counted_years(time: Array) -> None:
    """Warn if dates are years that pandas took for nanoseconds since 1970, as pd.to_datetime([1970, 1971]) does."""
    if time.dtype.kind != "M" or len(time) < 3:
        return
    since = (time - np.datetime64("1970-01-01")) / np.timedelta64(1, "ns")
    if ((since >= 1500) & (since < 2500)).all():
        warn(
            f"time: all dates lie {since[0]:.0f} to {since[-1]:.0f} nanoseconds after the beginning of 1970. They look "
            "like years that were read as nanoseconds: convert them with pd.to_datetime(years, format='%Y')."
        )
