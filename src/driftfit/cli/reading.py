"""Read parts of files: ranges of rows and times, separators, stdin; valid ranges and exclusions.

Rows are counted from 1 after the header, as in messages about cells, and ranges include both ends. Valid ranges and
intervals are passed on unchanged (`driftfit.data.limits`).
"""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl

from driftfit.data.clock import Clock
from driftfit.data.columns import Columns, Wanted, convert
from driftfit.data.files import paths_of, read_file, together
from driftfit.data.limits import marks, within
from driftfit.engine.kernel import Array
from driftfit.engine.settings import near

Range = tuple[float, float]


@dataclass(frozen=True)
class Part:
    """Which part of the files is used, and how they are read."""

    first: str | None = None
    last: str | None = None
    rows: tuple[int, int | None] = (1, None)
    separator: str | None = None
    decimal: str = "."
    dates: str | None = None
    missing: tuple[str, ...] = ()
    limits: tuple[tuple[str, Range], ...] = ()
    exclude: tuple[tuple[str, str], ...] = ()

    @property
    def whole(self) -> bool:
        """Whether the files are read without any restriction."""
        return self == Part(limits=self.limits, exclude=self.exclude, missing=self.missing)

    def restrictions(self, timed: bool) -> dict[str, Any]:
        """limits=, exclude= and missing= of `track`; without time, intervals are rows, which `track` numbers from 0."""
        exclude: list[tuple[Any, Any]] = list(self.exclude)
        if not timed:
            exclude = [(self._sample(first), self._sample(last)) for first, last in self.exclude]
        return {"limits": dict(self.limits) or None, "exclude": exclude or None, "missing": self.missing}

    def _sample(self, row: str) -> int:
        """The sample of a row."""
        if not row.isdigit():
            raise ValueError(f"--exclude: without --time give an interval of rows, such as 100..120; got {row!r}.")
        return int(row) - self.rows[0]


def table_of(rows: Columns, time: str | None, by: Sequence[str]) -> pl.DataFrame:
    """The rows of all files as a table that `track` reads."""
    columns: dict[str, Any] = dict(rows.numbers) | ({} if time is None else {time: rows.time})
    table = pl.DataFrame(columns | dict(zip(by, rows.by, strict=True)))
    if rows.zone is not None and time is not None:
        table = table.with_columns(pl.col(time).dt.replace_time_zone("UTC").dt.convert_time_zone(rows.zone))
    return table


def order_of(rows: Columns) -> Array:
    """Indices of the rows of a single series, sorted by time, with the first of several rows at the same time."""
    if rows.time is None:
        return np.arange(rows.rows)
    known = np.flatnonzero(np.isfinite(rows.time))
    return known[np.unique(rows.time[known], return_index=True)[1]]


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


def rows_of(files: Sequence[str], names: Sequence[str], time: str | None, by: Sequence[str], part: Part) -> Columns:
    """Read columns of several files in the order of the files."""
    if (part.first or part.last) and time is None:
        raise ValueError("--from and --to are times, so they need --time; rows are chosen with --rows.")
    how = marks(part.missing)[0], part.separator, part.decimal, part.dates
    wanted = Wanted(tuple(dict.fromkeys(names)), time, tuple(by), *how)
    found = together({path: _one(path, wanted, part) for path in (["-"] if "-" in files else paths_of(list(files)))})
    if found.time is None or (part.first is None and part.last is None):
        return found
    keep = np.flatnonzero(within([(part.first, part.last)], found.time, found.time, found.zone, "--from, --to"))
    if not len(keep):
        raise ValueError(f"no row is between --from {part.first or '...'} and --to {part.last or '...'}.")
    numbers = {name: column[keep] for name, column in found.numbers.items()}
    units = [[column[k] for k in keep.tolist()] for column in found.by]
    return Columns(numbers, found.time[keep], found.zone, units, len(keep), found.units)


def _one(path: str, wanted: Wanted, part: Part) -> Columns:
    """The selected rows of one file."""
    where = "stdin" if path == "-" else path
    frame, units = read_file(sys.stdin.buffer.read() if path == "-" else path, wanted, where)
    first, last = part.rows
    if len(frame) < first:
        raise ValueError(f"{where} has no row {first}.")
    return replace(convert(frame, wanted, where, 1, slice(first - 1, last)), units=units)


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
