"""The problem behind a run, for smoothers: see `driftfit.smooth.solvers.walk`.

The regressors are those that the filter used, lags that it filled by its own prediction included: the run is replayed
once to collect them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array, State, kernel, nothing
from driftfit.run.columns import COLLECTED, collect, put_fields
from driftfit.run.program import lanes_of
from driftfit.run.result import Track
from driftfit.smooth.solvers.walk import DRIFT, NONE, WEIGHT, Walk, Y, free, room_for_signals
from driftfit.smooth.unknown_drift import average_drift
from driftfit.trackers.base import RandomWalk


@lru_cache
def collecting_for_smoother(steps: TrackerSteps) -> TrackerSteps:
    """Steps that store the factor of the noise variance when the tracker runs, and the tracker's ``smoother_fields``.

    A model may make it larger than the factor that the user gave (measurement noise that enters through a curve).
    """
    store, note, notes = steps.store_for_smoother, steps.note, steps.note is not nothing

    @kernel
    def note_all(s: State, l: int, g: State, k: int) -> None:
        if notes:  # a constant
            note(s, l, g, k)
        s.used_noise[l] = s.noise[l]

    @kernel
    def collect_all(o: State, s: State, l: int) -> None:
        collect(o, s, l)
        store(o, s, l)
        o.used_noise[l] = s.used_noise[l]
        o.ok[l] = s.ok[l]
        o.e[l] = s.e[l]

    return steps._replace(store=collect_all, note=note_all)


ROWS = 1024
"""Samples of a block of a replay."""


def blocks(run: Track) -> Iterator[tuple[int, Array]]:
    """Run the tracker over its record again; (first sample, samples as the tracker received them) of each block.

    The fields are phi, y, dt, valid, used_noise (the factor of the noise variance), ok, observed, e, and the tracker's
    ``smoother_fields``. A block stays in the cache, and the next one takes its place.
    """
    run = run.decided
    program, T = run.program, len(run)
    tile = run.fresh()
    names = (*run.tracker.smoother_fields, *COLLECTED, "used_noise", "ok", "e")
    block = program.inspected(tile, min(ROWS, T), names, "own")
    loop = program.drivers("own", collecting_for_smoother(program.steps)).run
    y, u, known = lanes_of(run.record)
    for a in range(0, T, ROWS):
        part = slice(a, min(a + ROWS, T))
        rows = block[: part.stop - a]
        loop(tile, y[part], u[part], known if len(known) == 1 else known[part], rows)
        yield a, rows


def put_in_place(rows: Array, into: dict[str, Array], names: Sequence[str], first: int, T: int) -> None:
    """Copy fields of a block to arrays (T, ..), which are made for the first one."""
    for name in () if into else names:
        into[name] = np.empty((T, *rows[name].shape[1:]), rows[name].dtype)
    put_fields(rows, into, first)


def replay(run: Track) -> dict[str, Array]:
    """The samples of a run as its tracker received them, field by field, (T, .., 1); see `blocks`."""
    found: dict[str, Array] = {}
    for first, rows in blocks(run):
        put_in_place(rows, found, rows.dtype.names or (), first, len(run))
    return found


def collected(run: Track) -> tuple[Array, Array, dict[str, Array]]:
    """phi and signals of a run for a `Walk`, and, if the tracker has ``smoother_fields``, these and e."""
    own = run.tracker.smoother_fields
    phi, signals = np.empty((len(run), run.model.n)), room_for_signals(len(run), run.model.n)
    found: dict[str, Array] = {}
    for first, rows in blocks(run):
        part, row = slice(first, first + len(rows)), {name: rows[name][..., 0] for name in rows.dtype.names or ()}
        phi[part], signals[part, Y], signals[part, DRIFT] = row["phi"], row["y"], row["dt"]
        signals[part, WEIGHT] = np.where(row["ok"] > 0.0, 1.0 / row["used_noise"], 0.0)
        put_in_place(rows, found, ("e", *own) if own else (), first, len(run))
    return phi, signals, {name: values[..., 0] for name, values in found.items()}


def walk_of(run: Track, prior: RandomWalk | None = None, turned: bool = False) -> Walk:
    """The problem behind a run; ValueError if its tracker does not describe a random walk in Gaussian noise.

    ``prior`` replaces the random walk that the tracker assumes. ``turned``: drift is independent in coordinates in
    which the tracker estimates one; otherwise that counts as an independent drift of each parameter.
    """
    own, tracker = prior is None, run.tracker
    drift_root = run.known.extra if own and run.known.extra.size else NONE
    if prior is None:
        prior = free(run.model.n) if tracker.adapts else tracker.random_walk(run.model)
    phi, signals, fields = collected(run)
    weight, drift = signals[:, WEIGHT], signals[:, DRIFT]
    dt = drift.copy() if prior.slopes or fields else NONE
    first = int(np.argmax(drift > 0.0)) + 1
    drift *= run.known.drift
    basis = NONE
    if own and fields:
        B, r_of, rate, groups = tracker.problem(fields, phi[weight > 0.0])
        weight /= r_of / prior.r
    adapts = own and tracker.adapts
    if adapts:
        phi, signals[:, Y] = tracker.regression(fields, phi, signals[:, Y])
        basis = B if turned and np.any(np.eye(len(B)) != B) else NONE
        time = np.where(rate > 0.0, drift, 0.0)
        drift[:] = 1.0
    trend = dt if prior.slopes else NONE
    moving = dt * np.minimum(run.known.drift, 1.0) if len(dt) else NONE
    if prior.at_first_sample or prior.p0 is None:
        drift[:first], trend[:first], moving[:first] = 0.0, 0.0, 0.0
    r = 1.0 if prior.r is None else prior.r
    p0 = None if prior.p0 is None else prior.p0 / r
    walk = Walk(phi, signals, prior.q / r, prior.theta0, p0, prior.r, drift_root, trend, basis=basis)
    if not adapts:
        return walk
    return average_drift(walk.independent, (time, rate * time), moving, groups)._replace(phi=phi, basis=basis)
