"""The results of a run as columns, a row for each sample: the common part of records, streams and several outputs.

Where several outputs measure one theta, ``Regression(n, ny=2, shared=True)``, an instant holds a row for each of them.
Its rows are successive samples between which no time passes: correcting with one row after the other equals the
correction with all of them, for independent noises of variance r / weight. The prediction of the second output uses
the first one. What belongs to a single row is then (T, ny), and the state after an instant is that after its last row.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property

import numpy as np

from driftfit.engine.kernel import Array

SCALARS = ("y_hat", "e", "s", "ok")
"""Fields that belong to one row, as opposed to the state after it."""


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

    @property
    def theta(self) -> Array:
        return self.written("theta")

    @property
    def var(self) -> Array:
        """Variances of the parameters, in the shape of theta."""
        return self.written("var")

    @cached_property
    def std(self) -> Array:
        return np.sqrt(self.var)

    @property
    def prediction(self) -> Array:
        return self.written("y_hat")

    @property
    def innovation(self) -> Array:
        return self.written("e")

    @property
    def innovation_var(self) -> Array:
        """Variances of the innovations, in their shape."""
        return self.written("s")

    @cached_property
    def innovation_std(self) -> Array:
        return np.sqrt(self.innovation_var)

    @cached_property
    def ok(self) -> Array:
        return self.written("ok") > 0.0
