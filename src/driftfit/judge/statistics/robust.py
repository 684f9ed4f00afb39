"""Least squares with bounded influence of outliers in y, compiled.

    theta solves sum phi_t psi(e_t) = 0,    e_t = y_t - phi_t' theta,    psi(e) = e clipped at 1.5 scales of the noise

solved by iteratively reweighted least squares. The scale is 1.4826 times the median of the absolute residuals. Normal
equations are solved in an orthonormal basis of the regressors, so that their conditioning is that of the variation
within the record; a direction that a part of the record does not excite stays at zero there. Source: Huber (1964).
Cost: O(N n^2) per iteration, usually ten.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import Array, Driver, shared
from driftfit.engine.simd import (
    WIDTH,
    fill,
    higher,
    load,
    lower,
    minus,
    only,
    over,
    plus,
    store,
    sum_of,
    times,
)
from driftfit.smooth.parts.rank import column_sizes

CLIP = 1.5
ROUNDS = 30
SHRINKING = 0.9
"""A scale that in the last round is below this share of the one before vanishes."""
INSIDE = 0.9733
"""Mean square of a Gaussian within three standard deviations."""


def median(x: Array) -> float:
    """Median of finite values x (N,), N > 0; a quarter of the time of NumPy's, which is general."""
    return float(medians(x))


