"""The delta method: standard deviations of functions of the parameters.

    Cov f(theta) = J Cov(theta) J',     J = df / dtheta by central differences

Steps are a hundredth of a standard deviation, so the slope is that in the region of likely theta. If f is nonlinear
within a standard deviation (a gain whose denominator is near zero), the result is only a first-order approximation.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from driftfit.engine.kernel import Array

STEP = 0.01


def jacobian(f: Callable[[Array], Array], theta: Array, std: Array) -> Array:
    """Slopes (T, .., n) of f at theta (T, n); f maps (T, n) to (T, ..)."""
    size = np.where(np.isfinite(std) & (std > 0.0), STEP * std, 1e-6 * np.maximum(np.abs(theta), 1e-3))
    slopes = []
    for i in range(theta.shape[1]):
        h = np.zeros_like(theta)
        h[:, i] = size[:, i]
        up, down = f(theta + h), f(theta - h)
        slopes.append((up - down) / (2.0 * size[:, i]).reshape(-1, *(1,) * (up.ndim - 1)))
    return np.stack(slopes, axis=-1)


def spread(f: Callable[[Array], Array], theta: Array, cov: Array) -> tuple[Array, Array]:
    """(f, its standard deviation), each (T, ..), at theta (T, n) with covariance (T, n, n); NaN without one."""
    var = np.einsum("tii->ti", cov)
    J = jacobian(f, theta, np.sqrt(np.abs(var)))
    with np.errstate(invalid="ignore"):
        square = np.einsum("t...i,tij,t...j->t...", J, cov, J)
        return f(theta), np.sqrt(square)
