"""What a scenario is: a simulated record with all that is true of it, and how regressions and ARX plants are simulated.

A scenario is a function ``name(rng)`` that returns a `Case`. ``case.model`` with ``case.y``, ``case.u`` and
``case.reading`` (further arguments of `driftfit.track`) is what a tracker of ours takes; ``case.regressors`` and
``case.readings`` are the same for a function of regressors and outcomes, behind a gate that makes no mistake.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from driftfit import ARX, Regression
from driftfit.engine.kernel import Array
from driftfit.models.base import Model

T, NOISE = 1000, 0.3
Generator = np.random.Generator


def nothing() -> Array:
    return np.zeros(0)


@dataclass(frozen=True)
class Case:
    """One record: y_t = phi_t' theta_t + v_t.

    y (T,), u (T, m)   what the sensors say, codes and gaps included
    phi, theta (T, n)  regressors from signals without codes (NaN: not known), and the true parameters
    noise (T,)         the true v
    blind (T,)         samples whose y or u is a code: not scored, and skipped by the oracle
    r (T,)             noise variance, of which the oracle knows the proportions; for jumps also the size
    known (T,)         the part of v that follows from earlier v (coloured noise)
    moves (n, k)       directions in which theta walks, in units of the parameters; default all axes
    interval (T,)      by which the drift of each sample is multiplied
    kind               "constant", "walk", "slopes" (they walk) or "jumps"
    jumps, rate        variances (J, n, n) of the jumps, and the probability of each
    reading            further arguments of `driftfit.track`
    burn               samples that are not scored
    least              the smallest error of theta that matters, in units of y, where there is no noise
    """

    model: Model
    y: Array
    u: Array
    phi: Array
    theta: Array
    noise: Array
    r: Array
    blind: Array
    known: Array
    moves: Array
    interval: Array
    kind: str = "walk"
    jumps: Array = field(default_factory=nothing)
    rate: float = 0.0
    reading: Mapping[str, Any] = field(default_factory=dict)
    burn: int = 100
    least: float = 0.0

    @property
    def readings(self) -> Array:
        """y (T,); NaN where it is a code or its regressors are."""
        y: Array = np.where(self.blind, np.nan, self.y)
        return y

    @property
    def regressors(self) -> Array:
        """phi (T, n); NaN where a regressor is a code."""
        phi: Array = np.where(self.blind[:, None], np.nan, self.phi)
        return phi

    def weight(self) -> Array:
        """W (n, n): off' W off is the square of an error of theta in units of y, with regressors taken as independent.

        Beside an intercept, inputs are taken about their means, and the error of the intercept is that of the level.
        """
        phi = self.phi[np.isfinite(self.phi).all(axis=1)]
        constant = np.ptp(phi, axis=0) == 0.0
        if not constant.any():
            return np.diag(np.mean(phi**2, axis=0))
        mean = phi.mean(axis=0)
        return np.diag(phi.var(axis=0)) + np.outer(mean, mean)


def case(model: Model, y: Array, u: Array, phi: Array, theta: Array, noise: Array, **more: Any) -> Case:
    """A `Case` with white noise of constant variance, no codes and independent walks, unless ``more`` differs."""
    length, n = phi.shape
    usual: dict[str, Any] = {
        "r": np.full(length, np.mean(noise**2)),
        "blind": np.zeros(length, bool),
        "known": np.zeros(length),
        "moves": np.eye(n),
        "interval": np.ones(length),
    }
    return Case(model, y, u.reshape(length, -1), phi, np.broadcast_to(theta, phi.shape), noise, **{**usual, **more})


def walk(rng: Generator, start: Any, std: Any, length: int = T) -> Array:
    """Path (T, n) of a random walk; ``std`` is (n,) or (T, n)."""
    std = np.broadcast_to(np.asarray(std, float), (length, np.size(start)))
    path: Array = np.asarray(start) + np.cumsum(rng.normal(size=std.shape) * std, axis=0)
    return path


def only(n: int, which: int, size: float) -> Array:
    """(n,) with one entry that is not 0."""
    entries: Array = size * (np.arange(n) == which)
    return entries


def slow(rng: Generator, length: int, pole: float, std: float) -> Array:
    """A first-order autoregression (T,) with this standard deviation, begun in its own distribution."""
    x = rng.normal(size=length)
    x[1:] *= np.sqrt(1.0 - pole**2)
    for t in range(1, length):
        x[t] += pole * x[t - 1]
    return std * x


def held(rng: Generator, length: int, low: int, high: int, levels: Any) -> Array:
    """A signal (T,) that is constant for ``low`` to ``high`` samples at a time, at one of the levels."""
    x = np.zeros(length)
    t = 0
    while t < length:
        stay = int(rng.integers(low, high))
        x[t : t + stay] = rng.choice(levels)
        t += stay
    return x


def regression(rng: Generator, path: Array, noise: Any = NOISE, u: Array | None = None, **more: Any) -> Case:
    """y = phi' theta + v on white inputs, or those given; a last column of ones of ``u`` is the model's intercept."""
    length, n = path.shape
    phi = rng.normal(size=path.shape) if u is None else u
    v = more.pop("v", None)
    std = np.broadcast_to(noise, length)
    v = rng.normal(size=length) * std if v is None else v
    constant = n > 1 and bool((phi[:, -1] == 1.0).all())
    model = Regression(n - constant, intercept=constant)
    y = np.sum(phi * path, axis=1) + v
    return case(model, y, phi[:, : n - constant], phi, path, v, **{"r": std**2, **more})


def arx(
    rng: Generator, path: Array, orders: tuple[int, int, int], u: Array, noise: Any = NOISE, offset: bool = False,
    before: float = 0.0, **more: Any,
) -> Case:  # fmt: skip
    """y_t = a' y lags + b' u lags (+ c) + v_t with orders (na, nb, nk) for each column of u, which repeats in all.

    ``before`` is y before the record.
    """
    (na, nb, nk), length = orders, len(path)
    inputs = u.reshape(length, -1)
    std = np.broadcast_to(noise, length)
    v = rng.normal(size=length) * std
    late = [np.concatenate([np.zeros(nk + i), x[: length - nk - i]]) for x in inputs.T for i in range(nb)]
    y, ones = np.concatenate([np.full(na, before), np.zeros(length)]), np.ones((length, int(offset)))
    phi = np.column_stack([np.zeros((length, na)), *late, ones])
    for t in range(length):
        phi[t, :na] = y[t : t + na][::-1]
        y[t + na] = path[t] @ phi[t] + v[t]
    phi[: max(na, nb + nk - 1)] = np.nan
    m = inputs.shape[1]
    model = ARX(na, nb if m == 1 else (nb,) * m, nk=nk if m == 1 else (nk,) * m, intercept=offset)
    return case(model, y[na:], inputs, phi, path, v, **{"r": std**2, **more})
