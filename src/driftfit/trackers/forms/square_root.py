"""The Kalman filter of a random walk on square roots of information: positive by construction.

    predict    theta <- theta + diag(d)^(1/2) G w sqrt(dt), G G' = q    spread
    forecast   y_hat = phi' theta,  e = y - y_hat,  h = |S^-T phi|^2,  s = h + r / w
    correct    (phi' theta = y) / sqrt(r / w)                      absorb;  theta = S^-1 d,  P = S^-1 S^-T

Use it through ``Kalman(form="sqrt")``. The diffuse start (`driftfit.trackers.forms.diffuse`) is in this form too. The
rotations are in `driftfit.trackers.forms.information`.

Source: Bierman (1977), chapter 6. Cost per sample: O(n^3).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array, State, kernel
from driftfit.trackers.forms.covariance import prediction, read_drift
from driftfit.trackers.forms.diffuse import (
    MACHINES,
    absorb_on_roots,
    drifted,
    forecast_on_roots,
    scale_drift,
    spanned_variance,
)
from driftfit.trackers.forms.information import absorb, invert, solve, spread, triangular_root


def state(theta0: Array, p0: Array | None) -> Mapping[str, Any]:
    """Further fields of the square-root form."""
    from scipy import linalg  # a fifth of a second to import

    n = len(theta0)
    S = np.zeros((n, n)) if p0 is None else linalg.solve_triangular(triangular_root(p0), np.eye(n))
    return {"S": S, "d": S @ theta0, "row": np.zeros(n), "x": np.zeros(n)}


@kernel
def grow(s: State, l: int) -> None:
    scale_drift(s, l)
    spread(s.S, s.d, s.H, np.sqrt(s.dt[l] * s.drift[l]), s.pivot, l)


@kernel
def rotate_in(s: State, l: int) -> None:
    """Absorb the sample, if there is one."""
    root = np.sqrt(s.ok[l] / (s.r[l] * s.noise[l]))
    for i in range(s.theta.shape[0]):
        s.row[i, l] = root * s.phi[i, l]
    absorb(s.S, s.d, s.row, root * s.y[l], l)


@kernel
def read_out(s: State, l: int) -> None:
    """theta, which only a sample moves, and the lower triangle of P."""
    n = s.theta.shape[0]
    solve(s.S, s.d, s.row, l)
    for i in range(n):
        s.theta[i, l] = s.row[i, l] if s.ok[l] > 0.0 else s.theta[i, l]
    invert(s.S, s.R, l)
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += s.R[i, k, l] * s.R[j, k, l]
            s.P[i, j, l] = total


@kernel
def forecast(s: State, l: int) -> None:
    """y_hat, e and h = |S^-T phi|^2."""
    y_hat, total = prediction(s, l), 0.0
    for i in range(s.theta.shape[0]):
        t = s.phi[i, l]
        for j in range(i):
            t -= s.S[j, i, l] * s.x[j, l]
        s.x[i, l] = t / s.S[i, i, l]
        total += s.x[i, l] * s.x[i, l]
    s.y_hat[l], s.e[l], s.h[l] = y_hat, s.y[l] - y_hat, total


@kernel
def correct(s: State, l: int) -> None:
    rotate_in(s, l)
    read_out(s, l)


@kernel
def drift_before_span(s: State, l: int) -> None:
    drifted(s, s.dt[l] * s.drift[l], l)


@kernel
def correct_before_span(s: State, l: int) -> None:
    absorb_on_roots(s, l)
    s.root[l] = 1 if s.rank[l] < s.theta.shape[0] else 0


STEPS = TrackerSteps(
    grow, forecast, correct, read_extra=read_drift, machines=MACHINES,
    start=TrackerSteps(drift_before_span, forecast_on_roots, correct_before_span, spanned_variance),
)  # fmt: skip
