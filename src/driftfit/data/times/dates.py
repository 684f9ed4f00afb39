"""Dates in text, as spreadsheets and loggers of several countries write them.

2024-01-31  2024-01-31 12:00:00  20240131  2024-01-31 03:15 PM               the year first
31.1.2024  31/01/2024 12:00  1/31/2024  1/31/24 3:15 PM                      the day or the month first
01-Jan-24  1 January 2024 9:30  Jan 01, 2024                                 months by name
"""

from __future__ import annotations

import re

import polars as pl

from driftfit.data.times.instants import DAY
from driftfit.data.times.periods import span

CLOCK = r"(?:(?:[ T]+|, *)(?P<clock>\d{1,2}:\d{2}(?::\d{2}(?:\.\d+)?)?) *(?P<half>[AaPp])?(?:\.?[Mm]\.?)?)?$"
YEAR_LAST = (
    r"^(?P<one>\d{1,2}|[A-Za-z]{3,9})\.?(?P<sign>[ ./-]) *(?P<two>\d{1,2}|[A-Za-z]{3,9})\.?(?:, *|[ ./-] *)"
    rf"(?P<year>\d{{4}}|\d{{2}}){CLOCK}"
)
YEAR_FIRST = rf"^(?P<year>\d{{4}})[./-](?P<two>\d{{1,2}})[./-](?P<one>\d{{1,2}}){CLOCK}"
NAME, CENTURY = r"^[A-Za-z]", r"^\d{4}$"


def is_date(cell: str) -> bool:
    """Whether a text that does not begin with a number is a date."""
    return re.match(YEAR_LAST, cell) is not None or span(cell) is not None


def _parts(text: pl.Series, pattern: str = YEAR_LAST) -> pl.DataFrame:
    """The parts of dates: one, two, year, clock, half of the day, and the sign between them."""
    return text.str.extract_groups(pattern).struct.unnest()


def day_first(text: pl.Series) -> bool | None:
    """Whether dates that end with the year begin with the day; None if no cell shows it.

    With dots the day is first. With another separator a name, or a number above 12, shows which of the two it is. If
    years have two digits, the first number may be the year, and only a second one above 12 shows that it is the day.
    """
    parts = _parts(text.filter(text.str.contains(YEAR_LAST).fill_null(False)))
    whole = bool(parts["year"].str.contains(CENTURY).all())
    if len(parts) and ((whole and (parts["sign"] == ".").all()) or parts["two"].str.contains(NAME).all()):
        return True
    one, two = (parts[name].cast(pl.Int64, strict=False) for name in ("one", "two"))
    if whole and (one > 12).any():
        return True
    return False if (two > 12).any() or (len(parts) and parts["one"].str.contains(NAME).all()) else None


def dates(text: pl.Series, where: str, begins: bool | None = None) -> pl.Series:
    """The dates of a column of text without blanks around it; null for what is none in the form of the other cells.

    ``begins``: whether they begin with the day; None: the column shows it, or ValueError.
    """
    known = text.drop_nulls()
    if len(known) and known.str.contains(f"^{DAY}$").all():
        return text.str.to_datetime("%Y%m%d", time_unit="us", strict=False)
    if len(known) and known.str.contains(YEAR_LAST).all():
        begins = day_first(known) if begins is None else begins
        if begins is None:
            raise ValueError(
                f"{where}: the dates of column {text.name!r}, such as {known[0]!r}, may have the day or the month "
                "first, and none of them shows which; write them as 2024-01-31."
            )
        parts = _parts(text)
        day, month = ("one", "two") if begins else ("two", "one")
    elif len(known) and (known.str.contains(YEAR_FIRST) & known.str.contains("[AaPp][.]?[Mm][.]?$")).all():
        parts, day, month = _parts(text, YEAR_FIRST), "one", "two"
    else:
        try:
            return text.str.to_datetime(time_unit="us", strict=False)
        except pl.exceptions.ComputeError:  # the first cells contain no date from which to infer the format
            return pl.Series(text.name, [None] * len(text), dtype=pl.Datetime("us"))
    named = bool(parts[month].str.contains(NAME).any())
    century = bool(parts["year"].str.contains(CENTURY).any())
    clock = pl.col("clock").fill_null("0:00:00").str.replace(r"^(\d+:\d+)$", "$1:00")
    half = pl.when(pl.col("half").is_null()).then(pl.lit("")).otherwise(pl.col("half") + "m")
    written = parts.select(
        pl.format("{}-{}-{} {} {}", "year", pl.col(month).str.head(3 if named else 2), day, clock, half)
    )
    form = f"%{'Y' if century else 'y'}-%{'b' if named else 'm'}-%d "
    form += "%I:%M:%S%.f %p" if parts["half"].is_not_null().any() else "%H:%M:%S%.f "
    return written.to_series().alias(text.name).str.to_datetime(form, time_unit="us", strict=False)
