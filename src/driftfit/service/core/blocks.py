"""The history of units in blocks of 64 results: all columns, and least, largest and mean of each.

    columns    time, y, y_hat, innovation e, its standard deviation, theta_1 .. theta_n, std_1 .. std_n

A page that shows a million samples reads the extremes of 16,000 blocks, not the samples.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.service.core.results import TIME, Results, S

SIZE = 64
FIXED = ("time", "y", "y_hat", "e", "e_std")


class Blocks:
    """The results of the units of a section that are not yet in the history; a unit is known by its place."""

    def __init__(self, columns: int) -> None:
        self._values = np.empty((0, SIZE, columns))
        self._count = np.zeros(0, np.int64)
        self._first, self._last = np.zeros(0, np.int64), np.zeros(0, np.int64)

    @property
    def capacity(self) -> int:
        """Units for which there is room."""
        return len(self._count)

    def grow(self, capacity: int) -> None:
        """Make room for more units."""
        more = capacity - len(self._count)
        self._values = np.concatenate([self._values, np.empty((more, *self._values.shape[1:]))])
        zeros = np.zeros(more, np.int64)
        self._count, self._first, self._last = (
            np.concatenate([old, zeros]) for old in (self._count, self._first, self._last)
        )

    def add(self, places: Array, results: Results) -> list[tuple[Any, ...]]:
        """Add results, sorted by place (N,); the rows of the table ``block`` for the blocks that they complete."""
        values, found = history_of(results), []
        new = np.flatnonzero(np.append(True, places[1:] != places[:-1]))
        at = self._count[places] + np.arange(len(places)) - np.repeat(new, np.diff(np.append(new, len(places))))
        for turn in range(int(at.max()) // SIZE + 1):
            now = np.flatnonzero(at // SIZE == turn)
            here, number = places[now], results.number[now]
            self._values[here, at[now] - turn * SIZE] = values[now]
            begun = here[self._count[here] == 0]
            self._first[begun], self._last[begun] = np.iinfo(np.int64).max, 0
            np.minimum.at(self._first, here, number)
            np.maximum.at(self._last, here, number)
            np.add.at(self._count, here, 1)
            full = np.unique(here[self._count[here] == SIZE])
            if full.size:
                owner = dict(zip(here.tolist(), results.unit[now].tolist(), strict=True))
                found += self._rows(full, [owner[place] for place in full.tolist()])
        return found

    def flush(self, place: int, unit: int) -> list[tuple[Any, ...]]:
        """The row of the table ``block`` for what a unit has so far; none if it has nothing."""
        return self._rows(np.array([place]), [unit]) if self._count[place] else []

    def _rows(self, places: Array, units: list[int]) -> list[tuple[Any, ...]]:
        """The blocks at places with equal counts, which become empty."""
        count = int(self._count[places[0]])
        values = self._values[places, :count]
        extremes, first, last = extremes_of(values), self._first[places].tolist(), self._last[places].tolist()
        self._count[places] = 0
        start, stop = (values[:, k, TIME].tolist() for k in (0, -1))
        return [
            (*about, count, values[k].tobytes(), extremes[k].tobytes())
            for k, about in enumerate(zip(units, first, last, start, stop, strict=True))
        ]


def history_of(results: Results) -> Array:
    """The columns of the history (N, 5 + 2 n); where samples have no times their numbers are used."""
    values = results.values.copy()
    untimed = np.isnan(values[:, TIME])
    values[untimed, TIME] = results.number[untimed]
    with np.errstate(invalid="ignore"):
        values[:, S] = np.sqrt(values[:, S])
    return values


def extremes_of(values: Array) -> Array:
    """Least, largest and mean (.., 3, c) of columns (.., T, c), over finite numbers; NaN if there are none."""
    fine = np.isfinite(values)
    count = fine.sum(axis=-2)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(fine, values, 0.0).sum(axis=-2) / count
    low, high = np.where(fine, values, np.inf).min(axis=-2), np.where(fine, values, -np.inf).max(axis=-2)
    return np.where((count > 0)[..., None, :], np.stack([low, high, mean], axis=-2), np.nan)
