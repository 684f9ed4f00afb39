"""The drift of a record whose tracker estimated it sample by sample, pooled over the record.

A tracker that adapts reports a drift q_t (n,) for every sample. Even averaged over its modes given all samples, it
fluctuates where the drift is constant, because it was estimated from the same noise, and a smoother that takes it as
given follows the noise and reports bands that are too narrow. Two shapes of q over time are therefore compared, each at
a few scales,

    as estimated    q_t
    pooled          qbar, the mean over time, except at jumps: where q_t exceeds JUMP qbar

by the likelihood L of the record, which integrates theta out (`driftfit.smooth.parts.elimination`), and averaged:

    q = sum_k p_k q_k,    p_k proportional to L_k exp(-penalty_k)

The smoother is applied to this q, and its variances grow by the spread of the paths theta_k under the single drifts
about its path theta,

    sum_k p_k (theta_k - theta) (theta_k - theta)'

since a slow walk can look as if nothing moved, and the band of a constant would be too narrow.

q_t as estimated was fitted to the record, and its likelihood is too large by an amount that grows with the record; the
penalty, PRICE + T / SHARE, was found in simulations of constant drift. A record with jumps of several standard
deviations exceeds it many times.

Source: averaging over models by their likelihood, Hoeting, Madigan, Raftery and Volinsky (1999); the two shapes are
ours. Cost: eight smoothers.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.smooth.parts.elimination import smooth_and_weigh
from driftfit.smooth.parts.rank import column_scale
from driftfit.smooth.parts.rests import undecided
from driftfit.smooth.parts.slope_drift import compared
from driftfit.smooth.parts.slopes import smooth as smooth_slopes
from driftfit.smooth.parts.walk import Walk

JUMP = 10.0
"""q_t above this many times the mean of the others is a jump."""
SCALES = (1.0 / 3.0, 1.0, 3.0, 9.0)
TRENDS = 3.0
"""Penalty of slopes that walk, in units of the log-likelihood."""
PRICE, SHARE = 5.0, 200.0
"""Penalty of the drift as estimated: PRICE + T / SHARE in units of the log-likelihood."""
ROUNDS = 20
LEAST = 1e-3
"""Drifts with a smaller probability do not count in the variances."""


def pooled(rate: Array) -> Array:
    """Rates of drift (T, n) with their mean over time wherever there is drift, except at jumps."""
    found, moving = rate.copy(), rate.sum(axis=1) > 0.0
    for i in range(rate.shape[1] if moving.any() else 0):
        own = rate[moving, i]
        mean = own.mean()
        for _ in range(ROUNDS):
            rest = own[own <= JUMP * mean].mean()
            if rest >= mean:
                break
            mean = rest
        found[moving, i] = np.where(own > JUMP * mean, own, mean)
    return found


def average_drift(walk: Walk, time: Array, trend: Array) -> Walk:
    """The walk with the average of the drifts, and with the paths of the single drifts.

    ``time`` (T,) are the intervals of drift before each sample, and ``trend`` (T,) those of motion along a slope. The
    walk is returned unchanged if the likelihood cannot be computed accurately. Regressors that are always 0 take no
    part, and their parameters stay at 0.
    """
    moved = np.flatnonzero(np.any(walk.phi[walk.weight > 0.0] != 0.0, axis=0))
    if len(moved) == walk.phi.shape[1]:
        return averaged(walk, time, trend)
    some = averaged(walk.of(moved), time, trend) if len(moved) else walk
    if not len(some.paths):
        return walk
    drift_root, paths = np.zeros_like(walk.drift_root), np.zeros((len(some.paths), *walk.phi.shape))
    drift_root[:, moved], paths[:, :, moved] = some.drift_root, some.paths
    return walk._replace(drift_root=drift_root, trend=some.trend, paths=paths, belief=some.belief)


def averaged(walk: Walk, time: Array, trend: Array) -> Walk:
    """The same where every regressor moves."""
    q, span = walk.drift_root**2, time[:, None]
    rate = np.divide(q, span, out=np.zeros_like(q), where=span > 0.0)
    shapes = ((q, PRICE + len(q) / SHARE), (pooled(rate) * span, 0.0))
    size = column_scale(walk.phi, walk.signals)
    paths, log_p = [], np.full((len(shapes), len(SCALES)), -np.inf)
    for k, (one, price) in enumerate(shapes):
        for j, scale in enumerate(SCALES):
            solved = smooth_and_weigh(walk._replace(drift_root=np.sqrt(scale * one)), size)
            if solved is None:
                return walk
            paths.append(solved[0].theta)
            log_p[k, j] = solved[1] - price
    best = int(np.argmax(log_p))
    likeliest = walk._replace(drift_root=np.sqrt(SCALES[best % len(SCALES)] * shapes[best // len(SCALES)][0]))
    rates, better = compared(likeliest, trend, paths[best][0])
    p = np.append(log_p, log_p.max() + better - TRENDS)
    p = np.exp(p - p.max())
    p /= p.sum()
    which = np.flatnonzero(p >= LEAST)
    walks, slopes = p[: log_p.size], p[log_p.size :]
    for k in which[which >= log_p.size]:
        paths.append(smooth_slopes(sloped(walk, trend, rates[k - log_p.size])).theta)
    kept = np.stack([*(paths[k] for k in which if k < log_p.size), *paths[log_p.size :]])
    if slopes.sum() > 0.5:
        found = sloped(walk, trend, slopes @ rates / slopes.sum())
    else:
        share = walks.reshape(log_p.shape) @ np.array(SCALES) / walks.sum()
        found = walk._replace(drift_root=np.sqrt(share[0] * shapes[0][0] + share[1] * shapes[1][0]))
    if not len(found.trend):
        more = undecided(found, size)
        return found._replace(paths=np.concatenate([kept, more]), belief=np.append(p[which], np.ones(len(more))))
    return found._replace(paths=kept, belief=p[which])


def sloped(walk: Walk, trend: Array, rate: Array) -> Walk:
    """The problem with slopes that drift by ``rate`` (n,) per nominal interval instead of levels."""
    return walk._replace(trend=trend, drift_root=np.sqrt(trend[:, None] * rate))
