"""Several outputs as lanes of one tile: their trackers, their start, and the loop over a record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from driftfit.data import storage
from driftfit.data.signals import check_ready
from driftfit.engine.drivers import drivers, make_tile
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.run.warm_start import End, Run, carried
from driftfit.trackers.base import Tracker

Starts = Sequence[Mapping[str, Array]]
"""The fields that each lane takes over from a run before."""


def shown(trackers: Sequence[Tracker]) -> str:
    """The tracker of all outputs, or of each."""
    return repr(trackers[0]) if len(set(trackers)) == 1 else ", ".join(map(repr, trackers))


def trackers_of(model: Model, tracker: Any) -> tuple[Tracker, ...]:
    """The tracker of each output (of a shared theta: the only one); ValueError where they cannot run together."""
    if isinstance(tracker, Mapping) and not model.shared:
        if set(tracker) != set(model.outputs):
            raise ValueError(
                f"trackers were given for {', '.join(map(str, tracker))}, but the outputs are "
                f"{', '.join(model.outputs)}."
            )
        trackers = tuple(tracker[name] for name in model.outputs)
    else:
        trackers = (tracker,) * (1 if model.shared else len(model.outputs))
    for one in trackers:
        if not isinstance(one, Tracker):
            raise ValueError(f"several outputs take one tracker, or one for each output by its name; got {tracker!r}.")
        check_ready(one)
    if len({one.steps_for(model) for one in trackers}) > 1 or len({shapes(one, model) for one in trackers}) > 1:
        raise ValueError(f"the trackers of several outputs must be of one kind and form; got {shown(trackers)}.")
    return trackers


def shapes(tracker: Tracker, model: Model) -> tuple[Any, ...]:
    """Names and shapes of the state."""
    return tuple((name, np.shape(value)) for name, value in tracker.state_for(model).items())


def parameter_names(model: Model, trackers: Sequence[Tracker]) -> tuple[tuple[str, ...], ...]:
    """Names of the parameters of each output."""
    found = []
    for output, tracker in zip(model.outputs, trackers, strict=True):
        alone = model.alone(output)
        own = () if alone is None else tracker.names_for(alone)
        found.append(tuple(f"{name}[{output}]" for name in own) or model.names_of(output))
    return tuple(found)


def joint_tile(model: Model, trackers: Sequence[Tracker], starts: Starts = ()) -> Array:
    """A tile with a lane for each tracker, at its start or with the given fields."""
    states = []
    for output, tracker in zip(model.outputs, trackers, strict=True):
        own = model.alone(output) or model
        states.append({**own.memory(), **tracker.state_for(own)})
    tile = make_tile(model.n, model.m, model.memory(), states)
    for lane, start in enumerate(starts):
        for name, value in start.items():
            tile[name][0, ..., lane] = value
    return tile


def end_of(model: Model, trackers: tuple[Tracker, ...], tile: Array, last: Any) -> End:
    """The end of a run whose fields keep their lanes."""
    state = {name: tile[name][0].copy() for name in storage.fields(tile)}
    return End(model, trackers, state, last)  # type: ignore[arg-type]  # one for each lane


class _Lane:
    """One lane of a run, as a run."""

    def __init__(self, end: End) -> None:
        self._end = end

    def end(self) -> End:
        return self._end


def taken_over(before: Run | None, model: Model, trackers: Sequence[Tracker]) -> Starts:
    """What each lane takes over from a run before; ValueError where the two do not fit."""
    if before is None:
        return ()
    end: Any = before.end()
    if not isinstance(end.tracker, tuple) or len(end.tracker) != len(trackers):
        raise ValueError(f"warm_start: {before!r} is not a run of these outputs.")
    starts = []
    for lane, tracker in enumerate(trackers):
        state = {name: value[..., lane] for name, value in end.state.items()}
        starts.append(carried(_Lane(End(end.model, end.tracker[lane], state, end.last)), model, tracker))
    return starts


def drive(model: Model, steps: Any, keep: str, tile: Array, y: Array, u: Array, known: Array, out: Array) -> None:
    """Run a tile of outputs, y (T, ny), known (T, k, ny): every lane gets the same inputs u (T, m)."""
    inputs = np.repeat(u[:, :, None], y.shape[1], axis=2)
    drivers(model.steps, steps, keep).run(tile, y, inputs, known, out)
