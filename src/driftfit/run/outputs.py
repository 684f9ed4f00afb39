"""Several outputs, one theta for each.

    ARX(.., ny=2), Regression(n, ny=2)     yo_t = phi_t' theta_o,t + v_o,t     the outputs are lanes of one tile
    Regression(n, ny=2, shared=True)       yo_t = phi_o,t' theta_t + v_o,t     see `driftfit.run.shared_outputs`

Each output may have settings of its own, as a mapping from its name to its tracker; all of one kind, for they share the
compiled step. Each output of a record is a `Track` of its own (``run["level"]``): a regression on the regressors that
the joint run used, with everything that a Track can do.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from dataclasses import asdict, replace
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from driftfit.data import storage
from driftfit.data.record import PLAIN, Labels
from driftfit.engine.drivers import output_type
from driftfit.engine.kernel import Array
from driftfit.engine.settings import near
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.results import JudgedMany
from driftfit.run.output_lanes import Starts, drive, end_of, joint_tile, parameter_names, shown
from driftfit.run.result import Track
from driftfit.run.warm_start import End, fresh_tile
from driftfit.smooth.parts.walk import COLLECTED, collect
from driftfit.smooth.smoothed import Smoothed
from driftfit.trackers.base import Tracker

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from driftfit.use.forecast import Forecast


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
    trackers : tuple of Tracker
        The tracker of each output.
    """

    def __init__(
        self, model: Model, trackers: tuple[Tracker, ...], y: Array, u: Array, time: Array | None, known: Array,
        out: Array, tile: Array, starts: Starts = (), labels: Labels = PLAIN,
    ) -> None:  # fmt: skip
        self.model, self.trackers, self.y, self.u = model, trackers, y, u
        self._time, self._known, self._out, self._tile = time, known, out, tile
        self._starts, self.labels = starts, labels
        self.outputs = model.outputs
        self.names = parameter_names(model, trackers)

    def __len__(self) -> int:
        return len(self.y)

    def __repr__(self) -> str:
        used = ", ".join(f"{name} {int(ok)}" for name, ok in zip(self.outputs, self.ok.sum(axis=0), strict=True))
        return f"Outputs of {len(self)} samples, used: {used}: {self.model!r}, {shown(self.trackers)}"

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(missing(name, self.outputs[0]) if not name.startswith("_") else name)

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

    def band(self, level: float = 0.95) -> tuple[Array, Array]:
        """(low, high), each (T, ny, n): pointwise bands of theta at this level."""
        low, high = zip(*(track.band(level) for track in self), strict=True)
        return np.stack(low, axis=1), np.stack(high, axis=1)

    def cov(self, t: int) -> Array:
        """Covariances (ny, n, n) of the theta of each output after sample t."""
        return np.array([track.cov(t) for track in self])

    @cached_property
    def _seen(self) -> Array:
        """What the tracker saw: the regressors, which all outputs share."""
        steps = self.trackers[0].steps_for(self.model)._replace(store=collect)
        tile = joint_tile(self.model, self.trackers, self._starts)
        out = np.empty(len(self), output_type(tile, COLLECTED))
        drive(self.model, steps, "std", tile, self.y, self.u, self._known, out)
        return out

    def __getitem__(self, output: str | int) -> Track:
        """The record of one output, by name or place."""
        if output not in self.outputs and output not in range(len(self.outputs)):
            raise KeyError(f"there is no output {output!r}; there are {', '.join(self.outputs)}.")
        return self._tracks[output if isinstance(output, int) else self.outputs.index(output)]

    @cached_property
    def _tracks(self) -> tuple[Track, ...]:
        return tuple(self._track(lane) for lane in range(len(self.outputs)))

    def _track(self, lane: int) -> Track:
        """One output by itself, as a regression where the others are among its regressors."""
        tracker, alone, u = self.trackers[lane], self.model.alone(self.outputs[lane]), self.u
        known, names = self._known[..., lane].copy(), self.labels.u
        if alone is None:
            seen, names = self._seen, self.names[lane]
            alone, known[:, 0] = Regression(names), seen["dt"][:, lane]
            u = np.where(seen["valid"][:, lane, None] > 0.0, seen["phi"][..., lane], np.nan)
        tile = fresh_tile(alone, tracker)
        shapes = {name: tile[name].shape[:-1] for name in storage.fields(tile) if name != "u"}
        own = [name for name, shape in shapes.items() if shape == self._tile[name].shape[:-1]]
        for name in own:
            tile[name][0, ..., 0] = self._tile[name][0, ..., lane]
        out = np.empty(len(self), output_type(tile, tracker.outputs, "cov" if "P" in names_of(self._out) else "std"))
        for name in names_of(out):
            out[name][..., 0] = self._out[name][..., lane]
        start = {name: value for name, value in self._starts[lane].items() if name in own} if self._starts else None
        others = tuple(f"of {name} " for name in self.outputs if name != self.outputs[lane])
        missing = {reason: c for reason, c in self.labels.missing.items() if not reason.startswith(others)}
        labels = replace(self.labels, y=self.outputs[lane], u=names, missing=missing)
        return Track(alone, tracker, self.y[:, lane], u, self._time, known, out, tile, 0, labels, start)

    def __iter__(self) -> Iterator[Track]:
        return iter(self._tracks)

    def _runs(self) -> dict[Hashable, Track]:
        return dict(zip(self.outputs, self, strict=True))

    def smooth(self, keep: str = "std", order_by: Any = None, undetermined: str = "min_norm") -> dict[str, Smoothed]:
        """The smoothed path of each output, by name; the arguments are those of `Track.smooth`."""
        return {name: self[name].smooth(keep, order_by, undetermined) for name in self.outputs}

    def forecast(self, h: int, u: Any = None) -> Forecast:
        """The h nominal samples after the record, u (h,) or (h, m): theta, std (h, ny, n), y_hat, y_std (h, ny)."""
        from driftfit.use.forecast import forecast_outputs

        return forecast_outputs(self, h, u)

    def end(self) -> End:
        """Where the run ended, for another one to begin (`warm_start`); fields have the output as their last axis."""
        return end_of(self.model, self.trackers, self._tile, None if self._time is None else self._time[-1])

    def summary(self) -> str:
        """The summaries of all outputs."""
        return "\n\n".join(f"{name}\n{self[name].summary()}" for name in self.outputs)

    def plot(self, level: float = 0.95) -> Figure:
        """Parameters with bands: a row of pictures for each output."""
        from driftfit.show.plots import plot_outputs

        return plot_outputs(self, level)

    def to_table(self, kind: str = "polars") -> Any:
        """The results as one table, a row a sample; see `driftfit.data.export.outputs_table`."""
        from driftfit.data.export import outputs_table

        return outputs_table(self, kind)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the result to one file, without pickle; complete or not at all."""
        arrays = {"y": self.y, "u": self.u, "known": self._known}
        arrays |= {} if self._time is None else {"time": self._time}
        arrays |= {f"out_{name}": self._out[name] for name in names_of(self._out)}
        arrays |= {f"state_{name}": self._tile[name][0] for name in storage.fields(self._tile)}
        for lane, start in enumerate(self._starts):
            arrays |= {f"start{lane}_{name}": value for name, value in start.items()}
        header: dict[str, Any] = {"model": storage.describe(self.model)}
        header |= {"trackers": [storage.describe(one) for one in self.trackers]}
        header |= {"keep": "cov" if "P" in names_of(self._out) else "std", "labels": asdict(self.labels)}
        storage.write(path, {"kind": "outputs of a record", **header}, arrays)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Read what `save` wrote."""
        header, arrays = storage.read(path, "outputs of a record")
        model = storage.rebuild(header["model"], Model)
        trackers = tuple(storage.rebuild(one, Tracker) for one in header["trackers"])
        tile = joint_tile(model, trackers)
        storage.restore(path, trackers[0], arrays, "state_", {n: tile[n][0] for n in storage.fields(tile)})
        out = np.empty(len(arrays["y"]), output_type(tile, trackers[0].outputs, header["keep"]))
        storage.restore(path, trackers[0], arrays, "out_", {name: out[name] for name in names_of(out)})
        lanes = [f"start{lane}_" for lane in range(len(trackers))]
        starts = [{n.removeprefix(lane): arrays[n] for n in arrays if n.startswith(lane)} for lane in lanes]
        labels = Labels(**header["labels"])
        return cls(
            model, trackers, arrays["y"], arrays["u"], arrays.get("time"), arrays["known"], out, tile,
            starts if starts[0] else (), labels,
        )  # fmt: skip


def names_of(records: Array) -> tuple[str, ...]:
    """Fields of an array of records."""
    return records.dtype.names or ()


def missing(name: str, output: str) -> str:
    """What to say of an attribute that a run of several outputs does not have."""
    if hasattr(Track, name):
        return f"{name} is of one output at a time: run[{output!r}].{name}"
    return f"a run of several outputs has no {name!r}; {near(name, [one for one in dir(Outputs) if one[0] != '_'])}"
