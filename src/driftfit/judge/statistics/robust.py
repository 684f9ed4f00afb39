"""Least squares with bounded influence of outliers in y.

    theta solves sum phi_t psi(e_t) = 0,    e_t = y_t - phi_t' theta,    psi(e) = e clipped at 1.5 scales of the noise

solved by iteratively reweighted least squares. The scale is 1.4826 times the median of the absolute residuals. Normal
equations are solved in an orthonormal basis of the regressors, so that their conditioning is that of the variation
within the record. Source: Huber (1964).
Cost: O(N n^2) per iteration, usually ten.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import Array, Driver, part, shared
from driftfit.smooth.solvers.rank import column_sizes

CLIP = 1.5
SMALL = 1e-300
"""Added to a diagonal, so that it can be inverted."""
ROUNDED = 1e-14
"""Information below this share of that of the whole record is rounding."""
ROUNDS = 30
SHRINKING = 0.9
"""A scale that in the last round is below this share of the one before vanishes."""
INSIDE = 0.9733
"""Mean square of a Gaussian within three standard deviations."""
LEAST = 0.5 / 1.6449
"""Smallest scale as a share of the size that nine of ten residuals do not reach, 1.6449 for a Gaussian of variance 1:
where more than half of the readings of a coarse meter are the same, the median of the sizes is no scale.
"""
SOLE = 1e-12
"""A leverage of 1 less this is 1."""
FLAT = 1e-10
"""A pivot below this share of its diagonal entry counts as zero."""


@partial(shared, arrays=True)
def scale_of(x: Array) -> float:
    """Standard deviation of Gaussian values x (N,) around 0, from the median of their sizes, or `LEAST` of it."""
    sizes, N = np.sort(np.abs(x)), x.shape[0]
    half = sizes[N // 2] if N % 2 == 1 else 0.5 * (sizes[N // 2] + sizes[N // 2 - 1])
    return max(1.4826 * half, LEAST * sizes[9 * N // 10])  # type: ignore[no-any-return]


@Driver
def deviation(x: Array) -> float:
    """`scale_of`"""
    return scale_of(x)  # type: ignore[no-any-return]


class Fit(NamedTuple):
    """Constant coefficients of N samples on n regressors."""

    theta: Array
    """(n,)"""
    residual: Array
    """(N,): y - phi' theta."""
    scale: float
    """Noise standard deviation, from the median of the absolute residuals."""


@part
def eliminate(M: Array, n: int, least: float) -> float:
    """Factor L D L' of the leading n columns of M (k, k), a lower triangle, in place: L D below the diagonal, D^-1 on
    it; returns the remaining last entry of M. Directions of no more information than ``least`` are left out.

    With n = k - 1 and M = [phi, y]' [phi, y] that entry is the sum of squared residuals.
    """
    k = M.shape[0]
    for j in range(n):
        pivot = M[j, j]
        size = pivot
        for i in range(j):
            pivot -= M[j, i] * M[j, i] * M[i, i]
        M[j, j] = 1.0 / pivot if pivot > max(FLAT * size, least) else 0.0
        for r in range(j + 1, k):
            total = M[r, j]
            for i in range(j):
                total -= M[r, i] * M[j, i] * M[i, i]
            M[r, j] = total
    left: float = M[k - 1, k - 1]
    for i in range(n):
        left -= M[k - 1, i] * M[k - 1, i] * M[i, i]
    return left if left > 0.0 else 0.0


@shared
def solved(M: Array, theta: Array) -> None:
    """theta (n,) from M (n + 1, n + 1) after `eliminate`."""
    n = theta.shape[0]
    for i in range(n - 1, -1, -1):
        theta[i] = M[n, i]
        for j in range(i + 1, n):
            theta[i] -= M[j, i] * theta[j]
        theta[i] *= M[i, i]


class Basis(NamedTuple):
    """Regressors phi (N, n) = Q R diag(size), Q' Q = N I."""

    Q: Array
    R: Array
    size: Array
    """(n,): `column_sizes` of phi."""

    @property
    def negligible(self) -> float:
        """The largest singular value of R that is rounding."""
        return float(1e-9 / np.sqrt(len(self.Q)))

    @property
    def distinct(self) -> bool:
        """Whether the columns of phi are linearly independent, whatever their units."""
        return bool(np.linalg.matrix_rank(self.R, self.negligible) == len(self.size))


