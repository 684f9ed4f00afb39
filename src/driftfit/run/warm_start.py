"""Warm starts: a run that begins where another one ended.

Everything carries over: the parameters, their covariance, the lags of the model, and the time of the last sample, so
that a record cut in two gives the same bits as the whole. A setting that differs between the two trackers takes its new
value, a larger q for example.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from driftfit.data.clock import Clock, instant
from driftfit.data.record import Labels
from driftfit.engine.drivers import make_tile
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.trackers.base import Tracker

_LEFT = ("interval", "noise", "drift", "each", "F")
"""Fields that stay behind: what an operator set for the stream, and the diffuse likelihood of the run before."""


class End(NamedTuple):
    """Where a run ended: its model and tracker, the fields of its record, and the time of its last sample.

    ``awaits`` says whether a stream still expects the input of that sample (`driftfit.run.live.late_input`).
    """

    model: Model
    tracker: Tracker
    state: Mapping[str, Array]
    last: Any
    awaits: int = 0


class Run(Protocol):
    """What a warm start can begin from: a `Track` or a `Live`."""

    def end(self) -> End:
        """Where it ended."""


def fresh_tile(model: Model, tracker: Tracker, state: Mapping[str, Array] | None = None) -> Array:
    """A tile of one lane at its start, or with the given fields."""
    tile = make_tile(model.n, model.m, model.memory(), [tracker.state_for(model)])
    for name, value in (state or {}).items():
        tile[name][0, ..., 0] = value
    return tile


def carried(run: Run, model: Model, tracker: Tracker) -> dict[str, Array]:
    """The fields that a run of ``tracker`` takes over from another run; ValueError where the two do not fit."""
    end = run.end()
    if type(tracker) is not type(end.tracker):
        raise ValueError(
            f"warm_start: the run before was made by {type(end.tracker).__name__}, this one is by "
            f"{type(tracker).__name__}; start from its estimates instead, with theta0= and p0=."
        )
    if not model.follows(end.model):
        raise ValueError(f"warm_start: the run before followed {end.model!r}, this one follows {model!r}.")
    before, now = end.tracker.state_for(end.model), tracker.state_for(model)
    changed = {name for name, value in now.items() if not _same(before.get(name), value)}
    return {name: value for name, value in end.state.items() if name not in changed and name not in _LEFT}


def _same(one: Any, other: Any) -> bool:
    return np.shape(one) == np.shape(other) and bool(np.all(np.equal(one, other) | (np.not_equal(one, one))))


def first_interval(run: Run, time: Any, labels: Labels) -> float:
    """Nominal intervals from the end of a run to the first sample of the next; 1 where either knows no time."""
    last = run.end().last
    if last is None or time is None:
        return 1.0
    interval = Clock.of(labels.dt, labels.zone).since(instant(last), instant(time))
    if not interval >= 0.0:
        raise ValueError(f"warm_start: the record begins at {time}, not after the end of the run before, {last}.")
    return interval
