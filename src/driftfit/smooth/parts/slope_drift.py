"""Whether slopes walk at random instead of levels, for records whose tracker estimated the drift of the levels.

    theta_t = theta_{t-1} + tau_t slope_t,    slope_t = slope_{t-1} + w_t,    w_t ~ N(0, tau_t s)

is another model of the same record, with tau_t the nominal intervals between the samples and s = rho r / c_i share_i^2
for parameter i, where r is the typical noise variance and c_i the mean square of the regressor. It is tried at every
rho of `RATIOS`, and with two sets of shares: all parameters alike, and those of the random walk that the tracker has
estimated, squared as its drift ratio alpha^2 belongs to a slope's alpha^4 / 4
(`driftfit.trackers.mixture.filters`). Each has the likelihood

    log L = -1/2 sum (log f_t + min(e_t^2 / f_t, 16)),    e_t, f_t the innovations of a Kalman filter of level and slope

that is compared with the one of the random walk, from the same filter and the same prior of the level, which is `FAR`
standard deviations of the noise wide; that of the slope is as wide as what it moves in the whole record. Slopes are not
considered if one of `PARTS` equal parts of the record is all that speaks for them: it may be a jump or a fault.

Source: West and Harrison, Bayesian Forecasting and Dynamic Models (1997), chapter 7, for the model and its likelihood.
Cost: O(T n^2) for each of the likelihoods.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array, Driver
from driftfit.smooth.parts.walk import Walk

RATIOS = 10.0 ** np.arange(-10.0, -1.0)
FAR = 100.0
MOST = 16.0
"""The largest e^2 / f that counts, so that a single sample decides nothing."""
PARTS = 8


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
            total[t * parts // T] -= 0.5 * (np.log(f * weight) + min(e * e / f, MOST))
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
        total = np.zeros(PARTS)
        m, wide = np.append(start * size, np.zeros(n)), np.append(np.full(n, FAR**2 * r), rate * trend.sum())
        log_likelihood(samples, moves, rate, trend, m, np.diag(wide), total)
        return total

    at_rest = weigh(np.ascontiguousarray(level * size**2), np.zeros(n))
    still = np.zeros_like(level)
    gains = np.array([weigh(still, rate) for rate in rates]) - at_rest
    whole = gains.sum(axis=1)
    return rates / size**2, np.where(whole > gains.max(axis=1), whole, -np.inf)
