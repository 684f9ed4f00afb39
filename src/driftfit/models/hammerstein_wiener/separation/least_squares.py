"""Separation by generalised least squares: the minimal parameters nearest to theta in the metric of its covariance.

    zeta = argmin (theta - g(zeta))' P^-1 (theta - g(zeta)),     |c| = 1 for each input
    cov(zeta) = (J' P^-1 J)^-1 over the directions with c'dc = 0,       J = dg/dzeta

with zeta = (a, b, c, d_2 .., l), by Levenberg-Marquardt steps from another separation. All of c is free, which keeps
the problem well posed for c_1 = 0. The standard deviations are those of the delta method under the filter's own P, and
only as good as q and r. P is scaled to a unit diagonal before its Cholesky factorisation, with 1e-13 added to the
diagonal: after a prior of 1e8, computed eigenvalues are negative in every form that is not a square root.

Source: the delta method; Levenberg (1944). Cost per sample: O(n^3).
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array, Driver, shared

STEPS = 30
"""Largest number of steps; three to ten are typical."""
JITTER = 1e-13


@shared
def factor(P: Array, scale: Array, L: Array) -> bool:
    """L, the lower Cholesky factor of P scaled to a unit diagonal; False if P is not a finite covariance."""
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
def residual(theta: Array, zeta: Array, orders: tuple[int, int], sizes: Array, out: Array) -> None:
    """theta - g(zeta)."""
    na, n_out = orders
    inputs, at_d, at_c = sizes.shape[1], na, na
    for i in range(inputs):
        at_d, at_c = at_d + sizes[0, i], at_c + sizes[0, i]
    row, at_b = at_d + n_out - 1, na
    for i in range(na):
        out[i] = theta[i] - zeta[i]
    for i in range(inputs):
        nb, n_in = sizes[0, i], sizes[1, i]
        for j in range(nb):
            out[at_b + j] = theta[at_b + j] - zeta[at_c] * zeta[at_b + j]
        for k in range(1, n_in):
            for j in range(nb):
                out[row] = theta[row] - zeta[at_c + k] * zeta[at_b + j]
                row += 1
        at_b, at_c = at_b + nb, at_c + n_in
    for k in range(n_out - 1):
        out[at_d + k] = theta[at_d + k] - zeta[at_c + k]
        for i in range(na):
            out[row] = theta[row] - zeta[at_c + k] * zeta[i]
            row += 1
    for i in range(row, theta.shape[0]):
        out[i] = theta[i] - zeta[at_c + n_out - 1]


@shared
def jacobian(zeta: Array, orders: tuple[int, int], sizes: Array, J: Array) -> None:
    """dg/dzeta, transposed: J (n_z, n)."""
    na, n_out = orders
    inputs, at_d, at_c = sizes.shape[1], na, na
    for i in range(inputs):
        at_d, at_c = at_d + sizes[0, i], at_c + sizes[0, i]
    row, at_b = at_d + n_out - 1, na
    J[:] = 0.0
    for i in range(na):
        J[i, i] = 1.0
    for i in range(inputs):
        nb, n_in = sizes[0, i], sizes[1, i]
        for j in range(nb):
            J[at_b + j, at_b + j] = zeta[at_c]
            J[at_c, at_b + j] = zeta[at_b + j]
        for k in range(1, n_in):
            for j in range(nb):
                J[at_b + j, row] = zeta[at_c + k]
                J[at_c + k, row] = zeta[at_b + j]
                row += 1
        at_b, at_c = at_b + nb, at_c + n_in
    for k in range(n_out - 1):
        J[at_c + k, at_d + k] = 1.0
        for i in range(na):
            J[i, row] = zeta[at_c + k]
            J[at_c + k, row] = zeta[i]
            row += 1
    for i in range(row, J.shape[1]):
        J[at_c + n_out - 1, i] = 1.0


@shared
def starts(na: int, sizes: Array) -> tuple[int, int]:
    """The positions of b and c in zeta."""
    at_c = na
    for i in range(sizes.shape[1]):
        at_c += sizes[0, i]
    return na, at_c


@shared
def rescale(zeta: Array, na: int, sizes: Array) -> None:
    """The same products with |c| = 1 for each input."""
    at_b, at_c = starts(na, sizes)
    for i in range(sizes.shape[1]):
        b, c = zeta[at_b : at_b + sizes[0, i]], zeta[at_c : at_c + sizes[1, i]]
        size = 0.0
        for k in range(len(c)):
            size += c[k] * c[k]
        size = np.sqrt(size)
        for j in range(len(b)):
            b[j] *= size
        for k in range(len(c)):
            c[k] /= size
        at_b, at_c = at_b + len(b), at_c + len(c)


@shared
def hold_scales(zeta: Array, na: int, sizes: Array, N: Array) -> None:
    """Add c c' to N for each input, scaled to its size: it changes no product, and c'dc = 0 follows."""
    _, at_c = starts(na, sizes)
    for i in range(sizes.shape[1]):
        last = at_c + sizes[1, i]
        weight = 0.0
        for k in range(at_c, last):
            weight += N[k, k]
        weight = weight if weight > 0.0 else 1.0
        for k in range(at_c, last):
            for h in range(at_c, k + 1):
                N[k, h] += weight * zeta[k] * zeta[h]
        at_c = last


@shared
def project(zeta: Array, na: int, sizes: Array, cov: Array, v: Array, h: Array) -> None:
    """cov <- (I - v g') cov (I - v g')', g = (0, c) and v = (-b, c), after which c'dc = 0 for each input."""
    at_b, at_c = starts(na, sizes)
    for i in range(sizes.shape[1]):
        v[:] = 0.0
        for j in range(at_b, at_b + sizes[0, i]):
            v[j] = -zeta[j]
        for k in range(at_c, at_c + sizes[1, i]):
            v[k] = zeta[k]
        s = 0.0
        for x in range(len(v)):
            h[x] = 0.0
            for k in range(at_c, at_c + sizes[1, i]):
                h[x] += cov[x, k] * zeta[k]
        for k in range(at_c, at_c + sizes[1, i]):
            s += zeta[k] * h[k]
        for x in range(len(v)):
            for z in range(x + 1):
                cov[x, z] -= v[x] * h[z] + h[x] * v[z] - s * v[x] * v[z]
                cov[z, x] = cov[x, z]
        at_b, at_c = at_b + sizes[0, i], at_c + sizes[1, i]


@shared
def solve(N: Array, damping: float, right: Array, C: Array, step: Array) -> bool:
    """step = (N + damping diag N)^-1 right by Cholesky, factor in C; False if N is not positive definite."""
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
def equations(zeta: Array, orders: tuple[int, int], sizes: Array, L: Array, scale: Array, J: Array, N: Array) -> None:
    """The whitened Jacobian J (n_z, n) at zeta, and the lower triangle of N = J J' with the scales held."""
    n_x, n = J.shape
    jacobian(zeta, orders, sizes, J)
    for x in range(n_x):
        whiten(L, scale, J[x])
    for x in range(n_x):
        for z in range(x + 1):
            total = 0.0
            for i in range(n):
                total += J[x, i] * J[z, i]
            N[x, z] = total
    hold_scales(zeta, orders[0], sizes, N)


