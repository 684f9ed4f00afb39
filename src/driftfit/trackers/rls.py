"""Recursive least squares with exponential or directional forgetting.

    predict    P <- P / lambda_e,   lambda_e = min(1, max(lambda^dt, max_i P_ii / (c_max P_ii at the start)))
    forecast   y_hat = phi' theta;  e = y - y_hat;  g = P phi;  h = phi' g;  v = h + 1 / w;  s = r v
    correct    theta <- theta + g e / v;  P <- P - g g' / v;  r = sum(e^2 / v) / count

with w the weight of the sample. It minimises sum lambda^(t-k) w_k (y_k - phi_k' theta)^2 with a memory of
1/(1 - lambda) nominal samples. P is in units of the noise variance r, which is estimated over the samples after the
start.

Use it if all parameters drift alike and nothing is known about noise and drift. Without excitation exponential
forgetting would let P grow without bound. It stops when a variance is ``c_max`` times its value at the time when the
regressors first had full rank (before that: when they last spanned a new direction), which does not depend on units.

A model that is linearised poorly at first has its first samples forgotten, also for lambda = 1: up to sample k = N of
`Linearised.settling` the memory is at most `settling_memory` samples or k / 4, if that is more: the lambda(t) -> 1 of
Ljung and Soderstrom (1983), section 5.6. If the model has one of the noise, P is in units of the least variance of e so
far, of max(20, k / 8) samples: those before the noise was known have large innovations, and would outweigh all later
ones. The least of many estimates is too small for a noise variance, which is instead the mean of e^2 / s over the last
max(20, k / 4) samples (exponential weights) until the start is forgotten.

Directional forgetting (kind="directional") forgets only in the direction of a sample, after it has been used:

    g = P phi;  P <- P + (1/lambda - 1) g g' / (phi' g)

phi' P phi is then 1/lambda times its value in least squares, and the marginal distribution of every other combination
is unchanged. There is no wind-up: without excitation nothing is forgotten, so no cap is needed. It acts at usable
samples only. With one parameter the two kinds are the same.

Source: Ljung, System Identification (1999), eq. 11.12; Plackett (1950) for lambda = 1. Departures: forgetting depends
on time (dt, and also if y is missing); the cap; an exact diffuse start. Directional forgetting: Hagglund (1983),
Kulhavy and Karny (1984).
Cost per sample: O(n^2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import State, exp, kernel, nothing
from driftfit.engine.settings import check_numbers, matrix, numbers, one_of, vector
from driftfit.models.base import Model
from driftfit.trackers.base import Tracker
from driftfit.trackers.forms.covariance import correct as measure
from driftfit.trackers.forms.covariance import forecast
from driftfit.trackers.forms.diffuse import (
    SCRATCH,
    absorb_on_roots,
    before_any_sample,
    correct_on_roots,
    forecast_on_roots,
    hand_over,
    reform,
    started,
    wander,
)
from driftfit.trackers.forms.excitation import LARGE

RECENT, RECENT_SHARE, LATER_SHARE = 20.0, 0.125, 0.25
"""Memory of the present noise variance: samples, and shares of those so far for the unit of P and for the scale."""


@kernel
def growth(s: State, l: int) -> float:
    """The factor by which forgetting multiplies P."""
    dt, used = s.dt[l], s.count[l]
    faded = s.forgetting[l] if dt == 1.0 else exp(dt * s.log_forgetting[l])
    # once for each sample that was used, in the next interval: whether that has an output is not known in advance
    early = (used < s.discounted[l]) & (used > s.faded_at[l]) & (dt > 0.0)
    s.faded_at[l] = used if early else s.faded_at[l]
    faded = min(faded, 1.0 - 1.0 / max(s.first_memory[l], 0.25 * used)) if early else faded
    grown = 0.0
    for i in range(s.theta.shape[0]):
        # rounding can make a variance negative, which must not grow past the cap
        grown = max(grown, abs(s.P[i, i, l]) * s.per_cap[i, l])
    factor: float = s.quieter[l] / min(1.0, max(faded, grown))
    s.quieter[l] = 1.0
    return factor


@kernel
def fade(s: State, l: int) -> float:
    """P <- P / lambda_e; returns 1 / lambda_e."""
    grow: float = growth(s, l)
    for i in range(s.theta.shape[0]):
        for j in range(i + 1):
            s.P[i, j, l] *= grow
    return grow


@kernel
def forget(s: State, l: int) -> None:
    fade(s, l)


def no_scale() -> dict[str, Any]:
    """Fields of an estimated noise variance before the first innovation."""
    return {"squares": 0.0, "count": 0.0, "scale": np.nan}


@kernel
def square_over_variance(s: State, l: int) -> float:
    """e^2 / v of a used sample, v = h + 1 / w in units of the noise variance; 0 in a direction of no knowledge."""
    return s.ok[l] * s.e[l] * s.e[l] / (s.h[l] + s.r[l] * s.noise[l])  # type: ignore[no-any-return]


@kernel
def learn_scale(s: State, l: int) -> None:
    """r = sum(e^2 / v) / count over the used samples that had a prediction."""
    s.squares[l] += square_over_variance(s, l)
    s.count[l] += s.ok[l] if s.h[l] < np.inf else 0.0
    s.scale[l] = s.squares[l] / s.count[l]


@kernel
def keep_recent(s: State, squares: float, square: float, l: int) -> None:
    """While a start is forgotten, the noise variance is a mean of e^2 / v over the later samples.

    ``squares`` is the sum before this sample, and ``square`` its own, which counts in full: the sample changes theta in
    full, and with a bounded square the bands would stay too narrow after a quiet start, until dozens of samples later.
    """
    if (s.ok[l] > 0.0) & (s.count[l] > 1.0) & (s.count[l] < s.unequal[l]):
        before = squares / (s.count[l] - 1.0)
        share = 1.0 / min(s.count[l], max(RECENT, LATER_SHARE * s.count[l]))
        mean = before + share * (square - before)
        s.squares[l] = s.count[l] * mean
        s.scale[l] = mean


@kernel
def follow_variance(s: State, l: int) -> None:
    """While a start is forgotten, P is in units of the least noise variance so far."""
    if (s.ok[l] > 0.0) & (s.count[l] > 0.0) & (s.count[l] < s.unequal[l]):
        square = s.e[l] * s.e[l]
        before = s.recent[l] if s.recent[l] > 0.0 else square
        share = 1.0 / min(s.count[l], max(RECENT, RECENT_SHARE * s.count[l]))
        s.recent[l] = before + share * (min(square, LARGE * before) - before)
        least = s.recent[l] if s.least[l] <= 0.0 else min(s.least[l], s.recent[l])
        least = least if s.count[l] >= RECENT else 0.0
        ratio = s.least[l] / least if (s.least[l] > 0.0) & (least > 0.0) else 1.0
        s.least[l] = least
        s.quieter[l] *= ratio


@kernel
def learn_settling_scale(s: State, l: int) -> None:
    """The same for a tracker that may forget its start."""
    squares, square = s.squares[l], square_over_variance(s, l)
    learn_scale(s, l)
    if s.h[l] < np.inf:
        keep_recent(s, squares, square, l)
        follow_variance(s, l)


@kernel
def correct(s: State, l: int) -> None:
    measure(s, l)
    learn_settling_scale(s, l)


@kernel
def forget_root_form(s: State, l: int) -> None:
    shrink = 1.0 / np.sqrt(growth(s, l))
    for i in range(s.theta.shape[0]):
        s.d[i, l] *= shrink
        for j in range(i, s.theta.shape[0]):
            s.S[i, j, l] *= shrink


@kernel
def correct_root_form(s: State, l: int) -> None:
    rank = s.rank[l]
    correct_on_roots(s, l)
    learn_settling_scale(s, l)
    # the cap applies from the first direction on: regressors may lack excitation before they span everything
    for i in range(s.theta.shape[0]):
        known = s.rank[l] > rank and s.P[i, i, l] > 0.0
        s.per_cap[i, l] = 1.0 / (s.c_max[l] * s.P[i, i, l]) if known else s.per_cap[i, l]


@kernel
def forgotten(s: State, l: int) -> float:
    """The factor of g g' after a correction, with g = P phi before it."""
    h, noise = s.h[l], s.r[l] * s.noise[l]
    news = s.ok[l] > 0.0 and h > 0.0 and h < np.inf
    return noise * (1.0 / s.forgetting[l] - 1.0) / ((h + noise) * h) if news else 0.0


