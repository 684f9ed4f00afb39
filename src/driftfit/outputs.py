"""Several outputs: one theta for each, or one theta that all of them measure.

    ARX(.., ny=2), Regression(n, ny=2)     yo_t = phi_t' theta_o,t + v_o,t     the outputs are lanes of one tile
    Regression(n, ny=2, shared=True)       yo_t = phi_o,t' theta_t + v_o,t     rows of an instant, one after the other

Rows of one instant are successive samples between which no time passes: correcting with one row after the other is the
correction with all of them, for independent noises of variance r / weight. What is predicted for the second output
knows the first one already.

Each output of a record is a `Track` of its own (``run["level"]``): a regression on the regressors that the joint run
used, with everything that a Track can do.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from dataclasses import replace
from functools import cached_property
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from driftfit.drivers import drivers, known_factors, make_tile, output_type
from driftfit.judges.methods import JudgedMany
from driftfit.kernel import Array
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.records import Labels
from driftfit.result import Track, root_mean_square
from driftfit.settings import one_of
from driftfit.signals import as_inputs, as_numbers, check_ready, factor, intervals, noise_of
from driftfit.smoothers.smoothed import Smoothed
from driftfit.smoothers.walk import COLLECTED, collect
from driftfit.summary import WIDTH, table_of
from driftfit.trackers.base import Tracker

if TYPE_CHECKING:
    from os import PathLike

    from matplotlib.figure import Figure

    from driftfit.diagnose import Diagnosis
    from driftfit.verdict import Verdict


class Outputs(JudgedMany):
    """A record with several outputs, each with a theta of its own.

    Attributes
    ----------
    theta, std : (T, ny, n)
    prediction, innovation, innovation_std, ok : (T, ny)
        As in `Track`, output by output.
    outputs : tuple of str
        Names of the outputs; ``run[name]`` is the Track of one.
    names : tuple of tuples of str
        Names of the parameters of each output.
    """

    def __init__(
        self,
        model: Model,
        tracker: Tracker,
        y: Array,
        u: Array,
        time: Array | None,
        known: Array,
        out: Array,
        tile: Array,
    ) -> None:
        self.model, self.tracker, self.y, self.u = model, tracker, y, u
        self._time, self._known, self._out, self._tile = time, known, out, tile
        self.outputs = model.outputs
        self.names = tuple(model.names_of(output) for output in model.outputs)

    def __len__(self) -> int:
        return len(self.y)

    def __repr__(self) -> str:
        used = ", ".join(f"{name} {int(ok)}" for name, ok in zip(self.outputs, self.ok.sum(axis=0), strict=True))
        return f"Outputs of {len(self)} samples, used: {used}: {self.model!r}, {self.tracker!r}"

    def _written(self, name: str) -> Array:
        """A field of what the driver wrote, the output before the parameter."""
        return np.moveaxis(self._out[name], -1, 1)

    @property
    def theta(self) -> Array:
        return self._written("theta")

    @cached_property
    def std(self) -> Array:
        return np.sqrt(self._written("var"))

    @property
    def prediction(self) -> Array:
        return self._written("y_hat")

    @property
    def innovation(self) -> Array:
        return self._written("e")

    @cached_property
    def innovation_std(self) -> Array:
        return np.sqrt(self._written("s"))

    @cached_property
    def ok(self) -> Array:
        return self._written("ok") > 0.0

    @property
    def time(self) -> Array:
        """Times given, or sample numbers."""
        return np.arange(len(self)) if self._time is None else self._time

    @cached_property
    def loglik(self) -> float:
        """Sum over the outputs: their noises are taken to be independent."""
        return sum(track.loglik for track in self)

    @cached_property
    def _seen(self) -> Array:
        """What the tracker saw: the regressors, which all outputs share."""
        steps = self.tracker.steps_for(self.model)._replace(store=collect)
        tile = joint_tile(self.model, self.tracker)
        out = np.empty(len(self), output_type(tile, COLLECTED))
        drive(self.model, steps, "std", tile, self.y, self.u, self._known, out)
        return out

    def __getitem__(self, output: str | int) -> Track:
        """The record of one output, by name or place."""
        if output not in self.outputs and output not in range(len(self.outputs)):
            raise KeyError(f"there is no output {output!r}; there are {', '.join(self.outputs)}.")
        lane = output if isinstance(output, int) else self.outputs.index(output)
        name, seen = self.outputs[lane], self._seen
        phi = np.where(seen["valid"][:, lane, None] > 0.0, seen["phi"][..., lane], np.nan)
        T = len(self)
        known = np.broadcast_to(self._known, (T, 3)).copy()
        known[:, 0] = seen["dt"][:, lane]
        alone = Regression(self.names[lane])
        return Track(
            alone, self.tracker, self.y[:, lane], phi, self._time, known, self._out, self._tile, lane, Labels(y=name)
        )

    def __iter__(self) -> Iterator[Track]:
        return (self[name] for name in self.outputs)

    def _runs(self) -> dict[Hashable, Track]:
        return dict(zip(self.outputs, self, strict=True))

    def smooth(self, keep: str = "std") -> dict[str, Smoothed]:
        """The smoothed path of each output, by name."""
        return {name: self[name].smooth(keep) for name in self.outputs}

    def summary(self) -> str:
        """The summaries of all outputs."""
        return "\n\n".join(f"{name}\n{self[name].summary()}" for name in self.outputs)

    def plot(self, level: float = 0.95) -> Figure:
        """Parameters with bands: a row of pictures for each output."""
        from driftfit.plots import plot_outputs

        return plot_outputs(self, level)


class Shared:
    """A record whose outputs all measure one theta.

    ``theta``, ``std`` (T, n) are those after all outputs of an instant, ``prediction``, ``innovation``,
    ``innovation_std``, ``ok`` (T, ny) those of each. ``rows`` is the Track of the T ny rows.
    """

    def __init__(self, rows: Track, model: Model, time: Array | None) -> None:
        self.rows, self.model, self._time = rows, model, time
        self.outputs, self.names = model.outputs, rows.names

    def __len__(self) -> int:
        return len(self.rows) // len(self.outputs)

    def _by_output(self, values: Array) -> Array:
        return values.reshape(len(self), -1)

    @property
    def theta(self) -> Array:
        return self.rows.theta[len(self.outputs) - 1 :: len(self.outputs)]

    @property
    def std(self) -> Array:
        std: Array = self.rows.std[len(self.outputs) - 1 :: len(self.outputs)]
        return std

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

    def smooth(self, keep: str = "std") -> Smoothed:
        """The smoothed path of the rows; take every ny-th of them, between rows of one instant theta does not move."""
        return self.rows.smooth(keep)

    def verdict(self, level: float = 0.05, lags: int | None = None) -> Verdict:
        """Do the shared parameters move? The verdict of the rows; see `driftfit.verdict`."""
        return self.rows.verdict(level, lags)

    def diagnose(self) -> Diagnosis:
        """What `Track.diagnose` says of the rows."""
        return self.rows.diagnose()

    def report(self, path: str | PathLike[str], title: str | None = None) -> None:
        """The page of the rows; see `driftfit.report`."""
        self.rows.report(path, title)

    def summary(self) -> str:
        """Parameters now, and the one-step error of each output."""
        low, high = self.rows.band(0.95)
        table = table_of("Parameters after the last sample", "", "theta", "std", "[0.025", "0.975]")
        for i, name in enumerate(self.names):
            values = (self.theta[-1, i], self.std[-1, i], low[-1, i], high[-1, i])
            table.add_row(name, *(f"{value:.4g}" for value in values))
        errors = table_of("One-step prediction error, root mean square", *self.outputs)
        kept = self.innovation[max(50, 5 * len(self.names)) :]
        errors.add_row(*(f"{root_mean_square(e[np.isfinite(e)]):.5g}" for e in kept.T))
        text = StringIO()
        Console(file=text, width=WIDTH, color_system=None).print(table, errors)
        return text.getvalue()

    def plot(self, level: float = 0.95) -> Figure:
        """Parameters with bands, predictions and innovations of the rows."""
        return self.rows.plot(level)


def joint_tile(model: Model, tracker: Tracker) -> Array:
    """A tile with a lane for each output."""
    return make_tile(model.n, model.m, model.memory(), [tracker.state_for(model)] * len(model.outputs))


def row_model(model: Model, tracker: Tracker, m: int | None = None) -> Model:
    """The model of one row of a shared regression on m regressors."""
    assert isinstance(model, Regression)
    if not tracker.covariance:
        raise ValueError(
            f"{type(tracker).__name__} carries no covariance, so one row of an instant would not know of the others; "
            "use FLS, Kalman or RLS with shared=True."
        )
    alone = replace(model, ny=1, shared=False)
    return alone.bind(alone.m if m is None else m)


def drive(model: Model, steps: Any, keep: str, tile: Array, y: Array, u: Array, known: Array, out: Array) -> None:
    """Run a tile of outputs: every lane gets the same inputs."""
    ny = y.shape[1]
    inputs = np.repeat(u[:, :, None], ny, axis=2)
    drivers(model.steps, steps, keep).run(tile, y, inputs, np.repeat(known[:, :, None], ny, axis=2), out)


def track_outputs(
    model: Model, tracker: Tracker, y: Any, u: Any, time: Any, dt: Any, weights: Any, drift: Any, keep: str
) -> Outputs | Shared:
    """Record mode for a model with several outputs; see `driftfit.track`. y (T, ny); u as the model wants it."""
    ny = len(model.outputs)
    output = as_numbers("y", y)
    if output.ndim != 2 or output.shape[1] != ny or len(output) == 0:
        raise ValueError(f"y must be (T, {ny}) for the outputs {', '.join(model.outputs)}; got shape {output.shape}.")
    one_of("track", "keep", keep, ("std", "cov"))
    check_ready(tracker)
    T = len(output)
    axis, gaps = (None, 1.0) if time is None else intervals(time, dt, T)
    known = known_factors(gaps, noise_of(weights, T), factor("drift", drift, T))
    if model.shared:
        return _shared(model, tracker, output, u, axis, known, keep)
    inputs = as_inputs(u, T)
    bound = model.bind(inputs.shape[1])
    tile = joint_tile(bound, tracker)
    out = np.empty(T, output_type(tile, tracker.outputs, keep))
    drive(bound, tracker.steps_for(bound), keep, tile, output, inputs, known, out)
    return Outputs(bound, tracker, output, inputs, axis, known, out, tile)


def _shared(model: Model, tracker: Tracker, y: Array, u: Any, axis: Array | None, known: Array, keep: str) -> Shared:
    """Rows of one instant as successive samples between which no time passes."""
    from driftfit.track import drive as drive_one

    T, ny = y.shape
    regressors = as_numbers("u", u)
    if regressors.ndim != 3 or regressors.shape[:2] != (T, ny):
        raise ValueError(
            f"u must be (T, ny, m) = ({T}, {ny}, m) with shared=True: a row of regressors for each output; "
            f"got shape {regressors.shape}."
        )
    rows = row_model(model, tracker, regressors.shape[2])
    tile = joint_tile(rows, tracker)
    factors = np.repeat(np.broadcast_to(known, (T, 3)), ny, axis=0)
    factors[np.arange(T * ny) % ny > 0, 0] = 0.0
    flat, inputs = np.ascontiguousarray(y.ravel()), np.ascontiguousarray(regressors.reshape(T * ny, -1))
    out = drive_one(rows, tracker, tile, flat, inputs, factors, keep)
    times = None if axis is None else np.repeat(axis, ny)
    return Shared(Track(rows, tracker, flat, inputs, times, factors, out, tile), model, axis)