def medians(x: Array) -> Array:
    """Medians over the last axis of finite values x (.., N), N > 0."""
    N = x.shape[-1]
    ordered = np.partition(x, N // 2, axis=-1)
    above = ordered[..., N // 2]
    return np.asarray(above if N % 2 else 0.5 * (above + ordered[..., : N // 2].max(axis=-1)))


def deviation(x: Array) -> float:
    """Standard deviation of Gaussian values x (N,) around 0, from the median of their sizes, or `LEAST` of it."""
    sizes = np.partition(np.abs(x), (len(x) // 2, 9 * len(x) // 10))
    half, high = sizes[len(x) // 2], sizes[9 * len(x) // 10]
    half = half if len(x) % 2 else 0.5 * (half + sizes[: len(x) // 2].max())
    return float(max(1.4826 * half, LEAST * high))


LEAST = 0.5 / 1.6449
"""Smallest scale as a share of the size that nine of ten residuals do not reach, 1.6449 for a Gaussian of variance 1:
where more than half of the readings of a coarse meter are the same, the median of the sizes is no scale.
"""


SOLE = 1e-12
"""A leverage of 1 less this is 1."""
FLAT = 1e-10
"""A pivot below this share of its diagonal entry counts as zero."""


class Fit(NamedTuple):
    """Constant coefficients of N samples on n regressors."""

    theta: Array
    """(n,)"""
    residual: Array
    """(N,): y - phi' theta."""
    scale: float
    """Noise standard deviation, from the median of the absolute residuals."""
    psi: Array
    """(N,): residuals clipped at 1.5 scales."""
    inside: Array
    """(N,): 1 where a residual is not clipped."""


@shared
def cholesky(M: Array, n: int) -> float:
    """Lower factor of the leading n columns of M (k, k), in place; returns the remaining last entry, M[k-1, k-1].

    With n = k - 1 and M = [phi, y]' [phi, y] that entry is the sum of squared residuals.
    """
    k = M.shape[0]
    for j in range(n):
        pivot = M[j, j]
        size = pivot
        for i in range(j):
            pivot -= M[j, i] * M[j, i]
        root = np.sqrt(pivot) if pivot > FLAT * size else 0.0
        M[j, j] = root
        for r in range(j + 1, k):
            total = M[r, j]
            for i in range(j):
                total -= M[r, i] * M[j, i]
            M[r, j] = total / root if root > 0.0 else 0.0
    left: float = M[k - 1, k - 1]
    for i in range(n):
        left -= M[k - 1, i] * M[k - 1, i]
    return left if left > 0.0 else 0.0


@shared
def solved(M: Array, theta: Array) -> None:
    """theta (n,) from M (n + 1, n + 1) after `cholesky`."""
    n = theta.shape[0]
    for i in range(n - 1, -1, -1):
        total = M[n, i]
        for j in range(i + 1, n):
            total -= M[j, i] * theta[j]
        theta[i] = total / M[i, i] if M[i, i] > 0.0 else 0.0


@shared
def selected(x: Array, k: int) -> float:
    """Value k of x (N,) in ascending order, which the first k + 1 then are: Hoare's selection."""
    low, high = 0, x.shape[0] - 1
    while low < high:
        pivot, i, j = x[(low + high) // 2], low, high
        while i <= j:
            while x[i] < pivot:
                i += 1
            while pivot < x[j]:
                j -= 1
            if i <= j:
                x[i], x[j] = x[j], x[i]
                i, j = i + 1, j - 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return x[k]  # type: ignore[no-any-return]


@shared
def scale_of(x: Array) -> float:
    """`deviation` of sizes x (N,), whose order changes. `numpy.median` takes seconds to compile."""
    N = x.shape[0]
    high = selected(x, 9 * N // 10)
    k = N // 2
    half = selected(x[: 9 * N // 10 + 1], k)
    if N % 2 == 0:
        below = x[0]
        for i in range(1, k):
            below = max(below, x[i])
        half = 0.5 * (below + half)
    scale: float = max(1.4826 * half, LEAST * high)
    return scale


def columns_of(Q: Array, y: Array) -> Array:
    """[Q, y] (n + 1, N + 8) as `huber` reads it: a row for each regressor and one for y, with room for a vector."""
    N, n = Q.shape
    columns = np.zeros((n + 1, N + WIDTH))
    columns[:n, :N], columns[n, :N] = Q.T, y
    return columns


@shared
def moments(columns: Array, first: int, last: int, weight: Array, sums: Array, M: Array) -> None:
    """M = [Q, y]' W Q of the rows first .. last, lower triangle (n + 1, n); weight (1, ..) begins at the first of them.

    sums: scratch ((n + 1) n, 8).
    """
    k, n = columns.shape[0], M.shape[0] - 1
    for i in range(k * n):
        store(sums, i, 0, fill(0.0))
    for t in range(first, last, WIDTH):
        for i in range(k):
            left = times(load(weight, 0, t - first), load(columns, i, t))
            for j in range(min(i + 1, n)):
                store(sums, i * n + j, 0, plus(load(sums, i * n + j, 0), times(left, load(columns, j, t))))
    for i in range(k):
        for j in range(min(i + 1, n)):
            M[i, j] = sum_of(load(sums, i * n + j, 0))


@shared
def ones(weight: Array, N: int) -> None:
    """1 for each of N rows, and 0 for those that fill the last vector."""
    for t in range(N + WIDTH):
        weight[0, t] = 1.0 if t < N else 0.0


@partial(shared, arrays=True)
def huber(columns: Array, first: int, last: int, theta: Array, residual: Array) -> float:
    """Fit y on Q in rows first .. last of `columns_of`: fills theta (n,), residual (1, N + 8), returns the scale.

    If more than nine of ten readings lie on one plane, as the zeros of rare counts do, the scale shrinks from round to
    round, and with it the influence of all other readings: it is 0 then, and theta is not an estimate for them.
    """
    N, n = last - first, theta.shape[0]
    M, step, size = np.zeros((n + 1, n + 1)), np.empty(n), np.empty((1, N + WIDTH))
    weight, sums = np.empty((1, N + WIDTH)), np.empty(((n + 1) * n, WIDTH))
    scale, level, before = 0.0, 0.0, 0.0
    ones(weight, N)
    for i in range(n):
        theta[i] = 0.0
    for t in range(first, last):
        level += columns[n, t] * columns[n, t]
    level = ROUNDING * np.sqrt(level / max(N, 1))
    for round in range(ROUNDS):
        # weighted normal equations, and their solution by Cholesky
        moments(columns, first, last, weight, sums, M)
        cholesky(M, n)
        solved(M, step)
        # residuals, and the largest change of a fitted value
        store(sums, 0, 0, fill(0.0))
        for t in range(0, N, WIDTH):
            fitted, change = fill(0.0), fill(0.0)
            for i in range(n):
                own = load(columns, i, first + t)
                fitted = plus(fitted, times(own, fill(step[i])))
                change = plus(change, times(own, fill(step[i] - theta[i])))
            e = minus(load(columns, n, first + t), fitted)
            store(residual, 0, t, e)
            store(size, 0, t, higher(e, minus(fill(0.0), e)))
            change = only(higher(change, minus(fill(0.0), change)), load(weight, 0, t))
            store(sums, 0, 0, higher(load(sums, 0, 0), change))
        moved = 0.0
        for i in range(WIDTH):
            moved = max(moved, sums[0, i])
        for i in range(n):
            theta[i] = step[i]
        before, scale = scale, scale_of(size[0, :N])
        if (round == ROUNDS - 1 or (round > 0 and not scale > level)) and scale < SHRINKING * before:
            return 0.0
        if not scale > level or (round > 0 and moved < 1e-8 * scale):
            break
        # Huber's weights psi(e) / e for the next round
        for t in range(0, N, WIDTH):
            e = load(residual, 0, t)
            bounded = over(fill(CLIP * scale), higher(e, minus(fill(0.0), e)))
            store(weight, 0, t, only(lower(bounded, fill(1.0)), load(weight, 0, t)))
    return scale


def _fit(columns: Array, theta: Array, residual: Array, scale: Array) -> None:
    scale[0] = huber(columns, 0, columns.shape[1] - WIDTH, theta, residual)


_run = Driver(_fit)


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


def orthonormal(phi: Array) -> Basis:
    """An orthonormal basis of regressors phi (N, n), N > 0."""
    size, root = column_sizes(phi), np.sqrt(len(phi))
    Q, R = np.linalg.qr(phi / size)
    return Basis(np.ascontiguousarray(Q * root), R / root, size)


def robust_fit(phi: Array, y: Array) -> Fit:
    """Constant coefficients with bounded influence of outliers in y; phi (N, n), y (N,)."""
    return fit_in(orthonormal(phi), y)


def sole(Q: Array) -> Array:
    """Which rows of Q (N, n), Q' Q = N I, alone determine a direction: their residuals are 0, whatever y is."""
    return np.asarray(np.einsum("ti,ti->t", Q, Q) > (1.0 - SOLE) * len(Q))


def fit_in(basis: Basis, y: Array) -> Fit:
    """The same in a basis that `orthonormal` made."""
    Q, R, size = basis
    theta, residual, scale = np.zeros(Q.shape[1]), np.empty((1, len(y) + WIDTH)), np.empty(1)
    _run(columns_of(Q, y), theta, residual, scale)
    return clipped(np.linalg.lstsq(R, theta, rcond=ROUNDING)[0] / size, residual[0, : len(y)], float(scale[0]))


def noisy(fit: Fit, phi: Array, y: Array) -> bool:
    """Whether the residuals of a fit of y (N,) on phi (N, n) are more than the rounding of y and of its terms."""
    terms = np.sqrt(np.mean(phi * phi, axis=0)) @ np.abs(fit.theta)
    return bool(fit.scale > ROUNDING * (np.sqrt(np.mean(y * y)) + terms))


def clipped(theta: Array, residual: Array, scale: float) -> Fit:
    """A fit together with its clipped residuals."""
    psi = np.clip(residual, -CLIP * scale, CLIP * scale)
    return Fit(theta, residual, scale, psi, (np.abs(residual) <= CLIP * scale).astype(float))


def inverted(X: Array) -> Array:
    """Pseudo-inverse of the moments X' X of regressors X (N, n), whose units and offsets may be far apart.

    It is computed from X itself: the moments have half of its digits.
    """
    size = column_sizes(X, np.sum)
    root = np.linalg.pinv(X / size, rcond=np.finfo(float).eps * max(X.shape)) / size[:, None]
    return np.asarray(root @ root.T)


def least_squares(X: Array, y: Array) -> Array:
    """theta (n,) of least norm in units of the regressors X (N, n), which may be far apart."""
    size = column_sizes(X)
    return np.asarray(np.linalg.lstsq(X / size, y, rcond=None)[0] / size)


def core(z: Array) -> float:
    """Mean square of z (N,) within three of its robust deviations, 1 for a Gaussian of variance 1; NaN below ten."""
    z = z[np.isfinite(z)]
    if len(z) < 10:
        return float("nan")
    limit = 3.0 * deviation(z)
    return float(np.mean(z[np.abs(z) <= limit] ** 2)) / INSIDE
