"""The history of a unit in blocks of 64 results: all columns, and least, largest and mean of each.

    columns    time, y, y_hat, innovation e, its standard deviation, theta_1 .. theta_n, std_1 .. std_n

A page that shows a million samples reads the extremes of 16,000 blocks, not the samples.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import Array

SIZE = 64
FIXED = ("time", "y", "y_hat", "e", "e_std")


class Blocks:
    """The results of a unit that are not yet in the history."""

    def __init__(self, unit: int) -> None:
        self.unit = unit
        self._rows: list[list[Any]] = []

    def add(self, result: list[Any]) -> None:
        self._rows.append(result)

    def flush(self, all_of_it: bool = False) -> list[tuple[Any, ...]]:
        """Rows of the table ``block``: full blocks, or everything so far."""
        count = len(self._rows) if all_of_it else len(self._rows) // SIZE * SIZE
        rows, self._rows = self._rows[:count], self._rows[count:]
        return [self._block(rows[k : k + SIZE]) for k in range(0, count, SIZE)]

    def _block(self, rows: list[list[Any]]) -> tuple[Any, ...]:
        values = columns_of(rows)
        time = values[:, 0]
        places = [row[0] for row in rows]
        extremes = extremes_of(values)
        return (self.unit, min(places), max(places), float(time[0]), float(time[-1]), len(rows), values.tobytes(),
                extremes.tobytes())  # fmt: skip


def columns_of(rows: list[list[Any]]) -> Array:
    """Results as an array (count, 5 + 2 n); where samples have no times their numbers are used."""
    n = len(rows[0][8])
    values = np.full((len(rows), len(FIXED) + 2 * n), np.nan)
    for k, row in enumerate(rows):
        number, _, time, y, y_hat, e, s, _, theta, std, _ = row
        values[k, :5] = number if time is None else time, y, y_hat, e, s
        values[k, 5 : 5 + n] = theta
        values[k, 5 + n : 5 + n + len(std)] = std
    with np.errstate(invalid="ignore"):
        values[:, 4] = np.sqrt(values[:, 4])
    return values


def extremes_of(values: Array) -> Array:
    """Least, largest and mean (3, c) of columns, over finite numbers; NaN if there are none."""
    fine = np.isfinite(values)
    count = fine.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(fine, values, 0.0).sum(axis=0) / count
    low, high = np.where(fine, values, np.inf).min(axis=0), np.where(fine, values, -np.inf).max(axis=0)
    return np.where(count > 0, np.stack([low, high, mean]), np.nan)
