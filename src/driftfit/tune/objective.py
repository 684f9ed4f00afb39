"""The objectives of tuning: minus the log-likelihood, or the logarithm of a mean square of errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from driftfit.engine.drivers import make_tile
from driftfit.engine.kernel import Array
from driftfit.models.regression import Regression
from driftfit.run.result import Track
from driftfit.run.track import drive
from driftfit.smooth.parts.walk import ordered, walk_of
from driftfit.trackers.base import Tracker
from driftfit.tune.knobs import Knobs, constant
from driftfit.tune.lanes import Record, score


def along(record: Record, tracker: Tracker, order_by: Any) -> Record:
    """The record as a regression with samples sorted by a variable."""
    model = record.model
    walk, _ = ordered(walk_of(run_record(record, constant(record, tracker))), order_by)
    known = np.ones((len(walk.y), 3))
    with np.errstate(divide="ignore"):
        known[:, 1] = 1.0 / walk.weight
    return Record(Regression(model.names), walk.y, walk.phi, known)


@dataclass(frozen=True)
class Criterion:
    """Maps points (S, p) to values (S,) to be minimised: minus the log-likelihood, or the log of a mean square.

    In logarithms the unit of y is only an offset, so the tolerances of the search do not depend on it.
    """

    record: Record
    knobs: Knobs
    method: str
    h: int

    def __call__(self, points: Array) -> Array:
        trackers = [self.knobs.run(x) for x in points]
        if self.method == "ml":
            return -score(self.record, trackers).loglik(self.knobs.profiled)
        if self.method == "h-step":
            squares = score(self.record, trackers, self.h).h_step
        else:
            squares = np.array([_smoothed_score(self.record, tracker, self.method) for tracker in trackers])
        tiny = np.finfo(float).tiny  # a perfect fit is the best possible result and must have a logarithm
        return np.log(np.where(np.isfinite(squares), np.maximum(squares, tiny), np.inf))


def run_record(record: Record, tracker: Tracker) -> Track:
    """Track a checked record."""
    model, y, u, known = record
    tile = make_tile(model.n, model.m, model.memory(), [tracker.state_for(model)])
    out = drive(model, tracker, tile, y, u, known)
    return Track(model, tracker, y, u, None, known, out, tile)


def _smoothed_score(record: Record, tracker: Tracker, method: str) -> float:
    """Mean square of the leave-one-out residuals of the smoothed path, or the rotation-invariant variant of it."""
    path = run_record(record, tracker).smooth()
    weight = path.walk.weight
    used = weight > 0.0
    if method == "loo":
        value = path.press
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            value = float(path.measurement_cost / used.sum() / np.mean(1.0 - path.leverage[used]) ** 2)
    return value if np.isfinite(value) else np.inf