@kernel
def correct_direction(s: State, l: int) -> None:
    measure(s, l)
    gain = forgotten(s, l)
    for i in range(s.theta.shape[0]):
        for j in range(i + 1):
            s.P[i, j, l] += gain * s.g[i, l] * s.g[j, l]
    learn_scale(s, l)


@kernel
def product_of_roots(s: State, l: int) -> None:
    """s.g = R R' phi, which loses half the digits of P phi."""
    n = s.theta.shape[0]
    for i in range(n):
        s.g[i, l] = 0.0
    for k in range(n):
        x = 0.0
        for i in range(k + 1):
            x += s.R[i, k, l] * s.phi[i, l]
        x = x if s.S[k, k, l] > 0.0 else 0.0
        for i in range(k + 1):
            s.g[i, l] += s.R[i, k, l] * x


@kernel
def forecast_direction(s: State, l: int) -> None:
    forecast_on_roots(s, l)
    product_of_roots(s, l)


@kernel
def correct_direction_root_form(s: State, l: int) -> None:
    n = s.theta.shape[0]
    absorb_on_roots(s, l)
    for i in range(n):
        s.H[i, n - 1, l] = s.g[i, l]
    wander(s, np.sqrt(forgotten(s, l)), l)
    reform(s, l)
    learn_scale(s, l)
    hand_over(s, l)


