"""Periods in text, as statistical offices and pandas write them; the time of a period is its first moment.

1970Q1  1970-Q1  1970 Q1  1970:1Q  Q1 1970  1Q1970                           quarters
2020M03  2020-M3  2020 Mar  March 2020  Mar-2020  2020-03  03/2020           months
2020-W05  2020W05  2020 W5  2020-W05-3                                       weeks of ISO 8601, and days of these
2020H1  2020-S2                                                              half-years
2020-01-27/2020-02-02                                                        a period by its first and last day
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date, timedelta

import numpy as np

from driftfit.engine.kernel import Array

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
