"""Warm starts: a run that continues where another one ended.

Everything carries over: the parameters, their covariance, the lags of the model, and the time of the last sample, so
a record cut in two gives the same bits as the whole. A setting that differs between the two trackers takes its new
value, for example a larger q.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from driftfit.data.clock import Clock, instant
from driftfit.data.record import Labels
from driftfit.run.program import Program, State

_LEFT = ("interval", "noise", "drift", "drift_root", "F")
"""Fields that are not carried over: an operator's settings of the stream, and the diffuse likelihood of that run."""


class End(NamedTuple):
    """Where a run ended, lane by lane (one for a single output): its programs, their states, and its last time.

    ``awaits`` says whether a stream still expects the input of that sample (`driftfit.run.live.late_input`).
    """

    programs: tuple[Program, ...]
    states: tuple[State, ...]
    last: Any
    awaits: int = 0


class Run(Protocol):
    """Runs from which a warm start can begin: a `Track`, a `Live`, or one of several outputs."""

    def end(self) -> End:
        """The end of the run."""


def carried(run: Run | None, programs: Sequence[Program]) -> tuple[State, ...]:
    """The fields that each lane takes over from a run before; ValueError where the two do not fit."""
    if run is None:
        return ()
    end = run.end()
    if len(end.programs) != len(programs):
        raise ValueError(f"warm_start: {run!r} is not a run of these outputs.")
    return tuple(_carried(*lane) for lane in zip(end.programs, end.states, programs, strict=True))


def _carried(before: Program, state: State, now: Program) -> State:
    if type(now.tracker) is not type(before.tracker):
        raise ValueError(
            f"warm_start: the run before was made by {type(before.tracker).__name__}, this one is by "
            f"{type(now.tracker).__name__}; start from its estimates instead, with theta0= and p0=."
        )
    if not now.model.follows(before.model):
        raise ValueError(f"warm_start: the run before followed {before.model!r}, this one follows {now.model!r}.")
    old, new = before.tracker.state_for(before.model), now.tracker.state_for(now.model)
    changed = {name for name, value in new.items() if not _same(old.get(name), value)}
    return {name: value for name, value in state.items() if name not in changed and name not in _LEFT}


def _same(one: Any, other: Any) -> bool:
    return np.shape(one) == np.shape(other) and bool(np.all(np.equal(one, other) | (np.not_equal(one, one))))


def first_interval(run: Run, time: Any, labels: Labels) -> float:
    """Nominal intervals from the end of a run to the first sample of the next; 1 if either has no time."""
    last = run.end().last
    if last is None or time is None:
        return 1.0
    interval = Clock.of(labels.dt, labels.zone).since(instant(last), instant(time))
    if not interval >= 0.0:
        raise ValueError(f"warm_start: the record begins at {time}, not after the end of the run before, {last}.")
    return interval
