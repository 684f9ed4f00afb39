"""Least squares with bounded influence of outliers in y, compiled.

    theta solves sum phi_t psi(e_t) = 0,    e_t = y_t - phi_t' theta,    psi(e) = e clipped at 1.5 scales of the noise

solved by iteratively reweighted least squares. The scale is 1.4826 times the median of the absolute residuals. Normal
equations are solved in an orthonormal basis of the regressors, so that their conditioning is that of the variation
within the record; a direction that a part of the record does not excite stays at zero there. Source: Huber (1964).
Cost: O(N n^2) per iteration, usually ten.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver, shared

CLIP = 1.5
ROUNDS = 30
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
    half = selected(x, k)
    if N % 2 == 0:
        below = x[0]
        for i in range(1, k):
            below = max(below, x[i])
        half = 0.5 * (below + half)
    scale: float = max(1.4826 * half, LEAST * high)
    return scale


@shared
def huber(Q: Array, y: Array, theta: Array, residual: Array) -> float:
    """Fit y (N,) on Q (N, n): fills theta (n,) and residual (N,), returns the scale."""
    N, n = Q.shape
    M, step, weight, size = np.empty((n + 1, n + 1)), np.empty(n), np.empty(N), np.empty(N)
    scale, level = 0.0, 0.0
    for i in range(n):
        theta[i] = 0.0
    for t in range(N):
        weight[t] = 1.0
        level += y[t] * y[t]
    level = 1e-12 * np.sqrt(level / max(N, 1))
    for round in range(ROUNDS):
        # weighted normal equations, and their solution by Cholesky
        for i in range(n + 1):
            for j in range(n + 1):
                M[i, j] = 0.0
        for t in range(N):
            w = weight[t]
            for i in range(n):
                for j in range(i + 1):
                    M[i, j] += w * Q[t, i] * Q[t, j]
                M[n, i] += w * Q[t, i] * y[t]
        cholesky(M, n)
        solved(M, step)
        # residuals, and the largest change of a fitted value
        moved = 0.0
        for t in range(N):
            fitted, change = 0.0, 0.0
            for i in range(n):
                fitted += Q[t, i] * step[i]
                change += Q[t, i] * (step[i] - theta[i])
            residual[t] = y[t] - fitted
            size[t] = abs(residual[t])
            moved = max(moved, abs(change))
        for i in range(n):
            theta[i] = step[i]
        scale = scale_of(size)
        if not scale > level or (round > 0 and moved < 1e-8 * scale):
            break
        # Huber's weights psi(e) / e for the next round
        for t in range(N):
            large = abs(residual[t])
            weight[t] = CLIP * scale / large if large > CLIP * scale else 1.0
    return scale


def _fit(Q: Array, y: Array, theta: Array, residual: Array, scale: Array) -> None:
    scale[0] = huber(Q, y, theta, residual)


_run = Driver(_fit)


def orthonormal(phi: Array) -> tuple[Array, Array]:
    """(Q, R): phi (N, n) = Q R, Q' Q = N I, for linearly independent columns."""
    Q, R = np.linalg.qr(phi)
    root = np.sqrt(len(phi))
    return np.ascontiguousarray(Q * root), R / root


def robust_fit(phi: Array, y: Array) -> Fit:
    """Constant coefficients with bounded influence of outliers in y; phi (N, n), y (N,)."""
    size = np.sqrt(np.mean(phi * phi, axis=0))
    size[size == 0.0] = 1.0  # an idle column, whose parameter is 0
    Q, R = orthonormal(phi / size)
    theta, residual, scale = np.zeros(phi.shape[1]), np.empty(len(y)), np.empty(1)
    _run(Q, np.ascontiguousarray(y), theta, residual, scale)
    return clipped(np.linalg.lstsq(R, theta, rcond=1e-12)[0] / size, residual, float(scale[0]))


def clipped(theta: Array, residual: Array, scale: float) -> Fit:
    """A fit together with its clipped residuals."""
    psi = np.clip(residual, -CLIP * scale, CLIP * scale)
    return Fit(theta, residual, scale, psi, (np.abs(residual) <= CLIP * scale).astype(float))


def core(z: Array) -> float:
    """Mean square of z (N,) within three of its robust deviations, 1 for a Gaussian of variance 1; NaN below ten."""
    z = z[np.isfinite(z)]
    if len(z) < 10:
        return float("nan")
    limit = 3.0 * deviation(z)
    return float(np.mean(z[np.abs(z) <= limit] ** 2)) / INSIDE
