"""Program: a bound model with a tracker. It makes the tiles that hold their state and keeps the compiled drivers.

No other module makes tiles or drivers of a model and a tracker; a tile of several lanes has a program for each of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from driftfit.data import storage
from driftfit.data.record import Record
from driftfit.engine.drivers import Drivers, TrackerSteps, drivers, make_tile, output_type
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.trackers.base import Tracker

CHUNK = 1_000_000
"""Samples between two updates of the progress bar."""

State = Mapping[str, Array]
"""Fields of one lane of a tile, by name."""


@dataclass(frozen=True)
class Program:
    """A bound model and the tracker that estimates its parameters."""

    model: Model
    tracker: Tracker
    output: str | None = None
    """Which of several outputs it belongs to, in one of several lanes."""

    @property
    def alone(self) -> Program | None:
        """The program of its output alone; None if the model needs the other outputs, or has none."""
        model = None if self.output is None else self.model.alone(self.output)
        return None if model is None else Program(model, self.tracker)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        if self.output is None:
            return self.tracker.names_for(self.model)
        own = () if self.alone is None else self.alone.names
        return tuple(f"{name}[{self.output}]" for name in own) or self.model.names_of(self.output)

    @property
    def start(self) -> State:
        """Fields of a lane before the first sample, other than those of the model."""
        if self.output is None:
            return self.tracker.state_for(self.model)
        own = self.model if self.alone is None else self.alone.model
        return {**own.memory_for(self.steps.doubts), **self.tracker.state_for(own)}

    @property
    def steps(self) -> TrackerSteps:
        """The compiled steps of the tracker."""
        return self.tracker.steps_for(self.model)

    @property
    def shapes(self) -> tuple[Any, ...]:
        """Names and shapes of the tracker's state: programs with equal shapes and equal steps may share a tile."""
        return tuple((name, np.shape(value)) for name, value in self.tracker.state_for(self.model).items())

    def drivers(self, keep: str = "std", steps: TrackerSteps | None = None) -> Drivers:
        """The compiled loops; ``steps`` replace the tracker's own, to inspect the run."""
        return drivers(self.model.steps_for(self.steps.doubts), self.steps if steps is None else steps, keep)

    def tile(self, state: State | None = None) -> Array:
        """A tile of one lane at its start, or with the given fields."""
        return tile_of([self], () if state is None else (state,))

    def resting(self, state: State) -> Array:
        """A tile with the state of a run, without the known factors of its last sample."""
        return self.tile({name: value for name, value in state.items() if name not in STANDING})

    def written(self, tile: Array, T: int, keep: str = "std") -> Array:
        """An array for the driver's output of T samples of a tile."""
        return np.empty(T, output_type(tile, self.tracker.outputs, keep))

    def run(self, tile: Array, record: Record, keep: str = "std") -> Array:
        """Run a tile of one lane over a record; returns the driver's output, (T,) records of `output_type`."""
        T = len(record)
        out = self.written(tile, T, keep)
        with Progress(console=Console(stderr=True), transient=True, disable=T <= CHUNK) as progress:
            task = progress.add_task("tracking", total=T)
            for a in range(0, T, CHUNK):
                b = min(a + CHUNK, T)
                self.drivers(keep).run(tile, *lane_of(record.part(slice(a, b))), out[a:b])
                progress.advance(task, b - a)
        return out


STANDING = ("interval", "noise", "drift", "each")
"""Fields with the known factors of one sample."""


def tile_of(programs: Sequence[Program], states: Sequence[State] = ()) -> Array:
    """A tile with a lane for each program (all of one model), at its start or with the given fields."""
    model = programs[0].model
    starts = {one: one.start for one in programs}
    memory = model.memory_for(programs[0].steps.doubts)
    tile = make_tile(model.n, model.m, memory, [starts[one] for one in programs])
    for lane, state in enumerate(states):
        for name, value in state.items():
            tile[name][0, ..., lane] = value
    return tile


def lane_of(record: Record) -> tuple[Array, Array, Array]:
    """(y, u, known) of a record in the form that drivers of a tile of one lane take."""
    return record.y[:, None], record.u[:, :, None], record.known.columns[:, :, None]


def spread(record: Record, L: int) -> tuple[Array, Array, Array]:
    """(y, u, known) of a record, the same in each of L lanes."""
    y, u, known = (np.repeat(part[..., None], L, axis=-1) for part in (record.y, record.u, record.known.columns))
    return y, u, known


def state_of(tile: Array, lane: int = 0) -> dict[str, Array]:
    """The fields of a lane, by name, as views."""
    return {name: tile[name][0, ..., lane : lane + 1][..., 0] for name in storage.fields(tile)}
