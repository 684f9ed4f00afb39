"""The search: a grid over every knob, then a quasi-Newton method with gradients from lanes; profiles for intervals.

    start      all knobs together on a grid of at least 4 points per decade, then each separately (also at zero)
    refine     L-BFGS-B on the finite knobs, central differences of 1e-3 decades
    zero       a knob is set to zero if zero is at least as good
    profile    along the ridge x_hat + delta C e_i / C_ii, C the inverse of the Hessian: where the objective has risen
               by chi2 / 2, on either side; with one knob this is the profile itself

The objective is minimised; it maps points (S, p) to values (S,), +inf for impossible points.
It is minus the log-likelihood, or the logarithm of a mean square of errors (`Criterion`). Intervals of settings are
profiles of the likelihood, also of a noise variance that was estimated in closed form.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from driftfit.data.record import Known, Record
from driftfit.engine.kernel import Array
from driftfit.models.regression import Regression
from driftfit.run.live.conformal import quantile
from driftfit.run.program import Program
from driftfit.run.result import Track, track_record
from driftfit.smooth.problem import walk_of
from driftfit.smooth.smoothed import Smoothed
from driftfit.smooth.solvers.walk import ordered
from driftfit.trackers.base import Tracker
from driftfit.tune.lanes import Task, score
from driftfit.tune.parametrisation import Knobs, constant

Objective = Callable[[Array], Array]
GRID_PER_DECADE = 4
"""Points of a grid per decade."""
SLOPE_STEP = 1e-3
"""Decades between the points of a central difference."""
CURVATURE_STEP = 0.03
"""The same for second differences, which lose twice as many digits."""
GRID_CYCLES = 4
"""Largest number of rounds over the knobs."""
EDGE_DECADES = 0.01
"""Distance in decades from an end of the range that counts as being at the end."""


def half_chi2(level: float) -> float:
    """Half the chi-square quantile with one degree of freedom: by how much a log-likelihood falls in an interval."""
    return 0.5 * quantile(level) ** 2


class Counted:
    """An objective that stores every point at which it was evaluated."""

    def __init__(self, objective: Objective) -> None:
        self.objective = objective
        self.points: list[Array] = []
        self.values: list[Array] = []

    def __call__(self, points: Array) -> Array:
        values = self.objective(points)
        self.points.append(points)
        self.values.append(values)
        return values


def minimise(f: Objective, knobs: Knobs) -> Array:
    """The best point (p,), with knobs at zero where that is not worse, after which the others are refined again."""
    x, changed = _refine(f, knobs, _grid(f, knobs)), False
    for i in np.flatnonzero(knobs.zero & np.isfinite(x)):
        points = np.repeat(x[None], 2, axis=0)
        points[1, i] = -np.inf
        values = f(points)
        if values[1] <= values[0]:
            x, changed = points[1], True
    return _refine(f, knobs, x) if changed else x


def _axis(knobs: Knobs, i: int) -> Array:
    count = int(np.ceil(GRID_PER_DECADE * (knobs.high[i] - knobs.low[i]))) + 1
    points = np.linspace(knobs.low[i], knobs.high[i], max(count, 2))
    return np.asarray(np.append(points, -np.inf) if knobs.zero[i] else points)


def _grid(f: Objective, knobs: Knobs) -> Array:
    """A grid over all knobs with the same range together, with the others at their middle; then knob by knob."""
    p = len(knobs.low)
    together = (knobs.low == knobs.low[0]) & (knobs.high == knobs.high[0]) & (knobs.zero == knobs.zero[0])
    middle = np.clip(np.zeros(p), knobs.low, knobs.high)  # 0 is the scale of the data
    points = np.where(together, _axis(knobs, 0)[:, None], middle)
    values = f(points)
    x: Array = points[np.argmin(values)].copy()
    best = values.min()
    for _ in range(GRID_CYCLES if p > 1 else 0):
        before = best
        for i in range(p):
            points = np.repeat(x[None], len(_axis(knobs, i)), axis=0)
            points[:, i] = _axis(knobs, i)
            values = f(points)
            if values.min() < best:
                x, best = points[np.argmin(values)].copy(), values.min()
        if not best < before:
            break
    return x


def _refine(f: Objective, knobs: Knobs, x: Array) -> Array:
    free = np.flatnonzero(np.isfinite(x))
    if not free.size:
        return x
    # one grid cell around the best grid point, so that the search cannot end in another minimum
    reach = 1.0 / GRID_PER_DECADE if len(x) == 1 else np.inf
    low, high = np.maximum(knobs.low[free], x[free] - reach), np.minimum(knobs.high[free], x[free] + reach)

    def value_and_slope(part: Array) -> tuple[float, Array]:
        points = np.repeat(x[None], 2 * free.size + 1, axis=0)
        points[:, free] = part
        for j, i in enumerate(free):
            points[2 * j + 1, i] += SLOPE_STEP
            points[2 * j + 2, i] -= SLOPE_STEP
        values = f(points)
        with np.errstate(invalid="ignore"):  # without an error anywhere the criterion is -inf
            slopes = (values[1::2] - values[2::2]) / (2.0 * SLOPE_STEP)
        return float(values[0]), np.where(np.isfinite(slopes), slopes, 0.0)

    from scipy import optimize  # this import takes half a second

    options = {"ftol": 1e-14, "gtol": 1e-9, "maxiter": 100}  # the logarithm of a mean square is flat: 0.01 a decade^2
    found = optimize.minimize(
        value_and_slope, x[free], jac=True, method="L-BFGS-B", bounds=list(zip(low, high, strict=True)), options=options
    )
    refined: Array = x.copy()
    refined[free] = found.x
    return refined


def curvature(f: Objective, x: Array, free: Array) -> Array:
    """The Hessian of the free knobs by second differences; NaN where the objective has none."""
    k = free.size
    points = [x]
    pairs = [(i, j) for i in range(k) for j in range(i + 1)]
    for i, j in pairs:
        for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            point = x.copy()
            point[free[i]] += a * CURVATURE_STEP
            point[free[j]] += b * CURVATURE_STEP
            points.append(point)
    values = f(np.array(points))
    H = np.empty((k, k))
    for at, (i, j) in enumerate(pairs):
        pp, pm, mp, mm = values[1 + 4 * at : 5 + 4 * at]
        # on the diagonal the two steps add up to one of twice the length, or cancel
        H[i, j] = H[j, i] = (pp - pm - mp + mm) / (4.0 * CURVATURE_STEP**2)
    return H


class Search:
    """The best point, and the shape of the objective around it."""

    def __init__(self, f: Counted, knobs: Knobs, x: Array) -> None:
        self.f, self.knobs, self.x = f, knobs, x
        self.best = float(f(x[None])[0])
        self._tried = np.concatenate(f.points), np.concatenate(f.values)
        self.free = np.flatnonzero(np.isfinite(x))

    def tried(self) -> tuple[Array, Array]:
        """Points and values of the search, best first."""
        points, values = self._tried
        order = np.argsort(values, kind="stable")
        return points[order], values[order]

    def at_bound(self, i: int) -> bool:
        """Whether a knob is at an end of its range, or zero."""
        return not self.knobs.low[i] + EDGE_DECADES < self.x[i] < self.knobs.high[i] - EDGE_DECADES

    @cached_property
    def inverse(self) -> Array:
        """C, the inverse of the Hessian of the free knobs; NaN if the objective is not convex.

        1 / range^2 is added on the diagonal, because no knob is less certain than its range.
        """
        H = curvature(self.f, self.x, self.free) + np.diag((self.knobs.high - self.knobs.low)[self.free] ** -2.0)
        convex = np.isfinite(H).all() and np.linalg.eigvalsh(H).min(initial=np.inf) > 0.0
        return np.asarray(np.linalg.inv(H) if convex else np.full(H.shape, np.nan))

    def ridge(self, i: int) -> Array:
        """How the other knobs move with knob i so that the objective rises least, to second order; 1 for i itself."""
        direction = np.zeros(len(self.x))
        direction[i] = 1.0
        at = np.flatnonzero(self.free == i)
        if at.size and self.free.size > 1 and np.isfinite(self.inverse).all():
            direction[self.free] = self.inverse[at[0]] / self.inverse[at[0], at[0]]
        return direction

    def sweep(self, i: int) -> tuple[Array, Array]:
        """Points along the ridge of knob i over its range, denser within a decade of the best, with their values."""
        low, high = self.knobs.low[i], self.knobs.high[i]
        axis = np.linspace(low, high, 32)
        if np.isfinite(self.x[i]):
            axis = np.union1d(axis, np.clip(self.x[i] + np.linspace(-1.0, 1.0, 32), low, high))
        points = self._along(i, axis)
        return points, self.f(points)

    def _along(self, i: int, axis: Array) -> Array:
        points = np.repeat(self.x[None], len(axis), axis=0)
        if np.isfinite(self.x[i]):
            points = self._within(points + (axis - self.x[i])[:, None] * self.ridge(i))
        points[:, i] = axis
        return points

    def _within(self, points: Array) -> Array:
        """Points whose finite knobs are within their range, which the ridge of the best point may leave far from it."""
        return np.where(np.isfinite(points), np.clip(points, self.knobs.low, self.knobs.high), points)

    def line(self, towards: Array, shares: Array) -> Array:
        """Points from the best in a direction until a knob has passed through its range; below the range is zero."""
        knobs, moves = self.knobs, towards != 0.0
        start = np.where(moves & ~np.isfinite(self.x), knobs.low, self.x)
        reach = np.min((knobs.high - knobs.low)[moves] / np.abs(towards[moves]))
        points = start + (shares * reach)[:, None] * np.where(moves, towards, 0.0)
        return np.where(knobs.zero & (points < knobs.low), -np.inf, self._within(points))

    def profile(self, i: int, level: float) -> tuple[float, float]:
        """Ends of the interval of knob i, at which the objective has risen by half the chi-square quantile.

        -inf or inf if it does not rise that far within the range.
        """
        rise = half_chi2(level)
        start = self.x[i] if np.isfinite(self.x[i]) else self.knobs.low[i]
        ends = [self._crossing(i, start, end, rise) for end in (self.knobs.low[i], self.knobs.high[i])]
        return (-np.inf if not np.isfinite(self.x[i]) else ends[0]), ends[1]

    def _crossing(self, i: int, start: float, end: float, rise: float) -> float:
        """Where the square root of the rise, which is nearly linear, passes 1 between start and end."""
        nowhere = (
            np.copysign(np.inf, end - start) if end != start else (-np.inf if end == self.knobs.low[i] else np.inf)
        )
        axis = start + np.linspace(0.0, 1.0, 32) ** 2 * (end - start)
        crossing = nowhere
        for _ in range(2):
            root = np.sqrt(np.maximum(self.f(self._along(i, axis)) - self.best, 0.0) / rise)
            above = np.flatnonzero(root > 1.0)
            if not above.size:
                return float(nowhere)
            at = max(int(above[0]), 1)
            share = (1.0 - root[at - 1]) / (root[at] - root[at - 1]) if np.isfinite(root[at]) else 0.5
            crossing = axis[at - 1] + share * (axis[at] - axis[at - 1])
            axis = np.linspace(axis[at - 1], axis[at], 32)
        return float(crossing)


def intervals_of(
    search: Search, task: Task, method: str, tracker: Tracker, level: float | None
) -> dict[str, tuple[float, float]]:
    """Intervals by name of setting; NaN if there is no level, or the criterion is not a likelihood."""
    knobs = search.knobs
    if method != "ml" or level is None:
        return dict.fromkeys(knobs.names, (float("nan"), float("nan")))
    found: dict[str, tuple[float, float]] = {}
    ends = [search.profile(i, level) for i in range(len(search.x))]
    for entry, (name, i) in enumerate(zip(knobs.names, knobs.owner, strict=True)):
        low, high = (_value(knobs, search.x, i, end, entry) for end in ends[i])
        found[name] = (low, high)
    if knobs.profiled and "r" in tracker.required:
        found |= _with_noise(search, task, level)
    return found


def _value(knobs: Knobs, x: Array, i: int, end: float, entry: int) -> float:
    """A setting with its knob at the end of an interval."""
    point = x.copy()
    point[i] = end
    return float(knobs.values(point)[entry])


def _with_noise(search: Search, task: Task, level: float) -> dict[str, tuple[float, float]]:
    """Intervals of q and r, if r was estimated in closed form, from their profiles.

    At the knobs x the likelihood is highest at r = sigma^2(x), and less by N / 2 (log rho + 1 / rho - 1) at
    r = rho sigma^2(x). An end is the extreme of rho sigma^2(x), or of that times q_i / r, over all x at which the
    likelihood has not fallen by more than half the chi-square quantile. They are searched for along the ridges of log r
    and of log q_i: C g and C (g + e_i), with g the slope of log sigma^2.
    """
    knobs, x, free, C = search.knobs, search.x, search.free, search.inverse
    rise, used = half_chi2(level), score(task, [knobs.run(x)]).used[0]

    def at(points: Array) -> tuple[Array, Array, Array]:
        scores = score(task, [knobs.run(point) for point in points])
        return points, scores.sigma2(), rise - (-scores.loglik(scores.sigma2()) - search.best)

    steps = SLOPE_STEP * np.eye(len(x))[free]
    found = [at(np.concatenate([x[None], x + steps, x - steps]))]
    noise = np.log(found[0][1][1:]).reshape(2, -1)
    g = (noise[0] - noise[1]) / (2.0 * SLOPE_STEP)
    ridges = np.zeros((1 + len(x), len(x)))
    ridges[0, free], ridges[1:] = C @ g, np.eye(len(x))
    ridges[1 + free[:, None], free] = C * np.log(10.0) + C @ g
    for ridge in ridges[ridges.any(axis=1) & np.isfinite(ridges).all(axis=1)]:
        for towards in (ridge, -ridge):
            axis = np.linspace(0.0, 1.0, 32) ** 2
            found.append(at(search.line(towards, axis)))
            end = int(np.argmax(np.append(found[-1][2] < 0.0, True)))
            if end < len(axis):
                found.append(at(search.line(towards, np.linspace(0.0, axis[end], 32))))
    points, r, left = (np.concatenate(part) for part in zip(*found, strict=True))
    points, r, left = points[left >= 0.0], r[left >= 0.0], left[left >= 0.0]
    rho = [1.0 / -scipy.special.lambertw(-np.exp(-1.0 - 2.0 * left / used), k).real for k in (-1, 0)]
    ends = {"r": (0.0 if (points >= knobs.high).any() else float(np.min(r * rho[0])), float(np.max(r * rho[1])))}
    for name, ratio in zip(knobs.names, np.array([knobs.values(point) for point in points]).T, strict=True):
        ends[name.removesuffix("/r")] = float(np.min(ratio * r * rho[0])), float(np.max(ratio * r * rho[1]))
    return ends


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
            scores = score(self.task, trackers, self.h)
            with np.errstate(divide="ignore", invalid="ignore"):
                squares = scores.errors / scores.scored
        else:
            squares = np.array([_smoothed_score(self.task, tracker, self.method) for tracker in trackers])
        tiny = np.finfo(float).tiny  # a perfect fit is the best possible result and must have a logarithm
        return np.log(np.where(np.isfinite(squares), np.maximum(squares, tiny), np.inf))


def run_task(task: Task, tracker: Tracker) -> list[Track]:
    """Track the records of a task."""
    return [track_record(Program(task.model, tracker), record) for record in task.records]


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
