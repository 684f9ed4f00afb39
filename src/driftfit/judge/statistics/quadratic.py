"""The distribution of a weighted sum of chi-squares, by inverting its characteristic function.

    Q = sum_j w_j x_j^2,  x_j ~ N(0, 1)        phi(v) = prod_j (1 - 2 i v w_j)^(-1/2)
    P(Q > x) = 1/2 + sum_k Im(phi(v_k) e^(-i v_k x)) / (pi (k + 1/2)),   v_k = (k + 1/2) D

The step D is so small that no part of the distribution lies beyond x + 2 pi / D; the sum stops where phi has
vanished. Limits of score tests are such sums: a Cramer-von Mises statistic has w_j = 1 / (j pi)^2.

Source: Davies (1980), algorithm AS 155, without its error control. Error below 1e-6 for five weights and more.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array, Driver

TERMS = 65536
"""Largest number of terms of the sum."""
SMALL = 1e-3
"""Weights below this share of the largest are replaced by their mean."""


def tail(weights: Array, x: float) -> float:
    """P(sum w_j chi2_1 > x) for weights (k,), not negative; NaN where they are not finite."""
    weights = np.asarray(weights, float)
    if not np.isfinite(x) or not np.isfinite(weights).all():
        return float("nan")
    largest = weights.max(initial=0.0)
    if largest <= 0.0:
        return float(x <= 0.0)
    kept = weights > SMALL * largest
    x = (x - weights[~kept].sum()) / largest
    w = weights[kept] / largest
    if x <= 0.0:
        return 1.0
    total = np.zeros(1)
    _invert(np.ascontiguousarray(w), np.array([x]), total)
    return float(np.clip(0.5 + total[0], 0.0, 1.0))


def _inverted(w: Array, x: Array, total: Array) -> None:
    """The sum, until its terms have vanished; two weights at a time, so that a root is the principal one."""
    count = w.shape[0]
    step = 2.0 * np.pi / (x[0] + w.sum() + 60.0)
    for term in range(TERMS):
        k = term + 0.5
        v = k * step
        # c + i d = 1 / phi(v)
        c, d = 1.0, 0.0
        for j in range(0, count, 2):
            one = 2.0 * v * w[j]
            two = 2.0 * v * w[j + 1] if j + 1 < count else 0.0
            real, imaginary = 1.0 - one * two, -(one + two)
            larger = np.sqrt(0.5 * (np.sqrt(real * real + imaginary * imaginary) + abs(real)))
            smaller = 0.5 * imaginary / larger
            p, q = (larger, smaller) if real >= 0.0 else (-smaller, -larger)
            c, d = c * p - d * q, c * q + d * p
        square = c * c + d * d
        total[0] -= (np.sin(v * x[0]) * c + np.cos(v * x[0]) * d) / (square * np.pi * k)
        if square * k * k > 1e17:
            break


_invert = Driver(_inverted)


def quantile(weights: Array, p: float) -> float:
    """The x that is exceeded with probability p."""
    weights = np.asarray(weights, float)
    high = weights.sum() + 80.0 * weights.max()
    from scipy import optimize  # a tenth of a second to import

    return float(optimize.brentq(lambda x: tail(weights, x) - p, 0.0, high, xtol=1e-10 * high))
