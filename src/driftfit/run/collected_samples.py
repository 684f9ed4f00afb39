"""Samples as a tracker receives them, after the model and the missing-data rule."""

from __future__ import annotations

from functools import lru_cache

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import State, kernel

COLLECTED = ("phi", "y", "dt", "valid", "observed")
"""Fields that `collect` stores."""


@kernel
def collect(o: State, s: State, l: int) -> None:
    """Store the sample as the tracker receives it, after the model and the missing-data rule; not ``observed`` is also
    a reading that the tracker refused."""
    for i in range(s.phi.shape[0]):
        o.phi[i, l] = s.phi[i, l]
    o.y[l] = s.y[l]
    o.dt[l] = s.dt[l]
    o.valid[l], o.observed[l] = s.valid[l], s.observed[l]


@lru_cache(maxsize=256)
def collecting(steps: TrackerSteps) -> TrackerSteps:
    """The steps of a tracker that store its own outputs and the sample."""
    own = steps.store

    @kernel
    def both(o: State, s: State, l: int) -> None:
        own(o, s, l)
        collect(o, s, l)

    return steps._replace(store=both)
