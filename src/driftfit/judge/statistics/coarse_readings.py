"""Readings of a coarse sensor, drawn again within its step, so that their errors are those of a fine sensor.

    y_t = q round(m_t / q + S w_t / q),   m_t = phi_t' theta,   w_t normal        the reading, for constant theta
    z_t = m_t + S Phi^-1(F(a_t) + U_t (F(b_t) - F(a_t))),   a_t, b_t = (y_t -+ q/2 - m_t) / S,   U_t uniform

The error of rounding is a function of m_t: where an input is held, it is the same for as long, and another one at the
next level, so that sums of residuals wander although theta is constant. It has a mean of about q / pi exp(-2 pi^2 S^2 /
q^2) at most, which a noise of half a step averages to nothing. With less noise, the tests judge z_t: if theta is
constant, it has the errors S w_t, whatever the inputs do. A change that is smaller than the step moves z_t by less than
the reading, and only as far as readings can tell; one that is larger moves it as much, less half a step. The U_t are
functions of t and of all readings: the same record has the same verdict (`driftfit.run.live.rule`).

theta and S are those of greatest likelihood of the intervals, on readings near the fit. If they move, S is large, and
the readings remain as they are. Readings of a fine sensor always remain as they are, and so do those that constants
do not explain as rounded ones, and those of which nearly all are in one step, such as counts of rare events.

Source: Dunn and Smyth (1996), whose residuals these are; Burridge (1981) for the likelihood, which is concave in
theta / S and 1 / S. Cost: O(N n^2) for each of some ten iterations.
"""

from __future__ import annotations

import numpy as np
import scipy

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array
from driftfit.judge.statistics.robust import robust_fit
from driftfit.run.live.rule import chances, drawn, seed_of

MOST = 0.6
"""Noise in units of the step from which on rounding has no mean: its share of the step is below 0.0003."""
LEAST = 0.05
"""The least noise in units of the step."""
FAR = 4.0
"""Deviations beyond the step within which readings count; of all others there may be `STRANGE` of all."""
STRANGE = 0.02
REPEATED = 0.1
"""Share of the readings that repeat the one before, of a coarse sensor."""
DECIMALS = 1e-9
"""Share of the largest reading below which differences are rounded decimals."""
ROUNDS = 50
NONE = np.zeros(0, np.int64)


def step_of(y: Array) -> float:
    """The step of the readings y (T,), of which all are multiples from the first; missing ones are NaN. It is 0 if they
    are not those of a coarse sensor. Euclid's algorithm, for numbers with rounded decimals.
    """
    y = y[np.abs(y) < LARGEST]
    values = np.unique(y)
    if len(values) < 3 or np.mean(y[1:] == y[:-1]) < REPEATED:
        return 0.0
    least, step = DECIMALS * float(np.abs(values).max()), 0.0
    for apart in np.unique(np.diff(values)):
        left = float(apart)
        while left > least:
            step, left = left, abs(step - left * round(step / left))
    return step


def drawn_within(X: Array, y: Array, step: Array, breaks: Array = NONE) -> Array:
    """Readings y (N,) on X (N, n), X' X = N I, with steps (N,): z (N,), or y itself where constants, or those of
    segments with these breaks, do not explain the readings as rounded ones.
    """
    if len(breaks):
        own = np.arange(len(breaks) + 1) == np.searchsorted(breaks, np.arange(len(y)), side="right")[:, None]
        X = (own[:, :, None] * X[:, None, :]).reshape(len(y), -1)
    found = explained(X, y, step)
    return y if found is None else drawn(y, *found, 0.5 * step, chances(0, len(y), seed_of(y, step)))


def explained(X: Array, y: Array, step: Array) -> tuple[Array, float] | None:
    """m (N,) and S of greatest likelihood; None if the readings are not those of constants, or the noise averages the
    errors of rounding.
    """
    e = robust_fit(X, y).residual
    h, m, q = 0.5 * step, y - e, float(np.median(step))
    if q <= 0.0 or np.quantile(m / step, 0.95) - np.quantile(m / step, 0.05) < 1.0:
        return None
    near = np.abs(e) <= h + FAR * MOST * step
    if np.mean(~near) > STRANGE:
        return None
    moved, S = _most_likely(X[near], e[near], h[near], MOST * q)
    return None if MOST * q <= S else (m + X @ moved, max(S, LEAST * q))


def _most_likely(X: Array, e: Array, h: Array, S: float) -> tuple[Array, float]:
    """(theta (n,), S) of greatest likelihood of the intervals e -+ h (N,): Newton's steps for theta / S and 1 / S."""
    n = X.shape[1]
    lower, upper = np.column_stack([-X, e - h]), np.column_stack([-X, e + h])
    p = np.append(np.zeros(n), 1.0 / S)
    value, slope, curve = _likelihood(lower, upper, p)
    for _ in range(ROUNDS):
        move, share = np.linalg.lstsq(curve, slope, rcond=None)[0], 1.0
        while share > 1e-6:
            trial = p + share * move
            if trial[-1] > 0.0:
                found = _likelihood(lower, upper, trial)
                if found[0] >= value:
                    break
            share *= 0.5
        else:
            break
        gain, p = found[0] - value, trial
        value, slope, curve = found
        if gain < 1e-6:
            break
    return p[:-1] / p[-1], float(1.0 / p[-1])


def _likelihood(lower: Array, upper: Array, p: Array) -> tuple[float, Array, Array]:
    """Log-likelihood of intervals lower @ p .. upper @ p of a normal variable, its slope, and minus its curvature."""
    a, b = lower @ p, upper @ p
    side = a + b > 0.0
    mass = np.maximum(
        np.where(side, scipy.special.ndtr(-a) - scipy.special.ndtr(-b), scipy.special.ndtr(b) - scipy.special.ndtr(a)),
        1e-300,
    )
    at_a, at_b = (np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi) / mass for z in (a, b))
    slope = upper.T @ at_b - lower.T @ at_a
    both = upper * at_b[:, None] - lower * at_a[:, None]
    curve = both.T @ both + (upper * (b * at_b)[:, None]).T @ upper - (lower * (a * at_a)[:, None]).T @ lower
    return float(np.sum(np.log(mass))), slope, curve
