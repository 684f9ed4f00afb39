"""Several outputs, one theta for each.

    ARX(.., ny=2), Regression(n, ny=2)     yo_t = phi_t' theta_o,t + v_o,t     the outputs are lanes of one tile
    Regression(n, ny=2, shared=True)       yo_t = phi_o,t' theta_t + v_o,t     see `driftfit.run.shared_outputs`

Each output may have its own settings, as a mapping from its name to its tracker; all trackers are of one kind, because
they share the compiled step. Each output of a record is a `Track` (``run["level"]``): a regression on the regressors
that the joint run used, with all methods of a Track.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from os import PathLike
from typing import Any, Self

import numpy as np

from driftfit.data import storage
from driftfit.data.known import Known
from driftfit.data.record import Labels, Record
from driftfit.engine.drivers import output_type
from driftfit.engine.kernel import Array
from driftfit.engine.settings import near
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.run.collected_samples import COLLECTED, collect
from driftfit.run.fleet import Many
from driftfit.run.output_lanes import shown
from driftfit.run.program import Program, State, state_of, tile_of
from driftfit.run.result import Lane, Track, names_of
from driftfit.run.warm_start import End
from driftfit.trackers.base import Tracker


class Outputs(Many):
    """A record with several outputs, each with its own theta.

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
        self, programs: Sequence[Program], record: Record, out: Array, tile: Array, starts: Sequence[State] = ()
    ) -> None:
        self.programs, self.record, self.starts = tuple(programs), record, tuple(starts)
        self._out, self._tile = out, tile
        self.failed = {}
        self.outputs = self.model.outputs
        self.names = tuple(one.names for one in self.programs)

    @property
    def model(self) -> Model:
        return self.programs[0].model

    @property
    def trackers(self) -> tuple[Tracker, ...]:
        return tuple(one.tracker for one in self.programs)

    @property
    def y(self) -> Array:
        return self.record.y

    @property
    def u(self) -> Array:
        return self.record.u

    @property
    def labels(self) -> Labels:
        return self.record.labels

    @property
    def timed(self) -> bool:
        """Whether samples have times; otherwise `time` numbers them."""
        return self.record.time is not None

    @property
    def by(self) -> tuple[str, ...]:
        return ("output",)

    def __len__(self) -> int:
        return len(self.record)

    def __repr__(self) -> str:
        used = ", ".join(f"{name} {int(ok)}" for name, ok in zip(self.outputs, self.ok.sum(axis=0), strict=True))
        return f"Outputs of {len(self)} samples, used: {used}: {self.model!r}, {shown(self.trackers)}"

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(missing(name, self.outputs[0]) if not name.startswith("_") else name)

    def _written(self, name: str) -> Array:
        """A field of the driver's output, with the output axis before the parameter axis."""
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
        """The given times, or sample numbers."""
        return np.arange(len(self)) if self.record.time is None else self.record.time

    @cached_property
    def loglik(self) -> float:
        """Sum over the outputs: their noises are assumed to be independent."""
        return sum(track.loglik for track in self.values())

    def band(self, level: float = 0.95) -> tuple[Array, Array]:
        """(low, high), each (T, ny, n): pointwise bands of theta at this level."""
        low, high = zip(*(track.band(level) for track in self.values()), strict=True)
        return np.stack(low, axis=1), np.stack(high, axis=1)

    def cov(self, t: int) -> Array:
        """Covariances (ny, n, n) of the theta of each output after sample t."""
        return np.array([track.cov(t) for track in self.values()])

    @cached_property
    def _seen(self) -> Array:
        """The samples as the tracker received them, with the regressors that all outputs share."""
        steps = self.programs[0].steps._replace(store=collect)
        tile = tile_of(self.programs, self.starts)
        out = np.empty(len(self), output_type(tile, COLLECTED))
        self.programs[0].drivers(steps=steps).run(tile, *lanes_of(self.record), out)
        return out

    def __getitem__(self, output: str | int) -> Track:
        """The record of one output, by name or index."""
        if output not in self.outputs and output not in range(len(self.outputs)):
            raise KeyError(f"there is no output {output!r}; there are {', '.join(self.outputs)}.")
        return self._tracks[output if isinstance(output, int) else self.outputs.index(output)]

    @cached_property
    def _tracks(self) -> tuple[Track, ...]:
        return tuple(self._track(lane) for lane in range(len(self.outputs)))

    def _track(self, lane: int) -> Track:
        """One output alone, as a regression whose regressors may contain the other outputs."""
        alone, u = self.programs[lane].alone, self.u
        known, names, units = Known(self.record.known.columns[..., lane]), self.labels.u, dict(self.labels.units)
        if alone is None:
            seen, names = self._seen, self.names[lane]
            alone, known = Program(Regression(names), self.trackers[lane]), known.changed(interval=seen["dt"][:, lane])
            held = zip(names, self.model.sources, strict=True)
            units |= {name: units[source] for name, source in held if source in units}
            u = np.where(seen["valid"][:, lane, None] > 0.0, seen["phi"][..., lane], np.nan)
        tile = alone.tile()
        shapes = {name: value.shape for name, value in state_of(tile).items() if name != "u"}
        state = state_of(self._tile, lane)
        own = [name for name, shape in shapes.items() if shape == state[name].shape]
        for name in own:
            tile[name][0, ..., 0] = state[name]
        out = alone.written(tile, len(self), "cov" if "P" in names_of(self._out) else "std")
        for name in names_of(out):
            out[name][..., 0] = self._out[name][..., lane]
        start = {name: value for name, value in self.starts[lane].items() if name in own} if self.starts else None
        others = tuple(f"of {name} " for name in self.outputs if name != self.outputs[lane])
        missing = {reason: c for reason, c in self.labels.missing.items() if not reason.startswith(others)}
        labels = replace(self.labels, y=self.outputs[lane], u=names, missing=missing, units=units)
        record = Record(self.y[:, lane], u, known, self.record.time, labels)
        return Track(alone, record, Lane(out, tile), start)

    def keys(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.outputs

    def values(self) -> tuple[Track, ...]:
        """The record of each output."""
        return self._tracks

    def items(self) -> Iterator[tuple[str, Track]]:
        """Names and records of the outputs."""
        return zip(self.outputs, self._tracks, strict=True)

    def __iter__(self) -> Iterator[str]:
        return iter(self.outputs)

    def __contains__(self, output: object) -> bool:
        return output in self.outputs

    def runs(self) -> dict[Hashable, Track]:
        return dict(self.items())

    def end(self) -> End:
        """The end of the run, from which another one can continue (`warm_start`)."""
        lanes = range(len(self.outputs))
        states = tuple({n: value.copy() for n, value in state_of(self._tile, lane).items()} for lane in lanes)
        return End(self.programs, states, None if self.record.time is None else self.record.time[-1])

    def save(self, path: str | PathLike[str]) -> None:
        """Write the result to one file without pickle, completely or not at all."""
        arrays = {"y": self.y, "u": self.u, "known": self.record.known.columns}
        arrays |= {} if self.record.time is None else {"time": self.record.time}
        arrays |= {f"out_{name}": self._out[name] for name in names_of(self._out)}
        arrays |= {f"state_{name}": self._tile[name][0] for name in storage.fields(self._tile)}
        for lane, start in enumerate(self.starts):
            arrays |= {f"start{lane}_{name}": value for name, value in start.items()}
        header: dict[str, Any] = {"model": storage.describe(self.model)}
        header |= {"trackers": [storage.describe(one) for one in self.trackers]}
        header |= {"keep": "cov" if "P" in names_of(self._out) else "std", "labels": asdict(self.labels)}
        storage.write(path, {"kind": "outputs of a record", **header}, arrays)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Read a file that `save` wrote."""
        header, arrays = storage.read(path, "outputs of a record")
        model = storage.rebuild(header["model"], Model)
        programs = [Program(model, storage.rebuild(one, Tracker)) for one in header["trackers"]]
        tracker, tile = programs[0].tracker, tile_of(programs)
        storage.restore(path, tracker, arrays, "state_", {n: tile[n][0] for n in storage.fields(tile)})
        out = programs[0].written(tile, len(arrays["y"]), header["keep"])
        storage.restore(path, tracker, arrays, "out_", {name: out[name] for name in names_of(out)})
        lanes = [f"start{lane}_" for lane in range(len(programs))]
        starts = [{n.removeprefix(lane): arrays[n] for n in arrays if n.startswith(lane)} for lane in lanes]
        labels = Labels(**header["labels"])
        record = Record(arrays["y"], arrays["u"], Known(arrays["known"]), arrays.get("time"), labels)
        return cls(programs, record, out, tile, starts if starts[0] else ())


def lanes_of(record: Record) -> tuple[Array, Array, Array]:
    """(y, u, known) of a record of outputs, y (T, ny), known (T, k, ny): every lane gets the same inputs u (T, m)."""
    return record.y, np.repeat(record.u[:, :, None], record.y.shape[1], axis=2), record.known.columns


def missing(name: str, output: str) -> str:
    """The message for an attribute that a run of several outputs does not have."""
    if hasattr(Track.public(), name):
        return f"{name} is of one output at a time: run[{output!r}].{name}"
    known = [one for one in dir(Outputs.public()) if one[0] != "_"]
    return f"a run of several outputs has no {name!r}; {near(name, known)}"
