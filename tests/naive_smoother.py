"""Slow and obvious twins of the smoothers: dense least squares, and the same in eighty digits."""

from decimal import Decimal, getcontext
from fractions import Fraction

import numpy as np

getcontext().prec = 80


def stacked(phi, y, D, weight=None, theta0=0.0, lambda0=None):
    """The rows of the cost as one least squares problem: (A, b) with J = |A theta - b|^2."""
    L, n = phi.shape
    root = np.ones(L) if weight is None else np.sqrt(weight)
    A = np.zeros((L, L * n))
    for k in range(L):
        A[k, k * n : k * n + n] = root[k] * phi[k]
    blocks, b = [A], [root * y]
    for k in range(L - 1):
        W = np.zeros((n, L * n))
        half = np.linalg.cholesky(D[k]).T
        W[:, k * n : k * n + n], W[:, (k + 1) * n : (k + 2) * n] = -half, half
        blocks.append(W)
        b.append(np.zeros(n))
    if lambda0 is not None:
        half = np.linalg.cholesky(lambda0).T
        blocks.append(np.hstack([half, np.zeros((n, (L - 1) * n))]))
        b.append(half @ (np.zeros(n) + theta0))
    return np.vstack(blocks), np.concatenate(b)


def dense(*args, **kwargs):
    """(theta (L, n), C (L n, L n), J) from the stacked problem; of full rank."""
    A, b = stacked(*args, **kwargs)
    L, n = args[0].shape
    theta = np.linalg.lstsq(A, b, rcond=None)[0]
    return theta.reshape(L, n), np.linalg.inv(A.T @ A), float(np.sum((A @ theta - b) ** 2))


def precise(phi, y, mu):
    """(theta (L, n), variances (L, n)) by the flexible least squares recursion in eighty digits."""
    L, n = phi.shape
    mu = Decimal(float(mu))
    rows = [[Decimal(float(v)) for v in row] for row in phi]
    outputs = [Decimal(float(v)) for v in y]
    Q, p, kept = zeros(n), [Decimal(0)] * n, []
    for k in range(L):
        U = [[Q[i][j] + rows[k][i] * rows[k][j] for j in range(n)] for i in range(n)]
        z = [p[i] + rows[k][i] * outputs[k] for i in range(n)]
        if k < L - 1:
            E = inverse([[U[i][j] + (mu if i == j else 0) for j in range(n)] for i in range(n)])
            e = apply(E, z)
            kept.append((E, e))
            Q = [[mu * v for v in row] for row in product(E, U)]
            p = [mu * v for v in e]
    C = inverse(U)
    theta = apply(C, z)
    path, var = [theta], [[C[i][i] for i in range(n)]]
    for E, e in reversed(kept):
        M = [[mu * v for v in row] for row in E]
        theta = [a + b for a, b in zip(e, apply(M, theta), strict=True)]
        spread = product(product(M, C), [list(row) for row in zip(*M, strict=True)])
        C = [[E[i][j] + spread[i][j] for j in range(n)] for i in range(n)]
        path.append(theta)
        var.append([C[i][i] for i in range(n)])
    return np.array(path[::-1], dtype=float), np.array(var[::-1], dtype=float)


def zeros(n):
    return [[Decimal(0)] * n for _ in range(n)]


def apply(A, x):
    return [sum(a * b for a, b in zip(row, x, strict=True)) for row in A]


def product(A, B):
    return [[sum(A[i][k] * B[k][j] for k in range(len(B))) for j in range(len(B[0]))] for i in range(len(A))]


def inverse(A):
    """Gauss and Jordan, with pivoting."""
    n = len(A)
    M = [[*row, *(Decimal(int(i == j)) for j in range(n))] for i, row in enumerate(A)]
    for i in range(n):
        pivot = max(range(i, n), key=lambda k: abs(M[k][i]))
        M[i], M[pivot] = M[pivot], M[i]
        M[i] = [v / M[i][i] for v in M[i]]
        for k in range(n):
            if k != i:
                M[k] = [a - M[k][i] * b for a, b in zip(M[k], M[i], strict=True)]
    return [row[n:] for row in M]


def second_differences(phi, y, mu, dt=None, drift=1.0, weight=1.0):
    """The rows of the cost with second differences: (A, b) with J = |A theta - b|^2."""
    L, n = phi.shape
    dt, drift, w = np.ones(L) if dt is None else dt, np.ones((L, n)) * drift, np.ones(L) * weight
    A, b = np.zeros((L + (L - 2) * n, L, n)), np.zeros(L + (L - 2) * n)
    for k in range(L):
        A[k, k], b[k] = np.sqrt(w[k]) * phi[k], np.sqrt(w[k]) * y[k]
    for k in range(1, L - 1):
        for i in range(n):
            row, price = A[L + (k - 1) * n + i], np.sqrt(mu / (dt[k + 1] * drift[k + 1, i]))
            row[k + 1, i], row[k - 1, i] = price / dt[k + 1], price / dt[k]
            row[k, i] = -price / dt[k + 1] - price / dt[k]
    return A.reshape(len(A), L * n), b


def exact_normal_equations(A, b):
    """(theta, diagonal of the inverse) of |A theta - b|^2 in eighty digits."""
    rows = [[Decimal(float(v)) for v in row] for row in A]
    columns = [list(column) for column in zip(*rows, strict=True)]
    right = [sum(v * Decimal(float(c)) for v, c in zip(column, b, strict=True)) for column in columns]
    C = inverse([[sum(u * v for u, v in zip(p, q, strict=True)) for q in columns] for p in columns])
    return np.array(apply(C, right), dtype=float), np.array([C[i][i] for i in range(len(C))], dtype=float)


def inverse_of_normal(phi, mu):
    """The inverse of the normal matrix of flexible least squares in rational numbers, (T n, T n)."""
    T, n = phi.shape
    N, steps = T * n, [(i, i + n) for i in range((T - 1) * n)]
    rows = [[Fraction(0)] * N + [Fraction(int(i == j)) for j in range(N)] for i in range(N)]
    for t in range(T):
        for i in range(n):
            for j in range(n):
                rows[t * n + i][t * n + j] += Fraction(phi[t, i]) * Fraction(phi[t, j])
    for i, j in steps:
        for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            rows[a][b] += sign * Fraction(mu)
    for c in range(N):
        pivot = next(r for r in range(c, N) if rows[r][c])
        rows[c], rows[pivot] = rows[pivot], rows[c]
        rows[c] = [x / rows[c][c] for x in rows[c]]
        for r in range(N):
            if r != c and rows[r][c]:
                rows[r] = [x - rows[r][c] * z for x, z in zip(rows[r], rows[c], strict=True)]
    return np.array([[float(x) for x in row[N:]] for row in rows])
