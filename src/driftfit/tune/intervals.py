"""Intervals of settings from the likelihood: profiles, or curvature if the noise variance has a closed form."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.trackers.base import Tracker
from driftfit.tune.lanes import Task, score
from driftfit.tune.parametrisation import Knobs
from driftfit.tune.search import STEP, Search


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
        found |= _joint(search, task, level)
    return found


def _value(knobs: Knobs, x: Array, i: int, end: float, entry: int) -> float:
    """A setting with its knob at the end of an interval."""
    point = x.copy()
    point[i] = end
    return float(knobs.values(point)[entry])


def _joint(search: Search, task: Task, level: float) -> dict[str, tuple[float, float]]:
    """Intervals of q and r, if r was estimated in closed form, from the curvature in logarithms.

    With g the slope of log sigma^2 over the knobs: Var log r = 2 / N + g' C g,
    Var log q_i = 2 / N + (e_i + g)' C (e_i + g).
    """
    knobs, x, free, C = search.knobs, search.x, search.free, search.inverse
    points = np.repeat(x[None], 2 * free.size + 1, axis=0)
    for j, i in enumerate(free):
        points[2 * j + 1, i] += STEP
        points[2 * j + 2, i] -= STEP
    scores = score(task, [knobs.run(point) for point in points])
    r = float(scores.sigma2()[0])
    g = np.log(scores.sigma2()[1::2] / scores.sigma2()[2::2]) / (2.0 * STEP)
    found = {"r": _spread(r, 2.0 / scores.used[0] + g @ C @ g, level)}
    ratios = knobs.values(x)
    for entry, (name, i) in enumerate(zip(knobs.names, knobs.owner, strict=True)):
        slope = g + np.log(10.0) * (free == i)
        variance = 2.0 / scores.used[0] + slope @ C @ slope if np.isfinite(x[i]) else np.nan
        found[name.removesuffix("/r")] = _spread(r * ratios[entry], variance, level)
    return found


def _spread(value: float, variance: float, level: float) -> tuple[float, float]:
    """An interval that is symmetric in the logarithm."""
    factor = float(np.exp(NormalDist().inv_cdf(0.5 + level / 2.0) * np.sqrt(variance)))
    return float(value / factor), float(value * factor)
