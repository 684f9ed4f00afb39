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
theta / S and 1 / S. Cost: O(N n) for each of some twenty iterations.
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
SMALLEST = 1e-3
"""The least inverse of the noise, in units of that from which on rounding has no mean."""
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
    """(theta (n,), S) of greatest likelihood of the intervals e -+ h (N,), in theta / S and 1 / S, in units of S."""
    lower, upper = (np.column_stack([-X, end / S]) for end in (e - h, e + h))

    def loss(p: Array) -> tuple[float, Array]:
        a, b = lower @ p, upper @ p
        side = np.where(a + b > 0.0, -1.0, 1.0)  # tails have digits on the left
        mass = np.maximum(np.abs(scipy.special.ndtr(side * b) - scipy.special.ndtr(side * a)), 1e-300)
        at_a, at_b = (np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi) / mass for z in (a, b))
        return -float(np.sum(np.log(mass))), lower.T @ at_a - upper.T @ at_b

    n, free = X.shape[1], (None, None)
    given = {"jac": True, "method": "L-BFGS-B", "bounds": [*[free] * n, (SMALLEST, None)]}
    p = scipy.optimize.minimize(loss, np.append(np.zeros(n), 1.0), **given).x
    return S * p[:-1] / p[-1], float(S / p[-1])
