"""Constant Hammerstein-Wiener systems from a whole noisy record: least squares, instruments, the unbiased basis.

    theta_0  = argmin sum (z_t - phi_t' theta)^2                     biased: phi contains the noisy y
    y_s      = the output simulated with the estimate, from the inputs alone
    theta    = (sum phi_s,t phi_t' / R_t)^-1 sum phi_s,t z_t / R_t   phi_s from y_s, repeatedly
    R_t      = sum_i a_i^2 F'(y_s,t-i)^2,  a_0 = 1                   variance that white noise on y adds to the equation

The simulated regressors are independent of the noise of the record, so white noise on y no longer biases the part that
is linear in y. Weighting by R_t leaves a third of the error of equal weights. Powers of y remain biased, because
E y^2 = y0^2 + sigma^2; if sigma is known, and the noise is Gaussian, the expectations of Hermite polynomials of y are
the powers of the noise-free output,

    h_1 = y,  h_2 = y^2 - sigma^2,  h_3 = y^3 - 3 sigma^2 y,  h_(k+1) = y h_k - k sigma^2 h_(k-1)

Use it if nothing drifts; otherwise use `OutputError`. Source of instruments by simulation: Young, Recursive
Estimation and Time-Series Analysis (2011), chapter 7. Cost: O(T n^2) per iteration.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from driftfit.data.arguments import as_inputs, as_output
from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array
from driftfit.engine.settings import numbers, whole
from driftfit.models.hammerstein_wiener.basis import Polynomial
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.separation import Groups, minimal, split

POINTS = 2000
"""Points of the grid on which the output block is inverted."""


class Constant(NamedTuple):
    """theta (n,) and its blocks a, b, c, d; xi (n_x,); and ``y`` (T,), the output simulated with it, where
    the output block has the ``slope`` (T,).
    """

    theta: Array
    a: Array
    b: Array
    c: Array
    d: Array
    xi: Array
    y: Array
    slope: Array


def fit_constant(model: HammersteinWiener, y: Any, u: Any, *, rounds: int = 5, sigma: float | None = None) -> Constant:
    """Fit a system whose parameters are constant.

    Parameters
    ----------
    model : HammersteinWiener
        A model without a dead zone.
    y, u : (T,)
        A record; samples that need a missing value are left out.
    rounds : int
        Iterations with instruments; 0 is least squares.
    sigma : number or None
        Standard deviation of Gaussian noise on y, for the unbiased basis; the output must be a `Polynomial` or None.

    Raises
    ------
    ValueError
        For another model, fewer usable samples than parameters, or sigma with another basis.
    """
    if not isinstance(model, HammersteinWiener) or model.into.adaptive:
        raise ValueError(f"fit_constant: needs a HammersteinWiener model without a dead zone; got {model!r}.")
    whole("fit_constant", "rounds", rounds, 0)
    output = as_output(y)
    drive = as_inputs(u, len(output))[:, 0]
    g = model.out.value(output) if sigma is None else unbiased(model, output, sigma)
    f = model.into.value(drive)
    phi, z = regression(model, f, g)
    used = (np.abs(phi) < LARGEST).all(axis=1) & (np.abs(z) < LARGEST)
    if used.sum() < model.n:
        raise ValueError(f"fit_constant: {int(used.sum())} usable samples cannot determine {model.n} products.")
    found = _separated(model, np.linalg.lstsq(phi[used], z[used], rcond=None)[0], f, output)
    for _ in range(rounds):
        instruments = regression(model, f, model.out.value(found.y))[0]
        both = used & np.isfinite(instruments).all(axis=1)
        Z = instruments[both] / noise_of_equation(found)[both, None]
        found = _separated(model, np.linalg.lstsq(Z.T @ phi[both], Z.T @ z[both], rcond=None)[0], f, output)
    return found


def unbiased(model: HammersteinWiener, y: Array, sigma: float) -> Array:
    """Functions (T, n_out) of a noisy output whose expectations are the powers of the noise-free one."""
    if not isinstance(model.out, Polynomial):
        raise ValueError(f"fit_constant: sigma needs raw powers in the output block; got {model.out!r}.")
    variance = numbers("fit_constant", "sigma", sigma, ndim=0, low=0.0, strict=True) ** 2
    powers = [np.ones(len(y)), y]
    for k in range(1, model.out.n):
        powers.append(y * powers[k] - k * variance * powers[k - 1])
    return np.stack(powers[1:], axis=1)


def regression(model: HammersteinWiener, f: Array, g: Array) -> tuple[Array, Array]:
    """phi (T, n) and z (T,) from functions of inputs (T, n_in) and outputs (T, n_out); NaN before the record."""
    past = [_late(g, i) for i in range(1, model.na + 1)]
    drive = [-_late(f, model.nk + j) for j in range(model.nb)]
    columns = [row[:, 0] for row in (*past, *drive)] + list(g[:, 1:].T)
    columns += [row[:, k] for k in range(1, f.shape[1]) for row in drive]
    columns += [row[:, k] for k in range(1, g.shape[1]) for row in past]
    return np.stack(columns + ([np.ones(len(g))] if model.intercept else []), axis=1), -g[:, 0]


def noise_of_equation(fit: Constant) -> Array:
    """R_t (T,) plus a hundredth of its mean, so that flat parts of the output block do not get all the weight."""
    squares = fit.slope**2
    total = sum(a**2 * np.concatenate([squares[:i], squares[: len(squares) - i]]) for i, a in enumerate((1.0, *fit.a)))
    return np.asarray(total + 0.01 * np.mean(total))


def _late(x: Array, k: int) -> Array:
    return np.concatenate([np.full((k, x.shape[1]), np.nan), x[: max(len(x) - k, 0)]])[: len(x)]


def _separated(model: HammersteinWiener, theta: Array, f: Array, y: Array) -> Constant:
    """The blocks of products, and the output that they produce from the inputs."""
    a, b, c, d = (part[0] for part in split(model, theta[None], "svd-joint")[:4])
    rest = theta[-1:] if model.intercept else None
    v = np.nan_to_num(f @ c)
    from scipy.signal import lfilter  # half a second to import

    w = lfilter(np.concatenate([np.zeros(model.nk), b]), np.concatenate([[1.0], a]), v)
    w = w - (0.0 if rest is None else float(rest[0]) / (1.0 + a.sum()))
    outputs = y[np.abs(y) < LARGEST]
    grid = np.linspace(outputs.min(), outputs.max(), POINTS)
    level = np.maximum.accumulate(model.out.value(grid) @ d)
    xi = minimal(model, Groups(a, b, c, d), rest[0] if rest is not None else None)
    simulated = np.interp(w, level, grid)
    return Constant(theta, a, b, c, d, xi, simulated, np.interp(simulated, grid, np.gradient(level, grid)))
