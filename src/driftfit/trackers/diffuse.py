"""The exact diffuse start: no knowledge at all before the first sample, and no large number in its place.

With P0 = kappa I and kappa to infinity the covariance is kappa (I - V V') + P, where the rows of V are an orthonormal
basis of the regressors seen so far. A regressor outside their span, with w = (I - V V') phi / |phi| and
F = |phi|^2 |w|^2 (so s = kappa F + ..., infinite), determines one more direction:

    k = w / (|phi| |w|^2)
    theta <- theta + k e
    P     <- P + k k' (phi' P phi + r) - k (P phi)' - (P phi) k'
    V     <- [V; w / |w|],   rank <- rank + 1

and its share of the diffuse log-likelihood is -1/2 log F. A regressor inside the span is an ordinary correction with P.
Rank is decided on normalised regressors, twice orthogonalised: |w| > 1e-7. A regressor below 1e-100 counts as zero.

Source: Durbin and Koopman, Time Series Analysis by State Space Methods (2012), section 5.2, with the projector
I - V V' in the place of P_inf so that rank is decided on the regressors and not on eigenvalues. Cost: O(n^2).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.kernel import Array, State, kernel, shared

TOLERANCE = 1e-7
"""Sine below which a regressor counts as inside the span. The covariance of a direction excited with relative size d is
1/d^2 times that of the others; below 1e-7 those would be lost in its rounding, and estimates run away."""

SPANNED = 1e-10
"""Squared sine below which a parameter counts as inside the span."""

SMALLEST = 1e-100
"""A first regressor smaller than this would put a covariance above 1e200 into P, whose products overflow."""


def knowing_nothing(n: int) -> dict[str, Any]:
    """Fields for a diffuse start."""
    return {"V": np.zeros((n, n)), "w": np.zeros(n), "F": np.ones(n), "rank": 0}


def knowing(n: int) -> dict[str, Any]:
    """The same fields for a proper prior."""
    return knowing_nothing(n) | {"rank": n}


def product_with(entry: Any) -> Any:
    """A kernel that fills s.g = P x from the lower triangle of P and returns x' P x, for x_i = entry(s, i, l)."""

    @kernel
    def product(s: State, l: int) -> float:
        n = s.theta.shape[0]
        for i in range(n):
            g = 0.0
            for j in range(i + 1):
                g += s.P[i, j, l] * entry(s, j, l)
            for j in range(i + 1, n):
                g += s.P[j, i, l] * entry(s, j, l)
            s.g[i, l] = g
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
def measurement(s: State, l: int) -> None:
    """One correction with noise variance s.r: theta, the lower triangle of P, and s.y_hat, s.e, s.s.

    Only one triangle is updated: P - outer(k, P phi) rounds asymmetrically, and forgetting lets the antisymmetric part
    grow until it ruins a run of ten thousand steps that looked healthy at five hundred.
    """
    n = s.theta.shape[0]
    y_hat = prediction(s, l)
    v = symmetric_product(s, l) + s.r[l] * s.noise[l]
    e = s.y[l] - y_hat
    gain = s.ok[l] / v
    for i in range(n):
        k = gain * s.g[i, l]
        s.theta[i, l] += k * e
        for j in range(i + 1):
            s.P[i, j, l] -= k * s.g[j, l]
    s.y_hat[l] = y_hat
    s.e[l] = e
    s.s[l] = v


@shared
def outside(phi: Array, V: Array, rank: int, w: Array) -> tuple[float, float]:
    """w = the part of phi / |phi| outside the span of the first rows of V; returns (|phi|, |w|^2)."""
    n = w.shape[0]
    # The largest entry first: squares of 1e-200 or 1e200 would be 0 or inf.
    top = 0.0
    for i in range(n):
        top = max(top, abs(phi[i]))
    size = 0.0
    for i in range(n):
        w[i] = phi[i] / top if top > SMALLEST else 0.0
        size += w[i] * w[i]
    size = np.sqrt(size)
    for i in range(n):
        w[i] = w[i] / size if size > 0.0 else 0.0
    for _ in range(2):
        for k in range(rank):
            dot = 0.0
            for i in range(n):
                dot += V[k, i] * w[i]
            for i in range(n):
                w[i] -= dot * V[k, i]
    square = 0.0
    for i in range(n):
        square += w[i] * w[i]
    return top * size, square


@shared
def widen(
    theta: Array, P: Array, v: Array, w: Array, g: Array, e: float, f: float, length: float, square: float
) -> None:
    """Take in a new direction w: the formulas above with f = phi' P phi + r and g = P phi; v becomes the row of V."""
    n = theta.shape[0]
    for i in range(n):
        w[i] = w[i] / square / length  # k
        theta[i] += w[i] * e
    for i in range(n):
        for j in range(i + 1):
            P[i, j] += w[i] * w[j] * f - w[i] * g[j] - g[i] * w[j]
    for i in range(n):
        v[i] = w[i] * length * np.sqrt(square)


@kernel
def enter(s: State, l: int) -> None:
    """The correction while rank < n."""
    rank = s.rank[l]
    length, square = outside(s.phi[:, l], s.V[:, :, l], rank, s.w[:, l])
    if square <= TOLERANCE * TOLERANCE:
        measurement(s, l)
    else:
        y_hat = prediction(s, l)
        e = s.y[l] - y_hat
        f = symmetric_product(s, l) + s.r[l] * s.noise[l]
        if s.ok[l] > 0.0:
            widen(s.theta[:, l], s.P[:, :, l], s.V[rank, :, l], s.w[:, l], s.g[:, l], e, f, length, square)
            s.F[rank, l] = length * length * square
            s.rank[l] = rank + 1
        s.y_hat[l] = y_hat
        s.e[l] = e
        s.s[l] = np.inf


@kernel
def spanned_variance(s: State, l: int) -> None:
    """Report the variance while rank < n: infinite for every parameter that the regressors do not span yet."""
    spanned(s.P[:, :, l], s.V[:, :, l], s.rank[l], s.scale[l], s.var[:, l])


@shared
def spanned(P: Array, V: Array, rank: int, scale: float, var: Array) -> None:
    """var = diag P times the scale where the first rows of V span the axis, else inf."""
    for i in range(var.shape[0]):
        rest = 1.0
        for k in range(rank):
            rest -= V[k, i] * V[k, i]
        var[i] = P[i, i] * scale if rest < SPANNED else np.inf
