"""The results of a run as columns, a row for each sample: the common part of records, streams and several outputs.

Where several outputs measure one theta, ``Regression(n, ny=2, shared=True)``, an instant holds a row for each of them.
Its rows are successive samples between which no time passes: correcting with one row after the other equals the
correction with all of them, for independent noises of variance r / weight. The prediction of the second output uses
the first one. What belongs to a single row is then (T, ny), and the state after an instant is that after its last row.

`collect` stores samples as a tracker receives them; `put_columns` and `put_fields` copy rows column by column.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from operator import attrgetter
from typing import Any

import numpy as np

from driftfit.data.record import Labels
from driftfit.engine.drivers import TrackerSteps, stored_too
from driftfit.engine.kernel import Array, Driver, State, kernel

SCALARS = ("y_hat", "e", "s", "ok")
"""Fields that belong to one row, as opposed to the state after it."""


def attribute(path: str, text: str | None = None) -> Any:
    """A property that is an attribute of a part, such as "program.tracker"."""
    return property(attrgetter(path), doc=text)


def _written(name: str, text: str | None = None) -> Any:
    """A field of the driver's output as a property."""
    return property(lambda self: self.written(name), doc=text)


def _root_of(name: str) -> Any:
    """The square root of another property, computed once."""
    return cached_property(lambda self: np.sqrt(getattr(self, name)))


class Columns(ABC):
    """Results of T samples.

    Attributes
    ----------
    theta, std : (T, n), or (T, ny, n) for outputs that each have their own theta
        Parameters after each sample, and their standard deviations: inf for parameters that are not determined yet, NaN
        if the tracker has no covariance.
    prediction, innovation, innovation_std : (T,), or (T, ny) for several outputs
        One-step prediction made before the output was observed, its error, and the standard deviation of that error.
    ok : (T,) or (T, ny), bool
        Which samples were used.
    """

    @property
    def rows_per_instant(self) -> int:
        """1; for outputs that share one theta, their number."""
        return 1

    @abstractmethod
    def in_rows(self, name: str) -> Array:
        """A field of the driver's output, with an entry for each row."""

    def by_row(self, values: Array) -> Array:
        """Values of the rows, (T ny, ..), as (T, ny, ..) where an instant holds several."""
        ny = self.rows_per_instant
        return values if ny == 1 else values.reshape(len(values) // ny, ny, *values.shape[1:])

    def after_rows(self, values: Array) -> Array:
        """The values of each instant after all its rows."""
        return values[self.rows_per_instant - 1 :: self.rows_per_instant]

    def written(self, name: str) -> Array:
        """A field of the driver's output at every sample, (T, ..): one of the tracker's ``outputs``, for example."""
        values = self.in_rows(name)
        return self.by_row(values) if name in SCALARS else self.after_rows(values)

    theta: Array = _written("theta")
    var: Array = _written("var", "Variances of the parameters, in the shape of theta.")
    std: Array = _root_of("var")
    prediction: Array = _written("y_hat")
    innovation: Array = _written("e")
    innovation_var: Array = _written("s", "Variances of the innovations, in their shape.")
    innovation_std: Array = _root_of("innovation_var")

    @cached_property
    def ok(self) -> Array:
        return self.written("ok") > 0.0


class OfRecord(Columns):
    """The same with the signals and the times of the record."""

    record: Any

    @property
    def y(self) -> Array:
        return self.by_row(self.record.y)

    @property
    def u(self) -> Array:
        return self.by_row(self.record.u)

    @property
    def labels(self) -> Labels:
        """Names and units of the signals, and what was left out."""
        found: Labels = self.record.labels
        return found

    @property
    def timed(self) -> bool:
        """Whether samples have times; otherwise `time` numbers them."""
        return self.record.time is not None

    @property
    def time(self) -> Array:
        """The given times, or sample numbers."""
        T = len(self.record) // self.rows_per_instant
        return np.arange(T) if self.record.time is None else self.after_rows(self.record.time)


COLLECTED = ("phi", "y", "dt", "valid", "observed")
"""Fields that `collect` stores."""


@kernel
def collect(o: State, s: State, l: int) -> None:
    """Store the sample as the tracker receives it, after the model and the missing-data rule; not ``observed`` is also
    a reading that the tracker refused."""
    for i in range(s.phi.shape[0]):
        o.phi[i, l] = s.phi[i, l]
    o.y[l] = s.y[l]
    o.dt[l] = s.dt[l]
    o.valid[l], o.observed[l] = s.valid[l], s.observed[l]


def collecting(steps: TrackerSteps) -> TrackerSteps:
    """The steps of a tracker that store its own outputs and the sample."""
    return steps._replace(store=stored_too(steps.store, collect))


SHORT_ROW = 32
"""Rows of fewer numbers are copied column by column: NumPy takes 30 ns for each row."""


def put_columns(given: Array, into: Array) -> None:
    """Copy an array (T, ..) whose rows may be short and far apart."""
    T = len(into)
    given, into = given.reshape(T, -1), into.reshape(T, -1)
    if into.shape[1] >= SHORT_ROW:
        into[...] = given
        return
    for k in range(into.shape[1]):
        into[:, k] = given[:, k]


def put_fields(rows: Array, into: Mapping[str, Array], first: int) -> None:
    """Copy fields of rows of eight-byte numbers to rows ``first`` and following of arrays of the same types."""
    words = rows.view(np.int64).reshape(len(rows), -1)
    fields: Mapping[str, Any] = rows.dtype.fields or {}
    for name, values in into.items():
        put_words(words, fields[name][1] // 8, values.view(np.int64).reshape(len(values), -1), first)


@Driver
def put_words(words: Array, column: int, into: Array, first: int) -> None:
    """Copy columns of words, row by row: NumPy takes 30 ns for each short row, or reads all rows for each column."""
    for t in range(words.shape[0]):
        for k in range(into.shape[1]):
            into[first + t, k] = words[t, column + k]
