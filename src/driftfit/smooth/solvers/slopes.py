"""Second differences: the exact smoother of parameters whose slope is a random walk.

    minimise  sum_t weight_t (y_t - phi_t' theta_t)^2 + sum_t |G^-1 E_t^-1 (slope_t - slope_{t-1})|^2 / drift_t
    slope_t = (theta_t - theta_{t-1}) / trend_t

with trend_t the nominal intervals between the samples; for even steps slope_t - slope_{t-1} is the second difference
theta_t - 2 theta_{t-1} + theta_{t-2}. As a problem of 2 n parameters x_t = (theta_t, slope_t):

    x_t = F_t x_{t-1} + (trend_t, 1) w_t,   F_t = [[1, trend_t], [0, 1]],   w_t ~ N(0, r drift_t E_t q E_t)

which the two filters of `driftfit.smooth.solvers.two_filters` solve, with a shear of the triangle for F_t.

A straight line costs nothing, so 2 n directions must be determined. The regressors of x at the first sample are
(phi_t, tau_t phi_t), with tau_t the time since then: two samples are needed for each direction of theta. Directions
that they never span take theta0 and a slope of zero at the first sample.

Use it for parameters that move smoothly, and for forecasts that follow a trend; jumps are smeared more than by first
differences. Source: Whittaker (1923) for the penalty; Young (2011), chapter 4, for the integrated random walk. Cost:
O(T n^3), eight times that of first differences with the safe method.

Whether slopes walk instead of levels is asked (`compared`) of records whose tracker estimated the drift of the levels.
q_i is rho r / c_i share_i^2 for parameter i, where r is the typical noise variance and c_i the mean square of the
regressor. It is tried at every rho of `RATIOS`, and with two sets of shares: all parameters alike, and those of the
random walk that the tracker has estimated, squared as its drift ratio alpha^2 belongs to a slope's alpha^4 / 4
(`driftfit.trackers.mixture.filters`). Each has the likelihood

    log L = -1/2 sum (log f_t + min(e_t^2 / f_t, 16)),    e_t, f_t the innovations of a Kalman filter of level and slope

that is compared with the one of the random walk, from the same filter and the same prior of the level, which is
`LEVEL_STD` standard deviations of the noise wide; that of the slope is as wide as what it moves in the whole record.
Slopes are not considered if one of `EQUAL_PARTS` parts of the record is all that speaks for them: it may be a jump or a
fault.

Source: West and Harrison, Bayesian Forecasting and Dynamic Models (1997), chapter 7, for the model and its likelihood.
Cost: O(T n^2) for each of the likelihoods.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array, Driver
from driftfit.smooth.solvers import two_filters
from driftfit.smooth.solvers.rank import column_scale, ranks
from driftfit.smooth.solvers.two_filters import Start, unspanned
from driftfit.smooth.solvers.walk import Path, Walk
from driftfit.trackers.forms.information import triangular_root

RATIOS = 10.0 ** np.arange(-10.0, -1.0)
LEVEL_STD = 100.0
LARGEST_SQUARE = 16.0
"""The largest e^2 / f that counts, so that a single sample decides nothing."""
EQUAL_PARTS = 8


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
    natural = unspanned(unseen, double * np.repeat([1.0, span], n))
    return rank, Start.fixing(natural, double, double[:n] * walk.theta0, undetermined(natural, time))


def moved(rows: Array, time: float) -> Array:
    """Rows on x at the first sample expressed as rows on x ``time`` later, without drift."""
    n = rows.shape[1] // 2
    return np.asarray(np.hstack([rows[:, :n], rows[:, n:] - time * rows[:, :n]]))


def undetermined(natural: Array, time: Array) -> Array:
    """Which levels and slopes have a component in undetermined directions, (T, 2 n); the level follows the slope."""
    n = natural.shape[1] // 2
    first, second = natural[:, :n], natural[:, n:]
    level = np.linalg.norm(first + time[:, None, None] * second, axis=1) / np.hypot(1.0, time)[:, None]
    slope = np.broadcast_to(np.linalg.norm(second, axis=0), level.shape)
    return np.asarray(np.hstack([level, slope]) > 1e-8)


@Driver
def log_likelihood(samples: Array, level: Array, slope: Array, trend: Array, m: Array, P: Array, total: Array) -> None:
    """log L of the equal parts of a record, added to total (k,).

    Of rows (phi, y, weight) (T, n + 2), with drifts ``level`` (T, n) and ``slope`` (n,) per nominal interval; m (2 n,)
    and P (2 n, 2 n) are mean and covariance before the first sample, and are overwritten.
    """
    T, n = level.shape
    g, parts = np.zeros(2 * n), len(total)
    for t in range(T):
        tau = trend[t]
        for i in range(n):
            m[i] += tau * m[n + i]
            for j in range(n):
                P[i, j] += tau * (P[n + i, j] + P[i, n + j]) + tau * tau * P[n + i, n + j]
            P[i, i] += level[t, i] + tau**3 * slope[i]
        for i in range(n):
            for j in range(n):
                P[i, n + j] += tau * P[n + i, n + j]
            P[i, n + i] += tau * tau * slope[i]
            P[n + i, n + i] += tau * slope[i]
            for j in range(n):
                P[n + j, i] = P[i, n + j]
        weight = samples[t, n + 1]
        if weight > 0.0:
            e, f = samples[t, n], 1.0 / weight
            for i in range(2 * n):
                g[i] = 0.0
                for j in range(n):
                    g[i] += P[i, j] * samples[t, j]
            for i in range(n):
                e -= samples[t, i] * m[i]
                f += samples[t, i] * g[i]
            total[t * parts // T] -= 0.5 * (np.log(f * weight) + min(e * e / f, LARGEST_SQUARE))
            for i in range(2 * n):
                m[i] += g[i] * e / f
                for j in range(2 * n):
                    P[i, j] -= g[i] * g[j] / f


def compared(walk: Walk, trend: Array, start: Array) -> tuple[Array, Array]:
    """(rates (k, n) of the drift of slopes per nominal interval, log of their likelihood over that of ``walk`` (k,)).

    ``trend`` (T,) are the nominal intervals, and ``start`` (n,) is an estimate of theta at the first sample. Regressors
    are in units of their weighted root mean squares: one with a fault code counts as little as in the estimate.
    """
    used, level = walk.weight > 0.0, walk.drift_root**2
    n, power = len(start), walk.weight @ walk.phi**2 / walk.weight.sum()
    size = np.sqrt(np.where(power > 0.0, power, 1.0))
    r = float(np.median(1.0 / walk.weight[used]))
    samples = np.column_stack([walk.phi / size, walk.y, walk.weight])
    walked = (level * size**2).sum(axis=0)
    alone = (walked / walked.max()) ** 2 if walked.max() > 0.0 else np.ones(n)
    rates = r * np.concatenate([RATIOS[:, None] * share for share in (np.ones(n), alone)])

    def weigh(moves: Array, rate: Array) -> Array:
        total = np.zeros(EQUAL_PARTS)
        m, wide = np.append(start * size, np.zeros(n)), np.append(np.full(n, LEVEL_STD**2 * r), rate * trend.sum())
        log_likelihood(samples, moves, rate, trend, m, np.diag(wide), total)
        return total

    at_rest = weigh(np.ascontiguousarray(level * size**2), np.zeros(n))
    still = np.zeros_like(level)
    gains = np.array([weigh(still, rate) for rate in rates]) - at_rest
    whole = gains.sum(axis=1)
    return rates / size**2, np.where(whole > gains.max(axis=1), whole, -np.inf)
