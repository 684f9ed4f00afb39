"""The Kalman filter of parameters that are sums of components, each with its law (`driftfit.trackers.laws.law`).

    theta_t = H x_t,    x_t = F(dt) x_(t-1) + w_t,  w_t ~ N(0, Q(dt) d);    y_t = phi_t' H x_t + v_t

    predict    x <- F x;  C <- F C F' + Q
    forecast   h = H' phi;  e = y - h' x;  s = h' C h + r / w
    correct    x <- x + C h e / s;  C <- C - C h h' C / s

F has a block for each component: exp(-dt damping), a shear, or a rotation that may shrink. theta and P = H C H' are
what the result shows.

The start is diffuse in the components whose variance is not known, x_0 = c + delta: x and C are those for delta = 0,
and A = dx / d delta and the information about delta are computed beside them (de Jong 1991), as least squares in a
triangle R that rotations keep, so that k samples determine at most k directions, whatever is rounded:

    A <- F A;   a = A' h;   R' R <- R' R + a a' / s;   R' z <- R' z + a e / s;   A <- A - C h a' / s

until R, in the units of its own columns, can be inverted: then x <- x + A R^-1 z and C <- C + A R^-1 (A R^-1)'. What
no regressor has reached stays free, and holds up nothing else. Until then std is inf for the parameters that depend
on it.

Source: Harvey (1989), section 3.2; de Jong, The diffuse Kalman filter, Annals of Statistics 19 (1991). Departure:
delta is taken in as soon as it is determined. Cost per sample: O(N^2) for N components, O(N^3) at the start.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array, State, exp, kernel, log, nothing, shared
from driftfit.trackers.forms.covariance import LEFT, read_drift
from driftfit.trackers.laws.law import (
    COSINE,
    DAMPING,
    KIND,
    LEVEL,
    NOISE,
    OWNER,
    PLAIN,
    RATE,
    SINE,
    SLOPE,
    VISIBLE,
)

DETERMINED = 1e-9
"""Smallest square on the diagonal of R, in that of its column, with which delta is taken in."""

LOG_2_PI = 1.8378770664093453

H, G, B, W, WORK = range(5)
"""Rows of ``work``: h, C h, a, and a row that is turned into R."""


def state(table: Array, theta0: Array, p0: Array | None, means: Mapping[int, float]) -> Mapping[str, Any]:
    """Fields before the first sample; ``means`` are known means, by the place of their parameter.

    Of every sample ``known`` is h as if delta were known, and ``reached`` whether y depends on delta; ``total`` is -2
    times the logarithm of the likelihood of what delta took.
    """
    n, N = len(theta0), table.shape[1]
    x, C, free = np.zeros(N), np.zeros((N, N)), np.ones(N)
    first = [int(np.argmax(table[OWNER] == i)) for i in range(n)]
    x[first] = theta0
    if p0 is not None:
        C[np.ix_(first, first)] = p0
        free[first] = 0.0
    free[(table[KIND] == SINE) & (table[RATE] == np.pi)] = 0.0  # 0 at every sample
    for k in np.flatnonzero(table[DAMPING]):
        C[k, k], free[k] = table[NOISE, k], 0.0
    for i, mean in means.items():
        level = first[i]
        x[level], C[level], C[:, level], free[level] = mean, 0.0, 0.0, 0.0
    shown = (table[OWNER] == np.arange(n)[:, None]) * table[VISIBLE]
    return {
        "theta": shown @ x, "P": shown @ C @ shown.T, "law": table, "x": x, "C": C, "A": np.diag(free),
        "triangle": np.zeros((N, N)), "z": np.zeros(N), "free": free,
        "work": np.zeros((WORK, N)), "known": 0.0, "reached": 0.0, "total": 0.0, "drift_root": np.ones(n),
        "F": np.ones(N),
    }  # fmt: skip


@shared
def forward(law: Array, X: Array, dt: float) -> None:
    """X <- F X."""
    for k in range(len(X)):
        kind, keep = law[KIND, k], exp(-dt * law[DAMPING, k]) if law[DAMPING, k] > 0.0 else 1.0
        if kind == LEVEL:
            for c in range(X.shape[1]):
                X[k, c] += dt * X[k + 1, c]
        elif kind == COSINE:
            ahead, aside = keep * np.cos(dt * law[RATE, k]), keep * np.sin(dt * law[RATE, k])
            for c in range(X.shape[1]):
                one, other = X[k, c], X[k + 1, c]
                X[k, c], X[k + 1, c] = ahead * one + aside * other, ahead * other - aside * one
        elif kind == PLAIN:
            for c in range(X.shape[1]):
                X[k, c] *= keep


@shared
def turn_over(X: Array) -> None:
    """X <- X'."""
    for i in range(len(X)):
        for j in range(i):
            X[i, j], X[j, i] = X[j, i], X[i, j]


