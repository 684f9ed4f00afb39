"""The scenarios of the tracking benchmark: how parameters, noise and inputs behave, one function each.

A scenario is a function ``name(rng, T, n)`` that returns a `Plan`: the true path of the parameters on a scale on which
1 is large, the noise standard deviation of every sample, and the faults of inputs and outputs. `simulate` runs a plan
as a regression on white inputs or as an ARX(2, 2) model. To add a scenario write one function here; it is found
automatically.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array

T_DEFAULT = 1000
NOISE = 0.3
"""Standard deviation of the noise unless a scenario sets it."""


@dataclass
class Plan:
    """The content of a scenario; paths are relative to a nominal system."""

    path: Array
    noise: Array
    outlier: Array = field(default_factory=lambda: np.zeros(0, bool))
    missing: Array = field(default_factory=lambda: np.zeros(0, bool))
    quiet: Array = field(default_factory=lambda: np.zeros(0, bool))
    correlation: float = 0.0
    q: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Simulated:
    """A simulated record: y (T,), u (T, m), theta (T, n), which samples are outliers, and what the oracle knows."""

    y: Array
    u: Array
    theta: Array
    outlier: Array
    noise: Array
    q: Array


def _walk(rng: np.random.Generator, T: int, std: Any) -> tuple[Array, Array]:
    std = np.asarray(std, float)
    steps = rng.normal(size=(T, len(std))) * std
    return np.cumsum(steps, axis=0), np.broadcast_to(std**2, (T, len(std))).copy()


def no_drift(rng: np.random.Generator, T: int, n: int) -> Plan:
    """Nothing changes."""
    return Plan(np.zeros((T, n)), np.full(T, NOISE), q=np.zeros((T, n)))


def slow_walk(rng: np.random.Generator, T: int, n: int) -> Plan:
    """Every parameter is a random walk with steps of 0.01 per sample."""
    path, q = _walk(rng, T, np.full(n, 0.01))
    return Plan(path, np.full(T, NOISE), q=q)


def fast_walk(rng: np.random.Generator, T: int, n: int) -> Plan:
    """Every parameter is a random walk with steps of 0.06 per sample."""
    path, q = _walk(rng, T, np.full(n, 0.06))
    return Plan(path, np.full(T, NOISE), q=q)


def sinusoid(rng: np.random.Generator, T: int, n: int) -> Plan:
    """Every parameter oscillates by 0.5 with a period of 300 samples and its own phase."""
    phase = rng.uniform(0.0, 2.0 * np.pi, n)
    path = 0.5 * np.sin(2.0 * np.pi * np.arange(T)[:, None] / 300.0 + phase)
    q = np.gradient(path, axis=0) ** 2
    return Plan(path, np.full(T, NOISE), q=q)


def ramp(rng: np.random.Generator, T: int, n: int) -> Plan:
    """Every parameter is constant, changes by up to 1 over the middle third, and is constant again."""
    part = np.clip(3.0 * np.arange(T) / T - 1.0, 0.0, 1.0)
    path = part[:, None] * rng.uniform(-1.0, 1.0, n)
    return Plan(path, np.full(T, NOISE), q=np.gradient(path, axis=0) ** 2)


def sparse_jumps(rng: np.random.Generator, T: int, n: int) -> Plan:
    """All parameters jump by N(0, 0.7^2), on average once in 200 samples."""
    jump = rng.random(T) < 0.005
    steps = jump[:, None] * rng.normal(size=(T, n)) * 0.7
    return Plan(np.cumsum(steps, axis=0), np.full(T, NOISE), q=jump[:, None] * np.full(n, 0.49))


def mixed_rates(rng: np.random.Generator, T: int, n: int) -> Plan:
    """One parameter is a fast random walk, one a slow one, and the others are constant."""
    std = np.zeros(n)
    std[0], std[-1] = 0.04, 0.005
    path, q = _walk(rng, T, std)
    return Plan(path, np.full(T, NOISE), q=q)


def outliers(rng: np.random.Generator, T: int, n: int) -> Plan:
    """The drift is a slow random walk, and 5 % of the noise is ten times as large."""
    plan = slow_walk(rng, T, n)
    plan.outlier = rng.random(T) < 0.05
    return plan


def missing_data(rng: np.random.Generator, T: int, n: int) -> Plan:
    """The drift is a slow random walk; 15 % of the outputs are missing, and one block of 60."""
    plan = slow_walk(rng, T, n)
    plan.missing = rng.random(T) < 0.15
    plan.missing[T // 2 : T // 2 + 60] = True
    return plan


def lost_excitation(rng: np.random.Generator, T: int, n: int) -> Plan:
    """The drift is a slow random walk, and the inputs are constant for a sixth of the record."""
    plan = slow_walk(rng, T, n)
    plan.quiet = np.zeros(T, bool)
    plan.quiet[T // 2 : T // 2 + T // 6] = True
    return plan


def changing_noise(rng: np.random.Generator, T: int, n: int) -> Plan:
    """The drift is a slow random walk, and the noise is four times as large over the middle third."""
    plan = slow_walk(rng, T, n)
    plan.noise[T // 3 : 2 * T // 3] *= 4.0
    return plan


def collinear_inputs(rng: np.random.Generator, T: int, n: int) -> Plan:
    """The drift is a slow random walk, and the inputs have a correlation of 0.97."""
    plan = slow_walk(rng, T, n)
    plan.correlation = 0.97
    return plan


Scenario = Callable[[np.random.Generator, int, int], Plan]


def found() -> dict[str, Scenario]:
    """Every scenario of this file, by name."""
    own = {name: value for name, value in globals().items() if callable(value) and not name.startswith("_")}
    return {name: f for name, f in own.items() if getattr(f, "__annotations__", {}).get("return") == "Plan"}


def simulate(name: str, kind: str, seed: int, T: int = T_DEFAULT) -> Simulated:
    """Play a scenario as a "regression" (n = 3, white inputs) or an "arx" (ARX(2, 2), n = 4)."""
    rng = np.random.default_rng([seed, *name.encode()])
    n = 3 if kind == "regression" else 4
    plan = found()[name](rng, T, n)
    flags = {part: getattr(plan, part) if getattr(plan, part).size else np.zeros(T, bool) for part in _FLAGS}
    noise = rng.normal(size=T) * plan.noise * np.where(flags["outlier"], 10.0, 1.0)
    play = _regression if kind == "regression" else _arx
    y, u, theta, q = play(rng, plan, noise, flags["quiet"])
    y[flags["missing"]] = np.nan
    return Simulated(y, u, theta, flags["outlier"], plan.noise, q)


_FLAGS = ("outlier", "missing", "quiet")


def _regression(rng: np.random.Generator, plan: Plan, noise: Array, quiet: Array) -> tuple[Array, Array, Array, Array]:
    T, n = plan.path.shape
    common = rng.normal(size=(T, 1))
    u = np.sqrt(plan.correlation) * common + np.sqrt(1.0 - plan.correlation) * rng.normal(size=(T, n))
    u[quiet] = u[np.argmax(quiet)] if quiet.any() else 0.0
    theta = np.array([1.0, -0.5, 0.8])[:n] + plan.path
    return np.sum(u * theta, axis=1) + noise, u, theta, plan.q


_NOMINAL = np.array([1.1, -0.5, 1.0, 0.5])
_SHARE = np.array([0.25, 0.25, 1.0, 1.0])
"""The lag coefficients move a quarter as far, and are folded back into the stable region."""


def _arx(rng: np.random.Generator, plan: Plan, noise: Array, quiet: Array) -> tuple[Array, Array, Array, Array]:
    T = len(noise)
    pole = plan.correlation
    u = rng.normal(size=T)
    for t in range(1, T if pole else 0):
        u[t] = pole * u[t - 1] + np.sqrt(1.0 - pole * pole) * u[t]
    u[quiet] = u[np.argmax(quiet)] if quiet.any() else 0.0
    theta = _NOMINAL + _SHARE * plan.path
    theta[:, 0] = _fold(theta[:, 0], 0.6, 1.3)
    theta[:, 1] = _fold(theta[:, 1], -0.8, -0.4)
    y = np.zeros(T)
    for t in range(T):
        past = [y[t - 1] if t > 0 else 0.0, y[t - 2] if t > 1 else 0.0]
        inputs = [u[t - 1] if t > 0 else 0.0, u[t - 2] if t > 1 else 0.0]
        y[t] = theta[t] @ [*past, *inputs] + noise[t]
    return y, u[:, None], theta, plan.q * _SHARE**2


def _fold(x: Array, low: float, high: float) -> Array:
    """Reflect a path at both limits."""
    width = high - low
    return low + width - np.abs((x - low) % (2.0 * width) - width)