@shared
def gradient(J: Array, rho: Array, right: Array) -> None:
    """right = J rho."""
    for x in range(J.shape[0]):
        total = 0.0
        for i in range(J.shape[1]):
            total += J[x, i] * rho[i]
        right[x] = total


@shared
def inverse(N: Array, C: Array, right: Array, step: Array, out: Array) -> None:
    """out = N^-1, column by column and symmetric; C, right and step are scratch. NaN from where N has no factor."""
    n = N.shape[0]
    for x in range(n):
        right[:] = 0.0
        right[x] = 1.0
        if not solve(N, 0.0, right, C, step):
            break
        for z in range(n):
            out[z, x] = step[z]
    for x in range(n):
        for z in range(x):
            out[z, x] = out[x, z]


@Driver
def refine(theta: Array, P: Array, orders: tuple[int, int], sizes: Array, zeta: Array, cov: Array, cost: Array) -> None:
    """Refine zeta (T, n_z) in place; fill cov (T, n_z, n_z) and cost (T,), NaN where P is no finite covariance.

    ``orders`` are na and n_out, ``sizes`` (2, inputs) nb and n_in of the inputs; zeta has |c| = 1.
    """
    T, n = theta.shape
    n_x = zeta.shape[1]
    L, scale, rho, trial = np.zeros((n, n)), np.zeros(n), np.zeros(n), np.zeros(n)
    J, N, C = np.zeros((n_x, n)), np.zeros((n_x, n_x)), np.zeros((n_x, n_x))
    right, step, moved = np.zeros(n_x), np.zeros(n_x), np.zeros(n_x)
    for t in range(T):
        cov[t] = np.nan
        cost[t] = np.nan
        if not factor(P[t], scale, L):
            continue
        # the weighted residual L^-1 (theta - g(zeta)) at the start
        now = zeta[t]
        residual(theta[t], now, orders, sizes, rho)
        whiten(L, scale, rho)
        best = 0.0
        for i in range(n):
            best += rho[i] * rho[i]
        damping = 0.0
        for _ in range(STEPS):
            # Gauss-Newton: N step = J' rho, with more damping until the cost does not rise
            equations(now, orders, sizes, L, scale, J, N)
            gradient(J, rho, right)
            better = False
            for _ in range(10):
                if solve(N, damping, right, C, step):
                    for x in range(n_x):
                        moved[x] = now[x] + step[x]
                    residual(theta[t], moved, orders, sizes, trial)
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
            # accept the step, and restore |c| = 1
            gain = best - value
            best = value
            now[:] = moved
            rescale(now, orders[0], sizes)
            rho[:] = trial
            damping = 0.0 if damping < 1e-3 else 0.1 * damping
            if gain <= 1e-12 * best or gain == 0.0:
                break
        # the covariance is N^-1 at the minimum, column by column, projected onto |c| = 1
        cost[t] = best
        equations(now, orders, sizes, L, scale, J, N)
        inverse(N, C, right, step, cov[t])
        project(now, orders[0], sizes, cov[t], right, step)
