"""Results as columns: the estimates at the samples of one section, from the engine to sinks, history and page.

The values of a sample are

    time, y, y_hat, innovation e, its variance s, theta_1 .. theta_n, std_1 .. std_n
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver

TIME, Y, Y_HAT, E, S, THETA = range(6)
"""Columns of the values; theta begins at THETA."""
OK, ALARM = 1, 2
"""Bits of the flags."""


class Result(NamedTuple):
    """The tracker's result for one sample."""

    number: int
    """Number of the sample in the journal."""
    unit: Any
    """Its name; in `Results` and on the page its number."""
    time: float | None
    """Seconds, in UTC since 1970 for dates."""
    y: float
    y_hat: float
    e: float
    s: float
    ok: bool
    theta: list[float]
    std: list[float]
    alarm: bool
    """Whether an alarm is on."""


class Results(NamedTuple):
    """Results of N samples, sorted by unit, and of a unit in the order in which they were processed."""

    number: Array
    """(N,): number of the sample in the journal."""
    unit: Array
    """(N,): number of its unit."""
    flags: Array
    """(N,): OK if the sample was used, ALARM if an alarm is on."""
    values: Array
    """(N, 5 + 2 n), time NaN where samples have none."""

    @property
    def n(self) -> int:
        return int(self.values.shape[1] - THETA) // 2

    @property
    def theta(self) -> Array:
        """(N, n)"""
        return self.values[:, THETA : THETA + self.n]

    @property
    def std(self) -> Array:
        """(N, n)"""
        return self.values[:, THETA + self.n :]

    def some(self, which: Any) -> Results:
        return Results(*(column[which] for column in self))

    def last(self) -> Results:
        """The last result of every unit."""
        return self.some(np.flatnonzero(np.append(self.unit[1:] != self.unit[:-1], True)))

    def rows(self) -> list[Result]:
        """The results one by one."""
        n, found = self.n, []
        columns = (self.number, self.unit, self.flags, self.values)
        for number, unit, flags, values in zip(*(column.tolist() for column in columns), strict=True):
            time, y, y_hat, e, s, *rest = values
            ok, alarm = bool(flags & OK), bool(flags & ALARM)
            time = time if time == time else None
            found.append(Result(number, unit, time, y, y_hat, e, s, ok, rest[:n], rest[n:], alarm))
        return found

    def plain(self) -> tuple[bytes, bytes, bytes, bytes]:
        return self.number.tobytes(), self.unit.tobytes(), self.flags.tobytes(), self.values.tobytes()

    @classmethod
    def of(cls, number: bytes, unit: bytes, flags: bytes, values: bytes) -> Results:
        numbers = np.frombuffer(number, np.int64)
        shaped = np.frombuffer(values).reshape(len(numbers), -1)
        return cls(numbers, np.frombuffer(unit, np.int32), np.frombuffer(flags, np.uint8), shaped)


BLOCK_SAMPLES = 64
FIXED = ("time", "y", "y_hat", "e", "e_std")


class Blocks:
    """The results of the units of a section that are not yet in the history; a unit is known by its place."""

    def __init__(self, columns: int) -> None:
        self._values = np.empty((0, BLOCK_SAMPLES, columns))
        self._state: Array = np.zeros((0, 3), np.int64)
        """(count, first number, last number) of each unit."""

    @property
    def capacity(self) -> int:
        return len(self._state)

    @property
    def columns(self) -> int:
        return int(self._values.shape[2])

    def grow(self, capacity: int) -> None:
        more = capacity - self.capacity
        self._values = np.concatenate([self._values, np.empty((more, *self._values.shape[1:]))])
        self._state = np.concatenate([self._state, np.zeros((more, 3), np.int64)])

    def add(self, places: Array, results: Results) -> list[tuple[Any, ...]]:
        """Add results, sorted by place (N,); the rows of the table ``block`` for the blocks that they complete."""
        most = len(places) // BLOCK_SAMPLES + np.count_nonzero(places[1:] != places[:-1]) + 1
        rows, about = np.empty((most, BLOCK_SAMPLES, self.columns)), np.zeros((most + 1, 3), np.int64)
        _add(results.number, places, results.values, self._values, self._state, rows, about)
        about = about[: about[-1, 0]]
        rows = rows[: len(about)]
        units, extremes = results.unit[about[:, 0]].tolist(), extremes_of(rows)
        start, stop = (rows[:, k, TIME].tolist() for k in (0, -1))
        return [
            (*one, BLOCK_SAMPLES, rows[k].tobytes(), extremes[k].tobytes())
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
        if k + 1 == BLOCK_SAMPLES:
            for t in range(BLOCK_SAMPLES):
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
