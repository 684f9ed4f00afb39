"""Several outputs that all measure one theta: ``Regression(n, ny=2, shared=True)``.

Rows of one instant are successive samples between which no time passes: correcting with one row after the other equals
the correction with all of them, for independent noises of variance r / weight. The prediction of the second output
uses the first one.
"""

from __future__ import annotations

from os import PathLike
from typing import Any, Self

import numpy as np

from driftfit.data import storage
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.run.outputs import missing
from driftfit.run.public_class import Plain
from driftfit.run.result import Track
from driftfit.run.warm_start import End


class Shared(Plain):
    """A record whose outputs all measure one theta.

    ``theta``, ``std`` (T, n) are those after all outputs of an instant, ``prediction``, ``innovation``,
    ``innovation_std``, ``ok`` (T, ny) those of each. ``rows`` is the Track of the T ny rows.
    """

    def __init__(self, rows: Track) -> None:
        self.rows, self.model = rows, rows.program.whole
        self.outputs, self.names, self.tracker, self.labels = self.model.outputs, rows.names, rows.tracker, rows.labels
        self.instants = None if rows.record.time is None else self.last_rows(rows.record.time)

    def __len__(self) -> int:
        return len(self.rows) // len(self.outputs)

    def __repr__(self) -> str:
        return f"Outputs of {len(self)} samples of one theta: {self.model!r}, {self.tracker!r}"

    def __getattr__(self, name: str) -> Any:
        of_rows = name[0] != "_" and hasattr(Track.public(), name)
        raise AttributeError(f"{name} is of the rows: run.rows.{name}" if of_rows else missing(name, ""))

    @property
    def timed(self) -> bool:
        """Whether samples have times; otherwise `time` numbers them."""
        return self.instants is not None

    def by_output(self, values: Array) -> Array:
        """Values of the rows, (T ny,), by instant and output, (T, ny)."""
        return values.reshape(len(self), -1)

    def last_rows(self, values: Array) -> Array:
        """The values of each instant after all its rows."""
        return values[len(self.outputs) - 1 :: len(self.outputs)]

    @property
    def y(self) -> Array:
        return self.by_output(self.rows.y)

    @property
    def u(self) -> Array:
        """(T, ny, m)"""
        return self.rows.u.reshape(len(self), len(self.outputs), -1)

    @property
    def theta(self) -> Array:
        return self.last_rows(self.rows.theta)

    @property
    def std(self) -> Array:
        return self.last_rows(self.rows.std)

    @property
    def prediction(self) -> Array:
        return self.by_output(self.rows.prediction)

    @property
    def innovation(self) -> Array:
        return self.by_output(self.rows.innovation)

    @property
    def innovation_std(self) -> Array:
        return self.by_output(self.rows.innovation_std)

    @property
    def ok(self) -> Array:
        return self.by_output(self.rows.ok)

    @property
    def time(self) -> Array:
        """The given times, or sample numbers."""
        return np.arange(len(self)) if self.instants is None else self.instants

    @property
    def loglik(self) -> float:
        return self.rows.loglik

    def cov(self, t: int) -> Array:
        """Covariance (n, n) of theta after all outputs of sample t."""
        return self.rows.cov((t % len(self) + 1) * len(self.outputs) - 1)

    def band(self, level: float = 0.95, conformal: bool = False) -> tuple[Array, Array]:
        """(low, high), each (T, n): pointwise bands of theta at this level; ``conformal`` as for `Track.band`."""
        low, high = self.rows.band(level, conformal)
        return self.last_rows(low), self.last_rows(high)

    def end(self) -> End:
        """The end of the run, from which another one can continue (`warm_start`)."""
        return self.rows.end()

    def save(self, path: str | PathLike[str]) -> None:
        """Write the result to one file without pickle, completely or not at all."""
        header, arrays = self.rows.stored()
        storage.write(path, {**header, "kind": "shared outputs", "shared": storage.describe(self.model)}, arrays)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Read a file that `save` wrote."""
        header, arrays = storage.read(path, "shared outputs")
        return cls(Track.from_stored(path, header, arrays, storage.rebuild(header["shared"], Model)))
