"""The objectives of tuning: minus the log-likelihood, or the logarithm of a mean square of errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from driftfit.data.known import Known
from driftfit.data.record import Record
from driftfit.engine.kernel import Array
from driftfit.models.regression import Regression
from driftfit.run.program import Program
from driftfit.run.result import Track, track_record
from driftfit.smooth.parts.walk import ordered
from driftfit.smooth.problem import walk_of
from driftfit.smooth.smoothed import Smoothed
from driftfit.trackers.base import Tracker
from driftfit.tune.lanes import Task, score
from driftfit.tune.parametrisation import Knobs, constant


def along(task: Task, tracker: Tracker, order_by: Any) -> Task:
    """The record as a regression with samples sorted by a variable; ValueError for several records."""
    if len(task.records) > 1:
        raise ValueError("tune: order_by= sorts the samples of one record; leave out by=.")
    (run,) = run_task(task, constant(task, tracker))
    walk, _ = ordered(walk_of(run), order_by)
    with np.errstate(divide="ignore"):
        known = Known.of(noise=1.0 / walk.weight)
    return Task(Regression(task.model.names), (Record(walk.y, walk.phi, known),), task.left_out)


@dataclass(frozen=True)
class Criterion:
    """Maps points (S, p) to values (S,) to be minimised: minus the log-likelihood, or the log of a mean square.

    In logarithms the unit of y is only an offset, so the tolerances of the search do not depend on it.
    """

    task: Task
    knobs: Knobs
    method: str
    h: int

    def __call__(self, points: Array) -> Array:
        trackers = [self.knobs.run(x) for x in points]
        if self.method == "ml":
            scores = score(self.task, trackers)
            return -scores.loglik(scores.sigma2() if self.knobs.profiled else 1.0)
        if self.method == "h-step":
            squares = score(self.task, trackers, self.h).h_step
        else:
            squares = np.array([_smoothed_score(self.task, tracker, self.method) for tracker in trackers])
        tiny = np.finfo(float).tiny  # a perfect fit is the best possible result and must have a logarithm
        return np.log(np.where(np.isfinite(squares), np.maximum(squares, tiny), np.inf))


def run_task(task: Task, tracker: Tracker) -> list[Track]:
    """Track the records of a task."""
    program = Program(task.model, tracker)
    return [track_record(program, record) for record in task.records]


def _smoothed_score(task: Task, tracker: Tracker, method: str) -> float:
    """Mean square of the leave-one-out residuals of the smoothed paths, or the rotation-invariant variant of it."""
    squares, count, free, used = 0.0, 0, 0.0, 0
    for run in run_task(task, tracker):
        path = Smoothed.of(run, "fit")
        weight = path.weight
        terms = weight * path.loo**2 if method == "loo" else np.zeros(0)
        squares += float(np.nansum(terms)) if method == "loo" else path.measurement_cost
        count += int(np.isfinite(terms).sum())
        free += float(np.sum(1.0 - path.leverage[weight > 0.0]))
        used += int(np.sum(weight > 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.float64(squares) / count if method == "loo" else np.float64(squares) / used / (free / used) ** 2
    return float(value) if np.isfinite(value) else np.inf
