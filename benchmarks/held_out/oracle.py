"""The filter that a scenario is judged by: it is given the kind of drift, and learns its size in hindsight.

Where theta is constant, it is least squares. Where theta or its slope walks, it is the Kalman filter whose drift
variances, one for each direction in which theta can move, and noise variance have the largest likelihood of the whole
record. Where theta jumps, it knows the noise, how often and how far theta jumps, and not when: it keeps the `HISTORIES`
most probable histories. It works in coordinates in which the regressors of the record are white, so that offsets of
inputs cost no digits.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from benchmarks.held_out.case import Case
from driftfit.engine.kernel import Array, Driver

HISTORIES, NEGLIGIBLE = 60, 12.0
"""Histories that are kept, and the distance in log probability from the best at which one is dropped."""
STARTS = (-7.0, -5.0, -4.0, -3.0, -2.0, -1.0, 0.0)
"""Decimal logarithms of drift over noise from which the search begins."""


@Driver
def walking(z: Array, y: Array, r: Array, Q: Array, P0: Array, theta: Array, e: Array) -> float:
    """theta (T, m) and errors e (T,) of a random walk with drift Q (d, d) r[1] in noise of variance r[0]; d = 2 m: of
    slopes that walk. Returns the log-likelihood with the scale of noise and drift concentrated out. NaN is skipped."""
    T, m = z.shape
    d = len(Q)
    P, x, g = P0.copy(), np.zeros(d), np.zeros(d)
    squares, logs, count = 0.0, 0.0, 0
    for t in range(T):
        if d > m:
            for i in range(m):
                x[i] += x[m + i]
            for i in range(m):
                for j in range(d):
                    P[i, j] += P[m + i, j]
            for j in range(m):
                for i in range(d):
                    P[i, j] += P[i, m + j]
        for i in range(d):
            for j in range(d):
                P[i, j] += Q[i, j] * r[1, t]
        e[t] = y[t]
        for k in range(m):
            e[t] -= z[t, k] * x[k]
        if np.isfinite(e[t]):
            s = r[0, t]
            for i in range(d):
                g[i] = 0.0
                for k in range(m):
                    g[i] += P[i, k] * z[t, k]
            for k in range(m):
                s += z[t, k] * g[k]
            for i in range(d):
                x[i] += g[i] * e[t] / s
                for j in range(d):
                    P[i, j] -= g[i] * g[j] / s
            if count >= 2 * d:
                squares += e[t] * e[t] / s
                logs += np.log(s)
            count += 1
        for i in range(m):
            theta[t, i] = x[i]
    used = count - 2 * d
    return -0.5 * (used * np.log(squares / used + 1e-300) + logs)  # type: ignore[no-any-return]


@Driver
def jumping(z: Array, y: Array, r: Array, J: Array, logs: Array, P0: Array, theta: Array, e: Array) -> float:
    """theta (T, n) and errors e (T,) from histories of jumps with variances J (K, n, n), the first of which is no jump,
    and log probabilities ``logs`` (K,). Returns the number of histories that are left."""
    T, n = z.shape
    K, most = len(J), HISTORIES
    m, P, w = np.zeros((most, n)), np.zeros((most, n, n)), np.zeros(most)
    m2, P2, w2 = np.zeros((most, n)), np.zeros((most, n, n)), np.zeros(most)
    error, g, score = np.zeros(most), np.zeros(n), np.zeros(most * K)
    P[0] = P0
    alive = 1
    for t in range(T):
        e[t] = y[t]
        for b in range(alive):
            error[b] = y[t]
            for i in range(n):
                error[b] -= z[t, i] * m[b, i]
                e[t] -= np.exp(w[b]) * z[t, i] * m[b, i]
        if np.isfinite(e[t]):
            for b in range(alive):
                for k in range(K):
                    s = r[0, t]
                    for i in range(n):
                        for j in range(n):
                            s += z[t, i] * (P[b, i, j] + J[k, i, j]) * z[t, j]
                    score[b * K + k] = w[b] + logs[k] - 0.5 * (np.log(s) + error[b] ** 2 / s)
            order, kept, total = np.argsort(-score[: alive * K]), 0, 0.0
            for at in order[:most]:
                lost = score[order[0]] - score[at]
                if lost > NEGLIGIBLE:
                    break
                b, k = at // K, at % K
                s = r[0, t]
                for i in range(n):
                    g[i] = 0.0
                    for j in range(n):
                        g[i] += (P[b, i, j] + J[k, i, j]) * z[t, j]
                    s += g[i] * z[t, i]
                for i in range(n):
                    m2[kept, i] = m[b, i] + g[i] * error[b] / s
                    for j in range(n):
                        P2[kept, i, j] = P[b, i, j] + J[k, i, j] - g[i] * g[j] / s
                w2[kept] = -lost
                total += np.exp(-lost)
                kept += 1
            alive = kept
            for b in range(alive):
                m[b], P[b], w[b] = m2[b], P2[b], w2[b] - np.log(total)
        for i in range(n):
            theta[t, i] = 0.0
            for b in range(alive):
                theta[t, i] += np.exp(w[b]) * m[b, i]
    return float(alive)


def oracle(case: Case) -> tuple[Array, Array]:
    """theta (T, n), and the prediction (T,) of y before each sample."""
    phi, y = case.regressors, case.readings - case.known
    usable: Array = np.asarray(np.isfinite(phi).all(axis=1))
    scale = np.sqrt(np.mean(phi[usable] ** 2, axis=0))
    R = np.linalg.qr(phi[usable] / scale)[1] * scale / np.sqrt(usable.sum())
    back = np.linalg.inv(R)
    z = np.ascontiguousarray(np.where(usable[:, None], phi @ back, np.nan))
    theta, e = np.empty(z.shape), np.empty(len(z))
    noise = float(np.mean(case.r)) or 1e-12
    n, wide = len(R), 1e4 * (float(np.nanvar(y)) + float(np.nanmean(y)) ** 2) / noise
    if case.kind == "jumps":
        J = np.array([np.zeros((n, n)), *(R @ one @ R.T for one in case.jumps)])
        logs = np.log(np.array([1.0 - case.rate * (len(J) - 1), *[case.rate] * (len(J) - 1)]))
        r = np.array([np.maximum(case.r, 1e-12), case.interval])
        jumping(z, y, r, J, logs, wide * noise * np.eye(n), theta, e)
    else:
        likeliest(case, z, y, R, noise, wide, theta, e)
    return theta @ back.T, case.y - e


def likeliest(case: Case, z: Array, y: Array, R: Array, noise: float, wide: float, theta: Array, e: Array) -> None:
    """Fill theta and e by the drift of largest likelihood."""
    moves = case.moves[:, : 0 if case.kind == "constant" else None]
    n, M = len(R), R @ moves
    r = np.array([np.maximum(case.r / noise, 1e-9), case.interval])
    slopes = case.kind == "slopes"
    d, first = (2 * n, n) if slopes else (n, 0)
    centred = np.sqrt(np.diag(moves.T @ case.weight() @ moves))
    Q, P0 = np.zeros((d, d)), wide * np.diag(np.where(np.arange(d) < n, 1.0, 1e-2))

    def loss(logs: Array) -> float:
        q = 10.0 ** (logs - (3.0 if slopes else 0.0)) / centred**2
        Q[first:, first:] = (M * q) @ M.T
        return -float(walking(z, y, r, Q, P0, theta, e))

    if M.shape[1] == 0:
        loss(np.zeros(0))
        return
    start = min((np.full(M.shape[1], level) for level in STARTS), key=loss)
    found = minimize(loss, start, method="L-BFGS-B", bounds=[(-9.0, 5.0)] * M.shape[1], options={"maxiter": 40})
    loss(found.x)
