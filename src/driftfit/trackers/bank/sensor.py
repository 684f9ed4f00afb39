"""Sensor hypotheses: what the output says of theta at this sample.

    nominal, outlier    y = phi' theta + e,   e ~ N(0, factor r)
    offset              y = phi' theta + value + e
    frozen              y ~ N(last output seen, r_f), nothing learned

An *innovation* outlier drives the plant: y stays in the regressors of later samples. An *additive* one is the sensor's
alone: a leaf that believes it puts its own prediction into its output lags, and so does a frozen one. With
r_f = resolution^2 / (2 pi) the density at the last output is 1 / resolution, the likelihood of "the same code again".
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

from driftfit.engine.settings import Settings, numbers, one_of
from driftfit.trackers.bank.change import probability

KINDS = ("nominal", "outlier", "additive", "offset", "frozen")
STUCK = 1e-4
"""Variance of a frozen sensor without a resolution, in units of r."""


@dataclass(frozen=True)
class Sensor(Settings):
    """One hypothesis of what the sensor does; made by `nominal`, `outlier`, `offset` and `frozen`."""

    kind: str = "nominal"
    r: float | None = None
    prob: float | None = None
    factor: float = 1.0
    value: float = 0.0
    resolution: float | None = None
    guess: float | None = None
    nu: float = 4.0
    memory: float | None = 100.0
    limit: float | None = None

    def __post_init__(self) -> None:
        one_of("Sensor", "kind", self.kind, KINDS)
        for name in ("r", "guess", "factor", "resolution", "limit"):
            if getattr(self, name) is not None:
                self._set(name, numbers("Sensor", name, getattr(self, name), ndim=0, low=0.0, strict=True))
        self._set("value", numbers("Sensor", "value", self.value, ndim=0))
        self._set("nu", numbers("Sensor", "nu", self.nu, ndim=0, low=2.0, strict=True))
        if self.memory is not None:
            self._set("memory", numbers("Sensor", "memory", self.memory, ndim=0, low=3.0, strict=True))
        if self.prob is not None:
            self._set("prob", probability("Sensor", self.prob))

    @property
    def name(self) -> str:
        """What tables call it."""
        return f"offset {self.value:g}" if self.kind == "offset" else self.kind

    @classmethod
    def nominal(
        cls,
        r: float | None = None,
        prob: float | None = None,
        guess: float | None = None,
        nu: float = 4.0,
        memory: float | None = 100.0,
        limit: float | None = None,
    ) -> Sensor:
        """The sensor as it should be, with noise variance r.

        r=None: the variance is unknown, and every leaf carries an inverse gamma distribution of it that forgets over
        ``memory`` samples (None: never). 1 / ``guess`` is the mean of 1 / r before the first sample, worth ``nu``
        samples; without a guess it comes from the first residuals, and q and p0 are in units of it.

        A sample further than ``limit`` standard deviations from its forecast is taken for a fault code: it counts as
        missing, also as a lag, and is counted. After three in a row the next one is believed. None: never.
        """
        return cls("nominal", r, prob, guess=guess, nu=nu, memory=memory, limit=limit)

    @classmethod
    def outlier(cls, scale: float = 10.0, kind: str = "innovation", prob: float = 0.05, plus: bool = False) -> Sensor:
        """Noise ``scale`` times as large: variance scale^2 r, or (1 + scale^2) r with plus=True (noise and a spike)."""
        one_of("Sensor.outlier", "kind", kind, ("innovation", "additive"))
        scale = numbers("Sensor.outlier", "scale", scale, ndim=0, low=0.0, strict=True)
        name = "outlier" if kind == "innovation" else "additive"
        return cls(name, prob=prob, factor=scale * scale + (1.0 if plus else 0.0))

    @classmethod
    def offset(
        cls, value: float | None = None, std: float | None = None, prob: float = 0.01, r: float | None = None
    ) -> Sensor:
        """A known offset. One of unknown size, new at every sample (``std``), is an outlier: it warns and gives that.

        An offset that lasts is a parameter: ``intercept=True`` in the model, and a `Change` of that parameter.
        """
        if (value is None) == (std is None):
            raise ValueError(f"Sensor.offset: give either value= or std=; got value={value!r}, std={std!r}.")
        if std is None:
            return cls("offset", prob=prob, value=float(value or 0.0))
        if r is None:
            raise ValueError("Sensor.offset: std= needs r=, the noise variance to which it is added.")
        warnings.warn(
            "Sensor.offset(std=) is the same hypothesis as an outlier of variance r + std^2, and is replaced by one; "
            "for a lasting offset add an intercept to the model and a Change of it.",
            stacklevel=2,
        )
        return cls("outlier", prob=prob, factor=1.0 + std * std / r)

    @classmethod
    def frozen(cls, resolution: float | None = None, prob: float = 0.01) -> Sensor:
        """The last value again. ``resolution`` is the step of the sensor's code, in units of y; it persists, so give
        the bank a ``transition``.
        """
        if resolution is not None and not resolution > 0.0:
            raise ValueError(
                f"Sensor.frozen: resolution must be positive, as a density without width is infinite; got "
                f"{resolution!r}. Without resolution= the width is {math.sqrt(STUCK):g} of the noise's."
            )
        return cls("frozen", prob=prob, resolution=resolution)

    def row(self) -> list[float]:
        """What compiled code knows of it: the columns of `driftfit.trackers.bank.leaves.forecast`."""
        width = -STUCK if self.resolution is None else self.resolution**2 / (2.0 * math.pi)
        own = self.kind in ("additive", "frozen")
        return [self.factor, self.value, float(self.kind == "frozen"), width, float(own)]

    @property
    def cleans(self) -> bool:
        """Whether a leaf that believes it puts something other than y into its output lags."""
        return self.kind in ("additive", "offset", "frozen")
