"""Square roots of information: an upper triangle that represents the information on theta, updated by rotations only.

    |S theta - d|^2   is the information of the samples so far;   S' S = P^-1 in units of the noise variance,
                      S theta_hat = d

    absorb   the row phi' theta = y is rotated into the triangle from the top; what remains of y is rho = c e, with c
             the product of the cosines and s = 1 / c^2 the variance of the innovation e
    spread   theta <- theta + G w, w ~ N(0, I), G an upper triangle: the row (1 | 0) of each w and the rows (-S g | S)
             lose their first column to that of w by rotations from the bottom, which leave S a triangle

Nothing is subtracted that was added before, so S keeps its relative accuracy at any ratio of drift to noise and with
collinear and badly scaled regressors, and S' S cannot lose its positivity. A zero row is a direction without
information: the diffuse start needs no special case.

Arrays have the lane as their last axis, like fields of a record. Source: Bierman, Factorization Methods for Discrete
Sequential Estimation (1977), chapters 5 and 6; departure: rotations one component of the drift at a time, in an order
that preserves the triangle. Cost: n rotations per sample and n (n + 1) / 2 for the drift, so O(n^2) and O(n^3).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, kernel


@kernel
def absorb(S: Array, d: Array, row: Array, y: float, l: int) -> tuple[float, float]:
    """Rotate ``row' theta = y``, with noise variance 1, into (S, d); returns (rho, c). The row is overwritten."""
    n = S.shape[0]
    left = 1.0
    for i in range(n):
        a, b = S[i, i, l], row[i, l]
        r = np.sqrt(a * a + b * b)
        c = a / r if r > 0.0 else 1.0
        s = b / r if r > 0.0 else 0.0
        S[i, i, l] = r
        for j in range(i + 1, n):
            t = S[i, j, l]
            S[i, j, l] = c * t + s * row[j, l]
            row[j, l] = c * row[j, l] - s * t
        t = d[i, l]
        d[i, l] = c * t + s * y
        y = c * y - s * t
        left *= c
    return y, left


@kernel
def spread(S: Array, d: Array, G: Array, size: float, pivot: Array, l: int) -> None:
    """Move theta by ``size`` G w with w ~ N(0, I); ``pivot`` (n, L) is scratch space."""
    n = S.shape[0]
    for q in range(n):
        for j in range(n):
            pivot[j, l] = 0.0
        top, z = 1.0, 0.0
        for i in range(q, -1, -1):
            v = 0.0
            for j in range(i, q + 1):
                v -= S[i, j, l] * G[j, q, l]
            v *= size
            r = np.sqrt(top * top + v * v)
            c, s = top / r, v / r
            top = r
            for j in range(i, n):
                t = pivot[j, l]
                pivot[j, l] = c * t + s * S[i, j, l]
                S[i, j, l] = c * S[i, j, l] - s * t
            t = z
            z = c * t + s * d[i, l]
            d[i, l] = c * d[i, l] - s * t


@kernel
def shear(S: Array, time: float, l: int) -> None:
    """S <- S [[1, time], [0, 1]], which keeps S triangular.

    With x = (level, slope): the information of S about (level + time slope, slope) is then about x.
    """
    half = S.shape[0] // 2
    for i in range(S.shape[0]):
        for j in range(half):
            S[i, half + j, l] += time * S[i, j, l]


@kernel
def solve(S: Array, d: Array, x: Array, l: int) -> None:
    """x = S^-1 d."""
    n = S.shape[0]
    for i in range(n - 1, -1, -1):
        t = d[i, l]
        for j in range(i + 1, n):
            t -= S[i, j, l] * x[j, l]
        x[i, l] = t / S[i, i, l]


@kernel
def invert(S: Array, R: Array, l: int) -> None:
    """R = S^-1, an upper triangle with R R' = P."""
    n = S.shape[0]
    for j in range(n):
        R[j, j, l] = 1.0 / S[j, j, l]
        for i in range(j - 1, -1, -1):
            t = 0.0
            for k in range(i + 1, j + 1):
                t -= S[i, k, l] * R[k, j, l]
            R[i, j, l] = t / S[i, i, l]


def widen(S: Array, d: Array, p: Array) -> None:
    """Add variances p to theta, in place, outside compiled code: S (n, n), d (n,)."""
    n = len(d)
    spread.py_func(S[..., None], d[..., None], np.diag(np.sqrt(p))[..., None], 1.0, np.zeros((n, 1)), 0)


def triangular_root(q: Array) -> Array:
    """An upper triangle G with G G' = q, for a covariance that may be singular.

    It is the triangle of the correlations in the units of each parameter: eigenvalues of q itself would lose a variance
    1e16 times smaller than another.
    """
    variances = np.diag(q)
    if np.array_equal(q, np.diag(variances)):
        return np.diag(np.sqrt(variances))
    from scipy import linalg  # a fifth of a second to import

    unit = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    values, vectors = linalg.eigh(q / np.outer(unit, unit))
    return np.asarray(unit[:, None] * linalg.rq(vectors * np.sqrt(np.maximum(values, 0.0)), mode="r"))


def partly_known(small: Mapping[str, Any], large: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The ``large`` state of a tracker that begins with the ``small`` one along each axis; None without room for it.

    The other parameters are known to be 0: with a 1 on the diagonal of S they count as determined. Where regressors are
    0 in all samples, sums over parameters gain terms that are 0: results are those of the small state, bit for bit.
    """
    state = {name: np.array(value) for name, value in large.items()}
    if any(own > wide for name in state for own, wide in zip(np.shape(small[name]), state[name].shape, strict=True)):
        return None
    for name, value in state.items():
        value[tuple(slice(size) for size in np.shape(small[name]))] = small[name]
    n, N = len(small["theta"]), len(large["theta"])
    state["S"][range(n, N), range(n, N)] = 1.0
    if state["root"] > 0:
        state["rank"] += N - n
    return state
