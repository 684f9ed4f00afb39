"""A regression whose coefficients move by a step of given covariance before every sample: filter and smoother.

    G = C(t|t) C(t+1|t)^-1,   m_s = m + G (m_s(t+1) - m(t+1|t)),   C_s = C + G (C_s(t+1) - C(t+1|t)) G'

Source: Rauch, Tung and Striebel (1965). Cost: O(T n^3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver


class Problem(NamedTuple):
    """A regression whose coefficients have a separate drift covariance before every sample."""

    phi: Array
    y: Array
    r: Array
    """(T,): noise variance; inf for samples that are not used."""
    Q: Array
    """(T, n, n): covariance of the step before each sample."""
    m0: Array
    C0: Array


def solve(problem: Problem) -> tuple[Array, Array, Array]:
    """(theta (T, n), covariances (T, n, n), gains (T, n, n))."""
    T, n = problem.phi.shape
    m, C = np.empty((T, n)), np.empty((T, n, n))
    forward(problem.phi, problem.y, problem.r, problem.Q, problem.m0, problem.C0.copy(), m, C)
    gains = np.zeros((T, n, n))
    for t in range(T - 2, -1, -1):
        ahead = C[t] + problem.Q[t + 1]
        try:
            G = np.linalg.solve(ahead, C[t]).T
        except np.linalg.LinAlgError:
            G = C[t] @ np.linalg.pinv(ahead, hermitian=True)
        gains[t] = G
        m[t] += G @ (m[t + 1] - m[t])
        smoothed = C[t] + G @ (C[t + 1] - ahead) @ G.T
        C[t] = 0.5 * (smoothed + smoothed.T)
    return m, C, gains


@Driver
def forward(phi: Array, y: Array, r: Array, Q: Array, m0: Array, P: Array, m: Array, C: Array) -> tuple[float, float]:
    """The filter; m (T, n) and C (T, n, n) after each sample. Returns the sums of log s and of e^2 / s."""
    T, n = phi.shape
    logs, squares = 0.0, 0.0
    theta = m0.copy()
    g = np.empty(n)
    for t in range(T):
        for i in range(n):
            for j in range(n):
                P[i, j] += Q[t, i, j]
        if r[t] < np.inf:
            s, e = r[t], y[t]
            for i in range(n):
                g[i] = 0.0
                for j in range(n):
                    g[i] += P[i, j] * phi[t, j]
                s += phi[t, i] * g[i]
                e -= phi[t, i] * theta[i]
            logs += np.log(s)
            squares += e * e / s
            for i in range(n):
                theta[i] += g[i] / s * e
            for i in range(n):
                for j in range(i + 1):
                    P[i, j] -= g[i] * g[j] / s
                    P[j, i] = P[i, j]
        for i in range(n):
            m[t, i] = theta[i]
            for j in range(n):
                C[t, i, j] = P[i, j]
    return logs, squares
