"""The correction of theta and its covariance P by one sample, for trackers that carry both.

    y_hat = phi' theta;  e = y - y_hat;  g = P phi;  s = phi' g + r
    theta <- theta + g e / s;  P <- P - g g' / s

Only the lower triangle of P is kept. Source: Kalman (1960). Cost: O(n^2).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import State, kernel

LEFT = 1e-14
"""Smallest share of a variance that one sample leaves: below it the rest is rounding, which may be negative. It takes
a regressor ten million times as large as those before it."""

NARROW = 40
"""Parameters up to which a row of P is summed in order."""


def product_with(entry: Any) -> Any:
    """A kernel that fills s.g = P x from the lower triangle of P and returns x' P x, for x_i = entry(s, i, l).

    Each loop does one thing, here and in `corrected`: the compiler unrolls a loop over parameters, and vectorises the
    loop over lanes around it, only while the body has at most some 300 / n instructions. With more than NARROW
    parameters a row is read once, for its own entry of P x and those of its columns, and summed in eight parts: a sum
    in order waits for each of its additions.
    """

    @kernel
    def narrow(s: State, l: int) -> None:
        n = s.theta.shape[0]
        for i in range(n):
            g = 0.0
            for j in range(i + 1):
                g += s.P[i, j, l] * entry(s, j, l)
            s.g[i, l] = g
        for i in range(n):
            g = s.g[i, l]
            for j in range(i + 1, n):
                g += s.P[j, i, l] * entry(s, j, l)
            s.g[i, l] = g

    @kernel
    def wide(s: State, l: int) -> None:
        for i in range(s.theta.shape[0]):
            a, b, c, d, e, f, g, h = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            whole, x = i - i % 8, entry(s, i, l)
            for j in range(0, whole, 8):
                a += s.P[i, j, l] * entry(s, j, l)
                b += s.P[i, j + 1, l] * entry(s, j + 1, l)
                c += s.P[i, j + 2, l] * entry(s, j + 2, l)
                d += s.P[i, j + 3, l] * entry(s, j + 3, l)
                e += s.P[i, j + 4, l] * entry(s, j + 4, l)
                f += s.P[i, j + 5, l] * entry(s, j + 5, l)
                g += s.P[i, j + 6, l] * entry(s, j + 6, l)
                h += s.P[i, j + 7, l] * entry(s, j + 7, l)
            rest = s.P[i, i, l] * x
            for j in range(whole, i):
                rest += s.P[i, j, l] * entry(s, j, l)
            for j in range(i):
                s.g[j, l] += s.P[i, j, l] * x
            s.g[i, l] = rest + (((a + e) + (c + g)) + ((b + f) + (d + h)))

    @kernel
    def product(s: State, l: int) -> float:
        n = s.theta.shape[0]
        if n > NARROW:
            wide(s, l)
        else:
            narrow(s, l)
        total = 0.0
        for i in range(n):
            total += entry(s, i, l) * s.g[i, l]
        return total

    return product


@kernel
def regressor(s: State, i: int, l: int) -> float:
    """phi_i."""
    return s.phi[i, l]  # type: ignore[no-any-return]


symmetric_product = product_with(regressor)
"""s.g = P phi; returns phi' P phi."""


@kernel
def prediction(s: State, l: int) -> float:
    """phi' theta."""
    total = 0.0
    for i in range(s.theta.shape[0]):
        total += s.phi[i, l] * s.theta[i, l]
    return total


@kernel
def reduce_covariance(s: State, gain: float, l: int) -> None:
    """P <- P - gain g g' with s.g.

    Only one triangle is updated: P - outer(k, P phi) rounds asymmetrically, and forgetting lets the antisymmetric part
    grow until it ruins a run of ten thousand steps that looked healthy at five hundred.
    """
    for i in range(s.g.shape[0]):
        k = gain * s.g[i, l]
        for j in range(i):
            s.P[i, j, l] -= k * s.g[j, l]
        s.P[i, i, l] = max(s.P[i, i, l] - k * s.g[i, l], LEFT * s.P[i, i, l])


@kernel
def corrected(s: State, y_hat: float, v: float, l: int) -> float:
    """Correct theta and P from s.g = P h and the variance v of the innovation, and report s.y_hat, s.e, s.s.

    Returns 1 / v, or 0 if the sample is not used. Where v is not positive, s.ok becomes 0, and s.s infinite.
    """
    e = s.y[l] - y_hat
    gain = s.ok[l] / v
    for i in range(s.theta.shape[0]):
        s.theta[i, l] += gain * s.g[i, l] * e
    reduce_covariance(s, gain, l)
    # P that has lost its digits gets some of them back, but the sample has no variance, and says nothing of the noise
    s.ok[l] = s.ok[l] if v > 0.0 else 0.0
    s.y_hat[l], s.e[l], s.s[l] = y_hat, e, v if v > 0.0 else np.inf
    return gain  # type: ignore[no-any-return]


@kernel
def measurement(s: State, l: int) -> None:
    """One correction with noise variance s.r."""
    y_hat = prediction(s, l)
    corrected(s, y_hat, symmetric_product(s, l) + s.r[l] * s.noise[l], l)
