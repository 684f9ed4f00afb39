"""Recover properties of the system from a path of coefficients.

    static_curve        y = sum a_i y_{k-i} + sum b_j f(u_{k-j})     g_j(k) = theta_j(k) u_{k-j} = b_j f(u_{k-j})
    rational_constants  y = phi' a / g                               a from theta(k) = a / g_k, g given
    switching_times     constants between switches                   the largest |theta(k) - theta(k-1)|
    exp_autoregression  y = sum (a_i + b_i e^{-r y_{k-d}^2}) y_{k-i}  a, b by least squares for every r, then r

Use the first three on a smoothed path (`run.smooth()`). If the coefficients depend on a variable, smooth along it:
``run.smooth(order_by=u)`` estimates a static curve several times more accurately than smoothing in time. The data
determine only the product b_j f of a curve, and if f(0) is not 0 not even that: then beta = f / u is unbounded at
u = 0.

The constants of an exponential autoregression are fitted to y, never to the path, whose smoothing bias and noise would
end up in r. Cost: one or a few least-squares fits.

Source: the model classes of Chen et al., "augmented flexible least squares for time-varying parameter systems", section
2; variable projection of Golub and Pereyra (1973). Departures: the lag of the exponent is explicit; parameters that
cannot be identified are not returned.

A rational model is estimated without the bias of least squares, numerator and denominator:

    y_k = phi_k' a / g_k + v_k,      g_k = 1 + psi_k' b

with phi and psi functions of the data before y_k. Multiplied by g it is linear in (a, b),

    y_k = x_k' (a, b) + g_k v_k,     x_k = (phi_k, -y_k psi_k)

but x contains y_k and its noise: least squares is biased, however long the record, by

    E x x' - x0 x0' = sigma^2 [[0, 0], [0, psi psi']],      E x y - x0 y0 = -sigma^2 (0, psi)

x0 and y0 without noise. Bias compensation subtracts both. It needs sigma^2, and so an estimate of a and b; alternating
between the two, starting from the biased estimate, fails if the noise is large. `rational_model` therefore minimises
the sum of squares of y - phi' a / g itself, from b = 0, which is consistent and efficient. The compensated estimate
with the resulting sigma^2 is also returned: it is consistent as well, but has a far larger variance. Use it if
a and b are constant; if they drift, or g is not known, track the coefficients a / g with `driftfit.trackers.fls.FLS`.

Source: Billings and Zhu (1991), Int. J. Control 54; section 2.1.2 of Chen et al., "augmented flexible least squares for
time-varying parameter systems", which mentions the compensation without giving it. Cost: O(T n^2) per iteration.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from driftfit.data.arguments import as_inputs, as_output
from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array
from driftfit.engine.settings import whole
from driftfit.run.live.conformal import quantile
from driftfit.smooth.smoothed import Smoothed

COLLINEAR = 0.8
"""Correlation of two regressors above which a path does not separate their effects well."""
RATES = (1e-3, 1e3)
"""Range of r in units of 1 / mean(y^2): below it the exponential is a parabola, above it a spike."""
OFFSET = 5.0
"""Standard errors from 0 at which a warning says that a curve does not pass through the origin."""


class StaticCurve(NamedTuple):
    """A recovered curve: inputs (N,) in ascending order, b f(input) (N,) and its standard deviation (N,)."""

    input: Array
    value: Array
    std: Array


def static_curve(path: Smoothed, regressor: int | str) -> StaticCurve:
    """b f(u) from the coefficient of one regressor that is a lag of an input, given by its number or name.

    Warns if the path cannot represent the curve: neighbouring samples have very different inputs, or residuals are not
    centred near u = 0, as when f(0) is not 0.
    """
    i = _column(path, regressor)
    used = np.flatnonzero(path.walk.weight > 0.0)
    u, value = path.walk.phi[used, i], path.theta[used, i] * path.walk.phi[used, i]
    if path.order_by is None and _roughness(u) > 0.5:
        warnings.warn(
            f"static_curve: {path.names[i]!r} jumps from sample to sample, and its coefficient with it; smooth along "
            "the input: run.smooth(order_by=u).",
            stacklevel=2,
        )
    _warn_if_offset(u, value + path.loo[used])
    order = np.argsort(u, kind="stable")
    return StaticCurve(u[order], value[order], (path.std[used, i] * np.abs(u))[order])


def _column(path: Smoothed, regressor: int | str) -> int:
    if isinstance(regressor, str) and regressor not in path.names:
        raise ValueError(f"there is no regressor {regressor!r}; the model has {', '.join(path.names)}.")
    return path.names.index(regressor) if isinstance(regressor, str) else int(regressor)


def _roughness(u: Array) -> float:
    """Mean square step between neighbours over that of random pairs: 1 for white noise, near 0 for a slow signal."""
    spread = 2.0 * np.var(u)
    return float(np.mean(np.diff(u) ** 2) / spread) if spread > 0.0 and len(u) > 1 else 0.0


def _warn_if_offset(u: Array, partial: Array) -> None:
    """Fit c0 + c1 u + c2 u^2 to the partial residuals at the third of the samples nearest to u = 0; c0 is f(0)."""
    near = np.argsort(np.abs(u))[: len(u) // 3]
    near = near[np.isfinite(partial[near])]
    X = u[near, None] ** np.arange(3)
    if len(near) < 10 or np.linalg.matrix_rank(X) < 3:
        return
    c = np.linalg.lstsq(X, partial[near], rcond=None)[0]
    variance = np.sum((partial[near] - X @ c) ** 2) / (len(near) - 3) * np.linalg.inv(X.T @ X)[0, 0]
    if c[0] ** 2 > OFFSET**2 * variance:
        warnings.warn(
            f"static_curve: near u = 0 the curve seems to pass {c[0]:.2g} instead of 0, and f / u is unbounded there; "
            "add an intercept to the model.",
            stacklevel=3,
        )


class RationalConstants(NamedTuple):
    """Constants of a rational model, (n,) each: from the path, and by least squares of y on phi / g.

    ``correlation`` is the largest between two regressors (about zero): if it is near 1, the path hardly determines the
    split between their coefficients, and you should use the second estimate.
    """

    from_path: Array
    least_squares: Array
    correlation: float


def rational_constants(path: Smoothed, g: Callable[[Array], Any]) -> RationalConstants:
    """a in y = phi' a / g + v, with g a known function of the regressors phi (T, n), which returns (T,).

    g must be a function of phi, which contains the past only: a denominator that contains y_k itself is correlated
    with the noise, and no least squares of this kind is then consistent. ValueError if phi or g contains y_k.
    """
    if not callable(g):
        raise ValueError(
            "rational_constants: g must be a function of the regressors phi (T, n), such as lambda phi: 1 + "
            "phi[:, 1]**2; an array could hold the present output, for which the estimate is inconsistent."
        )
    used = (path.walk.weight > 0.0) & np.any(path.walk.phi != 0.0, axis=1)
    phi, y, theta = path.walk.phi[used], path.walk.y[used], path.theta[used]
    if any(np.array_equal(column, y) for column in phi.T):
        raise ValueError("rational_constants: a regressor is the present output; the estimate would be inconsistent.")
    shape = 1.0 / np.broadcast_to(np.asarray(g(phi), float), y.shape)
    fitted = np.linalg.lstsq(phi * shape[:, None], y, rcond=None)[0]
    unit = phi / np.sqrt(np.sum(phi**2, axis=0))
    correlation = np.abs(unit.T @ unit - np.eye(phi.shape[1])).max()
    if correlation > COLLINEAR:
        warnings.warn(
            f"rational_constants: two regressors have a correlation of {correlation:.3f}; the path determines "
            "the split between their coefficients weakly. Use least_squares.",
            stacklevel=2,
        )
    return RationalConstants(shape @ theta / (shape @ shape), fitted, float(correlation))


def switching_times(path: Smoothed, count: int = 1, apart: int = 10) -> Array:
    """First samples of new modes, (count,) ascending: the largest steps of theta, at least ``apart`` samples apart.

    The step of a parameter is measured by its effect on the output, |step| times the rms of its regressor. Fewer
    samples are returned if the record is too short. Smooth with a tuned tracker: a mu that is too small hides switches
    in noise.
    """
    whole("switching_times", "count", count, 1)
    whole("switching_times", "apart", apart, 1)
    used = path.walk.weight > 0.0
    power = np.sqrt(np.mean(path.walk.phi[used] ** 2, axis=0))
    steps = np.sqrt(np.sum((np.diff(path.theta, axis=0) * power) ** 2, axis=1))
    found: list[int] = []
    for _ in range(count):
        if not len(steps) or not steps.max() > 0.0:
            break
        at = int(np.argmax(steps))
        found.append(at + 1)
        steps[max(0, at - apart + 1) : at + apart] = -1.0
    return np.sort(np.array(found, dtype=int))


class ExpAutoregression(NamedTuple):
    """Constants of an exponential autoregression: a, b (n,), r with its profile interval, noise variance."""

    a: Array
    b: Array
    r: float
    interval: tuple[float, float]
    noise: float

    def theta(self, y: Any, delay: int = 1) -> Array:
        """Coefficients a_i + b_i e^{-r y_{k-d}^2} along a record, (T, n)."""
        past = _lagged(as_output(y), delay)
        return np.asarray(self.a + self.b * np.exp(-self.r * past[:, None] ** 2))


def exp_autoregression(y: Any, n: int, delay: int = 1, level: float = 0.95) -> ExpAutoregression:
    """Fit y_k = sum_{i=1..n} (a_i + b_i e^{-r y_{k-delay}^2}) y_{k-i} + v_k to a record (T,) by variable projection.

    The minimum over r is flat, so the interval of r (at ``level``, from the profile of the likelihood) matters more
    than r; an open end is 0 or inf, with a warning. Samples with missing lags are not used. ValueError if fewer than
    2 n + 2 samples are left.
    """
    lags, square, output = _exp_regressors(as_output(y), whole("exp_autoregression", "n", n, 1), delay)
    project = _projection(lags, square, output)
    low, high = (float(np.log(rate / np.mean(square))) for rate in RATES)
    grid = np.linspace(low, high, 81)
    at = int(np.argmin([project(x)[0] for x in grid]))
    bracket = (grid[max(at - 1, 0)], grid[min(at + 1, 80)])
    from scipy import optimize  # a tenth of a second to import

    best = float(optimize.minimize_scalar(lambda x: project(x)[0], bounds=bracket, method="bounded").x)
    cost, constants = project(best)
    limit = cost * float(np.exp(quantile(level, "exp_autoregression") ** 2 / len(output)))
    ends = _profile_end(project, best, low, limit, -np.inf), _profile_end(project, best, high, limit, np.inf)
    if not np.isfinite(ends).all():
        warnings.warn(
            "exp_autoregression: the record does not bound r on both sides; a and b are only known together with it.",
            stacklevel=2,
        )
    interval = (float(np.exp(ends[0])), float(np.exp(ends[1])))
    noise = cost / (len(output) - 2 * n - 1)
    return ExpAutoregression(constants[:n], constants[n:], float(np.exp(best)), interval, noise)


def _exp_regressors(y: Array, n: int, delay: int) -> tuple[Array, Array, Array]:
    """Lags (N, n), squares in the exponent (N,) and outputs (N,) of the samples that have them all."""
    whole("exp_autoregression", "delay", delay, 1)
    lags = np.stack([_lagged(y, i) for i in range(1, n + 1)], axis=1)
    square = _lagged(y, delay) ** 2
    used = np.isfinite(y) & np.isfinite(lags).all(axis=1) & np.isfinite(square)
    if used.sum() < 2 * n + 2 or not np.any(square[used] > 0.0):
        raise ValueError(
            f"exp_autoregression: {2 * n + 1} constants need at least {2 * n + 2} usable samples that are not all "
            f"zero; there are {used.sum()}."
        )
    return lags[used], square[used], y[used]


def _lagged(y: Array, lag: int) -> Array:
    """y delayed by ``lag`` samples; NaN before the first sample."""
    moved = np.full(len(y), np.nan)
    moved[lag:] = y[: len(y) - lag]
    return moved


def _projection(lags: Array, square: Array, y: Array) -> Callable[[float], tuple[float, Array]]:
    """log r -> (sum of squares, constants): least squares in a and b for that r."""

    def project(x: float) -> tuple[float, Array]:
        X = np.concatenate([lags, lags * np.exp(-np.exp(x) * square)[:, None]], axis=1)
        constants = np.linalg.lstsq(X, y, rcond=None)[0]
        return float(np.sum((y - X @ constants) ** 2)), constants

    return project


def _profile_end(
    project: Callable[[float], tuple[float, Array]], x: float, end: float, limit: float, nowhere: float
) -> float:
    """Where the cost first reaches a limit between x and an end of the range; ``nowhere`` if it does not."""
    from scipy import optimize

    for inner, outer in pairwise(np.linspace(x, end, 81)):
        if project(outer)[0] > limit:
            return float(optimize.brentq(lambda value: project(value)[0] - limit, inner, outer))
    return nowhere


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
        return np.asarray(output - top @ theta[:n] / (1.0 + below @ theta[n:]))

    def slope(theta: Array) -> Array:
        g = 1.0 + below @ theta[n:]
        return np.column_stack([-top / g[:, None], (top @ theta[:n] / g**2)[:, None] * below])

    from scipy import optimize

    fitted = optimize.least_squares(residual, start, slope, x_scale="jac")
    variance = 2.0 * fitted.cost / (len(output) - n - m)
    std = np.sqrt(variance * np.diag(np.linalg.pinv(fitted.jac.T @ fitted.jac)))
    bias = np.zeros((n + m, n + m))
    bias[n:, n:] = variance * below.T @ below
    right = x.T @ output + np.r_[np.zeros(n), variance * below.sum(axis=0)]
    compensated = np.linalg.lstsq(x.T @ x - bias, right, rcond=None)[0]
    return Rational(fitted.x[:n], fitted.x[n:], std, float(np.sqrt(variance)), compensated, plain)
