"""Forecast and correction of theta and its covariance P by one sample, for trackers that carry both.

    forecast   y_hat = phi' theta;  e = y - y_hat;  g = P phi;  h = phi' g
    correct    theta <- theta + g e / (h + r);  P <- P - g g' / (h + r)

Only the lower triangle of P is kept. Source: Kalman (1960). Cost: O(n^2).

Where every parameter has a drift of its own at every sample, ``drift=`` of shape (T, n), the covariance of the drift is
diag(d_t)^(1/2) q diag(d_t)^(1/2): for flexible least squares a separate weight for every step and parameter, mu_i /
d_ti. Trackers that support it have a field ``drift_root`` (n,), the square roots of d, which are 1 by default.
"""

from __future__ import annotations

from typing import Any

from driftfit.engine.drivers import COMMON
from driftfit.engine.kernel import Array, State, kernel

LEFT = 1e-14
"""Smallest share of a variance that one sample leaves: below it the rest is rounding, which may be negative. It takes
a regressor ten million times as large as those before it."""


def product_with(entry: Any) -> Any:
    """A kernel that fills s.g = P x from the lower triangle of P and returns x' P x, for x_i = entry(s, i, l).

    Each loop does one thing, here and in `reduce_covariance`: the compiler unrolls a loop over parameters, and
    vectorises the loop over lanes around it, only while the body has at most some 300 / n instructions.
    """

    @kernel
    def product(s: State, l: int) -> float:
        n = s.theta.shape[0]
        for i in range(n):
            g = -0.0  # to which adding changes nothing: the addition of 0.0 would remain
            for j in range(i + 1):
                g += s.P[i, j, l] * entry(s, j, l)
            s.g[i, l] = g
        for i in range(n):
            g = s.g[i, l]
            for j in range(i + 1, n):
                g += s.P[j, i, l] * entry(s, j, l)
            s.g[i, l] = g
        total = -0.0
        for i in range(n):
            total += entry(s, i, l) * s.g[i, l]
        return total

    return product


@kernel
def read_drift(s: State, known: Array, t: int, l: int) -> None:
    """Take the roots of d from the columns of ``known`` that only some trackers read."""
    for i in range(s.theta.shape[0]):
        s.drift_root[i, l] = known[t, COMMON + i, l]


@kernel
def regressor(s: State, i: int, l: int) -> float:
    """phi_i."""
    return s.phi[i, l]  # type: ignore[no-any-return]


symmetric_product = product_with(regressor)
"""s.g = P phi; returns phi' P phi."""


@kernel
def prediction(s: State, l: int) -> float:
    """phi' theta."""
    total = -0.0
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
def move(s: State, gain: float, e: float, l: int) -> None:
    """theta <- theta + gain g e with s.g."""
    for i in range(s.theta.shape[0]):
        s.theta[i, l] += gain * s.g[i, l] * e


@kernel
def forecast(s: State, l: int) -> None:
    """y_hat = phi' theta, e = y - y_hat, g = P phi, h = phi' g; less than 0 is rounding."""
    y_hat = prediction(s, l)
    s.y_hat[l], s.e[l] = y_hat, s.y[l] - y_hat
    s.h[l] = max(symmetric_product(s, l), 0.0)


@kernel
def correct(s: State, l: int) -> None:
    """theta <- theta + g e / v,  P <- P - g g' / v,  with v = h + r noise, if the sample is used."""
    gain = s.ok[l] / (s.h[l] + s.r[l] * s.noise[l])
    move(s, gain, s.e[l], l)
    reduce_covariance(s, gain, l)
