"""Separation by generalised least squares: the minimal parameters nearest to theta in the metric of its covariance.

    xi = argmin (theta - g(xi))' P^-1 (theta - g(xi)),     cov(xi) = (J' P^-1 J)^-1

by Levenberg-Marquardt steps from another separation. Its standard deviations are those of the delta method under the
filter's own P, and only as good as q and r. P is scaled to a unit diagonal before its Cholesky factor is taken, with
1e-13 added to the diagonal: a prior of 1e8 leaves computed eigenvalues below zero in every form that is no square root.

Source: the delta method; Levenberg (1944). Cost per sample: O(n^3).
"""

from __future__ import annotations

import numpy as np

from driftfit.kernel import Array, shared

STEPS = 30
"""Steps, at most; three to ten are the rule."""
JITTER = 1e-13


@shared
def factor(P: Array, scale: Array, L: Array) -> bool:
    """L, the lower Cholesky factor of P scaled to a unit diagonal; False where P is no finite covariance."""
    n = P.shape[0]
    for i in range(n):
        if not (P[i, i] > 0.0 and P[i, i] < np.inf):
            return False
        scale[i] = np.sqrt(P[i, i])
    for j in range(n):
        for i in range(j, n):
            total = 1.0 + JITTER if i == j else P[i, j] / scale[i] / scale[j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > 0.0:
                    total = JITTER
                L[i, i] = np.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    return True


@shared
def whiten(L: Array, scale: Array, x: Array) -> None:
    """x <- L^-1 x / scale."""
    for i in range(x.shape[0]):
        total = x[i] / scale[i]
        for k in range(i):
            total -= L[i, k] * x[k]
        x[i] = total / L[i, i]


@shared
def residual(theta: Array, xi: Array, orders: tuple[int, int, int, int], out: Array) -> None:
    """theta - g(xi)."""
    na, nb, n_in, n_out = orders
    at_d = na + nb
    at_bc, x_c, x_d = at_d + n_out - 1, at_d, at_d + n_in - 1
    at_ad = at_bc + nb * (n_in - 1)
    for i in range(theta.shape[0]):
        out[i] = theta[i]
    for i in range(at_d):
        out[i] -= xi[i]
    for k in range(n_out - 1):
        out[at_d + k] -= xi[x_d + k]
        for i in range(na):
            out[at_ad + k * na + i] -= xi[x_d + k] * xi[i]
    for k in range(n_in - 1):
        for j in range(nb):
            out[at_bc + k * nb + j] -= xi[x_c + k] * xi[na + j]
    last = at_ad + na * (n_out - 1)
    for i in range(last, theta.shape[0]):
        out[i] -= xi[x_d + n_out - 1]


@shared
def jacobian(xi: Array, orders: tuple[int, int, int, int], J: Array) -> None:
    """dg/dxi, transposed: J (n_x, n)."""
    na, nb, n_in, n_out = orders
    at_d = na + nb
    at_bc, x_c, x_d = at_d + n_out - 1, at_d, at_d + n_in - 1
    at_ad = at_bc + nb * (n_in - 1)
    J[:] = 0.0
    for i in range(at_d):
        J[i, i] = 1.0
    for k in range(n_out - 1):
        J[x_d + k, at_d + k] = 1.0
        for i in range(na):
            J[i, at_ad + k * na + i] = xi[x_d + k]
            J[x_d + k, at_ad + k * na + i] = xi[i]
    for k in range(n_in - 1):
        for j in range(nb):
            J[na + j, at_bc + k * nb + j] = xi[x_c + k]
            J[x_c + k, at_bc + k * nb + j] = xi[na + j]
    last = at_ad + na * (n_out - 1)
    for i in range(last, J.shape[1]):
        J[x_d + n_out - 1, i] = 1.0


@shared
def solve(N: Array, damping: float, right: Array, C: Array, step: Array) -> bool:
    """step = (N + damping diag N)^-1 right by Cholesky, factor in C; False where N is not positive."""
    n = N.shape[0]
    for j in range(n):
        for i in range(j, n):
            total = N[i, j] * (1.0 + damping) if i == j else N[i, j]
            for k in range(j):
                total -= C[i, k] * C[j, k]
            if i == j:
                if not total > 1e-300:
                    return False
                C[i, i] = np.sqrt(total)
            else:
                C[i, j] = total / C[j, j]
    for i in range(n):
        total = right[i]
        for k in range(i):
            total -= C[i, k] * step[k]
        step[i] = total / C[i, i]
    for i in range(n - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, n):
            total -= C[k, i] * step[k]
        step[i] = total / C[i, i]
    return True


@shared
def refine(theta: Array, P: Array, orders: tuple[int, int, int, int], xi: Array, cov: Array, cost: Array) -> None:
    """Refine xi (T, n_x) in place; fill cov (T, n_x, n_x) and cost (T,), NaN where P is no finite covariance."""
    T, n = theta.shape
    n_x = xi.shape[1]
    L, scale, rho, trial = np.zeros((n, n)), np.zeros(n), np.zeros(n), np.zeros(n)
    J, N, C = np.zeros((n_x, n)), np.zeros((n_x, n_x)), np.zeros((n_x, n_x))
    right, step, moved = np.zeros(n_x), np.zeros(n_x), np.zeros(n_x)
    for t in range(T):
        cov[t] = np.nan
        cost[t] = np.nan
        if not factor(P[t], scale, L):
            continue
        now = xi[t]
        residual(theta[t], now, orders, rho)
        whiten(L, scale, rho)
        best = 0.0
        for i in range(n):
            best += rho[i] * rho[i]
        damping = 0.0
        for _ in range(STEPS):
            jacobian(now, orders, J)
            for x in range(n_x):
                whiten(L, scale, J[x])
            for x in range(n_x):
                total = 0.0
                for i in range(n):
                    total += J[x, i] * rho[i]
                right[x] = total
                for z in range(x + 1):
                    total = 0.0
                    for i in range(n):
                        total += J[x, i] * J[z, i]
                    N[x, z] = total
            better = False
            for _ in range(10):
                if solve(N, damping, right, C, step):
                    for x in range(n_x):
                        moved[x] = now[x] + step[x]
                    residual(theta[t], moved, orders, trial)
                    whiten(L, scale, trial)
                    value = 0.0
                    for i in range(n):
                        value += trial[i] * trial[i]
                    if value <= best:
                        better = True
                        break
                damping = max(10.0 * damping, 1e-3)
            if not better:
                break
            gain = best - value
            best = value
            now[:] = moved
            rho[:] = trial
            damping = 0.0 if damping < 1e-3 else 0.1 * damping
            if gain <= 1e-12 * best or gain == 0.0:
                break
        cost[t] = best
        jacobian(now, orders, J)
        for x in range(n_x):
            whiten(L, scale, J[x])
        for x in range(n_x):
            for z in range(x + 1):
                total = 0.0
                for i in range(n):
                    total += J[x, i] * J[z, i]
                N[x, z] = total
        for x in range(n_x):
            right[:] = 0.0
            right[x] = 1.0
            if not solve(N, 0.0, right, C, step):
                break
            for z in range(n_x):
                cov[t, z, x] = step[z]
        for x in range(n_x):
            for z in range(x):
                cov[t, z, x] = cov[t, x, z]
