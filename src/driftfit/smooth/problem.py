"""The problem behind a run, for smoothers: see `driftfit.smooth.parts.walk`.

The regressors are those that the filter used, lags that it filled by its own prediction included: the run is replayed
once to collect them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array, State, kernel
from driftfit.engine.tiles import output_type
from driftfit.run.collected_samples import COLLECTED, collect
from driftfit.run.program import BLOCK, lanes_of, put_fields
from driftfit.run.result import Track
from driftfit.smooth.parts.pooled_drift import average_drift
from driftfit.smooth.parts.walk import NONE, Walk, free
from driftfit.trackers.base import RandomWalk


@kernel
def note_noise(s: State, l: int) -> None:
    s.used_noise[l] = s.noise[l]


@lru_cache
def collecting_for_smoother(steps: TrackerSteps) -> TrackerSteps:
    """Steps that store the factor of the noise variance when the tracker runs, and the tracker's ``smoother_fields``.

    A model may make it larger than the factor that the user gave (measurement noise that enters through a curve).
    """
    store = steps.store_for_smoother

    @kernel
    def collect_all(o: State, s: State, l: int) -> None:
        collect(o, s, l)
        store(o, s, l)
        o.used_noise[l] = s.used_noise[l]

    return steps._replace(store=collect_all, note=note_noise)


USED = ("phi", "y", "dt", "ok", "used_noise")
"""Fields that every smoother needs."""


def replay(run: Track, names: Sequence[str] = (*USED, "valid", "e")) -> dict[str, Array]:
    """Run the tracker over its record again and return the samples as it received them, field by field, (T, .., 1).

    The fields are phi, y, dt, valid, ok, e, used_noise (the factor of the noise variance), and the tracker's
    ``smoother_fields``.
    """
    program, T = run.program, len(run)
    tile = program.tile()
    own = (*COLLECTED, "used_noise", *run.tracker.smoother_fields)
    block = np.empty(min(BLOCK, T), output_type(tile, own))
    wanted = (*names, *run.tracker.smoother_fields)
    seen = {name: np.empty((T, *block[name].shape[1:]), block[name].dtype) for name in wanted}
    loop = program.drivers(steps=collecting_for_smoother(program.steps)).run
    for a in range(0, T, BLOCK):  # a block that stays in the cache; only some of its fields are kept
        part = slice(a, min(a + BLOCK, T))
        rows = block[: part.stop - a]
        loop(tile, *lanes_of(run.record.part(part)), rows)
        put_fields(rows, seen, a)
    return seen


def walk_of(run: Track, prior: RandomWalk | None = None) -> Walk:
    """The problem behind a run; ValueError if its tracker does not describe a random walk in Gaussian noise.

    ``prior`` replaces the random walk that the tracker assumes.
    """
    own, tracker = prior is None, run.tracker
    drift_root = run.known.extra if own and run.known.extra.size else NONE
    if prior is None:
        prior = free(run.model.n) if tracker.smoother_fields else tracker.random_walk(run.model)
    seen = replay(run, (*USED, "e") if tracker.smoother_fields else USED)
    dt, ok = seen["dt"][:, 0], seen["ok"][:, 0] > 0.0
    weight = np.divide(1.0, seen["used_noise"][:, 0], out=np.zeros(len(ok)), where=ok)
    drift = dt * run.known.drift
    phi, y = np.ascontiguousarray(seen["phi"][..., 0]), seen["y"][:, 0]
    fields = {name: seen[name][..., 0] for name in tracker.smoother_fields} or run.state
    weight[tracker.left_out(fields, phi, y, ok)] = 0.0
    if own and tracker.smoother_fields:
        q, r_of = tracker.estimated_variances(run.model, fields, seen["e"][:, 0], drift)
        phi, y = tracker.regression(fields, phi, y)
        drift_root, weight, time, drift = np.sqrt(q), weight / r_of, drift, np.ones(len(drift))
    trend = dt if prior.slopes else NONE
    moving = dt * np.minimum(run.known.drift, 1.0)
    if prior.at_first_sample or prior.p0 is None:
        first = int(np.argmax(dt > 0.0)) + 1
        drift[:first], trend[:first], moving[:first] = 0.0, 0.0, 0.0
    r = 1.0 if prior.r is None else prior.r
    p0 = None if prior.p0 is None else prior.p0 / r
    walk = Walk(phi, y, weight, drift, prior.q / r, prior.theta0, p0, prior.r, drift_root, trend)
    return average_drift(walk, time, moving) if own and tracker.smoother_fields else walk
