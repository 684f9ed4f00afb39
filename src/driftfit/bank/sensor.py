"""Sensor hypotheses: how the output depends on theta at a sample.

    nominal, outlier    y = phi' theta + e,   e ~ N(0, factor r)
    offset              y = phi' theta + value + e
    frozen              y ~ N(last output observed, r_f), nothing learned
    own                 a density that you define, of y given the forecast of a leaf (`Sensor.own`)

An *innovation* outlier drives the plant: y stays in the regressors of later samples. An *additive* one affects only the
reading: a leaf with this hypothesis puts its own prediction into its output lags, and so does one with a frozen sensor.
With r_f = resolution^2 / (2 pi) the density at the last output is 1 / resolution, the likelihood of "the same code".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import FunctionType
from typing import Any

import numpy as np

from driftfit.bank.change import probability
from driftfit.engine.kernel import Array
from driftfit.engine.settings import Settings, numbers, one_of, place_of

KINDS = ("nominal", "outlier", "additive", "offset", "frozen", "own")
STUCK = 1e-4
"""Variance of a frozen sensor without a resolution, in units of r."""


@dataclass(frozen=True)
class Sensor(Settings):
    """One hypothesis about the sensor; made by `nominal`, `outlier`, `offset` and `frozen`."""

    kind: str = "nominal"
    r: float | None = None
    prob: float | None = None
    factor: float = 1.0
    value: float = 0.0
    resolution: float | None = None
    guess: float | None = None
    nu: float = 4.0
    memory: float | None = 100.0
    likelihood: Any = None
    own_lags: bool = False

    def __post_init__(self) -> None:
        one_of("Sensor", "kind", self.kind, KINDS)
        for name in ("r", "guess", "factor", "resolution"):
            if getattr(self, name) is not None:
                self._set(name, numbers("Sensor", name, getattr(self, name), ndim=0, low=0.0, strict=True))
        self._set("value", numbers("Sensor", "value", self.value, ndim=0))
        self._set("nu", numbers("Sensor", "nu", self.nu, ndim=0, low=2.0, strict=True))
        if self.memory is not None:
            self._set("memory", numbers("Sensor", "memory", self.memory, ndim=0, low=3.0, strict=True))
        if (self.kind == "own") != (self.likelihood is not None):
            raise ValueError(f"Sensor: a likelihood of your own is Sensor.own(likelihood); got kind={self.kind!r}.")
        if self.likelihood is not None:
            self._set("likelihood", _function(self.likelihood))
        if self.prob is not None:
            self._set("prob", probability("Sensor", self.prob))

    @property
    def name(self) -> str:
        """The name in tables."""
        if self.kind == "own":
            return str(self.likelihood.__name__)
        return f"offset {self.value:g}" if self.kind == "offset" else self.kind

    @classmethod
    def nominal(
        cls, r: float | None = None, prob: float | None = None, guess: float | None = None, nu: float = 4.0,
        memory: float | None = 100.0,
    ) -> Sensor:  # fmt: skip
        """The sensor in its normal state, with noise variance r.

        r=None: the variance is unknown, and every leaf carries an inverse gamma distribution of it that forgets over
        ``memory`` samples (None: never). 1 / ``guess`` is the mean of 1 / r before the first sample, with the weight of
        ``nu`` samples; without a guess it comes from the first residuals, and q and p0 are in units of it.
        """
        return cls("nominal", r, prob, guess=guess, nu=nu, memory=memory)

    @classmethod
    def outlier(cls, scale: float = 10.0, kind: str = "innovation", prob: float = 0.05, plus: bool = False) -> Sensor:
        """Noise ``scale`` times as large: variance scale^2 r, or (1 + scale^2) r with plus=True (noise and spike)."""
        one_of("Sensor.outlier", "kind", kind, ("innovation", "additive"))
        scale = numbers("Sensor.outlier", "scale", scale, ndim=0, low=0.0, strict=True)
        name = "outlier" if kind == "innovation" else "additive"
        return cls(name, prob=prob, factor=scale * scale + (1.0 if plus else 0.0))

    @classmethod
    def offset(cls, value: float, prob: float = 0.01) -> Sensor:
        """A known offset. One of unknown size that is new at every sample, of standard deviation s, is an outlier with
        scale^2 = 1 + s^2 / r; a lasting one is a parameter: ``intercept=True`` in the model, and a `Change` of it.
        """
        return cls("offset", prob=prob, value=value)

    @classmethod
    def frozen(cls, resolution: float | None = None, prob: float = 0.01) -> Sensor:
        """The last value is repeated. ``resolution`` is the step of the sensor's code, in units of y. A frozen sensor
        persists, so give the bank a ``transition``.
        """
        if resolution is not None and not resolution > 0.0:
            raise ValueError(
                f"Sensor.frozen: resolution must be positive, as a density without width is infinite; got "
                f"{resolution!r}. Without resolution= the width is {math.sqrt(STUCK):g} of the noise's."
            )
        return cls("frozen", prob=prob, resolution=resolution)

    @classmethod
    def own(
        cls, likelihood: Callable[..., Any], prob: float = 0.01, scale: float = 1.0, cleans: bool = False
    ) -> Sensor:
        """A likelihood that you define: a plain function ``likelihood(y, y_hat, h, r, last)`` of numbers, which Numba
        compiles and which returns three, ``log_p, noise, clean``.

        Parameters
        ----------
        likelihood : function of the module, of
            y : the reading; y_hat, h : mean and variance of a leaf's forecast of the output, without noise;
            r : noise variance of the nominal sensor; last : the last reading (NaN: none),
            all in units of y. It returns
            log_p : log density of y, -inf where it cannot be;
            noise : the variance of the measurement y as which the leaf is updated (``np.inf``: nothing is learned);
            clean : the true output under this hypothesis, which enters the leaf's lags with ``cleans=True``.
            It may use numbers, `math` and other such functions, and has no state.
        prob : float
            Prior probability.
        scale : float
            Standard deviations of its noise in those of the nominal one, as far as forecasts are concerned.
        cleans : bool
            Whether ``clean`` takes the place of y in the leaf's output lags.

        Cost: one call of the function per leaf and sample; some three seconds of compiling, once. Saved runs
        keep the function's name; hand the function in to load them, ``Track.load(path, classes=[likelihood])``.
        """
        scale = numbers("Sensor.own", "scale", scale, ndim=0, low=0.0, strict=True)
        return cls("own", prob=prob, factor=scale * scale, likelihood=likelihood, own_lags=bool(cleans))

    def settings(self) -> dict[str, Any]:
        plain = super().settings()
        if self.likelihood is not None:
            plain["likelihood"] = {"function": place_of(self.likelihood)}
        return plain

    def row(self) -> list[float]:
        """The numbers for compiled code: the columns of `driftfit.bank.leaves.forecast`, but for its number
        among the user's own.
        """
        width = -STUCK if self.resolution is None else self.resolution**2 / (2.0 * math.pi)
        own = self.kind in ("additive", "frozen") or self.own_lags
        return [self.factor, self.value, float(self.kind == "frozen"), width, float(own)]

    @property
    def cleans(self) -> bool:
        """Whether a leaf with this hypothesis puts something other than y into its output lags."""
        return self.kind in ("additive", "offset", "frozen") or self.own_lags


def table_of(sensors: Sequence[Sensor]) -> Array:
    """The numbers of the sensors of a bank for compiled code, one row per sensor."""
    number = np.cumsum([sensor.kind == "own" for sensor in sensors])
    numbered = zip(sensors, number, strict=True)
    return np.array([[*sensor.row(), float(k) if sensor.kind == "own" else 0.0] for sensor, k in numbered])


def _function(given: Any) -> Any:
    """A function of the user's, which has a name by which files can tell it from others."""
    inner = getattr(given, "py_func", given)
    if not isinstance(inner, FunctionType) or "<" in inner.__qualname__:
        raise ValueError(
            f"Sensor.own: likelihood must be a function that a module defines by name, by which files tell it from "
            f"others; got {given!r}."
        )
    if inner.__code__.co_argcount != 5:
        raise ValueError(
            "Sensor.own: likelihood takes (y, y_hat, h, r, last) and returns (log_p, noise, clean); "
            f"{inner.__name__} takes {inner.__code__.co_argcount} arguments."
        )
    return inner
