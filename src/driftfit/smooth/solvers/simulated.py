"""Smoother of a recursion whose coefficients drift, linearised about a path: scores and bands without an inverse.

    x_t = x_{t-1} + eta_t                                          eta_tj ~ N(0, q_j drift_t)
    w_t = sum_i A_ti w_{t-i} + C_t' x_t + omega_t                  omega_t ~ N(omega0_t, q_w + lost_t)
    e_t = h_t w_t + H_t' x_t + v_t                                 v_t ~ N(0, r noise_t)

The state z = (w_t .. w_{t-na+1}, x_t) has a part without noise if q_w = 0, so its covariance P may be singular. The
backward recursion therefore carries the adjoint rho and its variance N (de Jong), with S, K of the filter:

    u = e / S - K' rho,   D = 1 / S + K' N K;      rho <- rho + H' u,   N <- (I - K H)' N (I - K H) + H' H / S
    z | all = z + P rho,  var = P - P N P;         before the time update: rho <- M' rho,  N <- M' N M

and the derivatives of the log-likelihood by q_j, q_w and r are half of sum(moved - expected): of rho_j^2 - N_jj before
the time update, rho_w^2 - N_ww after it, and u^2 - D, those of q and r times the factor of the sample.

Sources: de Jong (1988), Koopman and Shephard (1992). Cost: O(T N^2), with covariances O(T N^3); N^2 numbers a sample.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver

E, NOISE, DRIFT, LOST, OMEGA = range(5)
"""Columns of the signals; a noise of inf stands for a missing sample."""


class Problem(NamedTuple):
    """Signals (T, 5); ``of_w`` = (A, C) and ``of_e`` = (h, 0 .., H), (T, N); ``shift`` (T, n), by which the mean of x
    moves before each sample; ``mean`` and ``var`` (N,) of (w_-1 .., x_0)."""

    signals: Array
    of_w: Array
    of_e: Array
    shift: Array
    mean: Array
    var: Array


class Solution(NamedTuple):
    """Means ``z`` (T, N) and ``omega`` (T,) given all samples, ``begin`` (N,) those before the first one; ``moved`` and
    ``expected`` (2 + n,) by r, q_w and q; ``cov`` (T, n, n) of x, or none; log-likelihood."""

    z: Array
    omega: Array
    begin: Array
    moved: Array
    expected: Array
    cov: Array
    loglik: float


@Driver
def recursion(a: Array, drive: Array, w: Array) -> None:
    """w_t = sum_i a_ti w_{t-i} + drive_t, whose first na entries are before the record, in order of time."""
    T, na = a.shape
    for t in range(T):
        total = drive[t]
        for i in range(na):
            total += a[t, i] * w[t + na - 1 - i]
        w[t + na] = total


@Driver
def forwards(p: Problem, v: Array, P: Array, K: Array, z: Array, row: Array) -> float:
    """The filter: P (T, N, N) and z (T, N) before each sample, K (T, N + 2) with S and the innovation."""
    T, N = p.of_w.shape
    n = p.shift.shape[1]
    nw, total = N - n, 0.0
    at, now = np.zeros((N, N)), p.mean.copy()
    for i in range(N):
        at[i, i] = p.var[i]
    for t in range(T):
        for j in range(n):
            now[nw + j] += p.shift[t, j]
            at[nw + j, nw + j] += v[2 + j] * p.signals[t, DRIFT]
        own, mean = v[1] + p.signals[t, LOST], p.signals[t, OMEGA]
        for i in range(N):
            dot = 0.0
            for j in range(N):
                dot += at[i, j] * p.of_w[t, j]
            row[i] = dot
            own += dot * p.of_w[t, i]
            mean += now[i] * p.of_w[t, i]
        for i in range(nw - 1, 0, -1):
            now[i] = now[i - 1]
            for j in range(i, 0, -1):
                at[i, j] = at[j, i] = at[i - 1, j - 1]
            for j in range(nw, N):
                at[i, j] = at[j, i] = at[i - 1, j]
        for j in range(1, N):
            at[0, j] = at[j, 0] = row[j - 1] if j < nw else row[j]
        at[0, 0], now[0] = own, mean
        S, e = v[0] * p.signals[t, NOISE], p.signals[t, E]
        for i in range(N):
            z[t, i] = now[i]
            dot = 0.0
            for j in range(N):
                P[t, i, j] = at[i, j]
                dot += at[i, j] * p.of_e[t, j]
            row[i] = dot
            S += dot * p.of_e[t, i]
            e -= now[i] * p.of_e[t, i]
        used = p.signals[t, NOISE] < np.inf
        K[t, N], K[t, N + 1] = S, e if used else 0.0
        for i in range(N):
            K[t, i] = row[i] / S
        if used:
            total -= 0.5 * (np.log(2.0 * np.pi * S) + e * e / S)
            for i in range(N):
                now[i] += K[t, i] * e
                for j in range(N):
                    at[i, j] -= K[t, i] * row[j]
    return total


@Driver
def backwards(p: Problem, v: Array, P: Array, K: Array, found: Solution, NP: Array) -> None:
    """Fills ``found``, whose z are those of the filter before."""
    T, N = p.of_w.shape
    n = p.shift.shape[1]
    nw = N - n
    rho, R, old, NK = np.zeros(N), np.zeros((N, N)), np.zeros(N), np.zeros(N)
    for t in range(T - 1, -1, -1):
        if K[t, N] < np.inf:
            u, D = K[t, N + 1] / K[t, N], 1.0 / K[t, N]
            for i in range(N):
                u -= K[t, i] * rho[i]
                NK[i] = 0.0
                for j in range(N):
                    NK[i] += R[i, j] * K[t, j]
                D += K[t, i] * NK[i]
            for i in range(N):
                rho[i] += p.of_e[t, i] * u
                for j in range(N):
                    R[i, j] += p.of_e[t, i] * p.of_e[t, j] * D - p.of_e[t, i] * NK[j] - NK[i] * p.of_e[t, j]
            found.moved[0] += u * u * p.signals[t, NOISE]
            found.expected[0] += D * p.signals[t, NOISE]
        for i in range(N):
            for j in range(N):
                found.z[t, i] += P[t, i, j] * rho[j]
        for k in range(n if len(found.cov) else 0):
            for i in range(N):
                NP[i] = 0.0
                for j in range(N):
                    NP[i] += R[i, j] * P[t, j, nw + k]
            for m in range(n):
                found.cov[t, m, k] = P[t, nw + m, nw + k]
                for i in range(N):
                    found.cov[t, m, k] -= P[t, nw + m, i] * NP[i]
        found.omega[t] = p.signals[t, OMEGA] + (v[1] + p.signals[t, LOST]) * rho[0]
        found.moved[1] += rho[0] * rho[0]
        found.expected[1] += R[0, 0]
        for side in range(2):  # R M, then M' (R M), which is symmetric
            for i in range(N):
                for j in range(N):
                    old[j] = R[i, j] if side == 0 else R[j, i]
                for j in range(N):
                    up = (old[j + 1] if j + 1 < nw else 0.0) if j < nw else old[j]
                    if side == 0:
                        R[i, j] = old[0] * p.of_w[t, j] + up
                    else:
                        R[j, i] = old[0] * p.of_w[t, j] + up
        for j in range(N):
            old[j] = rho[j]
        for j in range(N):
            rho[j] = old[0] * p.of_w[t, j] + ((old[j + 1] if j + 1 < nw else 0.0) if j < nw else old[j])
        for j in range(n):
            found.moved[2 + j] += rho[nw + j] * rho[nw + j] * p.signals[t, DRIFT]
            found.expected[2 + j] += R[nw + j, nw + j] * p.signals[t, DRIFT]
    for i in range(N):
        found.begin[i] = p.mean[i] + p.var[i] * rho[i]


def solve(p: Problem, variances: Array, cov: bool = False) -> Solution:
    """Solve a problem with ``variances`` (2 + n,): r, q_w, q."""
    T, N = p.of_w.shape
    n = p.shift.shape[1]
    P, K, z = np.empty((T, N, N)), np.empty((T, N + 2)), np.empty((T, N))
    loglik = float(forwards(p, variances, P, K, z, np.empty(N)))
    sums, of_cov = np.zeros((2, 2 + n)), np.zeros((T if cov else 0, n, n))
    found = Solution(z, np.empty(T), np.empty(N), sums[0], sums[1], of_cov, loglik)
    backwards(p, variances, P, K, found, np.empty(N))
    return found
