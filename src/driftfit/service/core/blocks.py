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
        self._state: Array = np.zeros((0, 3), np.int64)
        """(count, first number, last number) of each unit."""

    @property
    def capacity(self) -> int:
        """Units for which there is room."""
        return len(self._state)

    @property
    def columns(self) -> int:
        """Numbers of a result."""
        return int(self._values.shape[2])

    def grow(self, capacity: int) -> None:
        """Make room for more units."""
        more = capacity - self.capacity
        self._values = np.concatenate([self._values, np.empty((more, *self._values.shape[1:]))])
        self._state = np.concatenate([self._state, np.zeros((more, 3), np.int64)])

    def add(self, places: Array, results: Results) -> list[tuple[Any, ...]]:
        """Add results, sorted by place (N,); the rows of the table ``block`` for the blocks that they complete."""
        most = len(places) // SIZE + np.count_nonzero(places[1:] != places[:-1]) + 1
        rows, about = np.empty((most, SIZE, self.columns)), np.zeros((most + 1, 3), np.int64)
        _add(results.number, places, results.values, self._values, self._state, rows, about)
        about = about[: about[-1, 0]]
        rows = rows[: len(about)]
        units, extremes = results.unit[about[:, 0]].tolist(), extremes_of(rows)
        start, stop = (rows[:, k, TIME].tolist() for k in (0, -1))
        return [
            (*one, SIZE, rows[k].tobytes(), extremes[k].tobytes())
            for k, one in enumerate(zip(units, *about[:, 1:].T.tolist(), start, stop, strict=True))
        ]

    def flush(self, place: int, unit: int) -> list[tuple[Any, ...]]:
        """The row of the table ``block`` for what a unit has so far; none if it has nothing."""
        count, first, last = self._state[place].tolist()
        if not count:
            return []
        self._state[place] = 0
        values = self._values[place, :count]
        start, stop = values[0, TIME].item(), values[-1, TIME].item()
        return [(unit, first, last, start, stop, count, values.tobytes(), extremes_of(values).tobytes())]


@Driver
def _add(number: Array, places: Array, given: Array, values: Array, state: Array, rows: Array, about: Array) -> None:
    """Copy results to the blocks of their places, whose ``state`` is (count, first, last).

    Complete ones are moved to ``rows``, with (a result of theirs, first, last); how many that are is written into the
    last row of ``about``. Where samples have no times their numbers are used; variances of innovations become standard
    deviations. All are plain loops: with slices it would take ten times as long to compile.
    """
    complete = 0
    for i in range(len(number)):
        p = places[i]
        k = state[p, 0]
        for c in range(given.shape[1]):
            values[p, k, c] = given[i, c]
        if np.isnan(values[p, k, TIME]):
            values[p, k, TIME] = number[i]
        values[p, k, S] = np.sqrt(values[p, k, S])
        state[p, 0] = k + 1
        if k == 0 or number[i] < state[p, 1]:
            state[p, 1] = number[i]
        if k == 0 or number[i] > state[p, 2]:
            state[p, 2] = number[i]
        if k + 1 == SIZE:
            for t in range(SIZE):
                for c in range(given.shape[1]):
                    rows[complete, t, c] = values[p, t, c]
            about[complete, 0], about[complete, 1], about[complete, 2] = i, state[p, 1], state[p, 2]
            state[p, 0] = 0
            complete += 1
    about[-1, 0] = complete


def extremes_of(values: Array) -> Array:
    """Least, largest and mean (.., 3, c) of columns (.., T, c), over finite numbers; NaN if there are none."""
    fine = np.isfinite(values)
    if fine.all():
        return np.stack([values.min(axis=-2), values.max(axis=-2), values.mean(axis=-2)], axis=-2)
    count = fine.sum(axis=-2)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(fine, values, 0.0).sum(axis=-2) / count
    low, high = np.where(fine, values, np.inf).min(axis=-2), np.where(fine, values, -np.inf).max(axis=-2)
    return np.where((count > 0)[..., None, :], np.stack([low, high, mean], axis=-2), np.nan)
