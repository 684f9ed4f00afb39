"""Simulated systems of the flexible least squares literature, with the true path of every coefficient.

    sinusoids     y_k = sin(2 pi k / 15) u1_k + cos(pi k / 15) u2_k + v_k              regression
    rational      y_k = (a1 y_{k-1} + a2 u_{k-1}) / g(u_{k-1}) + v_k                     theta = a / g
    switching     y_k = a(k) y_{k-1} + b(k) u_{k-1} + v_k, constants between switches    theta = (a, b)
    exp_ar        y_k = sum_i (a_i + b_i exp(-r y_{k-d}^2)) y_{k-i} + v_k                theta_i = a_i + b_i exp(..)
    hammerstein   y_k = sum_i a_i y_{k-i} + sum_j b_j f(u_{k-j}) + v_k                   theta = (a_i, b_j f(u) / u)

v_k is white and Gaussian with standard deviation ``std``; everything before the first sample is zero. The defaults are
the four examples of Chen et al., "augmented flexible least squares for time-varying parameter systems", section 6,
whose noise N(0, v) is read as a variance. `example(name, s)` generates them with the seeds of our reproduction.

Departures: the paper does not give the start of the autoregression (zero here), and its definition of the exponential
autoregression is ambiguous about the lag in the exponent (`delay` here).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import one_of
from driftfit.models.arx import ARX
from driftfit.models.base import Model
from driftfit.models.regression import Regression


class Simulated(NamedTuple):
    """A record and its truth: model, y (T,), u (T, m) or None, phi (T, n), theta (T, n); y = phi' theta + noise."""

    model: Model
    y: Array
    u: Array | None
    phi: Array
    theta: Array


def sinusoids(T: int = 30, std: float = 0.1, *, rng: np.random.Generator) -> Simulated:
    """Example 1: two regressors of constant length, coefficients with periods of 15 and 30 samples."""
    k = np.arange(1, T + 1)
    phi = np.stack([np.sin(10 + k) + 0.01, np.cos(10 + k)], axis=1)
    theta = np.stack([np.sin(2 * np.pi * k / 15), np.cos(np.pi * k / 15)], axis=1)
    y = np.sum(phi * theta, axis=1) + rng.normal(0.0, std, T)
    return Simulated(Regression(2), y, phi, phi, theta)


def slow_sine(T: int) -> Array:
    """The input of the rational example, sin(pi k / 30)."""
    return np.asarray(np.sin(np.pi * np.arange(1, T + 1) / 30))


def rational(
    T: int = 50,
    std: float = 0.2,
    *,
    rng: np.random.Generator,
    a: tuple[float, float] = (0.3, 0.7),
    g: Callable[[Any], Any] = lambda u: 1.0 + u * u,
    u: Array | None = None,
) -> Simulated:
    """Example 2: a ratio of polynomials, regarded as a linear system with varying coefficients."""
    u = slow_sine(T) if u is None else np.asarray(u, dtype=float)
    noise = rng.normal(0.0, std, len(u))
    past = np.concatenate([[0.0], u[:-1]])
    theta = np.array(a) / np.reshape(g(past), (-1, 1))
    return _autoregression(ARX(1, 1, start="zero"), theta, u[:, None], noise)


def switching(
    T: int = 200,
    std: float = 0.2,
    *,
    rng: np.random.Generator,
    modes: Sequence[tuple[float, float]] = ((0.3, 0.7), (0.8, 1.0)),
    at: Sequence[int] = (100,),
) -> Simulated:
    """Example 3: white input; mode i + 1 is active from sample ``at[i]`` (counted from 0) on."""
    u = rng.normal(0.0, 1.0, T)
    mode = np.searchsorted(np.asarray(at), np.arange(T), side="right")
    return _autoregression(ARX(1, 1, start="zero"), np.array(modes)[mode], u[:, None], rng.normal(0.0, std, T))


def exp_ar(
    T: int = 100,
    std: float = 0.1,
    *,
    rng: np.random.Generator,
    a: Sequence[float] = (1.95, -0.96),
    b: Sequence[float] = (0.23, -0.24),
    r: float = 1.0,
    delay: int = 1,
) -> Simulated:
    """Example 4: an autoregression whose coefficients depend on the size of the output."""
    base, swing = np.array(a, dtype=float), np.array(b, dtype=float)
    n = len(base)
    y = np.zeros(T + max(n, delay))  # the zero past comes first
    start = len(y) - T
    theta, phi = np.empty((T, n)), np.empty((T, n))
    noise = rng.normal(0.0, std, T)
    for k in range(T):
        t = start + k
        phi[k] = y[t - n : t][::-1]
        theta[k] = base + swing * np.exp(-r * y[t - delay] ** 2)
        y[t] = phi[k] @ theta[k] + noise[k]
    return Simulated(ARX(n, 0, start="zero"), y[start:], None, phi, theta)


def hammerstein(
    u: Array,
    f: Callable[[Array], Array],
    std: float = 0.05,
    *,
    rng: np.random.Generator,
    a: Sequence[float] = (0.5,),
    b: Sequence[float] = (1.0,),
) -> Simulated:
    """A static curve before a linear system; theta of the input is b f(u) / u, infinite where u is 0 but f is not."""
    u = np.asarray(u, dtype=float)
    T = len(u)
    past = np.stack([np.concatenate([np.zeros(j), u[: T - j]]) for j in range(1, len(b) + 1)], axis=1)
    drive = np.where(np.arange(T)[:, None] >= np.arange(1, len(b) + 1), f(past), 0.0) * np.array(b)
    y = np.zeros(T)
    noise = rng.normal(0.0, std, T)
    for k in range(T):
        y[k] = sum(c * y[k - i - 1] for i, c in enumerate(a) if k > i) + drive[k].sum() + noise[k]
    with np.errstate(divide="ignore", invalid="ignore"):
        beta = np.where(drive == 0.0, 0.0, drive / past)
    lags = np.stack([np.concatenate([np.zeros(i), y[: T - i]]) for i in range(1, len(a) + 1)], axis=1)
    theta = np.concatenate([np.broadcast_to(np.array(a), (T, len(a))), beta], axis=1)
    return Simulated(ARX(len(a), len(b), start="zero"), y, u[:, None], np.concatenate([lags, past], axis=1), theta)


def _autoregression(model: Model, theta: Array, u: Array, noise: Array) -> Simulated:
    """y_k = theta_k1 y_{k-1} + theta_k2 u_{k-1} + v_k from a zero past."""
    T = len(u)
    y, phi = np.zeros(T), np.zeros((T, 2))
    for k in range(T):
        if k:
            phi[k] = y[k - 1], u[k - 1, 0]
        y[k] = phi[k] @ theta[k] + noise[k]
    return Simulated(model, y, u, phi, theta)


EXAMPLES: dict[str, Callable[..., Simulated]] = {
    "sinusoids": sinusoids, "rational": rational, "switching": switching, "exp-ar": exp_ar,
}  # fmt: skip
MU = {"sinusoids": 1.0, "rational": 0.5, "switching": 0.1, "exp-ar": 0.1}
"""The weight that the paper gives each of its examples."""


def example(name: str, s: int = 0) -> Simulated:
    """Replication ``s`` of an example of the paper: "sinusoids", "rational", "switching" or "exp-ar"."""
    one_of("example", "name", name, tuple(EXAMPLES))
    return EXAMPLES[name](rng=np.random.default_rng(1000 + s))
