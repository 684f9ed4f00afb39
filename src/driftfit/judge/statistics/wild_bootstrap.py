"""The supremum of F over all dates, near the ends too, with its null distribution by a wild bootstrap.

    F_b = S_b' (A_b - A_b A_T^-1 A_b)^-1 S_b                 S_b, A_b: scores and information of the rows before b
    S*_b = sum_{s <= b} phi_s psi*_s - A_b A_T^-1 sum_s phi_s psi*_s
    psi*_s = +- psi_s;  near the ends +- c_s psi_r / c_r with a random row r      c_s: level of the noise

p is the share of the bootstrapped paths with a larger supremum: of DRAWS, or of those until ABOVE are larger. It is at
least ABOVE / DRAWS then, and below that it is the same number as without stopping early. A covariance that is estimated
from a few rows at the end of a record is useless there, so the tests of `driftfit.judge.statistics.supremum` leave the
ends out. F takes the variance of the noise from the whole record, and random signs keep the variance of every row. Near
the ends the residuals themselves would count the change as noise. Every row there is a date, and about MIDDLE between.

For scores without correlation and records of at least LEAST rows: with fewer rows, random signs represent the tails too
poorly.

Source: Hansen (2000), a fixed-regressor bootstrap; Liu (1988) for signs; Besag and Clifford (1991) for sequential
p-values. Departure: the ends. Cost: O(DRAWS (N n + MIDDLE n^2)), without a change a fifth of that.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array, Driver
from driftfit.judge.statistics.noise import HELD

DRAWS, ABOVE = 399, 20
LEAST = 300
MIDDLE, END = 40, 30
"""Dates between the ends, and rows at each end that are all dates."""


@Driver
def _share_above(X: Array, psi: Array, c: Array, dates: Array, roots: Array, shares: Array, found: float) -> float:
    """p-value of the supremum found; roots, shares (m, n, n): M_b^(-1/2) and A_b A_T^-1 at the dates (m,)."""
    N, n = X.shape
    m = dates.shape[0]
    S, whole = np.zeros((m, n)), np.zeros(n)
    state = np.uint64(88172645463325252)
    above = 0
    for draw in range(DRAWS):
        whole[:] = 0.0
        at = 0
        for t in range(N):
            if at < m and dates[at] == t:
                S[at] = whole
                at += 1
            # xorshift: one random number decides the sign and, near the ends, the row that is drawn
            state ^= state << np.uint64(13)
            state ^= state >> np.uint64(7)
            state ^= state << np.uint64(17)
            value = psi[t]
            if t < END or t >= N - END:
                r = int((state >> np.uint64(33)) % np.uint64(N))
                value = psi[r] * c[t] / c[r]
            signed = value if (state >> np.uint64(32)) & np.uint64(1) else -value
            for i in range(n):
                whole[i] += X[t, i] * signed
        # S*_b = S_b - A_b A_T^-1 S_T, and its quadratic form F_b
        best = 0.0
        for b in range(m):
            total = 0.0
            for i in range(n):
                for j in range(n):
                    S[b, i] -= shares[b, i, j] * whole[j]
            for i in range(n):
                z = 0.0
                for j in range(n):
                    z += roots[b, i, j] * S[b, j]
                total += z * z
            best = max(best, total)
        # sequential: stop as soon as enough draws exceed the observed supremum
        above += 1 if best >= found else 0
        if above == ABOVE:
            return above / (draw + 1)
    return (above + 1) / (DRAWS + 1)


def wild_supremum(X: Array, residual: Array, level: Array) -> float:
    """p-value of one break at any date of rows X (N, n); NaN for too few of them.

    residual (N,): of constants; it is limited to three levels of the noise (N,), which leaves a short change more
    weight than the bound of the other tests does.
    """
    N, n = X.shape
    if N < LEAST:
        return float("nan")
    psi, edge = np.clip(residual, -HELD * level, HELD * level), np.arange(n + 2, END + n)
    dates = np.unique(np.concatenate([edge, np.linspace(END + n, N - END - n, MIDDLE).astype(int), N - edge]))
    A = np.cumsum(np.einsum("ti,tj->tij", X, X), axis=0)[dates - 1]
    whole = X.T @ X
    shares = A @ np.linalg.inv(whole)
    values, vectors = np.linalg.eigh(A - shares @ A)
    good = values > 1e-9 * values.max(axis=1, keepdims=True)
    roots = np.where(good, 1.0 / np.sqrt(np.where(good, values, 1.0)), 0.0)[:, :, None] * np.swapaxes(vectors, 1, 2)
    path = np.cumsum(X * psi[:, None], axis=0)[dates - 1] - shares @ (X.T @ psi)
    F = np.sum(np.einsum("bij,bj->bi", roots, path) ** 2, axis=1)
    return float(
        _share_above(np.ascontiguousarray(X), psi, level, dates, *map(np.ascontiguousarray, (roots, shares)), F.max())
    )
