"""Known numbers of every sample in addition to its signals: elapsed time, noise, and how far theta may move."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import COMMON, DRIFT, INTERVAL, NOISE
from driftfit.engine.kernel import Array


@dataclass(frozen=True)
class Known:
    """``columns`` (T, k), or (1, k) where the same holds for every sample; k is 3, or more if there are extras.

    Samples of several outputs have columns (T, k, ny) or (1, k, ny); `for_output` gives those of one.

    ``interval``, ``noise`` and ``drift`` are its first columns: nominal intervals since the sample before, factors of
    the noise variance, and factors of the drift. ``extra`` (T, k - 3) is what `Tracker.extra_columns` made.
    """

    columns: Array

    @classmethod
    def of(cls, interval: Any = 1.0, noise: Any = 1.0, drift: Any = 1.0) -> Known:
        """The columns made of numbers or of arrays (T,)."""
        if type(interval) is type(noise) is type(drift) is float:
            return row_of(interval, noise, drift)
        parts = (interval, noise, drift)
        if not (np.ndim(interval) or np.ndim(noise) or np.ndim(drift)):
            return row_of(float(interval), float(noise), float(drift))
        return cls(np.stack(np.broadcast_arrays(*(np.atleast_1d(np.asarray(part, float)) for part in parts)), axis=1))

    def __len__(self) -> int:
        return len(self.columns)

    @cached_property
    def lanes(self) -> Array:
        """The columns of one output with an axis for its lane, (T, k, 1) or (1, k, 1)."""
        return self.columns[:, :, None]

    @property
    def constant(self) -> bool:
        """Whether one row holds for every sample."""
        return len(self.columns) == 1

    @property
    def interval(self) -> Array:
        """(T,) or (1,): nominal intervals since the sample before."""
        return self.columns[:, INTERVAL]

    @property
    def noise(self) -> Array:
        """(T,) or (1,): factors of the noise variance."""
        return self.columns[:, NOISE]

    @property
    def drift(self) -> Array:
        """(T,) or (1,): factors of the drift."""
        return self.columns[:, DRIFT]

    @property
    def extra(self) -> Array:
        """(T, k - 3): extra columns, which only some trackers read."""
        return self.columns[:, COMMON:]

    @property
    def common(self) -> Known:
        """The same numbers without the extra columns."""
        return Known(self.columns[:, :COMMON])

    def part(self, rows: slice | Array) -> Known:
        """The known numbers of some of the samples."""
        return self if self.constant else Known(self.columns[rows])

    def over(self, T: int) -> Known:
        """The same numbers with a row for each of T samples; the arrays must not be changed."""
        return Known(np.broadcast_to(self.columns, (T, *self.columns.shape[1:])))

    def changed(self, interval: Any = None, noise: Any = None) -> Known:
        """The same numbers with other intervals or noise factors; a single row applies to all samples."""
        given = {INTERVAL: interval, NOISE: noise}
        T = max(len(self), *(np.size(values) for values in given.values() if values is not None))
        columns = self.over(T).columns.copy()
        for place, values in given.items():
            if values is not None:
                columns[:, place] = values if columns.ndim == 2 else np.reshape(values, (-1, 1))
        return Known(columns)

    def begun(self, factors: Mapping[int, float]) -> Known:
        """The same numbers, with the intervals before the samples of these indices multiplied by a factor."""
        columns = self.columns.copy()
        for place, factor in factors.items():
            columns[place, INTERVAL] *= factor
        return Known(columns)

    def with_extra(self, columns: Array) -> Known:
        """The same numbers with extra columns (T, k) after interval, noise and drift."""
        common = self.common.over(len(columns)).columns
        if common.ndim > 2:
            columns = np.repeat(columns[:, :, None], common.shape[2], axis=2)
        return Known(np.hstack([common, columns]))

    def for_outputs(self, noise: Array) -> Known:
        """The same numbers for each of several outputs, which have separate factors of the noise variance (T, ny)."""
        T, ny = noise.shape
        columns = np.repeat(self.over(T).columns[:, :, None], ny, axis=2)
        columns[:, NOISE] = noise
        return Known(columns)

    def for_output(self, output: int) -> Known:
        """The known numbers of one of several outputs."""
        return Known(self.columns[..., output])

    def in_rows(self, T: int) -> Known:
        """(T ny, k): one row for each output of each instant; no time passes between the rows of an instant."""
        ny = self.columns.shape[2]
        columns = np.moveaxis(self.over(T).columns, 1, 2).flatten().reshape(T * ny, -1)
        columns[np.arange(T * ny) % ny > 0, INTERVAL] = 0.0
        return Known(columns)


@lru_cache(maxsize=256)
def row_of(interval: float, noise: float, drift: float) -> Known:
    """A row that holds for every sample; it is made once and cannot be written to."""
    columns = np.array([[interval, noise, drift]])
    columns.flags.writeable = False
    return Known(columns)
