"""A Kalman filter that chooses its own numbers: drift ratio, noise variance and jumps, from the data as they come.

K random-walk filters run side by side. Filter k lets parameter i drift by ``q_ki = ratio_k r / c_i`` a nominal sample,
where r is the present noise variance and c_i the mean square of regressor i, so ratio_k is the share of r that the
drift of one parameter adds to the output per sample, whatever the units. The first ratio is 0. The filters are the
modes of a Markov chain and interact (`driftfit.trackers.drift_ladder`).

The noise variance has J levels f_j r, the last an outlier's (`driftfit.trackers.noise_levels`). For each filter the
levels are merged at once, which is a rank-one update:

    p_kj   proportional to c_k nu_j N(e_k; 0, s_kj),   s_kj = phi' P_k phi + f_j r
    a_k    = sum_j p_(j|k) / s_kj,     d_k = sum_j p_(j|k) (1 / s_kj - a_k)^2
    m_k   <- m_k + g_k a_k e_k,        P_k <- P_k - g_k g_k' (a_k - d_k e_k^2),        g_k = P_k phi

Reported are the mean and covariance of the mixture; the one-step variance leaves the outlier level out, so its band is
one for samples that are not outliers.

Start: exact diffuse least squares without drift until there are a few residuals to tell r from, and the filters start
from there. Scaling inputs or outputs changes nothing but units. Use it when nothing is known; where q and r are known,
`Kalman` is as good and far cheaper. Two groups of parameters with very different rates are followed at one
common rate unless ``groups`` says otherwise.

Source: interacting multiple models are Blom and Bar-Shalom (1988); the ladder of ratios, its transitions, the noise
levels and the scaling are ours. Cost per sample: O(K n^2 + K J) for K modes and J levels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from driftfit.drivers import TrackerSteps
from driftfit.kernel import Array, State, exp, kernel
from driftfit.settings import numbers
from driftfit.trackers.base import Tracker
from driftfit.trackers.diffuse import ALMOST_ANY, LEFT, MACHINES, enter, knowing_nothing, measurement, spanned_variance
from driftfit.trackers.drift_ladder import filters, mix
from driftfit.trackers.excitation import learn_information, learn_scales, learned, no_excitation
from driftfit.trackers.noise_levels import FINEST, OUTLIER, any_level, learn_noise, noise_prior

LEAST = 1e-100
"""Probability that a filter is never below."""

RESIDUALS = 4
"""Residuals seen before the filters start."""


@kernel
def predict(s: State, l: int) -> None:
    time = s.dt[l] * s.drift[l]
    if s.settled[l] > 0 and s.dt[l] > 0.0:
        for k in range(s.mu.shape[0]):
            s.prior[k, l] = s.mu[k, l]
        for i in range(s.theta.shape[0]):
            unit = s.r[l] * time / s.c[i, l] if s.c[i, l] > 0.0 else 0.0
            for k in range(s.mu.shape[0]):
                s.C[i, i, k, l] += s.ratio[i, k, l] * unit


@kernel
def innovate(s: State, l: int) -> None:
    """Innovation of every filter, and prediction and variance of the mixture before the sample."""
    n, K, J = s.theta.shape[0], s.mu.shape[0], s.nu.shape[0]
    for k in range(K):
        s.e_k[k, l] = 0.0
        s.h[k, l] = 0.0
    for i in range(n):
        for k in range(K):
            s.e_k[k, l] += s.phi[i, l] * s.m[i, k, l]
            s.gain[i, k, l] = 0.0
        for j in range(i + 1):
            for k in range(K):
                s.gain[i, k, l] += s.C[i, j, k, l] * s.phi[j, l]
        for j in range(i + 1, n):
            for k in range(K):
                s.gain[i, k, l] += s.C[j, i, k, l] * s.phi[j, l]
        for k in range(K):
            s.h[k, l] += s.phi[i, l] * s.gain[i, k, l]
    mean = 0.0
    for k in range(K):
        mean += s.prior[k, l] * s.e_k[k, l]
    level = 0.0
    for j in range(J - 1):
        level += s.nu_prior[j, l] * s.level[j, l]
    v = s.r[l] * s.noise[l] * level / (1.0 - OUTLIER)
    for k in range(K):
        v += s.prior[k, l] * (s.h[k, l] + (s.e_k[k, l] - mean) ** 2)
    for k in range(K):
        s.e_k[k, l] = s.y[l] - s.e_k[k, l]
    s.y_hat[l] = mean
    s.e[l] = s.y[l] - mean
    s.s[l] = v


@kernel
def weigh(s: State, l: int) -> None:
    """Joint probabilities of drift modes and noise levels after the sample."""
    K, J = s.mu.shape[0], s.nu.shape[0]
    nearest = np.inf
    for j in range(J):
        noise = s.level[j, l] * s.r[l] * s.noise[l]
        for k in range(K):
            v = s.h[k, l] + noise
            s.inverse[j, k, l] = 1.0 / v
            nearest = min(nearest, s.e_k[k, l] * s.e_k[k, l] / v)
    total = 0.0
    for j in range(J):
        for k in range(K):
            far = s.e_k[k, l] * s.e_k[k, l] * s.inverse[j, k, l] - nearest
            p = s.prior[k, l] * s.nu_prior[j, l] * np.sqrt(s.inverse[j, k, l]) * exp(-0.5 * far)
            s.joint[j, k, l] = p
            total += p
    for k in range(K):
        s.mu[k, l] = 0.0
    for j in range(J):
        s.nu[j, l] = 0.0
        for k in range(K):
            s.joint[j, k, l] /= total
            s.nu[j, l] += s.joint[j, k, l]
            s.mu[k, l] += s.joint[j, k, l]
    for k in range(K):
        s.mu[k, l] = max(s.mu[k, l], LEAST)  # at 0 a mode that only such modes lead to would have no mixture at all
    # an outlier says nothing about the level: the chain keeps what it was
    for j in range(J - 1):
        s.nu[j, l] += s.nu[J - 1, l] * s.nu_prior[j, l] / (1.0 - OUTLIER)


@kernel
def update_filters(s: State, l: int) -> None:
    """Each filter takes the sample with its noise levels merged: one rank-one update."""
    n, K, J = s.theta.shape[0], s.mu.shape[0], s.nu.shape[0]
    for k in range(K):
        s.row[k, l] = 0.0
        s.mu_next[k, l] = 0.0
    for j in range(J):
        for k in range(K):
            share = s.joint[j, k, l] / max(s.mu[k, l], 1e-300)
            s.row[k, l] += share * s.inverse[j, k, l]
            s.mu_next[k, l] += share * s.inverse[j, k, l] * s.inverse[j, k, l]
    for k in range(K):
        a = s.row[k, l]
        spread = max(s.mu_next[k, l] - a * a, 0.0)
        s.h[k, l] = a - spread * s.e_k[k, l] * s.e_k[k, l]
        s.step[k, l] = a * s.e_k[k, l]
    for i in range(n):
        for k in range(K):
            s.m[i, k, l] += s.gain[i, k, l] * s.step[k, l]
        for j in range(i):
            for k in range(K):
                s.C[i, j, k, l] -= s.h[k, l] * s.gain[i, k, l] * s.gain[j, k, l]
        for k in range(K):
            left = s.C[i, i, k, l] - s.h[k, l] * s.gain[i, k, l] * s.gain[i, k, l]
            s.C[i, i, k, l] = max(left, LEFT * s.C[i, i, k, l])


@kernel
def mixture(s: State, l: int) -> None:
    """theta and its covariance from the filters; without a sample theta keeps its bits."""
    for i in range(s.theta.shape[0]):
        mean = 0.0
        for k in range(s.mu.shape[0]):
            mean += s.mu[k, l] * s.m[i, k, l]
        s.theta[i, l] = mean if s.ok[l] > 0.0 else s.theta[i, l]
        for j in range(i + 1):
            total = 0.0
            for k in range(s.mu.shape[0]):
                away = (s.m[i, k, l] - s.theta[i, l]) * (s.m[j, k, l] - s.theta[j, l])
                total += s.mu[k, l] * (s.C[i, j, k, l] + away)
            s.P[i, j, l] = total
        s.var[i, l] = s.P[i, i, l]


@kernel
def learn_start(s: State, l: int) -> None:
    """Count a residual of the least squares that the start runs; s.s and s.scale come in units of y."""
    s.squares[l] += s.ok[l] * s.e[l] * s.e[l] / s.s[l]
    s.count[l] += s.ok[l]
    s.s[l] *= s.scale[l]
    s.scale[l] = s.squares[l] / s.count[l]


@kernel
def settle(s: State, l: int) -> None:
    """Start the filters from least squares once there are residuals to tell r from."""
    n = s.theta.shape[0]
    if s.count[l] >= RESIDUALS:
        s.r[l] = max(s.scale[l], FINEST * s.power[l])
        s.scale[l] = 1.0
        s.settled[l] = 1
        for k in range(s.mu.shape[0]):
            for i in range(n):
                s.m[i, k, l] = s.theta[i, l]
                for j in range(i + 1):
                    s.C[i, j, k, l] = s.P[i, j, l] * s.r[l]


@kernel
def correct(s: State, l: int) -> None:
    learn_scales(s, l)
    learn_information(s, l)
    if s.settled[l] == 0:
        measurement(s, l)
        learn_start(s, l)
        settle(s, l)
    else:
        noise_prior(s, l)
        innovate(s, l)
        if s.ok[l] > 0.0:
            weigh(s, l)
            update_filters(s, l)
            learn_noise(s, l)


@kernel
def begin(s: State, l: int) -> None:
    learn_scales(s, l)
    learn_information(s, l)
    enter(s, l)
    if s.s[l] < np.inf:
        learn_start(s, l)
    spanned_variance(s, l)


@kernel
def report(s: State, l: int) -> None:
    if s.settled[l] > 0:
        mixture(s, l)
        if s.ok[l] > 0.0:
            # now, not before the next sample: its prediction may not depend on whether its output will be there
            mix(s, l)
    else:
        for i in range(s.theta.shape[0]):
            s.var[i, l] = s.P[i, i, l] * s.scale[l]


@dataclass(frozen=True)
class AdaptiveKalman(Tracker):
    """Random-walk Kalman filter without numbers to choose.

    Parameters
    ----------
    groups : sequence of sequences of indices, or None
        Parameters that may drift at a rate of their own, such as ``[[0, 1], [2]]``. None: one rate for all.

    Raises
    ------
    ValueError
        If an index appears in two groups, or (when it runs) does not exist.
    """

    groups: Any = None

    width: ClassVar[int] = 1
    adapts: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.groups is not None:
            groups = tuple(tuple(int(i) for i in group) for group in self.groups)
            members = [i for group in groups for i in group]
            if len(set(members)) != len(members) or not all(members_of for members_of in groups):
                raise ValueError(f"AdaptiveKalman: groups must be disjoint and not empty; got {self.groups!r}.")
            numbers("AdaptiveKalman", "groups", members, low=0.0)
            self._set("groups", groups)

    def state(self, n: int) -> Mapping[str, Any]:
        beyond = [i for group in self.groups or () for i in group if i >= n]
        if beyond:
            raise ValueError(f"AdaptiveKalman: groups name parameter {beyond[0]}, but there are {n} (0 .. {n - 1}).")
        modes, levels = filters(n, self.groups), any_level()
        K, J = len(modes["mu"]), len(levels["nu"])
        return {
            "theta": np.zeros(n),
            "P": np.zeros((n, n)),
            "g": np.zeros(n),
            "r": 1.0,
            "scale": np.nan,
            "squares": 0.0,
            "count": 0.0,
            "settled": 0,
            "gain": np.zeros((n, K)),
            "e_k": np.zeros(K),
            "step": np.zeros(K),
            "h": np.zeros(K),
            "inverse": np.zeros((J, K)),
            "joint": np.zeros((J, K)),
            **knowing_nothing(n, ALMOST_ANY),
            **no_excitation(n),
            **modes,
            **levels,
        }

    @property
    def steps(self) -> TrackerSteps:
        return TrackerSteps(predict, correct, report, begin, machines=MACHINES)

    def learning(self, lane: Mapping[str, Array]) -> Array:
        return learned(lane)