EXPONENTIAL = started(TrackerSteps(forget, forecast, correct, learns_scale=True), forget_root_form, correct_root_form)
DIRECTIONAL = started(
    TrackerSteps(nothing, forecast, correct_direction, learns_scale=True),
    nothing,
    correct_direction_root_form,
    forecast_direction,
)


class Forgetting(Tracker):
    """A tracker with exponential forgetting from a diffuse start: what `RLS` and `InstrumentalVariables` share."""

    forgetting: float | None
    p0: Any
    theta0: Any
    c_max: float

    required: ClassVar[tuple[str, ...]] = ("forgetting",)
    learns_noise: ClassVar[bool] = True
    scratch: ClassVar[tuple[str, ...]] = ("g", "R", *SCRATCH)

    def __post_init__(self) -> None:
        owner = type(self).__name__
        check_numbers(self, ("p0",), ("forgetting",), ("theta0",))
        if self.forgetting is not None and self.forgetting > 1.0:
            raise ValueError(f"{owner}: forgetting must be in (0, 1]; got {self.forgetting!r}.")
        self._set("c_max", numbers(owner, "c_max", self.c_max, ndim=0, low=1.0))

    def state(self, n: int) -> Mapping[str, Any]:
        owner = type(self).__name__
        P = np.zeros((n, n)) if self.p0 is None else matrix(owner, "p0", self.p0, n)
        first = self.c_max * np.diag(P)
        theta0 = vector(owner, "theta0", self.theta0, n)
        return {
            "theta": theta0,
            "P": P,
            "forgetting": self.forgetting,
            "log_forgetting": np.log(np.asarray(self.forgetting)),
            "r": 1.0,
            "g": np.zeros(n),
            "c_max": self.c_max,
            "per_cap": np.divide(1.0, first, out=np.zeros(n), where=first > 0.0),
            **dict.fromkeys(("discounted", "first_memory", "faded_at", "unequal", "recent", "least"), 0.0),
            "quieter": 1.0,
            **no_scale(),
            **before_any_sample(n, self.p0),
        }

    def state_for(self, model: Model) -> Mapping[str, Any]:
        state, one = self.state(model.n), model.linearised
        if one is None:
            return state
        N = one.settling
        return {**state, "discounted": N, "first_memory": one.settling_memory, "unequal": N * one.unequal_start}


@dataclass(frozen=True)
class RLS(Forgetting):
    """Recursive least squares with exponential or directional forgetting.

    Parameters
    ----------
    forgetting : number in (0, 1]
        lambda per nominal sample; 1 never forgets and is ordinary least squares.
    p0 : number, (n,), (n, n), or None
        Covariance of theta before the first sample, in units of the noise variance. None: exact diffuse start.
    theta0 : number or (n,)
        Mean of theta before the first sample.
    c_max : number
        Cap of the growth of a variance, as a multiple of its value at the start (exponential forgetting).
    kind : "exponential" or "directional"
        Forget in all directions alike, or only in those that the regressors excite.

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

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of("RLS", "kind", self.kind, ("exponential", "directional"))

    @property
    def steps(self) -> TrackerSteps:
        return EXPONENTIAL if self.kind == "exponential" else DIRECTIONAL
