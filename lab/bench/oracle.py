"""The oracle: the Kalman filter that knows the drift covariance and the noise variance of every sample.

    P <- P + diag(q_t);  s = phi' P phi + r_t;  K = P phi / s;  theta <- theta + K e;  P <- P - K (P phi)'

It knows jumps and outliers when they occur, but not the new value of theta. Where theta follows a rule instead of a
random walk (a ramp, a sinusoid) q_t is the square of its step, which is not all the information, and a tracker may win.
The lags of missing outputs are its own predictions, for at most ``na`` in a row, as in `ARX`. Start: P = 10^6 I at 0.

It is written as a plain loop independent of the library, so that it shares no fault with it.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array, Driver
from driftfit.models.arx import ARX
from lab.bench.records import Outcome, Record

DIFFUSE = 1e6


def oracle(record: Record) -> Outcome:
    """Run the oracle on a simulated record."""
    truth = record.truth
    assert truth is not None
    r = truth.noise**2 * np.where(truth.outlier, 100.0, 1.0)
    na = record.model.na if isinstance(record.model, ARX) else 0
    return known_walk(record.y, record.phi, na, np.broadcast_to(truth.q, record.phi.shape), r)


def known_walk(y: Array, phi: Array, na: int, q: Array, r: Array) -> Outcome:
    """The filter with q (T, n) and r (T,); the first ``na`` columns of phi are lags of y."""
    T, n = phi.shape
    out = Outcome(np.empty((T, n)), np.empty((T, n)), np.full(T, np.nan), np.full(T, np.nan))
    _loop(np.ascontiguousarray(y), np.ascontiguousarray(phi), na, np.column_stack([q, r]), *out)
    return out


@Driver
def _loop(
    y: Array, phi: Array, na: int, variances: Array, thetas: Array, stds: Array, predictions: Array,
    prediction_stds: Array,
) -> None:  # fmt: skip
    """``variances`` (T, n + 1) are q and r of every sample."""
    T, n = phi.shape
    theta, P, filled, missing = np.zeros(n), DIFFUSE * np.eye(n), np.full(T + na, np.nan), 0
    for t in range(len(y)):
        x = phi[t].copy()
        for i in range(na):
            x[i] = filled[t + na - 1 - i]
        for i in range(n):
            P[i, i] += variances[t, i]
        known, y_hat = np.isfinite(x).all(), np.nan
        if known:
            g = P @ x
            s, y_hat = x @ g + variances[t, n], x @ theta
            predictions[t], prediction_stds[t] = y_hat, np.sqrt(s)
            if np.isfinite(y[t]):
                theta += g * ((y[t] - y_hat) / s)
                P -= np.outer(g, g) / s
        missing = 0 if np.isfinite(y[t]) else missing + 1
        filled[t + na] = y[t] if missing == 0 else (y_hat if missing <= na else np.nan)
        thetas[t] = theta
        stds[t] = np.sqrt(np.diag(P))
