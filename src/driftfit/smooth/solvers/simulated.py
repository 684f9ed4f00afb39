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

Sources: de Jong (1988), Koopman and Shephard (1992). Cost: O(T N^3); N^2 numbers a sample.
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
    ``expected`` (2 + n,) by r, q_w and q; ``cov`` (T, n, n) of x; log-likelihood."""

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
def forwards(p: Problem, v: Array, M: Array, P: Array, K: Array, z: Array) -> float:
    """The filter: P (T, N, N) and z (T, N) before each sample, K (T, N + 2) with S and the innovation.

    ``M`` (N, N) is the transition, whose first row is that of the sample.
    """
    T, N = z.shape
    nw, total, now, C = N - p.shift.shape[1], 0.0, p.mean.copy(), np.diag(p.var)
    for t in range(T):
        now[nw:] += p.shift[t]
        for j in range(nw, N):
            C[j, j] += v[2 + j - nw] * p.signals[t, DRIFT]
        M[0] = p.of_w[t]
        now, C = M @ now, M @ C @ M.T
        now[0] += p.signals[t, OMEGA]
        C[0, 0] += v[1] + p.signals[t, LOST]
        z[t], P[t] = now, C
        h, known = p.of_e[t], p.signals[t, NOISE] < np.inf
        g = C @ h
        S, e = h @ g + v[0] * p.signals[t, NOISE], p.signals[t, E] - h @ now if known else 0.0
        K[t, :N], K[t, N], K[t, N + 1] = g / S, S, e
        if known:
            total -= 0.5 * (np.log(2.0 * np.pi * S) + e * e / S)
            now, C = now + g * (e / S), C - np.outer(g, g / S)
    return total


@Driver
def backwards(p: Problem, v: Array, M: Array, P: Array, K: Array, found: Solution) -> None:
    """Fills ``found``, whose z are those of the filter before."""
    T, N = found.z.shape
    n = p.shift.shape[1]
    rho, R = np.zeros(N), np.zeros((N, N))
    for t in range(T - 1, -1, -1):
        signals, h, k, S = p.signals[t], p.of_e[t], K[t, :N], K[t, N]
        if signals[NOISE] < np.inf:
            Rk, u = R @ k, K[t, N + 1] / S - k @ rho
            D = 1.0 / S + k @ Rk
            rho = rho + h * u
            R = R + np.outer(h, D * h - Rk) - np.outer(Rk, h)
            found.moved[0] += u * u * signals[NOISE]
            found.expected[0] += D * signals[NOISE]
        found.z[t] += P[t] @ rho
        found.cov[t] = (P[t] - P[t] @ R @ P[t])[N - n :, N - n :]
        found.omega[t] = signals[OMEGA] + (v[1] + signals[LOST]) * rho[0]
        found.moved[1] += rho[0] * rho[0]
        found.expected[1] += R[0, 0]
        M[0] = p.of_w[t]
        rho, R = M.T @ rho, M.T @ R @ M
        for j in range(n):
            found.moved[2 + j] += rho[N - n + j] ** 2 * signals[DRIFT]
            found.expected[2 + j] += R[N - n + j, N - n + j] * signals[DRIFT]
    found.begin[:] = p.mean + p.var * rho


def solve(p: Problem, variances: Array) -> Solution:
    """Solve a problem with ``variances`` (2 + n,): r, q_w, q."""
    T, N = p.of_w.shape
    n = p.shift.shape[1]
    M, P, K, z, sums = np.eye(N), np.empty((T, N, N)), np.empty((T, N + 2)), np.empty((T, N)), np.zeros((2, 2 + n))
    M[1 : N - n] = np.eye(N - n - 1, N)  # w_{t-1} .. of the state before
    loglik = float(forwards(p, variances, M, P, K, z))
    found = Solution(z, np.empty(T), np.empty(N), sums[0], sums[1], np.empty((T, n, n)), loglik)
    backwards(p, variances, M, P, K, found)
    return found
