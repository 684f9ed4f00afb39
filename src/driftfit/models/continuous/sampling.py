"""Sampling of linear systems whose inputs are held between samples (zero-order hold), by the matrix exponential.

    B(s) / A(s) = (b_1 s^(n-1) + .. + b_n) / (s^n + a_1 s^(n-1) + .. + a_n)  <->  the same in z, dt apart

    expm([[F, g], [0, 0]] dt) = [[Phi, gamma], [0, 1]]        with companion matrices of the order n

Source: Astrom and Wittenmark, Computer-Controlled Systems (1997), section 2.4.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array


def matrices(a: Array, b: Array) -> tuple[Array, Array]:
    """Observable companion form: x' = F x + g u, y = x_1."""
    F = np.diag(np.ones(len(a) - 1), 1)
    F[:, 0] = -a
    return F, b


def polynomials(F: Array, g: Array) -> Array:
    """(a, b) of x' = F x + g u, y = x_1."""
    n = len(g)
    a = np.poly(F)[1:]
    out = np.array([1.0, *np.zeros(n - 1)])
    # B = sum_k p^(n-1-k) sum_j a_j C F^(k-j) g
    markov = [g[0] if k == 0 else float(out @ np.linalg.matrix_power(F, k) @ g) for k in range(n)]
    full = np.append(1.0, a)
    b = [sum(full[j] * markov[k - j] for j in range(k + 1)) for k in range(n)]
    return np.concatenate([a, b]).real


def sampled(a: Array, b: Array, dt: float) -> Array:
    """(a, b) in z, from (a, b) in s."""
    from scipy import linalg  # only conversions need it

    F, g = matrices(a, b)
    n = len(a)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[:n, n] = F * dt, g * dt
    moved = linalg.expm(whole)
    return polynomials(moved[:n, :n], moved[:n, n])
