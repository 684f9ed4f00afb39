"""Rational models: estimate numerator and denominator without the bias of least squares.

    y_k = phi_k' a / g_k + v_k,      g_k = 1 + psi_k' b

with phi and psi functions of the data before y_k. Multiplied by g it is linear in (a, b),

    y_k = x_k' (a, b) + g_k v_k,     x_k = (phi_k, -y_k psi_k)

but x contains y_k and its noise: least squares is biased, however long the record, by

    E x x' - x0 x0' = sigma^2 [[0, 0], [0, psi psi']],      E x y - x0 y0 = -sigma^2 (0, psi)

x0 and y0 without noise. Bias compensation subtracts both. It needs sigma^2, and so an estimate of a and b; alternating
between the two, starting from the biased estimate, fails if the noise is large. `rational_model` therefore minimises
the sum of squares of y - phi' a / g itself, from b = 0, which is consistent and efficient. The compensated estimate
with the resulting sigma^2 is also returned: it is consistent as well, but has a far larger variance. Use this module if
a and b are constant; if they drift, or g is not known, track the coefficients a / g with `driftfit.trackers.fls.FLS`.

Source: Billings and Zhu (1991), Int. J. Control 54; section 2.1.2 of Chen et al., "augmented flexible least squares for
time-varying parameter systems", which mentions the compensation without giving it. Cost: O(T n^2) per iteration.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from driftfit.data.arguments import as_inputs, as_output
from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array


class Rational(NamedTuple):
    """Numerator a (n,) and denominator b (m,) of a rational model."""

    a: Array
    b: Array
    std: Array
    """(n + m,): standard deviations of a and b, to first order."""
    sigma: float
    """Standard deviation of v."""
    compensated: Array
    """(n + m,): a and b by bias compensation with that sigma."""
    least_squares: Array
    """(n + m,): a and b by plain least squares, which is biased."""


def rational_model(y: Any, phi: Any, psi: Any) -> Rational:
    """Fit y = phi' a / (1 + psi' b) + v.

    Parameters
    ----------
    y : (T,)
        Samples with a missing value, in y or a regressor, are left out.
    phi, psi : (T, n), (T, m)
        Regressors of the numerator and of the denominator; they may contain past outputs, but not the present one.

    Raises
    ------
    ValueError
        For shapes that do not fit, regressors that contain y itself, or fewer usable samples than parameters.
    """
    output = as_output(y)
    top, below = as_inputs(phi, len(output)), as_inputs(psi, len(output))
    used = np.abs(np.column_stack([output, top, below])).max(axis=1) < LARGEST
    output, top, below = output[used], top[used], below[used]
    n, m = top.shape[1], below.shape[1]
    if len(output) <= n + m:
        raise ValueError(f"rational_model: {len(output)} usable samples cannot determine {n + m} parameters.")
    for name, columns in (("phi", top), ("psi", below)):
        if (columns == output[:, None]).all(axis=0).any():
            raise ValueError(f"rational_model: a column of {name} is y itself, whose noise is not independent of y.")
    x = np.column_stack([top, -output[:, None] * below])
    plain = np.linalg.lstsq(x, output, rcond=None)[0]
    start = np.r_[np.linalg.lstsq(top, output, rcond=None)[0], np.zeros(m)]

    def residual(theta: Array) -> Array:
        found: Array = output - top @ theta[:n] / (1.0 + below @ theta[n:])
        return found

    def slope(theta: Array) -> Array:
        g = 1.0 + below @ theta[n:]
        return np.column_stack([-top / g[:, None], (top @ theta[:n] / g**2)[:, None] * below])

    from scipy import optimize  # a tenth of a second to import

    fitted = optimize.least_squares(residual, start, slope, x_scale="jac")
    variance = 2.0 * fitted.cost / (len(output) - n - m)
    std = np.sqrt(variance * np.diag(np.linalg.pinv(fitted.jac.T @ fitted.jac)))
    bias = np.zeros((n + m, n + m))
    bias[n:, n:] = variance * below.T @ below
    right = x.T @ output + np.r_[np.zeros(n), variance * below.sum(axis=0)]
    compensated = np.linalg.lstsq(x.T @ x - bias, right, rcond=None)[0]
    return Rational(fitted.x[:n], fitted.x[n:], std, float(np.sqrt(variance)), compensated, plain)
