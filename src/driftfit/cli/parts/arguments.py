"""Parse lists of names, units and intervals of the command line."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence

from driftfit.data.clock import Clock


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
