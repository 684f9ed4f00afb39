"""Drift laws: how a true parameter changes in a simulation.

    Constant         x_t = start
    RandomWalk       x_{t+1} = x_t + N(0, std^2), reflected at `limits` where they are given
    Ramp             x_t = start + step t
    SineIncrement    x_{t+1} = x_t + amplitude cos(omega t + phase)
    SineOffset       x_t = start + amplitude sin(omega t + phase)
    Jump             x_t = start for t < at, start + size from then on
    Free             x_t = function(t)

Sample numbers t start at 0. A law is frozen and has no state: `Law.path` returns the same path for the same state of
the generator. `paths` turns one law per parameter into an array (T, n); there a plain number is a constant and a plain
function is `Free`.

A sine increment moves x by amplitude / omega around its mean; a random walk without limits is unbounded.
Source: the usual laws of simulation studies of time-varying systems. Any other law, such as the sum of a sine and a
ramp, is a function of t.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from driftfit.engine.kernel import Array


class Law(ABC):
    """How one parameter changes."""

    @abstractmethod
    def path(self, T: int, rng: np.random.Generator) -> Array:
        """The values at T samples, (T,). Only a random walk draws from ``rng``."""


@dataclass(frozen=True)
class Constant(Law):
    """A constant parameter."""

    start: float

    def path(self, T: int, rng: np.random.Generator) -> Array:
        return np.full(T, float(self.start))


@dataclass(frozen=True)
class RandomWalk(Law):
    """Steps of standard deviation ``std``; ``limits = (low, high)`` reflect the path back into this interval."""

    start: float
    std: float
    limits: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not self.std >= 0.0:
            raise ValueError(f"RandomWalk: std must not be negative; got {self.std!r}.")
        if self.limits is not None and not self.limits[0] <= self.start <= self.limits[1]:
            raise ValueError(f"RandomWalk: start must lie within the limits {self.limits}; got {self.start!r}.")

    def path(self, T: int, rng: np.random.Generator) -> Array:
        steps = np.concatenate([[0.0], rng.normal(0.0, self.std, max(T - 1, 0))])[:T]
        return reflect(self.start + np.cumsum(steps), self.limits)


@dataclass(frozen=True)
class Ramp(Law):
    """A constant change of ``step`` per sample."""

    start: float
    step: float

    def path(self, T: int, rng: np.random.Generator) -> Array:
        return self.start + self.step * np.arange(T)


@dataclass(frozen=True)
class _Sine(Law):
    """The settings of a sine wave."""

    start: float
    amplitude: float
    omega: float
    phase: float = 0.0


@dataclass(frozen=True)
class SineIncrement(_Sine):
    """Increments that follow a sine wave of ``omega`` radians per sample."""

    def path(self, T: int, rng: np.random.Generator) -> Array:
        steps = self.amplitude * np.cos(self.omega * np.arange(T) + self.phase)
        return self.start + np.concatenate([[0.0], np.cumsum(steps[:-1])])[:T]


@dataclass(frozen=True)
class SineOffset(_Sine):
    """A sine wave of ``omega`` radians per sample around ``start``."""

    def path(self, T: int, rng: np.random.Generator) -> Array:
        return np.asarray(self.start + self.amplitude * np.sin(self.omega * np.arange(T) + self.phase))


@dataclass(frozen=True)
class Jump(Law):
    """A jump of ``size`` before sample ``at``."""

    start: float
    size: float
    at: int

    def path(self, T: int, rng: np.random.Generator) -> Array:
        return self.start + self.size * (np.arange(T) >= self.at)


@dataclass(frozen=True)
class Free(Law):
    """Any function of the sample numbers 0 .. T-1, given as an array."""

    function: Callable[[Array], Array]

    def path(self, T: int, rng: np.random.Generator) -> Array:
        return np.array(np.broadcast_to(np.asarray(self.function(np.arange(T)), dtype=float), (T,)))


def paths(laws: Sequence[Law | float | Callable[[Array], Array]], T: int, rng: np.random.Generator) -> Array:
    """One path per law, (T, n); drawn in the order of the laws."""
    return np.stack([as_law(law).path(T, rng) for law in laws], axis=1) if len(laws) else np.zeros((T, 0))


def as_law(law: Law | float | Callable[[Array], Array]) -> Law:
    """Return a law unchanged, a number as `Constant`, and a function as `Free`."""
    if isinstance(law, Law):
        return law
    return Free(law) if callable(law) else Constant(float(law))


def reflect(path: Array, limits: tuple[float, float] | None) -> Array:
    """Reflect a path at both ends of [low, high]; with None it is returned unchanged."""
    if limits is None:
        return path
    low, high = limits
    width = high - low
    if not width > 0.0:
        raise ValueError(f"limits must be (low, high) with low below high; got {limits!r}.")
    return low + width - np.abs((path - low) % (2.0 * width) - width)
