"""Scenarios on which the defaults were not designed: how systems, noise and sensors behave, one function each.

A scenario is a function ``name(rng)`` that returns a `Case`. What the best filter needs to know is part of it: the
drift covariance and the noise variance of every sample, and which samples say nothing. `benchmarks.scenarios` scores
trackers on them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from driftfit import ARX, Regression
from driftfit.engine.kernel import Array
from driftfit.models.base import Model

T, NOISE = 1000, 0.3
Generator = np.random.Generator


@dataclass(frozen=True)
class Case:
    """y (T,), u (T, m), theta (T, n) and, for the oracle, q (T, n), r (T,), ``known`` (T,), a part of y that it knows,
    ``blind`` (T,), samples that it skips; ``common`` (n,): drifts are q in this direction; ``slopes``: slopes walk;
    ``walks``: whether theta is a random walk throughout, so that bands are meant to cover; ``burn``: not scored."""

    model: Model
    y: Array
    u: Array
    theta: Array
    q: Array
    r: Array
    known: Array
    blind: Array
    common: Array = field(default_factory=lambda: np.zeros(0))
    slopes: bool = False
    walks: bool = True
    burn: int = 200


def walk(rng: Generator, start: Any, std: Any, length: int = T) -> tuple[Array, Array]:
    """Path (T, n) and drift (T, n) of a random walk; ``std`` is (n,) or (T, n)."""
    std = np.broadcast_to(np.asarray(std, float), (length, np.size(start)))
    return np.asarray(start) + np.cumsum(rng.normal(size=std.shape) * std, axis=0), std**2


def regression(rng: Generator, path: Array, q: Array, noise: Any = NOISE, u: Any = None, **more: Any) -> Case:
    """y = u' theta + v on white inputs, or those given."""
    u = rng.normal(size=path.shape) if u is None else u
    noise = np.broadcast_to(noise, len(path))
    v = more.pop("v", rng.normal(size=len(path)) * noise)
    y = np.sum(u * path, axis=1) + v
    none = np.zeros(len(path))
    return Case(Regression(path.shape[1]), y, u, path, q, noise**2, none, none > 0.0, **more)


def arx(
    rng: Generator, path: Array, q: Array, orders: tuple[int, int], noise: float = NOISE, ma: float = 0.0,
    gain: float = 0.0, offset: bool = False, **more: Any,
) -> Case:  # fmt: skip
    """y_t = theta_t' phi_t + v_t + ma v_(t-1); u is white, or that minus gain times y."""
    length, (na, nb) = len(path), orders
    u, v, y = rng.normal(size=length), rng.normal(size=length) * noise, np.zeros(length)
    for t in range(length):
        phi = [y[t - i] if t >= i else 0.0 for i in range(1, na + 1)]
        phi += [u[t - i] if t >= i else 0.0 for i in range(1, nb + 1)] + [1.0] * offset
        y[t] = path[t] @ phi + v[t] + (ma * v[t - 1] if t else 0.0)
        u[t] = (0.5 * u[t] - gain * y[t]) if gain else u[t]
    known = ma * np.concatenate([[0.0], v[:-1]])
    model = ARX(na, nb, intercept=offset)
    return Case(model, y, u[:, None], path, q, np.full(length, noise**2), known, np.zeros(length, bool), **more)


def only(n: int, which: int, std: float) -> Array:
    """Standard deviations of a drift of one parameter."""
    return std * (np.arange(n) == which)


def one_of_eight(rng: Generator) -> Case:
    """Drift in one of 8."""
    return regression(rng, *walk(rng, rng.normal(size=8), only(8, 3, 0.05)))


def few_of_twelve(rng: Generator) -> Case:
    """12 regressors, two drift."""
    return regression(rng, *walk(rng, rng.normal(size=12), only(12, 2, 0.05) + only(12, 9, 0.02)))


def bias_beside_ar(rng: Generator) -> Case:
    """Bias that drifts beside an AR term."""
    return arx(rng, *walk(rng, [0.7, 1.0, 0.0], only(3, 2, 0.06)), (1, 1), offset=True)


def armax(rng: Generator) -> Case:
    """ARMAX plant, c = 0.7, gains drift."""
    return arx(rng, *walk(rng, [1.1, -0.5, 1.0, 0.5], [0.0, 0.0, 0.02, 0.02]), (2, 2), ma=0.7)


