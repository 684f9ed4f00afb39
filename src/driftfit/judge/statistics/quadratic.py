"""The distribution of a weighted sum of chi-squares, by inverting its characteristic function.

    Q = sum_j w_j x_j^2,  x_j ~ N(0, 1)        phi(v) = prod_j (1 - 2 i v w_j)^(-1/2)
    P(Q > x) = 1/2 + sum_k Im(phi(v_k) e^(-i v_k x)) / (pi (k + 1/2)),   v_k = (k + 1/2) D

The step D is so small that no part of the distribution lies beyond x + 2 pi / D; the sum stops where phi has
vanished. Where Chernoff's bound E(e^(Q/4)) e^(-x/4), for weights of at most 1, is below e^-NOTHING, the tail is 0 and
nothing is summed: the larger x, the smaller the step, and the sum would end long before phi has vanished. Limits of
score tests are such sums: a Cramer-von Mises statistic has w_j = 1 / (j pi)^2.

Source: Davies (1980), algorithm AS 155, without its error control. Error below 1e-6 for five weights and more.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, Driver, shared

TERMS = 65536
"""Largest number of terms of the sum."""
TOGETHER = 32
NOTHING = 40.0
"""A probability below e^-40 is 0."""
SMALL = 1e-3
"""Weights below this share of the largest are replaced by their mean."""


@partial(shared, arrays=True)
def _inverted(w: Array, x: float) -> Any:
    """The sum, until its terms have vanished: `TOGETHER` terms side by side, which are vectorised.

    Four weights at a time: the angle of their product is between -2 pi and 0, so that of its root has a negative
    imaginary part. w (k,) with k a multiple of four; the last weights may be 0.
    """
    v, c, d = np.zeros(TOGETHER), np.zeros(TOGETHER), np.zeros(TOGETHER)
    total, step = 0.0, 2.0 * np.pi / (x + w.sum() + 60.0)
    turn, half = np.sin(step * x), np.sin(0.5 * step * x)
    for first in range(0, TERMS, TOGETHER):
        for i in range(TOGETHER):
            v[i], c[i], d[i] = 2.0 * (first + i + 0.5) * step, 1.0, 0.0
        for j in range(0, w.shape[0], 4):
            for i in range(TOGETHER):
                # c + i d = 1 / phi(v), by the square root of (1 - i v w_j) .. (1 - i v w_(j + 3))
                one, two, three, four = v[i] * w[j], v[i] * w[j + 1], v[i] * w[j + 2], v[i] * w[j + 3]
                a, b = 1.0 - one * two, one + two
                e, f = 1.0 - three * four, three + four
                real, imaginary = a * e - b * f, -(a * f + b * e)
                size = np.sqrt(real * real + imaginary * imaginary)
                larger = np.sqrt(0.5 * (size + abs(real)))
                smaller = 0.5 * abs(imaginary) / larger
                p = larger if real >= 0.0 else smaller
                q = smaller if real >= 0.0 else larger
                p = p if imaginary <= 0.0 else -p
                c[i], d[i] = c[i] * p + d[i] * q, d[i] * p - c[i] * q
        # the sine and cosine of every term from those of the first, by the formulas of addition
        angle = (first + 0.5) * step * x
        sine, cosine = np.sin(angle), np.cos(angle)
        for i in range(TOGETHER):
            k, square = first + i + 0.5, c[i] * c[i] + d[i] * d[i]
            total -= (sine * c[i] + cosine * d[i]) / (square * np.pi * k)
            if square * k * k > 1e17:
                return total
            sine, cosine = (
                sine - (2.0 * half * half * sine - turn * cosine),
                cosine - (2.0 * half * half * cosine + turn * sine),
            )
    return total


@Driver
def _tail(weights: Array, w: Array, x: float) -> float:
    """`tail`, but for rounding between 0 and 1; w (k + 4,) is zero."""
    largest, rest, kept = 0.0, 0.0, 0
    for one in weights:
        if not abs(one) < np.inf:
            return np.nan
        largest = max(largest, one)
    if not abs(x) < np.inf:
        return np.nan
    if largest <= 0.0:
        return 1.0 if x <= 0.0 else 0.0
    for one in weights:
        if one > SMALL * largest:
            w[kept] = one / largest
            kept += 1
        else:
            rest += one
    x = (x - rest) / largest
    # -log(1 - w / 2) / 2, whose sum is the logarithm of the expectation, is at most w log(2) / 2
    if 0.25 * x > NOTHING + 0.34657359028 * w.sum():
        return 0.0
    return 0.5 + _inverted(w[: kept + -kept % 4], x) if x > 0.0 else 1.0


def tail(weights: Array, x: float) -> float:
    """P(sum w_j chi2_1 > x) for weights (k,), not negative; NaN where they are not finite."""
    weights = np.ascontiguousarray(weights, float)
    found = _tail(weights, np.zeros(len(weights) + 4), float(x))
    return float(found if np.isnan(found) else min(max(found, 0.0), 1.0))


def quantile(weights: Array, p: float) -> float:
    """The x that is exceeded with probability p."""
    weights = np.asarray(weights, float)
    high = weights.sum() + 80.0 * weights.max()
    from scipy import optimize  # a tenth of a second to import

    return float(optimize.brentq(lambda x: tail(weights, x) - p, 0.0, high, xtol=1e-10 * high))
