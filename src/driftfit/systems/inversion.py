"""Invert a static block: find y with sum_k d_k g_k(y) = w, for all samples at once.

Newton's method within a bracket. If the block does not increase within the bracket, or does not reach a level, an error
is raised; one of several roots is never returned silently.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.models.hammerstein_wiener.basis import Basis, Polynomial

LIMIT = 1e3
"""Outputs beyond which the inversion gives up."""
GRID = 200
"""Points at which the slope of a block that is not a polynomial is evaluated."""


class NotMonotoneError(ValueError):
    """The output block does not increase where it is used, or does not reach a level."""


def invert(basis: Basis, d: Array, w: Any, limit: float = LIMIT, first: int = 0) -> Array:
    """y (T,) with sum_k d_k g_k(y) = w, for d (T, n) and w (T,).

    From [-1, 1], or the range of the basis, each end moves out by the present width until the levels enclose w. Then
    Newton steps follow; a step that leaves the bracket is replaced by bisection.

    Raises
    ------
    NotMonotoneError
        Names the first sample (counted from ``first``) at which the block does not increase within the bracket, or
        does not reach w within ``limit``.
    """
    d, w = np.asarray(d, dtype=float), np.asarray(w, dtype=float)
    low, high = _bracket(basis, d, w, limit, first)
    _check_rising(basis, d, low, high, first)
    y = 0.5 * (low + high)
    for _ in range(200):
        off = np.sum(d * basis.value(y), axis=1) - w
        low, high = np.where(off <= 0.0, y, low), np.where(off >= 0.0, y, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = y - off / np.sum(d * basis.derivative(y), axis=1)
        inside = (step >= low) & (step <= high)
        after = np.where(inside, step, 0.5 * (low + high))
        done = np.abs(after - y) <= 1e-14 * np.maximum(1.0, np.abs(y))
        y = after
        if done.all():
            break
    return y


def _bracket(basis: Basis, d: Array, w: Array, limit: float, first: int) -> tuple[Array, Array]:
    start = basis.expected if np.isfinite(basis.expected).all() else (-1.0, 1.0)
    low, high = (np.full(len(w), end) for end in start)
    bottom, top = np.maximum(basis.limits, -limit)[0], np.minimum(basis.limits, limit)[1]
    while True:
        with np.errstate(invalid="ignore", over="ignore"):
            below = np.sum(d * basis.value(low), axis=1) > w
            above = np.sum(d * basis.value(high), axis=1) < w
        lost = (below & (low <= bottom)) | (above & (high >= top)) | ~np.isfinite(w)
        if lost.any():
            t = int(np.argmax(lost))
            raise NotMonotoneError(
                f"sample {first + t}: the output block does not reach w = {w[t]:g} for any y within "
                f"({bottom:g}, {top:g})."
            )
        if not (below | above).any():
            return low, high
        width = high - low
        low = np.where(below, np.maximum(low - width, bottom), low)
        high = np.where(above, np.minimum(high + width, top), high)


def _check_rising(basis: Basis, d: Array, low: Array, high: Array, first: int) -> None:
    points = _suspects(basis, d, low, high)
    slopes = np.einsum("tgk,tk->tg", basis.derivative(points), d)
    bad = ~(slopes > 0.0)
    if bad.any():
        t = int(np.argmax(bad.any(axis=1)))
        where = points[t, bad[t]]
        raise NotMonotoneError(
            f"sample {first + t}: the output block does not increase between y = {where.min():g} and {where.max():g} "
            f"(d = {np.array2string(d[t], precision=4)}), so y cannot be recovered from w."
        )


def _suspects(basis: Basis, d: Array, low: Array, high: Array) -> Array:
    """Points (T, g) in the brackets; if the slope is 0 or less anywhere, it is so at one of them."""
    middle = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, 3 if isinstance(basis, Polynomial) else GRID)
    if not isinstance(basis, Polynomial) or basis.degree < 2:
        return middle
    k = basis.degree - 1  # the slope of a polynomial changes sign at its roots: test between them, and at the extrema
    roots = [np.roots((np.arange(1, k + 2) * row)[::-1]) for row in d] if k > 2 else _roots(d)
    found = np.full((len(d), 3 * k), np.nan)
    for t, row in enumerate(roots):
        real = np.sort(row.real[np.abs(row.imag) <= 1e-9 * np.maximum(1.0, np.abs(row))])
        ends = np.concatenate([real, 0.5 * (real[1:] + real[:-1])])[: 3 * k]
        found[t, : len(ends)] = ends
    inside = (found >= low[:, None]) & (found <= high[:, None])
    return np.concatenate([middle, np.where(inside, found, middle[:, :1])], axis=1)


def _roots(d: Array) -> Array:
    """Roots (T, 2) of 1 + 2 d_2 y + 3 d_3 y^2."""
    full = np.concatenate([d, np.zeros((len(d), 3 - d.shape[1]))], axis=1).astype(complex)
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.sqrt(full[:, 1] ** 2 - 3.0 * full[:, 2])
        both = np.stack([-full[:, 1] - spread, -full[:, 1] + spread], axis=1) / (3.0 * full[:, 2:3])
        single = -0.5 / full[:, 1:2]
    roots: Array = np.where(full[:, 2:3] == 0.0, single, both)
    return np.where(np.isfinite(roots), roots, 1j)