def invertible(G: Array, share: Array | float = ROUNDED) -> Array:
    """Sums of products G (.., q, q), with this share of the mean of their diagonal beside their own."""
    G = G.copy()
    own = np.einsum("...ii->...i", G)
    own += own.sum(axis=-1, keepdims=True) / G.shape[-1] * share + SMALL
    return G


def orthonormal(phi: Array) -> Basis:
    """An orthonormal basis of regressors phi (N, n), N > 0."""
    size, root = column_sizes(phi), np.sqrt(len(phi))
    Q, R = np.linalg.qr(phi / size)
    return Basis(np.ascontiguousarray(Q * root), R / root, size)


def pseudo_inverse(phi: Array) -> Array:
    """The pseudo-inverse (n, N) of regressors phi (N, n), whose units may be far apart."""
    basis = orthonormal(phi)
    return np.asarray(np.linalg.pinv(basis.R, basis.negligible) / basis.size[:, None] @ basis.Q.T / len(phi))


def robust_fit(phi: Array, y: Array) -> Fit:
    """Constant coefficients with bounded influence of outliers in y; phi (N, n), y (N,)."""
    return fit_in(orthonormal(phi), y)


def sole(Q: Array) -> Array:
    """Which rows of Q (N, n), Q' Q = N I, alone determine a direction: their residuals are 0, whatever y is."""
    return np.asarray(np.einsum("ti,ti->t", Q, Q) > (1.0 - SOLE) * len(Q))


@Driver
def _fitted(Q: Array, y: Array, theta: Array, residual: Array) -> float:
    """Fill in theta (n,) and the residuals (N,) of y (N,) on Q (N, n); returns their scale."""
    (N, n), scale, step, M = Q.shape, 0.0, np.empty(Q.shape[1]), np.empty((Q.shape[1] + 1, Q.shape[1] + 1))
    level = ROUNDING * np.sqrt(np.mean(y * y))
    for t in range(N):  # without slices, whose errors take Numba two seconds to compile
        residual[t] = y[t]
    for round in range(ROUNDS):
        M[:] = 0.0
        for t in range(N):
            weight = 1.0 if round == 0 else CLIP * scale / max(abs(residual[t]), CLIP * scale)
            for i in range(n + 1):
                part = weight * (Q[t, i] if i < n else y[t])
                for j in range(i + 1):
                    M[i, j] += part * (Q[t, j] if j < n else y[t])
        for i in range(n):
            M[i, i] += ROUNDED * M[i, i] + SMALL
        eliminate(M, n, 0.0)
        solved(M, step)
        moved = 0.0
        for t in range(N):
            residual[t], turn = y[t], 0.0
            for i in range(n):
                residual[t] -= Q[t, i] * step[i]
                turn += Q[t, i] * (step[i] - theta[i])
            moved = max(moved, abs(turn))
        for i in range(n):
            theta[i] = step[i]
        before, scale = scale, scale_of(residual)
        if ((round > 0 and not scale > level) or round == ROUNDS - 1) and scale < SHRINKING * before:
            scale = 0.0
        if not scale > level or (round > 0 and moved < 1e-8 * scale):
            break
    return scale


def fit_in(basis: Basis, y: Array) -> Fit:
    """The same in a basis that `orthonormal` made.

    If more than nine of ten readings lie on one plane, as the zeros of rare counts do, the scale shrinks from round to
    round, and with it the influence of all other readings: it is 0 then, and theta is not an estimate for them.
    """
    Q, R, size = basis
    theta, residual = np.zeros(Q.shape[1]), np.empty(len(y))
    scale = float(_fitted(Q, np.ascontiguousarray(y), theta, residual))
    return Fit(np.linalg.lstsq(R, theta, rcond=ROUNDING)[0] / size, residual, scale)


def noisy(fit: Fit, phi: Array, y: Array) -> bool:
    """Whether the residuals of a fit of y (N,) on phi (N, n) are more than the rounding of y and of its terms."""
    terms = np.sqrt(np.mean(phi * phi, axis=0)) @ np.abs(fit.theta)
    return bool(fit.scale > ROUNDING * (np.sqrt(np.mean(y * y)) + terms))


def core(z: Array) -> float:
    """Mean square of z (N,) within three of its robust deviations, 1 for a Gaussian of variance 1; NaN below ten."""
    z = z[np.isfinite(z)]
    if len(z) < 10:
        return float("nan")
    limit = 3.0 * deviation(z)
    return float(np.mean(z[np.abs(z) <= limit] ** 2)) / INSIDE