def quantised(rng: Generator) -> Case:
    """Quantised output, one of 4 drifts."""
    case = regression(rng, *walk(rng, rng.normal(size=4), only(4, 1, 0.03)))
    step = 0.5
    return with_(case, y=step * np.round(case.y / step), r=case.r + step**2 / 12.0)


def closed_loop(rng: Generator) -> Case:
    """Closed loop, the gain drifts."""
    path, q = walk(rng, [0.8, 1.0], only(2, 1, 0.02))
    return arx(rng, np.column_stack([path[:, 0], fold(path[:, 1], 0.5, 1.5)]), q, (1, 1), gain=0.4)


def near_unit_root(rng: Generator) -> Case:
    """Near unit root, the gain drifts."""
    return arx(rng, *walk(rng, [0.995, 1.0], only(2, 1, 0.02)), (1, 1))


def start_up(rng: Generator) -> Case:
    """Start-up transient: fast drift for 60 samples, then rest."""
    std = np.where(np.arange(400) < 60, 0.15, 0.0)[:, None] * np.ones(3)
    return regression(rng, *walk(rng, rng.normal(size=3), std, 400), burn=10)


def jumps_and_faults(rng: Generator) -> Case:
    """Jumps + outliers + frozen."""
    path, q = walk(rng, rng.normal(size=3), (rng.random(T) < 0.005)[:, None] * np.full(3, 0.7))
    case = regression(rng, path, q, walks=False)
    y, blind = case.y.copy(), rng.random(T) < 0.03
    y[blind] += 10.0 * NOISE * rng.normal(size=blind.sum()) + np.sign(rng.normal(size=blind.sum())) * 3.0
    for start in (300, 550, 800):
        start += int(rng.integers(0, 100))
        y[start : start + 40] = y[start - 1]
        blind[start : start + 40] = True
    return with_(case, y=y, blind=blind)


def frozen_coarse(rng: Generator) -> Case:
    """Frozen coarse meter."""
    case = regression(rng, *walk(rng, rng.normal(size=3), 0.02))
    step, blind = 0.3, np.zeros(T, bool)
    y = step * np.round(case.y / step)
    for start in (300, 550, 800):
        y[start : start + 60] = y[start - 1]
        blind[start : start + 60] = True
    return with_(case, y=y, blind=blind, r=case.r + step**2 / 12.0)


def one_sided_jump(rng: Generator) -> Case:
    """One of 4 jumps, twice."""
    std = np.zeros((T, 4))
    std[[400, 700], 2] = 1.0
    return regression(rng, *walk(rng, rng.normal(size=4), std), walks=False)


def very_slow(rng: Generator) -> Case:
    """Very slow drift, T = 50,000."""
    return regression(rng, *walk(rng, rng.normal(size=2), NOISE * 10.0**-3.5, 50_000), burn=5000)


def little_noise(rng: Generator) -> Case:
    """Little noise."""
    return regression(rng, *walk(rng, rng.normal(size=4), 0.05), noise=0.01)


def correlated(rng: Generator) -> Case:
    """Correlated drifts: one common random walk."""
    common = np.array([1.0, 0.7, -0.5, 0.9])
    path = walk(rng, [0.0], 0.03)[0] * common
    return regression(rng, path + rng.normal(size=4), np.full((T, 4), 0.03**2), common=common)


def counts(rng: Generator) -> Case:
    """Counts as y."""
    path, q = walk(rng, [3.0, 2.0, 4.0], only(3, 0, 0.1))
    path[:, 0] = fold(path[:, 0], 1.0, 8.0)
    u = rng.uniform(0.0, 2.0, (T, 3))
    mean = np.sum(u * path, axis=1)
    return regression(rng, path, q, np.sqrt(mean), u, v=rng.poisson(mean) - mean)


def mean_reverting(rng: Generator) -> Case:
    """Mean-reverting parameters."""
    steps, path = 0.05 * rng.normal(size=(T, 3)), np.zeros((T, 3))
    for t in range(1, T):
        path[t] = 0.97 * path[t - 1] + steps[t]
    return regression(rng, 1.0 + path, np.full((T, 3), 0.05**2), walks=False)


