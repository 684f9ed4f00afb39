"""Several outputs that all measure one theta: ``Regression(n, ny=2, shared=True)``.

Rows of one instant are successive samples between which no time passes: correcting with one row after the other is the
correction with all of them, for independent noises of variance r / weight. What is predicted for the second output
knows the first one already.
"""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from driftfit.data import storage
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.run.output_lanes import end_of
from driftfit.run.outputs import missing
from driftfit.run.result import Track, root_mean_square
from driftfit.run.warm_start import End
from driftfit.show.summary import printed, table_of
from driftfit.smooth.shared_theta import SmoothedShared
from driftfit.trackers.base import Tracker

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from driftfit.judge.diagnose import Diagnosis
    from driftfit.judge.verdict import Verdict
    from driftfit.use.forecast import Forecast


class Shared:
    """A record whose outputs all measure one theta.

    ``theta``, ``std`` (T, n) are those after all outputs of an instant, ``prediction``, ``innovation``,
    ``innovation_std``, ``ok`` (T, ny) those of each. ``rows`` is the Track of the T ny rows.
    """

    def __init__(self, rows: Track, model: Model, time: Array | None) -> None:
        self.rows, self.model, self._time = rows, model, time
        self.outputs, self.names, self.tracker, self.labels = model.outputs, rows.names, rows.tracker, rows.labels

    def __len__(self) -> int:
        return len(self.rows) // len(self.outputs)

    def __repr__(self) -> str:
        return f"Outputs of {len(self)} samples of one theta: {self.model!r}, {self.tracker!r}"

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(
            f"{name} is of the rows: run.rows.{name}" if hasattr(Track, name) and name[0] != "_" else missing(name, "")
        )

    def _by_output(self, values: Array) -> Array:
        return values.reshape(len(self), -1)

    def _last(self, values: Array) -> Array:
        """Of each instant what holds after all its rows."""
        return values[len(self.outputs) - 1 :: len(self.outputs)]

    @property
    def y(self) -> Array:
        return self._by_output(self.rows.y)

    @property
    def u(self) -> Array:
        """(T, ny, m)"""
        return self.rows.u.reshape(len(self), len(self.outputs), -1)

    @property
    def theta(self) -> Array:
        return self._last(self.rows.theta)

    @property
    def std(self) -> Array:
        return self._last(self.rows.std)

    @property
    def prediction(self) -> Array:
        return self._by_output(self.rows.prediction)

    @property
    def innovation(self) -> Array:
        return self._by_output(self.rows.innovation)

    @property
    def innovation_std(self) -> Array:
        return self._by_output(self.rows.innovation_std)

    @property
    def ok(self) -> Array:
        return self._by_output(self.rows.ok)

    @property
    def time(self) -> Array:
        """Times given, or sample numbers."""
        return np.arange(len(self)) if self._time is None else self._time

    @property
    def loglik(self) -> float:
        return self.rows.loglik

    def cov(self, t: int) -> Array:
        """Covariance (n, n) of theta after all outputs of sample t."""
        return self.rows.cov((t % len(self) + 1) * len(self.outputs) - 1)

    def band(self, level: float = 0.95) -> tuple[Array, Array]:
        """(low, high), each (T, n): pointwise bands of theta at this level."""
        low, high = self.rows.band(level)
        return self._last(low), self._last(high)

    def smooth(self, keep: str = "std", order_by: Any = None, undetermined: str = "min_norm") -> SmoothedShared:
        """The smoothed path: theta (T, n) as here, residuals of every output (T, ny)."""
        if order_by is not None:
            raise ValueError("smooth: order_by= would separate the rows of an instant; it needs a single output.")
        return SmoothedShared(self.rows.smooth(keep, undetermined=undetermined), self)

    def forecast(self, h: int, u: Any = None) -> Forecast:
        """The h nominal samples after the record, u (h, ny, m): theta, std (h, n), y_hat, y_std (h, ny)."""
        from driftfit.use.forecast import forecast_outputs

        return forecast_outputs(self, h, u)

    def end(self) -> End:
        """Where the run ended, for another one to begin (`warm_start`)."""
        rows = self.rows
        return end_of(rows.model, (rows.tracker,), rows._tile, None if self._time is None else self._time[-1])

    def verdict(self, level: float = 0.05, lags: int | None = None, burn: int | None = None) -> Verdict:
        """Do the shared parameters move? The verdict of the rows; see `driftfit.judge.verdict`."""
        return self.rows.verdict(level, lags, burn)

    def diagnose(self) -> Diagnosis:
        """What `Track.diagnose` says of the rows."""
        return self.rows.diagnose()

    def report(self, path: str | PathLike[str], title: str | None = None) -> None:
        """The page of the rows; see `driftfit.show.report`."""
        self.rows.report(path, title)

    def summary(self) -> str:
        """Parameters now, and the one-step error of each output."""
        low, high = self.band(0.95)
        table = table_of("Parameters after the last sample", "", "theta", "std", "[0.025", "0.975]")
        for i, name in enumerate(self.names):
            values = (self.theta[-1, i], self.std[-1, i], low[-1, i], high[-1, i])
            table.add_row(name, *(f"{value:.4g}" for value in values))
        errors = table_of("One-step prediction error, root mean square", *self.outputs)
        kept = self.innovation[max(50, 5 * len(self.names)) :]
        errors.add_row(*(f"{root_mean_square(e[np.isfinite(e)]):.5g}" for e in kept.T))
        return printed(table, errors)

    def plot(self, level: float = 0.95) -> Figure:
        """Parameters with bands, predictions and innovations of the rows."""
        return self.rows.plot(level)

    def to_table(self, kind: str = "polars") -> Any:
        """The results as one table, a row a sample; see `driftfit.data.export.outputs_table`."""
        from driftfit.data.export import outputs_table

        return outputs_table(self, kind)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the result to one file, without pickle; complete or not at all."""
        header, arrays = self.rows.written()
        arrays |= {} if self._time is None else {"instants": self._time}
        storage.write(path, {**header, "kind": "shared outputs", "shared": storage.describe(self.model)}, arrays)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Read what `save` wrote."""
        header, arrays = storage.read(path, "shared outputs")
        rows = Track.from_written(path, header, arrays)
        return cls(rows, storage.rebuild(header["shared"], Model), arrays.get("instants"))


def row_model(model: Model, tracker: Tracker, m: int | None = None) -> Model:
    """The model of one row of a shared regression on m regressors."""
    assert isinstance(model, Regression)
    if not tracker.covariance:
        raise ValueError(
            f"{type(tracker).__name__} carries no covariance, so the rows of an instant could not inform each other; "
            "use FLS, Kalman or RLS with shared=True."
        )
    alone = replace(model, ny=1, shared=False)
    return alone.bind(alone.m if m is None else m)
