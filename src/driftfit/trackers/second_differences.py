"""Second differences, on line: parameters that move along a slope, and whose slope walks at random.

At every t it gives the last point of the path that minimises

    J = sum_k w_k (y_k - phi_k' theta_k)^2 + sum_k (slope_{k+1} - slope_k)' D_k (slope_{k+1} - slope_k)
    slope_{k+1} = (theta_{k+1} - theta_k) / dt_{k+1},   D_k = diag(mu / d_{k+1}) / dt_{k+1}

which for even steps prices theta_{k+1} - 2 theta_k + theta_{k-1}. With x = (theta, slope):

    predict   x <- F x,  F = [[1, dt], [0, 1]];   P <- F P F' + D^-1 (dt, 1)(dt, 1)'       (not before the first sample)
    correct   as in `driftfit.trackers.fls`, with the regressor h = (phi, 0)

Start: nothing is known of x at the first sample. The exact diffuse start of `driftfit.trackers.diffuse` works on
the regressors of x *there*: after tau intervals these are z = F_tau' h = (phi, tau phi), and a new direction w of them
moves x by F_tau w. Rank goes to 2 n; ``known`` counts it, and ``rank``, which tells the driver who is still starting,
is half of it.

Use it through ``FLS(mu, differences=2)``, for parameters that move smoothly and for forecasts that follow a trend.
Source: Young, Recursive Estimation and Time-Series Analysis (2011), chapter 4 (the integrated random walk). Departure:
the diffuse start. Cost per sample: O((2 n)^2).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.drivers import TrackerSteps, diagonal
from driftfit.kernel import Array, State, kernel, shared
from driftfit.trackers.diffuse import SPANNED, TOLERANCE, outside, prediction, symmetric_product
from driftfit.trackers.each import told
from driftfit.trackers.resolution import resolve
from driftfit.trackers.rls import learn_scale, no_scale


def state(mu: Array, theta0: Array) -> Mapping[str, Any]:
    """Fields before the first sample."""
    n = len(theta0)
    two = np.zeros(2 * n)
    return {
        "theta": theta0, "slope": np.zeros(n), "P": np.zeros((2 * n, 2 * n)), "q": 1.0 / mu, "r": 1.0,
        "g": two, "each": np.ones(n), "begun": 0.0, **no_scale(),
        "V": np.zeros((2 * n, 2 * n)), "z": two, "w": two, "F": np.ones(2 * n), "known": 0, "rank": 0, "tau": 0.0,
    }  # fmt: skip


@kernel
def drift(s: State, l: int) -> None:
    """Level and slope, and the lower triangle of their covariance, between samples."""
    n = s.theta.shape[0]
    dt = s.dt[l] * s.begun[l]
    for i in range(n):
        s.theta[i, l] += dt * s.slope[i, l]
    for i in range(n):  # F P: row i of the levels takes dt times row n + i, from the lower triangle alone
        for j in range(i + 1):
            low, high = s.P[n + i, j, l], s.P[n + j, i, l]
            s.P[i, j, l] += dt * (low + high + dt * s.P[n + i, n + j, l])
    for i in range(n):
        for j in range(n):
            top, bottom = max(i, j), min(i, j)
            s.P[n + i, j, l] += dt * s.P[n + top, n + bottom, l]
    for i in range(n):
        q = s.q[i, l] * (s.each[i, l] * s.each[i, l]) * (dt * s.drift[l])
        s.P[i, i, l] += dt * dt * q
        s.P[n + i, i, l] += dt * q
        s.P[n + i, n + i, l] += q
    s.tau[l] += dt
    s.begun[l] = 1.0 if s.dt[l] > 0.0 else s.begun[l]


@kernel
def spread(s: State, l: int) -> float:
    """s.g = P h, h the regressor and zeros for the slopes, from the lower triangle of P; returns h' P h."""
    n = s.theta.shape[0]
    total: float = symmetric_product(s, l)
    for i in range(n):
        g = 0.0
        for j in range(n):
            g += s.P[n + i, j, l] * s.phi[j, l]
        s.g[n + i, l] = g
    return total


@kernel
def measurement(s: State, l: int) -> None:
    n = s.theta.shape[0]
    y_hat = prediction(s, l)
    v = spread(s, l) + s.r[l] * s.noise[l]
    e = s.y[l] - y_hat
    gain = s.ok[l] / v
    for i in range(n):
        s.theta[i, l] += gain * s.g[i, l] * e
        s.slope[i, l] += gain * s.g[n + i, l] * e
    for i in range(2 * n):
        k = gain * s.g[i, l]
        for j in range(i + 1):
            s.P[i, j, l] -= k * s.g[j, l]
    s.y_hat[l] = y_hat
    s.e[l] = e
    s.s[l] = v


@kernel
def correct(s: State, l: int) -> None:
    resolve(s, l)
    measurement(s, l)
    learn_scale(s, l)


@shared
def widen(
    theta: Array, slope: Array, P: Array, v: Array, w: Array, g: Array, tau: float, e: float, f: float,
    length: float, square: float,
) -> None:  # fmt: skip
    """Take in a new direction w of x at the first sample: k = F_tau w / (|z| |w|^2), v becomes the row of V."""
    n = theta.shape[0]
    for i in range(2 * n):
        v[i] = w[i] / np.sqrt(square)
        w[i] /= square * length
    for i in range(n):
        w[i] += tau * w[n + i]
    for i in range(n):
        theta[i] += w[i] * e
        slope[i] += w[n + i] * e
    for i in range(2 * n):
        for j in range(i + 1):
            P[i, j] += w[i] * w[j] * f - w[i] * g[j] - g[i] * w[j]


@kernel
def enter(s: State, l: int) -> None:
    """The correction while not all directions are known."""
    n, known, tau = s.theta.shape[0], s.known[l], s.tau[l]
    for i in range(n):
        s.z[i, l] = s.phi[i, l]
        s.z[n + i, l] = tau * s.phi[i, l]
    length, square = outside(s.z[:, l], s.V[:, :, l], known, s.w[:, l])
    if square <= TOLERANCE * TOLERANCE:
        measurement(s, l)
    else:
        y_hat = prediction(s, l)
        e = s.y[l] - y_hat
        f = spread(s, l) + s.r[l] * s.noise[l]
        if s.ok[l] > 0.0:
            widen(
                s.theta[:, l], s.slope[:, l], s.P[:, :, l], s.V[known, :, l], s.w[:, l], s.g[:, l], tau, e, f, length,
                square,
            )  # fmt: skip
            s.F[known, l] = length * length * square
            s.known[l] = known + 1
            s.rank[l] = (known + 1) // 2
        s.y_hat[l] = y_hat
        s.e[l] = e
        s.s[l] = np.inf


@shared
def spanned(P: Array, V: Array, known: int, tau: float, scale: float, var: Array) -> None:
    """var = diag P times the scale where the regressors determine the level now, else inf."""
    n = var.shape[0]
    size = np.sqrt(1.0 + tau * tau)
    for i in range(n):
        rest = 1.0
        for k in range(known):
            rest -= ((V[k, i] + tau * V[k, n + i]) / size) ** 2
        var[i] = P[i, i] * scale if rest < SPANNED else np.inf


@kernel
def begin(s: State, l: int) -> None:
    resolve(s, l)
    drift(s, l)
    enter(s, l)
    if s.s[l] < np.inf:
        learn_scale(s, l)
    spanned(s.P[:, :, l], s.V[:, :, l], s.known[l], s.tau[l], s.scale[l], s.var[:, l])


STEPS = TrackerSteps(drift, correct, diagonal, begin, told=told)