def bursts(rng: Generator) -> Case:
    """Bursts of drift."""
    active = (np.arange(T) % 250 > 200)[:, None]
    return regression(rng, *walk(rng, rng.normal(size=3), active * np.full(3, 0.1)), walks=False)


def switch(rng: Generator) -> Case:
    """Switch between two regimes."""
    regime = (np.cumsum(rng.random(T) < 0.01) % 2).astype(float)
    a, b = np.array([1.0, -0.5, 0.8, 0.3]), np.array([-0.5, -0.5, 0.2, 0.3])
    path = a + regime[:, None] * (b - a)
    return regression(rng, path, np.diff(path, axis=0, prepend=path[:1]) ** 2, walks=False)


def t3_noise(rng: Generator) -> Case:
    """Noise of t3."""
    v = NOISE * rng.standard_t(3, T) / np.sqrt(3.0)
    return regression(rng, *walk(rng, rng.normal(size=3), 0.02), v=v)


def garch(rng: Generator) -> Case:
    """GARCH noise."""
    z, v, h = rng.normal(size=T), np.zeros(T), np.full(T, NOISE**2)
    for t in range(T):
        h[t] = 0.02 * NOISE**2 + 0.2 * v[t - 1] ** 2 + 0.78 * h[t - 1] if t else NOISE**2
        v[t] = np.sqrt(h[t]) * z[t]
    return regression(rng, *walk(rng, rng.normal(size=3), 0.02), noise=np.sqrt(h), v=v)


def missing_blocks(rng: Generator) -> Case:
    """Missing blocks."""
    case = regression(rng, *walk(rng, rng.normal(size=3), 0.02))
    y = case.y.copy()
    for start in range(250, T, 150):
        y[start : start + 40] = np.nan
    return with_(case, y=y)


def scales(rng: Generator) -> Case:
    """Inputs of very different scales."""
    unit = np.array([1e3, 1.0, 1e-3])
    path, q = walk(rng, rng.normal(size=3) / unit, 0.02 / unit)
    return regression(rng, path, q, u=rng.normal(size=(T, 3)) * unit)


def integrated(rng: Generator) -> Case:
    """Integrated random walk."""
    slope, q = walk(rng, np.zeros(3), 3e-4)
    return regression(rng, rng.normal(size=3) + np.cumsum(slope, axis=0), q, slopes=True, walks=False)


def short(rng: Generator) -> Case:
    """T = 60."""
    return regression(rng, *walk(rng, rng.normal(size=3), 0.05, 60), burn=20)


def intercept(rng: Generator) -> Case:
    """Intercept that drifts beside inputs with offsets."""
    u = rng.normal(size=(T, 3)) + np.array([10.0, -5.0, 0.0])
    u[:, 2] = 1.0
    return regression(rng, *walk(rng, [1.0, 0.5, 3.0], only(3, 2, 0.08)), u=u)


def seasonal(rng: Generator) -> Case:
    """Seasonal parameters."""
    path = 1.0 + 0.5 * np.sin(2.0 * np.pi * np.arange(T)[:, None] / 200.0 + np.array([0.0, 1.0, 2.0]))
    return regression(rng, path, np.diff(path, axis=0, prepend=path[:1]) ** 2, walks=False)


def steady(rng: Generator) -> Case:
    """Nothing changes."""
    return regression(rng, *walk(rng, rng.normal(size=4), 0.0))


def fold(x: Array, low: float, high: float) -> Array:
    """Reflect a path at both limits."""
    width = high - low
    return low + width - np.abs((x - low) % (2.0 * width) - width)


def ar_noise(rng: Generator) -> Case:
    """Noise of a first-order autoregression beside gains that drift."""
    v, n = rng.normal(size=T) * NOISE, np.zeros(T)
    for t in range(1, T):
        n[t] = 0.7 * n[t - 1] + v[t]
    case = regression(rng, *walk(rng, rng.normal(size=3), 0.02), v=n)
    return with_(case, known=n - v)


def with_(case: Case, **changed: Any) -> Case:
    """A case with some fields replaced."""
    return Case(**{**vars(case), **changed})


def found() -> dict[str, Callable[[Generator], Case]]:
    """Every scenario of this file, by name."""
    return {
        name: f
        for name, f in globals().items()
        if getattr(f, "__annotations__", {}) == {"rng": "Generator", "return": "Case"}
    }
