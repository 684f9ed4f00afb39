"""Parse lists of names, units and intervals of the command line."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence

import numpy as np


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


UNITS = {"us": "us", "ms": "ms", "s": "s", "min": "m", "m": "m", "h": "h", "d": "D", "w": "W"}


def parse_interval(text: str | None) -> float | np.timedelta64 | None:
    """``0.5`` as a number, ``15min`` as a duration."""
    if text is None:
        return None
    match = re.fullmatch(r"\s*(\d+)\s*([a-z]+)\s*", text)
    if match and match[2] in UNITS:
        return np.timedelta64(int(match[1]), UNITS[match[2]])  # type: ignore[call-overload,no-any-return]
    try:
        return float(text)
    except ValueError:
        raise ValueError(
            f"--dt {text}: give a number, or a whole number with one of {', '.join(UNITS)} for a time that is a date."
        ) from None