@shared
def spread(law: Array, root: Array, C: Array, dt: float, drift: float) -> None:
    """C <- C + Q(dt)."""
    for k in range(len(C)):
        i, damping = int(law[OWNER, k]), law[DAMPING, k]
        own = law[NOISE, k] * root[i] * root[i] * drift
        if damping > 0.0:
            C[k, k] += own * (1.0 - exp(-2.0 * dt * damping))
        elif law[KIND, k] == SLOPE:
            C[k, k] += own * dt
            C[k - 1, k] += own * dt * dt
            C[k, k - 1] += own * dt * dt
            C[k - 1, k - 1] += own * dt * dt * dt
        else:
            C[k, k] += own * dt


@shared
def measure(law: Array, x: Array, C: Array, phi: Array, work: Array) -> tuple[float, float]:
    """h, C h; returns y_hat, and the variance of the prediction as if delta were known."""
    N = len(C)
    y_hat, variance = 0.0, 0.0
    for k in range(N):
        work[H, k] = phi[int(law[OWNER, k])] * law[VISIBLE, k]
        y_hat += work[H, k] * x[k]
    for k in range(N):
        g = 0.0
        for j in range(N):
            g += C[k, j] * work[H, j]
        work[G, k] = g
        variance += work[H, k] * g
    return y_hat, variance


@shared
def reach(A: Array, free: Array, work: Array) -> bool:
    """a = A' h, and whether y depends on delta."""
    N, reached = len(A), False
    for d in range(N):
        a = 0.0
        if free[d] > 0.0:
            for k in range(N):
                a += A[k, d] * work[H, k]
        work[B, d] = a
        reached = reached or a != 0.0
    return reached


@shared
def correct_state(x: Array, C: Array, work: Array, gain: float, e: float) -> None:
    for i in range(len(C)):
        k = gain * work[G, i]
        x[i] += k * e
        for j in range(i):
            C[i, j] -= k * work[G, j]
            C[j, i] = C[i, j]
        C[i, i] = max(C[i, i] - k * work[G, i], LEFT * C[i, i])


@shared
def inform(A: Array, R: Array, z: Array, work: Array, e: float, v: float) -> float:
    """Take the sample, of variance v, as information about delta: turn a / sqrt(v), e / sqrt(v) into R, z; returns -2
    times the logarithm of its likelihood."""
    N, root, row = len(A), 1.0 / np.sqrt(v), work[W]
    for d in range(N):
        row[d] = work[B, d] * root
        for c in range(N):
            A[d, c] -= work[G, d] * work[B, c] / v
    left = e * root
    for d in range(N):
        if row[d] != 0.0:
            length = np.sqrt(R[d, d] * R[d, d] + row[d] * row[d])
            ahead, aside = R[d, d] / length, row[d] / length
            for c in range(d, N):
                one, other = R[d, c], row[c]
                R[d, c], row[c] = ahead * one + aside * other, ahead * other - aside * one
            one = z[d]
            z[d], left = ahead * one + aside * left, ahead * left - aside * one
    found: float = LOG_2_PI + log(v) + e * e / v
    return found


