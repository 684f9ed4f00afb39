"""A Kalman filter that estimates its own settings: drift, noise variance and jumps, from the data as they arrive.

    y[t]  = phi[t]' theta[t] + v[t],              v[t] = e[t] + c e[t-1],  e of variance V
    theta[t] = theta[t-1] (+ slope) + w[t],       w ~ N(0, rho r Q)        one pair (Q, rho) is one mode

| ladder | Q, in units of noise variance over input power | rho |
|---|---|---|
| common | 1 / c_i, c_i = mean phi_i^2; inputs far from 0 drift about their means | 0, 1e-4 .. .01, .04, .2, 1, J |
| trend | as common; theta moves on along its slope | .001, .01, .1 |
| learned | the drift covariance found by a backward pass of scores over the last 40 samples | .001, .01, .1, 1 |
| single i | 1 / c_i for parameter i alone (two to eight parameters), or for those of a group | .003, .05, 1, J |

J, the largest jump, is 1000, or e^2 / r where that is more, but not more than the mean square of y. It lasts for two
samples: then the filter goes on with the next smaller ratio. Every mode is a Kalman filter. They are merged after every
sample. Noise is quiet, restless, or an outlier of any size, and coarse readings that repeat share their rounding
(`driftfit.trackers.mixture.filters`). Scales, means, noise, its colour and the covariance of the drift are learned
(`driftfit.trackers.mixture.learned`). Readings are judged by a gate (`driftfit.readings.gate`), which is on for this
tracker, and not here.

The results are the mean and covariance of the mixture, the latter enlarged because probabilities of filters and r are
estimates themselves. The variance before a sample is for samples that are no outliers: the geometric mean, by their
probabilities, of the variances with and without a jump in the last samples. The covariance has jumps that no sample
ruled out; that of a forecast has none after the last sample: it holds until theta jumps.

The start is exact diffuse least squares without drift, until there are enough residuals to estimate r; its bands are
Student's (`driftfit.trackers.student`). All filters start from these least squares, in the directions that the
regressors span. Scaling inputs or outputs changes only the units.

``volatility`` makes log r a random walk (`driftfit.trackers.forms.volatility`): the number of samples that tell of r,
its memory and the degrees of freedom, falls between samples, 2 / count <- 2 / count + volatility dt.

Use it if nothing is known; if q and r are known, `Kalman` is as good and far cheaper. Which parameters drift is learned
in a few hundred samples; ``groups`` specifies it from the start.

Source: interacting multiple models are Blom and Bar-Shalom (1988); the modes and what is learned are ours. Cost per
sample: O(K n^2) for K modes; without groups K = 15 + 4 n for two to eight parameters, and 15 for more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array, State, kernel, nothing
from driftfit.engine.settings import numbers, whole
from driftfit.readings.repeats import note_reading
from driftfit.trackers.base import Tracker
from driftfit.trackers.forms.coordinates import located_within, unseen_variance
from driftfit.trackers.forms.diffuse import MACHINES, knowing_nothing, spanned_variance
from driftfit.trackers.forms.excitation import FIRST, learned, no_excitation, window
from driftfit.trackers.forms.information import partly_known
from driftfit.trackers.mixture.filters import (
    FAR,
    MOST_ALONE,
    STILL,
    bank,
    mix,
    mixture,
    predict,
)
from driftfit.trackers.mixture.learned import (
    MEMORY_OF_R,
    colour,
    follow,
    forecast_start,
    look_ahead,
    nothing_learned,
    settle,
    start_density,
    take_start,
)
from driftfit.trackers.student import RESIDUALS, widen_estimates, wider


@kernel
def forecast(s: State, l: int) -> None:
    """Of the filters, and of least squares until they start."""
    s.density[l] = np.nan
    if s.restless[l] > 0.0:
        look_ahead(s, l)
    else:
        forecast_start(s, l)
        s.s[l] *= wider(s.count[l])


@kernel
def correct(s: State, l: int) -> None:
    if s.restless[l] > 0.0:
        follow(s, l)
        return
    residuals = s.count[l]
    take_start(s, l)
    if s.h[l] < np.inf:
        s.density[l] = start_density(s.e[l], s.s[l] / wider(residuals), residuals)
    n = s.parameters[l]
    rank = s.rank[l] - (s.theta.shape[0] - n)  # without the parameters that are known
    # a column that enters late, as of signals that a model has to compute first, has no residuals yet
    early = rank == n and s.remembered[l] <= n + RESIDUALS
    enough = s.count[l] >= RESIDUALS and (early or s.remembered[l] >= FIRST)
    spanned_variance(s, l)
    if enough and s.remembered[l] - rank >= RESIDUALS:
        settle(s, l)
    else:
        widen_estimates(s, l)


@kernel
def report(s: State, l: int) -> None:
    if s.restless[l] > 0.0:
        mixture(s, l)
        if s.ok[l] > 0.0:
            located_within(s, l)
            # now, not before the next sample: its prediction may not depend on whether its output will be there
            mix(s, l)
        unseen_variance(s, l)


@kernel
def predict_moving(s: State, l: int) -> None:
    """As before, and log r walks: 2 / count <- 2 / count + volatility dt."""
    predict(s, l)
    if s.restless[l] > 0.0:
        s.count[l] /= 1.0 + 0.5 * s.volatility[l] * s.dt[l] * s.count[l]


SMOOTHER_FIELDS = ("drift_rate", "usual_noise", "white", "explained", "restless", "mean", "variance", "c")
"""Fields that are stored at every sample for the smoother (`driftfit.smooth.unknown_drift`): the drift r sum mu_k rho_k
of rho_k < 1, the noise 1 / r_t = sum_j nu_tj / v_tj, signals without coloured noise, and means."""


@kernel
def store_for_smoother(o: State, s: State, l: int) -> None:
    """Store the fields of the smoother."""
    for i in range(s.c.shape[0]):
        o.white[i, l], o.c[i, l] = s.white[i, l], s.c[i, l]
        o.mean[i, l], o.variance[i, l] = s.mean[i, l], s.variance[i, l]
    o.drift_rate[l], o.usual_noise[l] = s.drift_rate[l], s.usual_noise[l]
    o.explained[l], o.restless[l] = s.explained[l], s.restless[l]


@kernel
def keep_density(o: State, s: State, l: int) -> None:
    o.density[l] = s.density[l]


def drift_ahead(rate: Array) -> Array:
    """The mean of the rate (T,) over the next `MEMORY_OF_R` samples."""
    total, now = np.append(0.0, np.cumsum(rate)), np.arange(len(rate))
    until = np.minimum(now + int(MEMORY_OF_R), len(rate))
    return np.asarray((total[until] - total[now]) / (until - now))


def centring(fields: Mapping[str, Array], phi: Array) -> Array:
    """The matrix A (n, n) for which phi A are the regressors (N, n) less their means, where these are far from 0."""
    c, v, A = fields["c"], fields["variance"], np.eye(phi.shape[1])
    constant = (v <= STILL * c) & (fields["mean"] != 0.0)
    beside = (c > (1.0 + FAR) * v) & (v > STILL * c) & constant.any(axis=1)[:, None]
    for k in np.flatnonzero(constant[-1])[-1:]:
        mean = phi.mean(axis=0)
        A[k] = np.where(beside.any(axis=0), -mean / mean[k], A[k])
    return A


@dataclass(frozen=True)
class AdaptiveKalman(Tracker):
    """Random-walk Kalman filter that needs no settings.

    Parameters
    ----------
    groups : sequence of sequences of indices, or None
        Parameters that drift together, such as ``[[0, 1], [2]]``: each group has filters in which it alone drifts.
        None: each of up to eight parameters has.
    volatility : number or None
        Variance of the change of log r in a nominal sample; positive. None: r has a memory of 70 samples, as with 4e-4
        and less.

    Raises
    ------
    ValueError
        If an index appears in two groups, or (when it runs) does not exist, or volatility is not positive.
    """

    groups: Any = None
    volatility: float | None = None

    width: ClassVar[int] = 1
    outputs: ClassVar[tuple[str, ...]] = ("density",)
    density: ClassVar[str] = "density"
    smoother_fields: ClassVar[tuple[str, ...]] = SMOOTHER_FIELDS
    adapts: ClassVar[bool] = True
    gated: ClassVar[bool] = True
    scratch: ClassVar[tuple[str, ...]] = (
        "pivot", "H", "work", "at_start", "R", "W", "x", "white", "explained", "gain", "e_k", "step", "h_k", "curve",
        "inverse", "joint", "share", "row", "walk", "Z", "away", "density", "drift_rate", "usual_noise",
    )  # fmt: skip

    def __post_init__(self) -> None:
        if self.groups is not None:
            index = partial(whole, "AdaptiveKalman", "an index in groups", low=0)
            groups = tuple(tuple(map(index, group)) for group in self.groups)
            members = [i for group in groups for i in group]
            if len(set(members)) != len(members) or not all(groups):
                raise ValueError(f"AdaptiveKalman: groups must be disjoint and not empty; got {self.groups!r}.")
            self._set("groups", groups)
        if self.volatility is not None:
            given = numbers("AdaptiveKalman", "volatility", self.volatility, ndim=0, low=0.0, strict=True)
            self._set("volatility", given)

    def state(self, n: int) -> Mapping[str, Any]:
        beyond = [i for group in self.groups or () for i in group if i >= n]
        if beyond:
            raise ValueError(f"AdaptiveKalman: groups name parameter {beyond[0]}, but there are {n} (0 .. {n - 1}).")
        return {
            "theta": np.zeros(n),
            "P": np.zeros((n, n)),
            "x": np.zeros(n),
            "W": np.zeros((n, n)),
            "density": np.nan,
            "r": 1.0,
            "scale": np.nan,
            "count": 0.0,
            "vague": 0.0,
            **{name: value for name, value in knowing_nothing(n).items() if name != "worst"},
            **no_excitation(n),
            **nothing_learned(n),
            **bank(n, self.groups),
            **({} if self.volatility is None else {"volatility": self.volatility}),
        }

    def partly_known(self, n: int, N: int) -> Mapping[str, Any] | None:
        return partly_known(self.state(n), self.state(N))

    @property
    def steps(self) -> TrackerSteps:
        return TrackerSteps(
            predict if self.volatility is None else predict_moving,
            forecast,
            correct,
            report,
            nothing,
            store=keep_density,
            store_for_smoother=store_for_smoother,
            machines=MACHINES,
            doubts=True,
            outlined=True,
            note=note_reading,
        )

    def regression(self, fields: Mapping[str, Array], phi: Array, y: Array) -> tuple[Array, Array]:
        running = np.append(False, fields["restless"][:-1] > 0.0)  # not yet at the sample with which the filters start
        return np.where(running[:, None], fields["white"], phi), np.where(running, y - fields["explained"], y)

    def problem(self, fields: Mapping[str, Array], phi: Array) -> tuple[Array, Array, Array, Sequence[Sequence[int]]]:
        n = phi.shape[1]
        groups = [[i] for i in range(n)] if self.groups is None and n <= MOST_ALONE else self.groups or ()
        running = fields["restless"] > 0.0
        noise = np.where(running, fields["usual_noise"], fields["usual_noise"][np.argmax(running)])
        rate = np.where(running, drift_ahead(fields["drift_rate"]), 0.0)
        return centring(fields, phi), noise, rate, groups

    def widen(self, lane: Mapping[str, Array], p: Array) -> None:
        if lane["restless"] > 0.0:
            lane["C"][:] += np.tril((lane["S"] * p) @ lane["S"].T)[..., None]
            np.einsum("ii->i", lane["P"])[:] += p
            lane["var"][:] += p
        else:
            super().widen(lane, p)

    def place(self, lane: Mapping[str, Array], which: Sequence[int], values: Array) -> None:
        """All filters are moved by the same amount, so that their mixture is at the given value."""
        before = lane["d"].copy()
        super().place(lane, which, values)
        lane["m"][:] += (lane["d"] - before)[:, None]

    def learning(self, lane: Mapping[str, Array]) -> Array:
        return learned(lane)

    def remarks(self, run: Any) -> tuple[tuple[str, str], ...]:
        lane = run.state
        lately = np.array(run.names)[np.isfinite(lane["var"]) & ~learned(lane)]
        text = f"{', '.join(lately)}: not excited by the last regressors"
        return (*((("Not learned now", text),) if len(lately) else ()), *colour(lane))

    def unlearned(self, lane: Mapping[str, Array]) -> Array:
        never = np.isinf(lane["var"])
        return never & bool(lane["restless"] > 0.0 and lane["power_samples"] >= window(len(never)))
