"""Laws by which a parameter moves: what is known of it besides that it drifts.

    theta_t = m_t + d_t + sum_k c_k,t

    walk      m_t = m_(t-1) + w_t                                         m: random walk, q per nominal sample
    trend     m_t = m_(t-1) + dt slope_t + w_t                            slope: random walk, q; w: level
    returns   d_t = exp(-dt / time) d_(t-1) + w_t                         d: AR(1) of standard deviation std; m constant
    season    c_k turns by 2 pi k dt / period, and gains variance q       k = 1 .. harmonics
    cycle     c turns by 2 pi dt / period and shrinks by exp(-dt / time)  c: standard deviation std

A parameter may follow several laws: its parts are added up. m is a random walk with the drift that the tracker gives
the parameter unless a law says otherwise.

A law is a soft prior: the data may move the parameter anywhere, but where they say little it behaves as the law says.
After a long gap a walk is at its last value, with a wide band; what returns is at its mean, with its own spread; a
trend has gone on; and a season is at the same time of its day.

    Kalman(q=1e-5, r=0.1, laws={"b1": Law.returns(time=200, std=0.3), "b2": Law.season(24)})
    Kalman(q=0, r=0.1, laws={"level": (Law.trend(1e-5, level=1e-4), Law.season(12, harmonics=5, q=1e-6))})

Source: Harvey, Forecasting, Structural Time Series Models and the Kalman Filter (1989), sections 2.3 and 2.4; Young,
Recursive Estimation and Time-Series Analysis (2011), chapters 4 and 5 (generalised random walks, dynamic harmonic
regression). Departure: a slope moves before the level that it moves, as if it had been observed a sample later.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import Settings, near, numbers, one_of, whole

REQUIRED = {
    "walk": ("q",), "trend": ("q", "level"), "returns": ("time", "std"), "season": ("q",), "cycle": ("time", "std"),
}  # fmt: skip
"""By kind, the settings that a law needs; `tune` finds those that are None."""

PLAIN, LEVEL, SLOPE, COSINE, SINE = (float(kind) for kind in range(5))
"""How a component of a parameter moves. A level is followed by its slope, a cosine by its sine."""

OWNER, VISIBLE, KIND, RATE, DAMPING, NOISE, ROWS = range(7)
"""Rows of the table of components: the parameter, whether it is part of its value, how it moves, the angle and the
logarithm of the shrinkage in a nominal sample, and the variance that it gains: per nominal sample, or in all if it
shrinks."""


@dataclass(frozen=True)
class Law(Settings):
    """The law of one parameter; made by `walk`, `trend`, `returns`, `season` and `cycle`."""

    kind: str = "walk"
    q: float | None = None
    level: float | None = 0.0
    time: float | None = None
    std: float | None = None
    mean: float | None = None
    period: float | None = None
    harmonics: int = 1

    def __post_init__(self) -> None:
        one_of("Law", "kind", self.kind, tuple(REQUIRED))
        for name in ("q", "level", "time", "std", "mean", "period"):
            value = getattr(self, name)
            if value is not None:
                low = -np.inf if name == "mean" else 0.0
                checked = numbers("Law", name, value, ndim=0, low=low, strict=name in ("time", "std", "period"))
                self._set(name, checked)
        self._set("harmonics", whole("Law", "harmonics", self.harmonics, 1))
        if self.kind in ("season", "cycle") and not self.harmonics <= 0.5 * (self.period or 0.0):
            raise ValueError(
                f"Law: {self.harmonics} harmonics of a period of {self.period or 0.0:g} samples have more than half a "
                "wave between two samples; give fewer harmonics, or a longer period."
            )

    @property
    def title(self) -> str:
        """The kind, and the period if there is one: what tells laws of one parameter apart."""
        return self.kind if self.period is None else f"{self.kind}({self.period:g})"

    @property
    def required(self) -> tuple[str, ...]:
        """Names of the settings that the law needs."""
        return REQUIRED[self.kind]

    @classmethod
    def walk(cls, q: float | None = None) -> Law:
        """A random walk with its own drift variance q per nominal sample."""
        return cls("walk", q=q)

    @classmethod
    def trend(cls, q: float | None = None, level: float | None = 0.0) -> Law:
        """An integrated random walk: the slope gains variance q per nominal sample, and the level gains ``level``."""
        return cls("trend", q=q, level=level)

    @classmethod
    def returns(cls, time: float | None = None, std: float | None = None, mean: float | None = None) -> Law:
        """It wanders about a mean with standard deviation std, and forgets its past with this time constant.

        ``time`` is in nominal samples. ``mean=None``: the mean is constant and estimated, as a further unknown.
        """
        return cls("returns", time=time, std=std, mean=mean)

    @classmethod
    def season(cls, period: float, harmonics: int = 1, q: float | None = 0.0) -> Law:
        """A periodic part of ``harmonics`` waves, whose coefficients gain variance q per nominal sample.

        ``period`` is in nominal samples. With half as many waves as samples in a period the part is any pattern of sum
        0; the last wave then changes its sign from sample to sample, and has no sine.
        """
        return cls("season", period=period, harmonics=harmonics, q=q)

    @classmethod
    def cycle(cls, period: float, time: float | None = None, std: float | None = None) -> Law:
        """A damped wave of standard deviation std, which forgets its phase with this time constant.

        ``period`` and ``time`` are in nominal samples; rho of Harvey (1989, eq. 2.3.36) is exp(-1 / time).
        """
        return cls("cycle", period=period, time=time, std=std)

    def components(self, i: int) -> list[tuple[float, ...]]:
        """Columns of the table for what the law adds to the level of parameter i."""
        damping = 0.0 if self.time is None else 1.0 / self.time
        if self.kind == "returns":
            return [(i, 1.0, PLAIN, 0.0, damping, (self.std or 0.0) ** 2)]
        if self.kind not in ("season", "cycle"):
            return []
        noise = (self.q or 0.0) if self.kind == "season" else (self.std or 0.0) ** 2
        found: list[tuple[float, ...]] = []
        for k in range(1, self.harmonics + 1):
            angle = np.pi * (2.0 * k / (self.period or 1.0))  # exactly pi for half a wave
            hidden = 0.0 if angle == np.pi else noise
            found += [(i, 1.0, COSINE, angle, damping, noise), (i, 0.0, SINE, angle, damping, hidden)]
        return found


def laws_of(owner: str, given: Any) -> tuple[tuple[str, Law], ...] | None:
    """Pairs of the name of a parameter and a law, as plain data: from a mapping, from pairs, or None."""
    if given is None:
        return None
    pairs = given.items() if isinstance(given, Mapping) else (tuple(one) for one in given)
    found = tuple((name, law) for name, some in pairs for law in (some if isinstance(some, list | tuple) else (some,)))
    for name, law in found:
        if not isinstance(name, str) or not isinstance(law, Law):
            raise ValueError(f'{owner}: laws must map names of parameters to laws, as {{"b1": Law.trend(1e-6)}}.')
    return found or None


def table_of(owner: str, laws: tuple[tuple[str, Law], ...], names: tuple[str, ...], q: Array) -> Array:
    """The table (ROWS, N) of the components of all parameters; ValueError for a name that is none, and for two laws of
    one level.
    """
    for name, _ in laws:
        if name not in names:
            raise ValueError(f"{owner}: laws names {name!r}, which is not a parameter; {near(name, names)}")
    columns: list[tuple[float, ...]] = []
    for i, name in enumerate(names):
        own = [law for owner_of_law, law in laws if owner_of_law == name]
        levels = [law for law in own if law.kind in ("walk", "trend")]
        if len(levels) > 1:
            raise ValueError(f"{owner}: two laws of {name!r} move its level; give one of walk and trend.")
        returns = any(law.kind == "returns" for law in own)  # to a constant level
        trend = bool(levels) and levels[0].kind == "trend"
        noise = (levels[0].level if trend else levels[0].q) if levels else 0.0 if returns else q[i]
        columns.append((i, 1.0, LEVEL if trend else PLAIN, 0.0, 0.0, noise or 0.0))
        columns += [(i, 0.0, SLOPE, 0.0, 0.0, levels[0].q or 0.0)] if trend else []
        columns += [column for law in own for column in law.components(i)]
    return np.array(columns, dtype=float).T.copy()


def transition(table: Array, dt: float) -> tuple[Array, Array]:
    """(F, Q), (N, N) each: how the components move in dt nominal samples, and the covariance that they gain."""
    kind, rate, damping, noise = (table[row] for row in (KIND, RATE, DAMPING, NOISE))
    F, gained = np.diag(np.exp(-dt * damping)), noise * np.where(damping > 0.0, 1.0 - np.exp(-2.0 * dt * damping), dt)
    Q = np.diag(gained)
    for k in np.flatnonzero(kind == LEVEL):
        F[k, k + 1] = dt
        Q[k, k] += dt * dt * gained[k + 1]
        Q[k, k + 1] = Q[k + 1, k] = dt * gained[k + 1]
    for k in np.flatnonzero(kind == COSINE):
        turned = np.exp(1j * rate[k] * dt) * F[k, k]
        F[k : k + 2, k : k + 2] = [[turned.real, turned.imag], [-turned.imag, turned.real]]
    return F, Q
