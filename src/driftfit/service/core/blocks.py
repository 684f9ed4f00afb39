"""The history of units in blocks of 64 results: all columns, and least, largest and mean of each.

    columns    time, y, y_hat, innovation e, its standard deviation, theta_1 .. theta_n, std_1 .. std_n

A page that shows a million samples reads the extremes of 16,000 blocks, not the samples.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, Driver
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

    @property
    def columns(self) -> int:
        """Numbers of a result."""
        return int(self._values.shape[2])

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
        most = len(places) // SIZE + np.count_nonzero(places[1:] != places[:-1]) + 1
        rows = np.empty((most, SIZE, self.columns))
        extremes, about = np.empty((most, 3, self.columns)), np.zeros((most + 1, 3), np.int64)
        kept = (self._values, self._count, self._first, self._last)
        _add(*results, places, *kept, rows, extremes, about)
        owners, first, last = about[: about[-1, 0]].T.tolist()
        return [
            (unit, a, b, *rows[k, :: SIZE - 1, TIME].tolist(), SIZE, rows[k].tobytes(), extremes[k].tobytes())
            for k, (unit, a, b) in enumerate(zip(owners, first, last, strict=True))
        ]

    def flush(self, place: int, unit: int) -> list[tuple[Any, ...]]:
        """The row of the table ``block`` for what a unit has so far; none if it has nothing."""
        count = int(self._count[place])
        if not count:
            return []
        self._count[place] = 0
        values, (first, last) = self._values[place, :count], (int(one[place]) for one in (self._first, self._last))
        start, stop = values[0, TIME].item(), values[-1, TIME].item()
        return [(unit, first, last, start, stop, count, values.tobytes(), extremes_of(values).tobytes())]


@Driver
def _add(
    number: Array, unit: Array, flags: Array, given: Array, places: Array, values: Array, count: Array, first: Array,
    last: Array, rows: Array, extremes: Array, about: Array,
) -> None:  # fmt: skip
    """Copy results to the blocks of their places; what is complete is moved to ``rows``, with (unit, first, last).

    How many blocks that are is written into the last row of ``about``. Where samples have no times their numbers are
    used; variances of innovations become standard deviations.
    """
    complete = 0
    for i in range(len(number)):
        p = places[i]
        k = count[p]
        for c in range(given.shape[1]):
            values[p, k, c] = given[i, c]
        if np.isnan(values[p, k, TIME]):
            values[p, k, TIME] = number[i]
        values[p, k, S] = np.sqrt(values[p, k, S])
        first[p] = min(number[i], first[p]) if k else number[i]
        last[p] = max(number[i], last[p]) if k else number[i]
        count[p] = k + 1
        if k + 1 < SIZE:
            continue
        rows[complete] = values[p]
        for c in range(given.shape[1]):
            low, high, total, fine = np.inf, -np.inf, 0.0, 0
            for t in range(SIZE):
                x = values[p, t, c]
                if np.isfinite(x):
                    low, high, total, fine = min(low, x), max(high, x), total + x, fine + 1
            extremes[complete, 0, c] = low if fine else np.nan
            extremes[complete, 1, c] = high if fine else np.nan
            extremes[complete, 2, c] = total / fine if fine else np.nan
        about[complete, 0], about[complete, 1], about[complete, 2] = unit[i], first[p], last[p]
        count[p] = 0
        complete += 1
    about[-1, 0] = complete


def extremes_of(values: Array) -> Array:
    """Least, largest and mean (.., 3, c) of columns (.., T, c), over finite numbers; NaN if there are none."""
    fine = np.isfinite(values)
    count = fine.sum(axis=-2)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(fine, values, 0.0).sum(axis=-2) / count
    low, high = np.where(fine, values, np.inf).min(axis=-2), np.where(fine, values, -np.inf).max(axis=-2)
    return np.where((count > 0)[..., None, :], np.stack([low, high, mean], axis=-2), np.nan)