@shared
def settle(x: Array, C: Array, A: Array, R: Array, z: Array, free: Array) -> float:
    """Take in delta, as far as regressors have reached it; returns -2 log likelihood of it, and 0 if it has to wait."""
    N, total = len(R), 0.0
    for d in range(N):
        square = 0.0
        for c in range(d + 1):
            square += R[c, d] * R[c, d]
        if R[d, d] * R[d, d] < DETERMINED * square:
            return 0.0
        total += (2.0 * log(R[d, d]) - LOG_2_PI if R[d, d] > 0.0 else 0.0) - z[d] * z[d]
    for i in range(N):  # row i of A R^-1, in the place of the columns of A that are taken in
        for d in range(N):
            if R[d, d] > 0.0:
                for c in range(d):
                    A[i, d] -= R[c, d] * A[i, c] if R[c, c] > 0.0 else 0.0
                A[i, d] /= R[d, d]
                x[i] += A[i, d] * z[d]
                for j in range(i + 1):
                    C[i, j] += A[i, d] * A[j, d]
                    C[j, i] = C[i, j]
    for d in range(N):
        if R[d, d] > 0.0:
            free[d], z[d] = 0.0, 0.0
            for i in range(N):
                A[i, d], R[d, i] = 0.0, 0.0
    return total


@shared
def show(law: Array, x: Array, C: Array, A: Array, theta: Array, P: Array, var: Array) -> None:
    """theta = H x, P = H C H', and inf where theta depends on delta."""
    n, N = len(theta), len(C)
    for i in range(n):
        theta[i] = 0.0
        for j in range(n):
            P[i, j] = 0.0
    for k in range(N):
        i = int(law[OWNER, k])
        theta[i] += law[VISIBLE, k] * x[k]
        for j in range(N):
            P[i, int(law[OWNER, j])] += law[VISIBLE, k] * law[VISIBLE, j] * C[k, j]
    for i in range(n):
        var[i] = P[i, i]
    for k in range(N):
        for d in range(N):
            if law[VISIBLE, k] * A[k, d] != 0.0:
                var[int(law[OWNER, k])] = np.inf


@kernel
def predict(s: State, l: int) -> None:
    """The time update."""
    law, C, dt = s.law[:, :, l], s.C[:, :, l], s.dt[l]
    if dt > 0.0:
        forward(law, s.x[:, l : l + 1], dt)
        forward(law, s.A[:, :, l], dt)
        forward(law, C, dt)
        turn_over(C)
        forward(law, C, dt)
        spread(law, s.drift_root[:, l], C, dt, s.drift[l])


@kernel
def forecast(s: State, l: int) -> None:
    """y_hat, e, and h."""
    work = s.work[:, :, l]
    y_hat, s.known[l] = measure(s.law[:, :, l], s.x[:, l], s.C[:, :, l], s.phi[:, l], work)
    reached = reach(s.A[:, :, l], s.free[:, l], work)
    s.reached[l] = 1.0 if reached else 0.0
    s.y_hat[l], s.e[l], s.h[l] = y_hat, s.y[l] - y_hat, np.inf if reached else s.known[l]


@kernel
def correct(s: State, l: int) -> None:
    """The correction, and what is shown of it."""
    x, C, A, R, z, work = s.x[:, l], s.C[:, :, l], s.A[:, :, l], s.triangle[:, :, l], s.z[:, l], s.work[:, :, l]
    v, N = s.known[l] + s.r[l] * s.noise[l], s.x.shape[0]
    informs = (s.reached[l] > 0.0) & (s.ok[l] > 0.0)
    if informs:
        s.total[l] += inform(A, R, z, work, s.e[l], v)
    correct_state(x, C, work, s.ok[l] / v, s.e[l])
    if informs:
        taken = settle(x, C, A, R, z, s.free[:, l])
        if taken != 0.0:
            s.total[l] += taken
            for k in range(N):  # the factors of the diffuse likelihood, whose logarithms add up to the total
                s.F[k, l] = exp(s.total[l] / N)
    show(s.law[:, :, l], x, C, A, s.theta[:, l], s.P[:, :, l], s.var[:, l])


STEPS = TrackerSteps(predict, forecast, correct, nothing, read_extra=read_drift, outlined=True)
"""The correction reports."""
