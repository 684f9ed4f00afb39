"""Recursive least squares with exponential or directional forgetting.

    predict   P <- P / lambda_e,   lambda_e = min(1, max(lambda^dt, tr P / c_max))
    correct   e = y - phi' theta;  s = phi' P phi + 1;  K = P phi / s
              theta <- theta + K e;  P <- P - K (P phi)'

It minimises sum lambda^(t-k) (y_k - phi_k' theta)^2 with a memory of 1/(1 - lambda) nominal samples. P is in units of
the noise variance, which is estimated as it goes: sum(e^2 / s) / count over the samples after the start, and not below
what coarse readings allow (`driftfit.trackers.resolution`).

Use it when all parameters drift alike and nothing is known of noise and drift. Without excitation exponential
forgetting would blow P up; it stops at ``c_max`` times the trace that P had when the regressors first had full rank
(before that: when they last showed a new direction).

Directional forgetting (kind="directional") forgets only what a sample brings news of, after it was taken in:

    g = P phi;  P <- P + (1/lambda - 1) g g' / (phi' g)

phi' P phi is then 1/lambda times what least squares would leave, the marginal of every other combination stays, and
nothing winds up: without excitation nothing is forgotten, so it has no cap. It acts at usable samples only. With one
parameter the two are the same.

Source: Ljung, System Identification (1999), eq. 11.12; Plackett (1950) for lambda = 1. Departures: forgetting belongs
to time (dt, and also when y is missing); the cap; an exact diffuse start. Directional forgetting: Hagglund (1983),
Kulhavy and Karny (1984). Cost per sample: O(n^2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from driftfit.drivers import TrackerSteps, diagonal
from driftfit.kernel import State, exp, kernel, nothing
from driftfit.settings import covariance, matrix, numbers, one_of, vector
from driftfit.trackers.base import Tracker
from driftfit.trackers.diffuse import enter, knowing, knowing_nothing, measurement, spanned_variance
from driftfit.trackers.resolution import resolution, resolve, unresolved


@kernel
def trace(s: State, l: int) -> float:
    total = 0.0
    for i in range(s.theta.shape[0]):
        total += abs(s.P[i, i, l])  # rounding can make a variance negative: it must not grow behind the cap
    return total


@kernel
def keep_to_span(s: State, l: int) -> None:
    """P <- V'V P V'V: outside the span P is rounding error, and forgetting would let it grow without end."""
    n = s.theta.shape[0]
    rank = s.rank[l]
    for i in range(n):
        for k in range(rank):
            total = 0.0
            for j in range(n):
                total += s.P[max(i, j), min(i, j), l] * s.V[k, j, l]
            s.PV[i, k, l] = total
    for k in range(rank):
        for i in range(n):
            s.w[i, l] = 0.0
        for m in range(rank):
            total = 0.0
            for i in range(n):
                total += s.V[m, i, l] * s.PV[i, k, l]
            for i in range(n):
                s.w[i, l] += total * s.V[m, i, l]
        for i in range(n):
            s.PV[i, k, l] = s.w[i, l]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(rank):
                total += s.PV[i, k, l] * s.V[k, j, l]
            s.P[i, j, l] = total


@kernel
def forget(s: State, l: int) -> None:
    dt = s.dt[l]
    faded = s.forgetting[l] if dt == 1.0 else exp(dt * s.log_forgetting[l])
    grow = 1.0 / min(1.0, max(faded, trace(s, l) * s.per_cap[l]))
    for i in range(s.theta.shape[0]):
        for j in range(i + 1):
            s.P[i, j, l] *= grow


def no_scale() -> dict[str, Any]:
    """Fields of an estimated noise variance before the first innovation."""
    return {"squares": 0.0, "count": 0.0, "scale": np.nan, **unresolved()}


@kernel
def learn_scale(s: State, l: int) -> None:
    """Count the innovation; s.s becomes a variance with the scale known before this sample, s.scale takes it in."""
    counted = s.ok[l] * s.fresh[l]
    s.squares[l] += counted * s.e[l] * s.e[l] / s.s[l]
    s.count[l] += counted
    s.s[l] *= s.scale[l]
    scale = s.squares[l] / s.count[l]
    s.scale[l] = s.coarse[l] if s.coarse[l] > scale else scale  # NaN stays


@kernel
def correct(s: State, l: int) -> None:
    resolve(s, l)
    measurement(s, l)
    learn_scale(s, l)


@kernel
def begin(s: State, l: int) -> None:
    rank = s.rank[l]
    resolve(s, l)
    forget(s, l)
    keep_to_span(s, l)
    enter(s, l)
    if s.s[l] < np.inf:
        learn_scale(s, l)
    spanned_variance(s, l)
    # the cap holds from the first direction on: regressors may stay silent before they span everything
    if s.rank[l] > rank:
        s.per_cap[l] = 1.0 / (s.c_max[l] * trace(s, l))


@kernel
def forget_direction(s: State, l: int) -> None:
    """After `measurement`: s.g is still P phi before the sample, s.s its innovation variance."""
    h = s.s[l] - s.r[l] * s.noise[l]
    gain = s.ok[l] * (1.0 / s.forgetting[l] - 1.0) / (s.s[l] * h) if h > 0.0 and s.ok[l] > 0.0 else 0.0
    gain *= s.r[l] * s.noise[l] if s.ok[l] > 0.0 else 0.0
    for i in range(s.theta.shape[0]):
        for j in range(i + 1):
            s.P[i, j, l] += gain * s.g[i, l] * s.g[j, l]


@kernel
def correct_direction(s: State, l: int) -> None:
    resolve(s, l)
    measurement(s, l)
    forget_direction(s, l)
    learn_scale(s, l)


@kernel
def begin_direction(s: State, l: int) -> None:
    resolve(s, l)
    enter(s, l)
    if s.s[l] < np.inf:
        learn_scale(s, l)
    spanned_variance(s, l)


EXPONENTIAL = TrackerSteps(forget, correct, diagonal, begin)
DIRECTIONAL = TrackerSteps(nothing, correct_direction, diagonal, begin_direction)


@dataclass(frozen=True)
class RLS(Tracker):
    """Recursive least squares with exponential or directional forgetting.

    Parameters
    ----------
    forgetting : number in (0, 1]
        lambda per nominal sample; 1 never forgets and is least squares.
    p0 : number, (n,), (n, n), or None
        Covariance of theta before the first sample, in units of the noise variance. None: exact diffuse start.
    theta0 : number or (n,)
        Mean of theta before the first sample.
    c_max : number
        Cap of the growth of P, as a multiple of its trace at the start (exponential forgetting).
    kind : "exponential" or "directional"
        What is forgotten: all directions alike, or only those that the regressors excite.

    Raises
    ------
    ValueError
        If forgetting is outside (0, 1], p0 is not a covariance, or c_max is below 1.
    """

    forgetting: float | None = None
    p0: Any = None
    theta0: Any = 0.0
    c_max: float = 1e8
    kind: str = "exponential"

    required: ClassVar[tuple[str, ...]] = ("forgetting",)

    def __post_init__(self) -> None:
        if self.forgetting is not None:
            self._set("forgetting", numbers("RLS", "forgetting", self.forgetting, ndim=0, low=0.0, strict=True))
            if self.forgetting > 1.0:
                raise ValueError(f"RLS: forgetting must be in (0, 1]; got {self.forgetting!r}.")
        if self.p0 is not None:
            self._set("p0", covariance("RLS", "p0", self.p0))
        self._set("theta0", numbers("RLS", "theta0", self.theta0))
        one_of("RLS", "kind", self.kind, ("exponential", "directional"))
        self._set("c_max", numbers("RLS", "c_max", self.c_max, ndim=0, low=1.0))

    def state(self, n: int) -> Mapping[str, Any]:
        P = np.zeros((n, n)) if self.p0 is None else matrix("RLS", "p0", self.p0, n)
        known = self.p0 is not None and np.trace(P) > 0.0
        return {
            "theta": vector("RLS", "theta0", self.theta0, n),
            "P": P,
            "forgetting": self.forgetting,
            "log_forgetting": np.log(np.asarray(self.forgetting)),
            "r": 1.0,
            "g": np.zeros(n),
            "PV": np.zeros((n, n)),
            "c_max": self.c_max,
            "per_cap": 1.0 / (self.c_max * np.trace(P)) if known else 0.0,
            **no_scale(),
            **(knowing_nothing(n) if self.p0 is None else knowing(n)),
        }

    def remarks(self, run: Any) -> tuple[tuple[str, str], ...]:
        return resolution(run.end().state)

    @property
    def steps(self) -> TrackerSteps:
        return EXPONENTIAL if self.kind == "exponential" else DIRECTIONAL
