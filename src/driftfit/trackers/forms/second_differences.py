"""Second differences, on line: parameters that move along a slope which is a random walk.

At every t it computes the last point of the path that minimises

    J = sum_k w_k (y_k - phi_k' theta_k)^2 + sum_k (slope_{k+1} - slope_k)' D_k (slope_{k+1} - slope_k)
    slope_{k+1} = (theta_{k+1} - theta_k) / dt_{k+1},   D_k = diag(mu / d_{k+1}) / dt_{k+1}

which for even steps penalises theta_{k+1} - 2 theta_k + theta_{k-1}. With x = (theta, slope):

    predict             x <- F x,  F = [[1, dt], [0, 1]];   P <- F P F' + D^-1 (dt, 1)(dt, 1)'
                                                                                  (not before the first sample)
    forecast, correct   as in `driftfit.trackers.fls`, with the regressor h = (phi, 0)

The start is diffuse in x at the first sample (`driftfit.trackers.forms.diffuse`), and the rank goes up to 2 n. The
information moves with x, S <- S F^-1, which is a shear of the triangle: after a gap, a level that was determined is not
determined any more until there is a slope.

Use it through ``FLS(mu, differences=2)``, for parameters that move smoothly and for forecasts that follow a trend.
Source: Young, Recursive Estimation and Time-Series Analysis (2011), chapter 4 (the integrated random walk). Departure:
the diffuse start. Cost per sample: O((2 n)^2).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array, State, kernel
from driftfit.trackers.forms.covariance import prediction, read_drift, reduce_covariance, symmetric_product
from driftfit.trackers.forms.diffuse import (
    BEFORE,
    MACHINES,
    absorb_row,
    foresee_row,
    hand_over,
    knowing_nothing,
    spanned_variance,
    wander,
)
from driftfit.trackers.forms.information import shear
from driftfit.trackers.rls import learn_scale, no_scale


def state(mu: Array, theta0: Array) -> Mapping[str, Any]:
    """Fields before the first sample."""
    n = len(theta0)
    return {
        "theta": theta0, "slope": np.zeros(n), "P": np.zeros((2 * n, 2 * n)), "q": 1.0 / mu, "r": 1.0,
        "g": np.zeros(2 * n), "drift_root": np.ones(n), "begun": 0.0, **no_scale(),
        "tau": 0.0, "x": np.zeros(2 * n), "z": np.zeros(2 * n), **knowing_nothing(2 * n),
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
        q = s.q[i, l] * (s.drift_root[i, l] * s.drift_root[i, l]) * (dt * s.drift[l])
        s.P[i, i, l] += dt * dt * q
        s.P[n + i, i, l] += dt * q
        s.P[n + i, n + i, l] += q
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
def forecast(s: State, l: int) -> None:
    y_hat = prediction(s, l)
    s.y_hat[l], s.e[l], s.h[l] = y_hat, s.y[l] - y_hat, max(spread(s, l), 0.0)


@kernel
def correct(s: State, l: int) -> None:
    n = s.theta.shape[0]
    gain = s.ok[l] / (s.h[l] + s.r[l] * s.noise[l])
    for i in range(n):
        s.theta[i, l] += gain * s.g[i, l] * s.e[l]
        s.slope[i, l] += gain * s.g[n + i, l] * s.e[l]
    reduce_covariance(s, gain, l)
    learn_scale(s, l)


@kernel
def drifted(s: State, l: int) -> None:
    """The same in square-root form."""
    n = s.theta.shape[0]
    dt = s.dt[l] * s.begun[l]
    s.tau[l] += dt
    shear(s.S, -dt, l)
    for i in range(n):
        root = s.drift_root[i, l] * np.sqrt(s.q[i, l])
        s.H[i, n + i, l], s.H[n + i, n + i, l] = dt * root, root
        s.theta[i, l] += dt * s.slope[i, l]
    wander(s, np.sqrt(dt * s.drift[l]), l)
    s.begun[l] = 1.0 if s.dt[l] > 0.0 else s.begun[l]


@kernel
def forecast_root_form(s: State, l: int) -> None:
    n = s.theta.shape[0]
    for i in range(n):
        s.x[i, l], s.x[n + i, l] = s.theta[i, l], s.slope[i, l]
        s.z[i, l], s.z[n + i, l] = s.phi[i, l], 0.0
    foresee_row(s, s.x.ctypes.data, s.z.ctypes.data, l)
    y_hat = prediction(s, l)
    s.y_hat[l], s.e[l], s.h[l] = y_hat, s.y[l] - y_hat, s.at_start[BEFORE, l]


@kernel
def correct_root_form(s: State, l: int) -> None:
    n = s.theta.shape[0]
    absorb_row(s, s.x.ctypes.data, s.z.ctypes.data, s.tau[l], l)
    for i in range(n):
        s.theta[i, l], s.slope[i, l] = s.x[i, l], s.x[n + i, l]
    hand_over(s, l)
    learn_scale(s, l)


STEPS = TrackerSteps(
    drift, forecast, correct, read_extra=read_drift, machines=MACHINES, learns_scale=True,
    start=TrackerSteps(drifted, forecast_root_form, correct_root_form, spanned_variance),
)  # fmt: skip
