"""Options of the command line as the library takes them: ranges, intervals, separators, names, units."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence

from driftfit.data.clock import Clock
from driftfit.engine.settings import near

Range = tuple[float, float]


def limits_from(entry: str, names: Sequence[str]) -> tuple[str, Range]:
    """``flow=0:80`` as a name and its range."""
    name, _, bounds = entry.rpartition("=")
    low, colon, high = bounds.partition(":")
    try:
        found = float(low or "-inf"), float(high or "inf")
    except ValueError:
        colon = ""
    if not colon or not found[0] <= found[1]:
        raise ValueError(f"--limits {entry}: give a valid range as column=low:high, such as --limits flow=0:80.")
    if name.strip() not in names:
        raise ValueError(f"--limits {entry}: no signal has the name {name.strip()!r}; {near(name.strip(), names)}")
    return name.strip(), found


def interval_from(entry: str, option: str = "--exclude") -> tuple[str, str]:
    """``2024-03-01..2024-03-04`` as a pair of ends."""
    first, dots, last = entry.partition("..")
    if not (dots and first.strip() and last.strip()):
        raise ValueError(f"{option} {entry}: give an interval as FROM..TO, such as {option} 2024-03-01..2024-03-04.")
    return first.strip(), last.strip()


def decimal_from(text: str) -> str:
    """The decimal sign."""
    if text not in (".", ","):
        raise ValueError(f"--decimal {text}: the decimal sign must be a point or a comma.")
    return text


def separator_from(text: str | None) -> str | None:
    """The separator of cells, one character; None: it is detected."""
    sign = "\t" if text in ("tab", "\\t") else text
    if sign is not None and len(sign) != 1:
        raise ValueError(f"--separator {text}: the separator must be one character, such as ';', or tab.")
    return sign


def sample_of(row: str, first: int) -> int:
    """The sample, from 0, of a row that is given as text."""
    if not row.isdigit():
        raise ValueError(f"--exclude: without --time give an interval of rows, such as 100..120; got {row!r}.")
    return int(row) - first


def rows_from(text: str | None) -> tuple[int, int | None]:
    """``100:500`` as the first and the last row, None: to the end."""
    if text is None:
        return 1, None
    first, colon, last = text.partition(":")
    if not colon or not all(part.strip().isdigit() or not part.strip() for part in (first, last)):
        raise ValueError(f"--rows {text}: rows are counted from 1, as in --rows 100:500, 100: or :500.")
    a, b = int(first or 1), int(last) if last.strip() else None
    if a < 1 or (b is not None and b < a):
        raise ValueError(
            f"--rows {text}: there are no such rows; rows are counted from 1, and the first must not be after the last."
        )
    return a, b


def listed(given: Sequence[str] | None) -> list[str]:
    """Names that were given in several options, or separated by commas; one with a comma is quoted, as in a CSV file.

    In a shell that is ``--u '"flow, cold",temperature'``. Blanks, parentheses and other signs need no quotes here.
    """
    try:
        rows = [next(csv.reader([entry], skipinitialspace=True, strict=True), []) for entry in given or []]
    except csv.Error:
        raise ValueError(
            f"{', '.join(given or [])}: a name with a comma is quoted as in a CSV file, in a shell as "
            "--u '\"flow, cold\",temperature'."
        ) from None
    return [name.strip() for row in rows for name in row if name.strip()]


def parse_units(given: Sequence[str] | None) -> dict[str, str]:
    """``flow=l/min`` as a name and its unit."""
    pairs = {entry: entry.rpartition("=") for entry in given or []}
    for entry, (name, _, unit) in pairs.items():
        if not name.strip() or not unit.strip():
            raise ValueError(f"--unit {entry}: give a unit as column=unit, such as --unit flow=l/min.")
    return {name.strip(): unit.strip() for name, _, unit in pairs.values()}


def parse_interval(text: str | None) -> float | str | None:
    """``0.5`` as a number; a duration or a step of the calendar as text, in which ``m`` after a number is minutes."""
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        given = re.sub(r"(\d\s*)m\s*$", r"\1min", text)
    try:
        Clock.of(given)
    except ValueError as error:
        raise ValueError(f"--dt {text}: {error}") from None
    return given
