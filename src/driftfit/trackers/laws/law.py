"""Laws by which a parameter moves: what is known of it besides that it drifts.

    walk      theta_t = m_t                                                 m: random walk, q per nominal sample
    returns   theta_t = m + d_t,   d_t = exp(-dt / time) d_(t-1) + w_t      d: AR(1) of standard deviation std
    trend     theta_t = m_t,   m_t = m_(t-1) + dt slope_t                   slope: random walk, q
    season    theta_t = m_t + sum_k c_k,t,   k = 1 .. harmonics             c_k: turns by 2 pi k dt / period, q

A law is a soft prior: the data may move the parameter anywhere, but where they say little it behaves as the law says.
After a long gap a walk is at its last value, with a wide band; what returns is at its mean, with its own spread; a
trend has gone on; and a season is at the same time of its day.

    Kalman(q=1e-5, r=0.1, laws={"b1": Law.returns(time=200, std=0.3), "b2": Law.season(24)})

Source: Young, Recursive Estimation and Time-Series Analysis (2011), chapters 4 and 5 (generalised random walks, dynamic
harmonic regression); Harvey, Forecasting, Structural Time Series Models and the Kalman Filter (1989), section 2.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import Settings, near, numbers, one_of, whole

KINDS = ("walk", "returns", "trend", "season")

WALK, DECAY, LEVEL, SLOPE, COSINE, SINE = (float(kind) for kind in range(6))
"""How a component of a parameter moves. A level is followed by its slope, a cosine by its sine."""

OWNER, VISIBLE, KIND, RATE, NOISE, ROWS = range(6)
"""Rows of the table of components: the parameter, whether it is part of its value, how it moves, 1 / time or the angle
per nominal sample, and the variance that it gains: per nominal sample, or of a `DECAY` in all."""


@dataclass(frozen=True)
class Law(Settings):
    """The law of one parameter; made by `walk`, `returns`, `trend` and `season`."""

    kind: str = "walk"
    q: float | None = None
    time: float | None = None
    std: float | None = None
    mean: float | None = None
    period: float | None = None
    harmonics: int = 1

    def __post_init__(self) -> None:
        one_of("Law", "kind", self.kind, KINDS)
        for name in ("q", "time", "std", "mean", "period"):
            value = getattr(self, name)
            if value is not None:
                low = -np.inf if name == "mean" else 0.0
                checked = numbers("Law", name, value, ndim=0, low=low, strict=name in ("time", "std", "period"))
                self._set(name, checked)
        self._set("harmonics", whole("Law", "harmonics", self.harmonics, 1))
        needed = {"walk": ("q",), "returns": ("time", "std"), "trend": ("q",), "season": ("period", "q")}[self.kind]
        if absent := [name for name in needed if getattr(self, name) is None]:
            raise ValueError(f"Law: {self.kind} needs {', '.join(absent)}; see Law.{self.kind}.")
        if self.kind == "season" and not self.harmonics < 0.5 * (self.period or 0.0):
            raise ValueError(
                f"Law: {self.harmonics} harmonics of a period of {self.period:g} samples have half a wave or more "
                "between two samples; give fewer harmonics."
            )

    @classmethod
    def walk(cls, q: float) -> Law:
        """A random walk with its own drift variance q per nominal sample."""
        return cls("walk", q=q)

    @classmethod
    def returns(cls, time: float, std: float, mean: float | None = None) -> Law:
        """It wanders about a mean with standard deviation std, and forgets its past with this time constant.

        ``time`` is in nominal samples. ``mean=None``: the mean is constant and estimated, as a further unknown.
        """
        return cls("returns", time=time, std=std, mean=mean)

    @classmethod
    def trend(cls, q: float) -> Law:
        """An integrated random walk: the slope gains variance q per nominal sample."""
        return cls("trend", q=q)

    @classmethod
    def season(cls, period: float, harmonics: int = 1, q: float = 0.0) -> Law:
        """A level and a periodic part of ``harmonics`` waves, whose coefficients gain variance q per nominal sample.

        ``period`` is in nominal samples. The level drifts with the q of the tracker.
        """
        return cls("season", period=period, harmonics=harmonics, q=q)

    def components(self, i: int, q: float) -> list[tuple[float, ...]]:
        """Columns of the table for parameter i; q is the drift variance that the tracker gives it."""
        own = 0.0 if self.q is None else self.q
        if self.kind == "returns":
            decay = (i, 1.0, DECAY, 1.0 / (self.time or 1.0), (self.std or 0.0) ** 2)
            return [(i, 1.0, WALK, 0.0, 0.0), decay]
        if self.kind == "trend":
            return [(i, 1.0, LEVEL, 0.0, 0.0), (i, 0.0, SLOPE, 0.0, own)]
        if self.kind == "walk":
            return [(i, 1.0, WALK, 0.0, own)]
        found: list[tuple[float, ...]] = [(i, 1.0, WALK, 0.0, q)]
        for k in range(1, self.harmonics + 1):
            angle = 2.0 * np.pi * k / (self.period or 1.0)
            found += [(i, 1.0, COSINE, angle, own), (i, 0.0, SINE, angle, own)]
        return found


def laws_of(owner: str, given: Any) -> tuple[tuple[str, Law], ...] | None:
    """Laws by the names of parameters, as plain data: from a mapping, from pairs, or None."""
    if given is None:
        return None
    pairs = tuple(given.items() if isinstance(given, Mapping) else (tuple(one) for one in given))
    for name, law in pairs:
        if not isinstance(name, str) or not isinstance(law, Law):
            raise ValueError(f'{owner}: laws must map names of parameters to laws, as {{"b1": Law.trend(1e-6)}}.')
    return pairs or None


def table_of(owner: str, laws: tuple[tuple[str, Law], ...], names: tuple[str, ...], q: Array) -> Array:
    """The table (ROWS, N) of the components of all parameters; ValueError for a name that is none."""
    by_name = dict(laws)
    for name in by_name:
        if name not in names:
            raise ValueError(f"{owner}: laws name {name!r}, which is no parameter; {near(name, names)}")
    columns: list[tuple[float, ...]] = []
    for i, name in enumerate(names):
        columns += by_name[name].components(i, q[i]) if name in by_name else [(i, 1.0, WALK, 0.0, q[i])]
    return np.array(columns, dtype=float).T.copy()
