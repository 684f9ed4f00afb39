"""The changing variances of the residuals of records, eight records side by side in SIMD vectors.

    h_(t+1) = 1 - alpha - beta + (alpha g_t^2 / v + beta) h_t,   g_t = x_t / sqrt(h_t) clipped at +-clip

with the model, `Frozen.numbers`, of each record. A matrix (rows, 8) has a column for each record.
Source: Bollerslev (1986).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, Driver, kernel
from driftfit.engine.simd import WIDTH, fill, higher, load, log_of, lower, minus, over, plus, root, store, times
from driftfit.run.live.reference_model import ALPHA, BETA, CLIP, INSIDE, V


@kernel
def _next(level: Any, g: Any, numbers: Array) -> Any:
    """h of the next sample."""
    clip, alpha, beta = load(numbers, CLIP, 0), load(numbers, ALPHA, 0), load(numbers, BETA, 0)
    g = lower(higher(g, minus(fill(0.0), clip)), clip)
    fed = plus(over(times(times(alpha, g), g), load(numbers, V, 0)), beta)
    return plus(minus(minus(fill(1.0), alpha), beta), times(fed, level))


@Driver
def _of_residuals(x: Array, numbers: Array, h: Array) -> None:
    """h (T, 8) of residuals x (T, 8) in units of their scale; numbers (k, 8)."""
    level = fill(1.0)
    for t in range(x.shape[0]):
        store(h, t, 0, level)
        level = _next(level, over(load(x, t, 0), root(level)), numbers)


@Driver
def _of_scores(x: Array, numbers: Array, w: Array) -> None:
    """Residuals w (T, 8) whose standardised values are x (T, 8): the inverse of `_of_residuals`."""
    level = fill(1.0)
    for t in range(x.shape[0]):
        store(w, t, 0, times(load(x, t, 0), root(level)))
        level = _next(level, load(x, t, 0), numbers)


def variances(x: Array, numbers: Array) -> Array:
    """The variances h (R, T) of residuals x (R, T) in units of their scale, by the models ``numbers`` (R, k)."""
    return _by_eights(_of_residuals, x, numbers)


def residuals(x: Array, numbers: Array) -> Array:
    """Residuals (R, T) in units of their scale whose standardised values are x (R, T)."""
    return _by_eights(_of_scores, x, numbers)


def _by_eights(driver: Callable[..., None], x: Array, numbers: Array) -> Array:
    (R, T), made = x.shape, np.empty(x.shape)
    for first in range(0, R, WIDTH):
        lanes = np.minimum(np.arange(first, first + WIDTH), R - 1)  # the last record fills the vector
        out = np.empty((T, WIDTH))
        driver(np.ascontiguousarray(x[lanes].T), np.ascontiguousarray(numbers[lanes].T), out)
        made[first : first + WIDTH] = out.T[: R - first]
    return made


@Driver
def losses(x: Array, numbers: Array, weights: Array, level: Array, total: Array) -> None:
    """sum log h + g^2 / inside of residuals x (R, T) for candidates of the GARCH part, side by side, into total (R, C).

    ``weights`` (2, C) are their alpha and beta, ``total`` is 0 before, ``level`` (1, C) is scratch; 8 divides C. With
    this factor h = 1 is the best constant for every distribution of x.
    """
    for r in range(x.shape[0]):
        clip, v, inside = numbers[r, CLIP], numbers[r, V], numbers[r, INSIDE]
        for c in range(0, total.shape[1], WIDTH):
            store(level, 0, c, fill(1.0))
        for t in range(x.shape[1]):
            own = fill(x[r, t])
            for c in range(0, total.shape[1], WIDTH):
                h, alpha, beta = load(level, 0, c), load(weights, 0, c), load(weights, 1, c)
                g = over(own, root(h))
                g = lower(higher(g, fill(-clip)), fill(clip))
                square = times(g, g)
                gain = plus(log_of(h), over(square, fill(inside)))
                store(total, r, c, plus(load(total, r, c), gain))
                fed = plus(over(times(alpha, square), fill(v)), beta)
                store(level, 0, c, plus(minus(minus(fill(1.0), alpha), beta), times(fed, h)))
