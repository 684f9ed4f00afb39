"""Program: a bound model with a tracker. It makes the tiles that hold their state and keeps the compiled drivers.

Nothing else asks for tiles or drivers of a model and a tracker; a tile of several lanes has a program for each of them.
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
"""Samples between two looks at the progress bar."""

State = Mapping[str, Array]
"""Fields of one lane of a tile, by name."""


@dataclass(frozen=True)
class Program:
    """A bound model and the tracker that follows its parameters."""

    model: Model
    tracker: Tracker
    output: str | None = None
    """Which of several outputs it follows, in a lane beside the others."""

    @property
    def alone(self) -> Program | None:
        """The program of its output by itself; None where the model needs the other outputs, or has none."""
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
        """Fields of a lane before the first sample, beside those of the model."""
        if self.output is None:
            return self.tracker.state_for(self.model)
        own = self.model if self.alone is None else self.alone.model
        return {**own.memory(), **self.tracker.state_for(own)}

    @property
    def steps(self) -> TrackerSteps:
        """What the tracker compiles for this model."""
        return self.tracker.steps_for(self.model)

    @property
    def shapes(self) -> tuple[Any, ...]:
        """Names and shapes of the tracker's state: programs with the same ones and the same steps may share a tile."""
        return tuple((name, np.shape(value)) for name, value in self.tracker.state_for(self.model).items())

    def drivers(self, keep: str = "std", steps: TrackerSteps | None = None) -> Drivers:
        """The compiled loops; ``steps`` take the place of the tracker's own, to look inside."""
        return drivers(self.model.steps, self.steps if steps is None else steps, keep)

    def tile(self, state: State | None = None, **more: Any) -> Array:
        """A tile of one lane at its start, or with the given fields; ``more`` are fields beside the tracker's own."""
        return tile_of([self], () if state is None else (state,), **more)

    def resting(self, state: State) -> Array:
        """A tile with the state of a run; what was known of its last sample alone is left behind."""
        return self.tile({name: value for name, value in state.items() if name not in STANDING})

    def written(self, tile: Array, T: int, keep: str = "std") -> Array:
        """Room for what a driver writes of T samples of a tile."""
        return np.empty(T, output_type(tile, self.tracker.outputs, keep))

    def run(self, tile: Array, record: Record, keep: str = "std") -> Array:
        """Drive a tile of one lane over a record; returns what the driver wrote, (T,) records of `output_type`."""
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
"""Fields that hold what is known of one sample."""


def tile_of(programs: Sequence[Program], states: Sequence[State] = (), **more: Any) -> Array:
    """A tile with a lane for each program (all of one model), at its start or with the given fields."""
    model = programs[0].model
    starts = {one: {**one.start, **more} for one in programs}
    tile = make_tile(model.n, model.m, model.memory(), [starts[one] for one in programs])
    for lane, state in enumerate(states):
        for name, value in state.items():
            tile[name][0, ..., lane] = value
    return tile


def lane_of(record: Record) -> tuple[Array, Array, Array]:
    """(y, u, known) of a record as the drivers of a tile of one lane take them."""
    return record.y[:, None], record.u[:, :, None], record.known.columns[:, :, None]


def spread(record: Record, L: int) -> tuple[Array, Array, Array]:
    """(y, u, known) of a record, the same in each of L lanes."""
    y, u, known = (np.repeat(part[..., None], L, axis=-1) for part in (record.y, record.u, record.known.columns))
    return y, u, known


def state_of(tile: Array, lane: int = 0) -> dict[str, Array]:
    """The fields of a lane, by name, as views."""
    return {name: tile[name][0, ..., lane : lane + 1][..., 0] for name in storage.fields(tile)}
