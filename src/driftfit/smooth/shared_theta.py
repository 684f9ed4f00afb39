"""The smoothed path of outputs that share one theta: one theta per instant, one residual per output.

Rows of one instant are successive samples between which theta does not move. The estimate after its last row is
therefore that of the instant, and the lag from one instant to the next is that from its last row to the first row of
the next.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, Self

from driftfit.engine.kernel import Array
from driftfit.run.result import Track
from driftfit.smooth.parts.walk import Walk
from driftfit.smooth.smoothed import Smoothed


class SmoothedShared(Smoothed):
    """Shared parameters of a record, each estimated from the complete record.

    As `Smoothed`, with ``theta``, ``std``, ``slope`` (T, n), ``rank`` (T,) and ``residual``, ``loo``, ``leverage``
    (T, ny). ``rows`` is the path of the T ny rows.
    """

    @classmethod
    def of_shared(cls, run: Track, keep: str = "std", order_by: Any = None, undetermined: str = "min_norm") -> Self:
        """Smooth a record of outputs that share one theta."""
        if order_by is not None:
            raise ValueError("smooth: order_by= would separate the rows of an instant; it needs a single output.")
        return cls(Smoothed.of(run.rows, keep, undetermined=undetermined), run)

    def __init__(self, rows: Smoothed, run: Track) -> None:
        self.rows, self._ny = rows, len(run.outputs)
        self.run: Any = run
        self._walk, self._path, self._data, self.order_by = rows._walk, rows._path, rows._data, None
        self.theta, self.rank = self._last(rows.theta), self._last(rows.rank)
        self.cost, self.method, self.r = rows.cost, rows.method, rows.r
        self.measurement_cost = rows.measurement_cost

    @property
    def walk(self) -> Walk:
        """The problem of the rows."""
        return self.rows.walk

    def _last(self, values: Array) -> Array:
        """The values of each instant after all its rows."""
        return values[self._ny - 1 :: self._ny]

    def _by_output(self, values: Array) -> Array:
        return values.reshape(-1, self._ny)

    @cached_property
    def std(self) -> Array:
        return self._last(self.rows.std)

    @property
    def slope(self) -> Array:
        """Change of theta per nominal interval, (T, n), if the slope is a random walk (``differences=2``)."""
        return self._last(self.rows.slope)

    @cached_property
    def slope_std(self) -> Array:
        """Standard deviation of the slope, (T, n)."""
        return self._last(self.rows.slope_std)

    @cached_property
    def leverage(self) -> Array:
        return self._by_output(self.rows.leverage)

    @cached_property
    def residual(self) -> Array:
        return self._by_output(self.rows.residual)

    @cached_property
    def loo(self) -> Array:
        return self._by_output(self.rows.loo)

    @cached_property
    def press(self) -> float:
        return self.rows.press

    @cached_property
    def alone(self) -> int:
        return self.rows.alone

    @property
    def weight(self) -> Array:
        return self.rows.weight

    def cov(self, t: int) -> Array:
        """Covariance (n, n) of theta at sample t; entries of undetermined parameters are inf on the diagonal."""
        return self.rows.cov(range(len(self.theta))[t] * self._ny + self._ny - 1)

    def lag_cov(self, t: int) -> Array:
        """Covariance (n, n) of theta at samples t and t + 1, rows for t."""
        return self.rows.lag_cov(range(len(self.theta) - 1)[t] * self._ny + self._ny - 1)
