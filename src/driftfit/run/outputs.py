"""Several outputs, one theta for each.

    ARX(.., ny=2), Regression(n, ny=2)     yo_t = phi_t' theta_o,t + v_o,t     the outputs are lanes of one tile
    Regression(n, ny=2, shared=True)       yo_t = phi_o,t' theta_t + v_o,t     one Track, see `driftfit.run.columns`

Each output may have its own settings, as a mapping from its name to its tracker; all trackers are of one kind, because
they share the compiled step. Each output of a record is a `Track` (``run["level"]``): a regression on the regressors
that the joint run used, with all methods of a Track.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from driftfit.data.record import Record
from driftfit.engine.kernel import Array
from driftfit.engine.settings import near
from driftfit.models.regression import Regression
from driftfit.readings.left_out import NOTHING_LEFT_OUT, left_out_of
from driftfit.run.columns import COLLECTED, OfRecord, collect
from driftfit.run.keyed_results import KeyedResults
from driftfit.run.lanes import Lane, names_of
from driftfit.run.program import Program, kept, lanes_of, shown, state_of, tile_of
from driftfit.run.result import Track
from driftfit.run.warm_start import End
from driftfit.trackers.base import Tracker


class Outputs(KeyedResults, OfRecord):
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

    _kind = "outputs of a record"

    @cached_property
    def record(self) -> Record:
        """The record, y (T, ny)."""
        return self.records.part(0)

    @property
    def outputs(self) -> tuple[str, ...]:
        return self.records.outputs

    @property
    def names(self) -> tuple[tuple[str, ...], ...]:
        return tuple(one.names for one in self._programs)

    @property
    def trackers(self) -> tuple[Tracker, ...]:
        return tuple(one.tracker for one in self._programs)

    @property
    def by(self) -> tuple[str, ...]:
        return ("output",)

    def _named(self) -> Sequence[Hashable]:
        return self.records.outputs

    def __len__(self) -> int:
        return len(self.record)

    def __repr__(self) -> str:
        used = ", ".join(f"{name} {int(ok)}" for name, ok in zip(self.outputs, self.ok.sum(axis=0), strict=True))
        return f"Outputs of {len(self)} samples, used: {used}: {self.model!r}, {shown(self.trackers)}"

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(missing(name, self.outputs[0]) if not name.startswith("_") else name)

    def in_rows(self, name: str) -> Array:
        """A field of the driver's output, (T, ny, ..)."""
        if name not in self._stacked:
            self._stacked[name] = np.stack([lane.written(name) for lane in self._lanes], axis=1)
        return self._stacked[name]

    @cached_property
    def _stacked(self) -> dict[str, Array]:
        return {}

    @cached_property
    def loglik(self) -> float:
        """Sum over the outputs: their noises are assumed to be independent."""
        return sum(track.loglik for track in self.values())

    def band(self, level: float = 0.95, conformal: bool = False) -> tuple[Array, Array]:
        """(low, high), each (T, ny, n): pointwise bands of theta at this level; ``conformal`` as for `Track.band`."""
        low, high = zip(*(track.band(level, conformal) for track in self.values()), strict=True)
        return np.stack(low, axis=1), np.stack(high, axis=1)

    def cov(self, t: int) -> Array:
        """Covariances (ny, n, n) of the theta of each output after sample t."""
        return np.array([track.cov(t) for track in self.values()])

    @cached_property
    def _collected(self) -> Array:
        """The samples as the tracker received them, with the regressors that all outputs share."""
        return self.replayed(collect, COLLECTED)

    def replayed(self, store: Any, fields: tuple[str, ...]) -> Array:
        """The run again, (T,) records of a lane for each output, with these fields as ``store`` writes them."""
        tile = tile_of(self._programs, [self._starts[j] for j in sorted(self._starts)])
        out = self._programs[0].inspected(tile, len(self), fields)
        steps = self._programs[0].steps._replace(store=store)
        self._programs[0].drivers(steps=steps).run(tile, *lanes_of(self.record), out)
        return out

    def __getitem__(self, output: str | int) -> Track:
        """The record of one output, by name or index."""
        if output not in self.outputs and output not in range(len(self.outputs)):
            raise KeyError(f"there is no output {output!r}; there are {', '.join(self.outputs)}.")
        return self._tracks[output if isinstance(output, int) else self.outputs.index(output)]

    @cached_property
    def _tracks(self) -> tuple[Track, ...]:
        return tuple(self._track(lane) for lane in range(len(self.outputs)))

    def _run(self, j: int) -> Track:
        return self._tracks[j]

    def _track(self, j: int) -> Track:
        """One output alone, as a regression whose regressors may contain the other outputs."""
        alone, y, u, lane = self._programs[j].alone, self.y[:, j], self.u, self._lanes[j]
        left = NOTHING_LEFT_OUT
        known, names, units = self.record.known.for_output(j), self.labels.u, dict(self.labels.units)
        if alone is None:
            found, names = self._collected, self.names[j]
            alone, known = Program(Regression(names), self.trackers[j]), known.changed(interval=found["dt"][:, j])
            signals = {("y", k): name for k, name in enumerate(self.outputs)}
            signals |= {("u", k): name for k, name in enumerate(self.labels.u)}
            held = [(name, signals.get(term[:2])) for name, term in zip(names, self.model.terms or (), strict=False)]
            units |= {name: units[source] for name, source in held if source in units}
            u = np.where(found["valid"][:, j, None] > 0.0, found["phi"][..., j], np.nan)
            if self._programs[j].gate is not None:
                left = left_out_of(lane.written("reason"), y, lane.written("ok") > 0.0, 0, self._programs[j].signals)
                y, noise = left.applied(y, known.noise)
                known = known.changed(noise=noise)
        tile = alone.tile()
        shapes = {name: value.shape for name, value in state_of(tile).items() if name != "u"}
        state = state_of(lane.tile, lane.lane)
        own = [name for name, shape in shapes.items() if shape == state[name].shape]
        for name in own:
            tile[name][0, ..., 0] = state[name]
        out = alone.written(tile, len(self), *kept(lane.out.dtype))
        for name in names_of(out):
            out[name][..., 0] = lane.written(name)
        start = {name: value for name, value in self._starts[j].items() if name in own} if self._starts else None
        others = tuple(f"of {name} " for name in self.outputs if name != self.outputs[j])
        missing = {reason: c for reason, c in self.record.labels.missing.items() if not reason.startswith(others)}
        labels = replace(self.record.labels, y=self.outputs[j], u=names, missing=missing, units=units)
        record = Record(y, u, known, self.record.time, labels)
        return Track(alone, record, Lane(out, tile), start, left)

    def __contains__(self, output: object) -> bool:
        return output in self.outputs

    def end(self) -> End:
        """The end of the run, from which another one can continue (`warm_start`)."""
        lanes = [state_of(lane.tile, lane.lane) for lane in self._lanes]
        states = tuple({name: value.copy() for name, value in lane.items()} for lane in lanes)
        labels = self.labels
        return End(self._programs, states, self.time[-1] if self.timed else None, dt=labels.dt, zone=labels.zone)


def missing(name: str, output: str) -> str:
    """The message for an attribute that a run of several outputs does not have."""
    if hasattr(Track.public(), name):
        return f"{name} is of one output at a time: run[{output!r}].{name}"
    known = [one for one in dir(Outputs.public()) if one[0] != "_"]
    return f"a run of several outputs has no {name!r}; {near(name, known)}"
