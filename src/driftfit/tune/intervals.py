"""Intervals of settings: profiles of the likelihood, also of a noise variance that was estimated in closed form."""

from __future__ import annotations

import numpy as np
import scipy

from driftfit.engine.kernel import Array
from driftfit.trackers.base import Tracker
from driftfit.tune.lanes import Task, score
from driftfit.tune.parametrisation import Knobs
from driftfit.tune.search import STEP, Search, half_chi2


def intervals_of(
    search: Search, task: Task, method: str, tracker: Tracker, level: float
) -> dict[str, tuple[float, float]]:
    """Intervals by name of setting; NaN if the criterion is not a likelihood."""
    knobs = search.knobs
    if method != "ml":
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

    steps = STEP * np.eye(len(x))[free]
    found = [at(np.concatenate([x[None], x + steps, x - steps]))]
    noise = np.log(found[0][1][1:]).reshape(2, -1)
    g = (noise[0] - noise[1]) / (2.0 * STEP)
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
