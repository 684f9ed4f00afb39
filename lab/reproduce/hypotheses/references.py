"""Reference values of the tables, of an independent implementation on separate records; None where it gives none."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from functools import cache
from pathlib import Path

Row = tuple[float | None, ...]


def lines(name: str) -> Iterator[list[str]]:
    """Lines of one of the tables in this folder, without its header."""
    text = (Path(__file__).parent / name).read_text(encoding="utf-8")
    return iter(list(csv.reader(text.splitlines()))[1:])


@cache
def references(table: str) -> dict[str, Row]:
    """RMSE, after a jump, steady, detection rate, mean delay, false alarms per 1000, mean log p(y), NEES/n and leaf
    updates per step of every row of a table.
    """
    found = (line[1:] for line in lines("bank_tables.csv") if line[0] == table)
    return {row: tuple(float(cell) if cell else None for cell in cells) for row, *cells in found}


def sensitivity() -> dict[str, Row]:
    """RMSE of five reductions, and of the fourth-deepest decision when steady, for every wrong setting."""
    return {row: tuple(map(float, cells)) for row, *cells in lines("bank_sensitivity.csv")}
