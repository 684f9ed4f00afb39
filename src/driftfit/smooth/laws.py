"""The exact smoother of parameters with laws: fixed-interval smoothing of a linear state with a diffuse start.

    x_t = F x_(t-1) + w_t,  w_t ~ N(0, Q);    y_t = h_t' x_t + v_t,  h_t = H' phi_t;    x_0 = c + A delta

With e, S, g = C h and a = A' h of the filter for delta = 0, and J = I - h g' / S, from the last sample to the first

    [r | R] <- h [e | -a'] / S + J F' [r | R];    N <- h h' / S + J F' N F J'
    delta = M^-1 m,   M = sum a a' / S,   m = sum a e / S
    D = A + C R;   x_t | y = x + C r + D delta;   Cov = C - C N C + D M^-1 D'

Source: de Jong, Smoothing and interpolation with the state-space model, Journal of the American Statistical Association
84 (1989); The diffuse Kalman filter, Annals of Statistics 19 (1991). Cost: O(N^3) a sample for N components, in NumPy.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.run.result import Track
from driftfit.smooth.problem import replay
from driftfit.smooth.solvers.walk import Path
from driftfit.trackers.forms.volatility import smoothed_noise
from driftfit.trackers.laws.law import OWNER, VISIBLE, transition

SPANNED = 1e-10
"""Share of the largest eigenvalue of M, in the units of its diagonal, below which a direction of delta is free."""


def smooth(run: Track) -> tuple[Path, Array]:
    """(the smoothed path with covariances, relative to r, weights (T,)) of a run of a Kalman filter with laws."""
    lane, r = run.fresh(), run.tracker.r  # type: ignore[attr-defined]
    rows = {name: values[..., 0] for name, values in replay(run).items()}
    law, n, T = lane["law"][0, ..., 0], run.model.n, len(run)
    H = (law[OWNER] == np.arange(n)[:, None]) * law[VISIBLE]
    h, owner = rows["phi"] @ H, law[OWNER].astype(int)
    w = np.where(rows["ok"] > 0.0, 1.0 / rows["used_noise"], 0.0)
    if "spread" in rows:
        w *= r / smoothed_noise(rows)
    drift = np.broadcast_to(run.known.drift, T)
    roots = run.known.extra[:, owner] if run.known.extra.size else np.ones((T, len(owner)))
    moves = {dt: transition(law, dt) for dt in np.unique(rows["dt"])}

    x, C, A = lane["x"][0, ..., 0].copy(), lane["C"][0, ..., 0].copy(), lane["A"][0, ..., 0].copy()
    N = len(x)
    means, covs, free, now = np.empty((T, N)), np.empty((T, N, N)), np.empty((T, N, N)), np.zeros((T, 2))
    M, m, cost = np.zeros((N, N)), np.zeros(N), 0.0
    for t in range(T):
        F, Q = moves[rows["dt"][t]]
        x, A, C = F @ x, F @ A, F @ C @ F.T + drift[t] * np.outer(roots[t], roots[t]) * Q
        means[t], free[t], covs[t] = x, A, C
        if w[t] > 0.0:
            g, a, e = C @ h[t], h[t] @ A, rows["y"][t] - h[t] @ x
            S = h[t] @ g + r / w[t]
            now[t] = e, S
            M, m, cost = M + np.outer(a, a) / S, m + a * e / S, cost + e * e / S
            x, A, C = x + g * (e / S), A - np.outer(g, a) / S, C - np.outer(g, g) / S

    inverse, unseen = _inverse(M)
    delta = inverse @ m
    R, information, later = np.zeros((N, 1 + N)), np.zeros((N, N)), np.zeros((N, N))
    after = np.zeros((N, N))
    theta, var, rho, c = np.empty((T, n)), np.empty((T, n)), np.full(T, np.nan), np.full(T, np.nan)
    cov, lag_cov = np.empty((T, n, n)), np.empty((max(T - 1, 0), n, n))
    for t in range(T - 1, -1, -1):
        C, A, J = covs[t], free[t], np.eye(N)
        F = moves[rows["dt"][min(t + 1, T - 1)]][0]
        R, information = F.T @ R, F.T @ information @ F
        if w[t] > 0.0:
            e, S = now[t]
            g, a = C @ h[t], h[t] @ A
            row = np.append(e, -a) / S - g @ R / S
            error, of_delta = row[0] + row[1:] @ delta, row[1:]
            spread = 1.0 / S + g @ information @ g / S**2 - of_delta @ inverse @ of_delta
            c[t] = np.sqrt(max(spread * r / w[t], 0.0))
            rho[t] = r * error / np.sqrt(w[t]) / c[t] if c[t] > 0.0 else 0.0
            J -= np.outer(h[t], g) / S
            R = np.outer(h[t], np.append(e, -a)) / S + J @ R
            information = np.outer(h[t], h[t]) / S + J @ information @ J.T
        D = A + C @ R[:, 1:]
        theta[t] = H @ (means[t] + C @ R[:, 0] + D @ delta)
        cov[t] = H @ (C - C @ information @ C + D @ inverse @ D.T) @ H.T
        if t < T - 1:
            lag_cov[t] = H @ (C @ J @ F.T @ later + D @ inverse @ after.T) @ H.T
        later, after = np.eye(N) - information @ C, D
        var[t] = np.where(np.any(np.abs(H @ D @ unseen) > SPANNED, axis=1), np.inf, np.diagonal(cov[t]))
    residual = rows["y"] - np.einsum("ti,ti->t", rows["phi"], theta)
    costs, rank = (r * (cost - float(m @ delta)), float(w @ residual**2)), np.full(T, N - unseen.shape[1], np.int16)
    return Path(theta, var / r, rho, c, *costs, 0.0, cov / r, lag_cov / r, "safe", rank), w


def _inverse(M: Array) -> tuple[Array, Array]:
    """(the inverse of M where samples determine delta, the directions (N, k) that depend on delta and are free)."""
    there = np.diag(M) > 0.0
    scale = np.where(there, 1.0 / np.sqrt(np.where(there, np.diag(M), 1.0)), 0.0)
    values, vectors = np.linalg.eigh(M * np.outer(scale, scale))
    seen = values > SPANNED * max(values.max(initial=0.0), SPANNED)
    root = scale[:, None] * vectors[:, seen] / np.sqrt(values[seen])
    return root @ root.T, np.where(there, scale, 1.0)[:, None] * vectors[:, ~seen]
