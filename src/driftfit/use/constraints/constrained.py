"""theta with bounds and linear constraints: `run.constrain("b1 >= 0", "b1 + b2 == 1")`.

    p(theta_t | data, constraints) ~ N(theta_t; theta, P) prod_k 1[low_k <= g_k' theta_t <= high_k]

The filter runs free, and its Gaussian at each sample is cut to where theta is known to be
(`driftfit.use.constraints.truncated`): mean, standard deviation and quantiles of what is left. For constant parameters
this is Bayes' rule itself, because the constraint is the same at all samples. For parameters that drift it is the
distribution given the constraint *at that sample*; that it held before as well could narrow it further. The cut is
never fed back into the filter: a filter that learns from the same inequality again at every sample shrinks its
covariance without data, and leaves the bound for no reason.

``prob`` is the probability that the free filter gives to each constraint. Where it is small, data and constraint
contradict each other, and the constraint may be wrong. Cost per sample: O(k n^2) for each sweep, some ten sweeps for
several constraints that matter together.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.run.live.live import Live
from driftfit.run.result import Track
from driftfit.use.constraints.half_spaces import HalfSpace, half_space
from driftfit.use.constraints.truncated import cut


class Constrained:
    """Parameters within constraints, sample by sample.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters.
    theta, std : (T, n)
        Mean and standard deviation within the constraints; as in the run where theta is not determined yet.
    prob : (T, k)
        Probability of each constraint in the free run; 0 for an equation, and NaN before theta is determined.
    """

    def __init__(self, names: tuple[str, ...], within: tuple[HalfSpace, ...], theta: Array, P: Array) -> None:
        from scipy.special import ndtr  # a tenth of a second to import

        self.names, self.within = names, within
        known = np.isfinite(P).all(axis=(1, 2))
        self.theta, self._P = theta.astype(float), P.astype(float)
        self._left, self._spread, self.prob = (np.full((len(theta), len(within)), np.nan) for _ in range(3))
        if not known.any():
            return
        free, S = self.theta[known], self._P[known]
        for k, one in enumerate(within):
            std = np.sqrt(np.einsum("i,tij,j->t", one.g, S, one.g))
            with np.errstate(divide="ignore", invalid="ignore"):
                self.prob[known, k] = ndtr((one.high - free @ one.g) / std) - ndtr((one.low - free @ one.g) / std)
        self.theta[known], self._P[known], self._left[known], self._spread[known] = cut(free, S, within)

    def __repr__(self) -> str:
        return f"Constrained theta of {len(self.theta)} samples: {', '.join(one.text for one in self.within)}"

    @cached_property
    def std(self) -> Array:
        std: Array = np.sqrt(np.maximum(np.einsum("tii->ti", self._P), 0.0))
        return std

    def cov(self, t: int) -> Array:
        """Covariance (n, n) within the constraints after sample t."""
        cov: Array = self._P[t].copy()
        return cov

    def band(self, level: float = 0.95) -> tuple[Array, Array]:
        """(low, high), each (T, n): equal-tailed bands, which never leave a bound of a single parameter."""
        if not 0.0 < level < 1.0:
            raise ValueError(f"band: level must be between 0 and 1, such as 0.95; got {level!r}.")
        from scipy import stats

        tails = np.array([0.5 - 0.5 * level, 0.5 + 0.5 * level])
        low, high = (self.theta + stats.norm.ppf(tail) * self.std for tail in tails)
        for k, one in enumerate(self.within):
            own = np.flatnonzero(one.g)
            if len(own) > 1 or one.low == one.high:
                continue
            i, factor = own[0], one.g[own[0]]
            limits = sorted((one.low / factor, one.high / factor))
            with np.errstate(invalid="ignore"):
                mean, std = self._left[:, k] / factor, np.sqrt(self._spread[:, k]) / abs(factor)
                cuts = [(limit - mean) / std for limit in limits]
                for tail, into in zip(tails, (low, high), strict=True):
                    found = stats.truncnorm.ppf(tail, *cuts, loc=mean, scale=std)
                    into[:, i] = np.where(np.isfinite(found) & (std > 0.0), found, into[:, i])
        return low, high


def _constrained(names: tuple[str, ...], theta: Array, P: Array, constraints: tuple[str, ...]) -> Constrained:
    if not constraints:
        raise ValueError('constrain: give at least one constraint, such as "b1 >= 0".')
    return Constrained(names, tuple(half_space(one, names) for one in constraints), theta, P)


def constrain(run: Track, *constraints: str) -> Constrained:
    """theta of a run within constraints; ValueError if it has no covariance, or a text is no constraint."""
    if not run.tracker.covariance:
        raise ValueError(f"constrain: {type(run.tracker).__name__} has no covariance to be cut; use RLS or Kalman.")
    return _constrained(run.names, run.theta, run.covariances(), constraints)


def constrain_stream(live: Live, *constraints: str) -> Constrained:
    """The same for the present theta of a stream, with T = 1."""
    if not live.tracker.covariance:
        raise ValueError(f"constrain: {type(live.tracker).__name__} has no covariance to be cut; use RLS or Kalman.")
    theta: Any = live.theta
    return _constrained(live.names, theta[None], live.cov[None], constraints)
