"""The problem that smoothers solve: a regression whose coefficients walk at random. Arrays only, no runs.

y_t = phi_t' theta_t + v_t,          v_t ~ N(0, r / weight_t)
theta_t = theta_{t-1} + w_t,         w_t ~ N(0, r drift_t E_t q E_t),  E_t = diag(drift_root_t)
theta_0 ~ N(theta0, r p0),           p0 = None: nothing is known
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import as_numbers
from driftfit.trackers.base import RandomWalk
from driftfit.trackers.forms.diffuse import WITHIN_SPAN

NONE = np.zeros((0, 0))
"""No parameter has its own drift, and none has a slope."""


Y, WEIGHT, DRIFT = 0, 1, 2
"""Columns of the signals of a `Walk`."""


class Walk(NamedTuple):
    """T samples of a regression whose n parameters are random walks; q and p0 are relative to the noise variance.

    ``phi`` and ``signals`` have room for a path and its variances, which may take their place
    (`driftfit.smooth.exact.smooth`).
    """

    phi: Array
    """(T, n), finite."""
    signals: Array
    """(T, max(n, 3)): y, finite; weight, 0 for samples that are not used; drift, the nominal intervals of drift before
    each sample; the columns `Y`, `WEIGHT` and `DRIFT`."""
    q: Array
    """(n, n), drift covariance per nominal interval."""
    theta0: Array
    """(n,)"""
    p0: Array | None
    """(n, n), or None for the diffuse start."""
    r: float | None
    """Noise variance; None if it is to be estimated."""
    drift_root: Array = NONE
    """(T, n): square roots of the factors of each parameter's drift before each sample; empty if there are none."""
    trend: Array = NONE
    """(T,): intervals of motion along a slope before each sample, if q is the drift of that slope; otherwise empty."""
    paths: Array = NONE
    """(K, T, n): paths under other drifts that are possible too; empty if the drift is known."""
    belief: Array = NONE
    """(K,): their probabilities."""
    mixture: Any = None
    """The moments of a mixture, whose path and variances take the place of those of the walk; None if there is none."""
    basis: Array = NONE
    """(n, n): drifts, ``drift_root`` and ``paths`` are those of z, theta = basis z; empty if they are those of theta.
    """

    @property
    def y(self) -> Array:
        """(T,)"""
        return self.signals[:, Y]

    @property
    def weight(self) -> Array:
        """(T,)"""
        return self.signals[:, WEIGHT]

    @property
    def drift(self) -> Array:
        """(T,)"""
        return self.signals[:, DRIFT]

    def changed(self, column: int, values: Array) -> Walk:
        """The problem with other values (T,) of one of its signals."""
        signals = self.signals.copy()
        signals[:, column] = values
        return self._replace(signals=signals)

    def of(self, which: Array) -> Walk:
        """The problem of some parameters with a diffuse start, if the regressors of the others are 0."""
        phi = np.ascontiguousarray(self.phi[:, which])
        return self._replace(phi=phi, q=self.q[np.ix_(which, which)], theta0=self.theta0[which])

    @property
    def independent(self) -> Walk:
        """The problem in z, whose drifts are independent."""
        if not len(self.basis):
            return self
        phi, terms = self.phi @ self.basis, np.abs(self.phi) @ np.abs(self.basis)
        return self._replace(phi=np.where(np.abs(phi) > WITHIN_SPAN * terms, phi, 0.0), basis=NONE)

    @property
    def used(self) -> int:
        """Number of samples with a positive weight."""
        return int(np.count_nonzero(self.weight))

    def residual(self, theta: Array) -> Array:
        """y - phi' theta, (T,)."""
        return np.asarray(self.y - np.einsum("ti,ti->t", self.phi, theta))

    def pull(self, residual: Array) -> Array:
        """sum over i > t of weight_i phi_i residual_i for t = -1 .. T - 2, (T, n): the gradient of each increment.

        At the minimum of J its first row is zero (without a prior), and `moves` converts it to the increments.
        """
        weighted = self.phi * (self.weight * residual)[:, None]
        return np.asarray(np.cumsum(weighted[::-1], axis=0)[::-1])

    def moves(self, pull: Array) -> Array:
        """theta_{t+1} - theta_t from gradients (T, n) of `pull`: drift_{t+1} E q E pull_{t+1}, (T - 1, n).

        With slopes it is slope_{t+1} - slope_t, with sum over i > t of trend_i pull_i instead of pull.
        """
        if len(self.trend):
            pull = np.cumsum((self.trend[:, None] * pull)[::-1], axis=0)[::-1]
        drift_root = self.drift_root[1:] if len(self.drift_root) else 1.0
        return np.asarray(self.drift[1:, None] * drift_root * ((drift_root * pull[1:]) @ self.q))


def room_for_signals(T: int, n: int) -> Array:
    """Zeros of the shape of the signals of T samples of n parameters."""
    return np.zeros((T, max(n, DRIFT + 1)))


def constants(n: int) -> RandomWalk:
    """Constant parameters with a diffuse start."""
    return RandomWalk(np.zeros((n, n)), None, np.zeros(n), None, at_first_sample=True)


def free(n: int) -> RandomWalk:
    """Parameters with a diffuse start, whose drift and noise are given for every sample."""
    return RandomWalk(np.eye(n), 1.0, np.zeros(n), None)


class Path(NamedTuple):
    """The result of a smoother; covariances are relative to the noise variance."""

    theta: Array
    """(T, n)"""
    var: Array
    """(T, n): inf for parameters that the record does not determine."""
    rho: Array
    """(T,): NaN for samples that were not used; empty if it was not kept."""
    c: Array
    """(T,): sqrt(1 - leverage); empty if it was not kept."""
    cost: float
    """The minimum of J."""
    measurement_cost: float
    """The part of J that is the sum of weight_t (y_t - phi_t' theta_t)^2."""
    spread: float
    """Sum of phi_t' C_t phi_t over the used samples, with C_t the covariance of theta_t."""
    cov: Array
    """(T, n, n), or empty."""
    lag_cov: Array
    """(T - 1, n, n), of theta_t and theta_{t+1}, or empty."""
    method: str
    """"fast" or "safe"."""
    rank: Array = np.zeros(0, np.int16)
    """(T,): rank of the regressors up to each sample."""
    slope: Array = NONE
    """(T, n), per nominal interval; empty if theta has no slope."""
    slope_var: Array = NONE
    """(T, n), or empty."""
    log_likelihood: float = np.nan
    """Of y given q, drift, weights and the start, up to a constant; only the fast method computes it."""


def ordered(walk: Walk, by: Any) -> tuple[Walk, Array]:
    """(walk, order): the samples sorted by a state variable, one nominal step apart; ties stay in time order.

    Samples with a missing value of the variable come last and are not used.
    """
    value = as_numbers("order_by", by)
    if value.shape != walk.y.shape:
        raise ValueError(f"order_by has shape {value.shape}, but the record has {len(walk.y)} samples.")
    order = np.argsort(value, kind="stable")
    signals = walk.signals[order]
    signals[:, WEIGHT] *= np.isfinite(value)[order]
    signals[:, DRIFT] = 1.0
    signals[:1, DRIFT] = 0.0 if walk.p0 is None else 1.0
    trend = signals[:, DRIFT].copy() if len(walk.trend) else NONE
    arranged = walk._replace(
        phi=walk.phi[order], signals=signals, drift_root=NONE, trend=trend, paths=NONE, belief=NONE
    )
    return arranged, order
