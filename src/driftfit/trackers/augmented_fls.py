"""Augmented flexible least squares, on line: a strongly regularised, cheap tracker.

    forecast   y_hat = phi' theta;  e = y - y_hat
    correct    theta <- theta + alpha phi e / (mu / (w d dt) + phi' phi)

with w the weight of the sample and d a known factor of the drift, both 1 unless given.

This is epsilon-NLMS (regularised projection, affine projection of order one) with unit step. It minimises
(y - phi' theta)^2 + mu |theta - theta_{t-1}|^2 with the past fixed, and equals a Kalman step whose covariance is reset
to I / mu before every sample. No matrix is formed: O(n) per sample. It has no covariance, so bands are NaN.

Use it if n is large, or as a robust and cheap reference. Its mu is *not* the mu of `FLS`: `from_fls_mu` converts.
theta0 is a prior at (nearly) zero: estimates are shrunk to it while there are few data, and y + phi' c does not shift
theta by c unless theta0 shifts too. With noise and a fixed mu the error does not go to zero.

Source: Chen et al., "augmented flexible least squares for time-varying parameter systems", eq. 20-22; the matrix of its
step 6 need not be inverted (a rank-one identity makes it O(n)). Departures: alpha, and mu refers to one nominal
interval, so that after a gap of k intervals theta moves k times as freely.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import TrackerSteps, no_variance, unknown
from driftfit.engine.kernel import State, kernel, nothing
from driftfit.engine.settings import check_numbers, vector
from driftfit.trackers.base import Tracker
from driftfit.trackers.forms.covariance import prediction


@kernel
def forecast(s: State, l: int) -> None:
    y_hat = prediction(s, l)
    s.y_hat[l], s.e[l], s.h[l] = y_hat, s.y[l] - y_hat, 0.0


@kernel
def correct(s: State, l: int) -> None:
    power = 0.0
    for i in range(s.theta.shape[0]):
        power += s.phi[i, l] * s.phi[i, l]
    gain = s.ok[l] * s.alpha[l] * s.e[l] / (s.mu[l] * s.noise[l] / (s.dt[l] * s.drift[l]) + power)
    for i in range(s.theta.shape[0]):
        s.theta[i, l] += gain * s.phi[i, l]


@dataclass(frozen=True)
class AugmentedFLS(Tracker):
    """Augmented flexible least squares (epsilon-NLMS).

    Parameters
    ----------
    mu : number
        Penalty on a squared change of theta relative to a squared residual; positive, in units of phi' phi.
    theta0 : number or (n,)
        theta before the first sample.
    alpha : number in (0, 2)
        Step size, an extension; 1 is the published recursion.

    Raises
    ------
    ValueError
        If mu is not positive or alpha not in (0, 2).
    """

    mu: float | None = None
    theta0: Any = 1e-6
    alpha: float = 1.0

    covariance: ClassVar[bool] = False
    required: ClassVar[tuple[str, ...]] = ("mu",)

    def __post_init__(self) -> None:
        check_numbers(self, (), ("mu", "alpha"), ("theta0",))
        if self.alpha >= 2.0:
            raise ValueError(f"AugmentedFLS: alpha must be in (0, 2), or the recursion diverges; got {self.alpha!r}.")

    @classmethod
    def from_fls_mu(cls, mu: float, n: int, s: float) -> AugmentedFLS:
        """The weight closest to `FLS`'s mu for n white regressors with mean phi' phi = s.

        mu_A = 2 mu / (n (1 + sqrt(1 + 4 mu / (n s)))): exact for n = 1 and constant phi' phi, a guide otherwise.
        """
        return cls(mu=2.0 * mu / (n * (1.0 + float(np.sqrt(1.0 + 4.0 * mu / (n * s))))))

    def state(self, n: int) -> Mapping[str, Any]:
        return {"theta": vector("AugmentedFLS", "theta0", self.theta0, n), "mu": self.mu, "alpha": self.alpha}

    @property
    def steps(self) -> TrackerSteps:
        return TrackerSteps(nothing, forecast, correct, unknown, no_variance)
