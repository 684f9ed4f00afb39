"""Second differences: the exact smoother of parameters whose slope is a random walk.

    minimise  sum_t weight_t (y_t - phi_t' theta_t)^2 + sum_t |G^-1 E_t^-1 (slope_t - slope_{t-1})|^2 / drift_t
    slope_t = (theta_t - theta_{t-1}) / trend_t

with trend_t the nominal intervals between the samples; for even steps slope_t - slope_{t-1} is the second difference
theta_t - 2 theta_{t-1} + theta_{t-2}. As a problem of 2 n parameters x_t = (theta_t, slope_t):

    x_t = F_t x_{t-1} + (trend_t, 1) w_t,   F_t = [[1, trend_t], [0, 1]],   w_t ~ N(0, r drift_t E_t q E_t)

which the two filters of `driftfit.smooth.parts.two_filters` solve, with a shear of the triangle for F_t.

A straight line costs nothing, so 2 n directions must be determined. The regressors of x at the first sample are
(phi_t, tau_t phi_t), with tau_t the time since then: two samples are needed for each direction of theta. Directions
that they never span take theta0 and a slope of zero at the first sample.

Use it for parameters that move smoothly, and for forecasts that follow a trend; jumps are smeared more than by first
differences. Source: Whittaker (1923) for the penalty; Young (2011), chapter 4, for the integrated random walk. Cost:
O(T n^3), eight times that of first differences with the safe method.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.smooth.parts import two_filters
from driftfit.smooth.parts.rank import column_scale, ranks
from driftfit.smooth.parts.two_filters import Start, unspanned
from driftfit.smooth.parts.walk import Path, Walk
from driftfit.trackers.forms.information import triangular_root


def smooth(walk: Walk, keep: str = "std") -> Path:
    """Solve a problem with slopes."""
    n = walk.phi.shape[1]
    scale = column_scale(walk.phi, walk.signals)
    double = np.tile(scale, 2)
    time = np.cumsum(walk.trend)
    rank, begin = start(walk, double, time)
    G = root(triangular_root(walk.q * np.outer(scale, scale)))
    found = two_filters.smooth(expanded(walk), double, G, begin, keep)
    level, slope = slice(0, n), slice(n, None)
    return found._replace(
        theta=found.theta[:, level], var=found.var[:, level], cov=found.cov[:, level, level],
        lag_cov=found.lag_cov[:, level, level], rank=rank, slope=found.theta[:, slope], slope_var=found.var[:, slope],
    )  # fmt: skip


def expanded(walk: Walk) -> Walk:
    """The problem in terms of level and slope."""
    drift_root = walk.drift_root if len(walk.drift_root) else np.ones(walk.phi.shape)
    return walk._replace(
        phi=np.hstack([walk.phi, np.zeros_like(walk.phi)]),
        theta0=np.append(walk.theta0, np.zeros_like(walk.theta0)),
        drift_root=np.hstack([walk.trend[:, None] * drift_root, drift_root]),
    )


def root(g: Array) -> Array:
    """The triangle through which the noise of the slope enters level and slope; ``drift_root`` then scales its rows."""
    return np.block([[np.zeros_like(g), g], [np.zeros_like(g), g]])


def start(walk: Walk, double: Array, time: Array) -> tuple[Array, Start]:
    """Rank up to each sample, and the information before the first one."""
    span = max(float(time[-1]), 1.0)
    at_first = np.hstack([walk.phi, walk.phi * (time / span)[:, None]])
    rank, unseen = ranks(at_first, walk.signals, double)
    n = len(double) // 2
    hidden = np.zeros(len(double), bool)
    if rank[-1] == 2 * n:
        return rank, Start(np.zeros((0, 2 * n)), np.zeros(0), hidden)
    natural = unspanned(unseen, double * np.repeat([1.0, span], n))
    rows = natural / double
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return rank, Start(rows, rows[:, :n] @ (double[:n] * walk.theta0), undetermined(natural, time))


def moved(rows: Array, time: float) -> Array:
    """Rows on x at the first sample expressed as rows on x ``time`` later, without drift."""
    n = rows.shape[1] // 2
    later: Array = np.hstack([rows[:, :n], rows[:, n:] - time * rows[:, :n]])
    return later


def undetermined(natural: Array, time: Array) -> Array:
    """Which levels and slopes have a component in undetermined directions, (T, 2 n); the level follows the slope."""
    n = natural.shape[1] // 2
    first, second = natural[:, :n], natural[:, n:]
    level = np.linalg.norm(first + time[:, None, None] * second, axis=1) / np.hypot(1.0, time)[:, None]
    slope = np.broadcast_to(np.linalg.norm(second, axis=0), level.shape)
    unknown: Array = np.hstack([level, slope]) > 1e-8
    return unknown
