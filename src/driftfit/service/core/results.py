"""Results as columns: the estimates at the samples of one section, from the engine to sinks, history and page.

The values of a sample are

    time, y, y_hat, innovation e, its variance s, theta_1 .. theta_n, std_1 .. std_n
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array

TIME, Y, Y_HAT, E, S, THETA = range(6)
"""Columns of the values; theta begins at THETA."""
OK, ALARM = 1, 2
"""Bits of the flags."""


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
        """Number of parameters."""
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
        """Some of the rows."""
        return Results(*(column[which] for column in self))

    def last(self) -> Results:
        """The last result of every unit."""
        return self.some(np.flatnonzero(np.append(self.unit[1:] != self.unit[:-1], True)))

    def rows(self) -> list[list[Any]]:
        """A list for each sample: number, unit, time or None, y, y_hat, e, s, ok, theta, std, alarm."""
        n, found = self.n, []
        columns = (self.number, self.unit, self.flags, self.values)
        for number, unit, flags, values in zip(*(column.tolist() for column in columns), strict=True):
            time, theta, std = values[TIME], values[THETA : THETA + n], values[THETA + n :]
            found.append([number, unit, time if time == time else None, *values[Y:THETA], bool(flags & OK), theta, std,
                          bool(flags & ALARM)])  # fmt: skip
        return found

    def plain(self) -> tuple[bytes, bytes, bytes, bytes]:
        """The columns as bytes."""
        return self.number.tobytes(), self.unit.tobytes(), self.flags.tobytes(), self.values.tobytes()

    @classmethod
    def of(cls, number: bytes, unit: bytes, flags: bytes, values: bytes) -> Results:
        """The inverse of `plain`."""
        numbers = np.frombuffer(number, np.int64)
        shaped = np.frombuffer(values).reshape(len(numbers), -1)
        return cls(numbers, np.frombuffer(unit, np.int32), np.frombuffer(flags, np.uint8), shaped)
