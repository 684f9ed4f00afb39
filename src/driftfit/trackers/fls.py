"""Flexible least squares, on line: the exact filter.

At every t it computes the last point of the path that minimises

    J = sum_k w_k (y_k - phi_k' theta_k)^2 + sum_k (theta_{k+1} - theta_k)' D_k (theta_{k+1} - theta_k) + prior
    D_k = diag(mu / d_{k+1}) / dt_{k+1},   k <= t

with w the weight of a sample, dt the interval since the last one and d known factors of the drift, one number or one
for each parameter, 1 unless given: ``track(.., drift=1 / mu)`` with `FLS(1.0)` has a separate mu for every step and
parameter (``drift[0]`` belongs to the time before the first sample and is not used).

    predict    P <- P + D^-1                                         (not before the first sample)
    forecast   y_hat = phi' theta;  e = y - y_hat;  g = P phi;  h = phi' g;  v = h + 1 / w;  s = r v
    correct    theta <- theta + g e / v;  P <- P - g g' / v
               r = sum(e^2 / v) / count, which is J / (N - rank) after a diffuse start

This is the Kalman filter with q = 1 / mu, r = 1 and an estimated scale: mu = r / q is a ratio of variances, and it
depends on the scale ((c phi, c y, c^2 mu) gives the same path). mu = inf keeps a parameter constant.

Use it to describe smoothness by one number; `tune` estimates it. `Kalman` has q and r as settings, `AugmentedFLS` is
cheaper and has no covariance. `run.smooth()` computes the whole path that minimises J.

Source: Kalaba and Tesfatsion, Time-varying linear regression via flexible least squares (1989), whose matrix recursion
is used in covariance form. Departures: an exact diffuse start (`driftfit.trackers.forms.diffuse`), which needs no
penalty on the first point and no large matrix; the minimum-norm solution about theta0 until the regressors span. In
Chen et al. this is the classical method, T-FLS: J is (8), the filter (9) to (12), `smooth` (13) to (15). Cost O(n^2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array, State, kernel
from driftfit.engine.settings import check_numbers, matrix, plain, vector
from driftfit.models.base import Model
from driftfit.trackers.base import RandomWalk, Tracker
from driftfit.trackers.forms import second_differences
from driftfit.trackers.forms.covariance import correct as measure
from driftfit.trackers.forms.covariance import forecast, read_drift
from driftfit.trackers.forms.diffuse import SCRATCH, before_any_sample, correct_on_roots, drifted, started
from driftfit.trackers.forms.information import partly_known
from driftfit.trackers.rls import learn_scale, no_scale


@kernel
def drift(s: State, l: int) -> None:
    """Between samples only, because the prior refers to the first sample."""
    time = s.dt[l] * s.drift[l] * s.begun[l]
    for i in range(s.theta.shape[0]):
        s.P[i, i, l] += s.q[i, l] * (s.drift_root[i, l] * s.drift_root[i, l]) * time
    s.begun[l] = 1.0 if s.dt[l] > 0.0 else s.begun[l]


@kernel
def correct(s: State, l: int) -> None:
    measure(s, l)
    learn_scale(s, l)


@kernel
def drift_root_form(s: State, l: int) -> None:
    drifted(s, s.dt[l] * s.drift[l] * s.begun[l], l)
    s.begun[l] = 1.0 if s.dt[l] > 0.0 else s.begun[l]


@kernel
def correct_root_form(s: State, l: int) -> None:
    correct_on_roots(s, l)
    learn_scale(s, l)


def price(mu: Any) -> Any:
    """Check mu: positive, inf allowed, one number or one per parameter."""
    try:
        array = np.asarray(mu, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"FLS: mu must be numeric; got {mu!r}.") from None
    if array.ndim == 2 and array.size and (array > 0.0).all():
        raise ValueError(
            f"FLS: mu must be one number or one per parameter; got shape {array.shape}. Pass a mu for every step with "
            "the record: FLS(1.0) and track(.., drift=1 / mu), drift being (T, n) with the steps in rows 1 to T - 1."
        )
    if array.ndim > 1 or not (array > 0.0).all():
        raise ValueError(
            f"FLS: mu must be positive, one number or one per parameter (inf keeps a parameter constant); got {mu!r}."
        )
    return plain(array)


@dataclass(frozen=True)
class FLS(Tracker):
    """Flexible least squares (exact filter).

    Parameters
    ----------
    mu : number or (n,)
        Penalty on a squared change of theta per nominal sample relative to a squared residual; positive, in units of
        phi' phi. inf keeps a parameter constant.
    theta0 : number or (n,)
        Mean of theta at the first sample; without p0 it remains only in directions that the regressors never span.
    p0 : number, (n,), (n, n), or None
        Covariance of theta at the first sample, in units of the noise variance. None: a diffuse start.
    differences : 1 or 2
        2 penalises changes of the slope, theta_{k+1} - 2 theta_k + theta_{k-1}, instead of changes of theta, so that
        a straight line costs nothing (`driftfit.trackers.forms.second_differences`); its start is diffuse.

    Raises
    ------
    ValueError
        If mu is not positive, p0 is not a covariance, or differences is neither 1 nor 2 or comes with p0.
    """

    mu: Any = None
    theta0: Any = 0.0
    p0: Any = None
    differences: int = 1

    required: ClassVar[tuple[str, ...]] = ("mu",)
    learns_noise: ClassVar[bool] = True
    scratch: ClassVar[tuple[str, ...]] = ("g", "R", *SCRATCH)
    drift_per_parameter: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.mu is not None:
            self._set("mu", price(self.mu))
        check_numbers(self, ("p0",), (), ("theta0",))
        if self.differences not in (1, 2):
            raise ValueError(f"FLS: differences must be 1 or 2; got {self.differences!r}.")
        if self.differences == 2 and self.p0 is not None:
            raise ValueError("FLS: p0 does not describe the slope; with differences=2 leave it None (a diffuse start).")

    def state(self, n: int) -> Mapping[str, Any]:
        mu, theta0 = vector("FLS", "mu", self.mu, n), vector("FLS", "theta0", self.theta0, n)
        if self.differences == 2:
            return second_differences.state(mu, theta0)
        return {
            "theta": theta0,
            "P": np.zeros((n, n)) if self.p0 is None else matrix("FLS", "p0", self.p0, n),
            "q": 1.0 / mu,
            "G": np.diag(np.sqrt(1.0 / mu)),
            "r": 1.0,
            "g": np.zeros(n),
            "drift_root": np.ones(n),
            "begun": 0.0,
            **no_scale(),
            **before_any_sample(n, self.p0),
        }

    @property
    def slopes(self) -> bool:
        return self.differences == 2

    def partly_known(self, n: int, N: int) -> Mapping[str, Any] | None:
        return None if self.slopes else partly_known(self.state(n), self.state(N))

    @property
    def steps(self) -> TrackerSteps:
        return second_differences.STEPS if self.differences == 2 else STEPS

    def cov(self, lane: Mapping[str, Array]) -> Array:
        n = len(lane["theta"])
        return super().cov({**lane, "P": lane["P"][:n, :n]})

    def widen(self, lane: Mapping[str, Array], p: Array) -> None:
        n = len(p)
        super().widen({**lane, "P": lane["P"][:n, :n]}, p)

    def random_walk(self, model: Model) -> RandomWalk:
        n = model.n
        p0 = None if self.p0 is None else matrix("FLS", "p0", self.p0, n)
        q = np.diag(1.0 / vector("FLS", "mu", self.mu, n))
        theta0 = vector("FLS", "theta0", self.theta0, n)
        return RandomWalk(q, None, theta0, p0, at_first_sample=True, slopes=self.slopes)


STEPS = started(
    TrackerSteps(drift, forecast, correct, read_extra=read_drift, learns_scale=True),
    drift_root_form,
    correct_root_form,
)
