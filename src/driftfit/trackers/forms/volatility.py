"""Stochastic volatility: the logarithm of the noise variance r is a random walk, known as far as residuals tell.

    log r_t = log r_{t-1} + eta_t,  eta ~ N(0, volatility dt)
    1 / r_t | past ~ Gamma with mean 1 / r and nu degrees of freedom: the variance of log r_t is about 2 / nu

    predict   2 / nu <- 2 / nu + volatility dt
    forecast  v = h + r / w;  (y - y_hat) / sqrt(v) ~ t_nu;  s = v (t / z)^2
    correct   k = (r / w) / v;  r <- r (nu + k e^2 / v) / (nu + k);  nu <- nu + k
    smooth    1 / r_t|T = 1 / r_t + (nu_t+1|t / nu_t) (1 / r_t+1|T - 1 / r_t)

with h the variance of the prediction, w the weight of the sample and k the share of the noise in v: a sample whose
prediction is uncertain says little of r. theta is corrected, and smoothed, as if r were known. Before the first sample
r is the setting, and nu infinite. t / z is the ratio of Student's quantile to the normal one
(`driftfit.trackers.student`): y_hat +- 1.96 sqrt(s) holds 95 %.

For h = 0 the correction is Bayes' rule. In the long run r has a memory of sqrt(2 / volatility) samples, 14 for 0.01,
as from variance discounting. Unlike discounting, a gap in the record widens what is known of r by its length only.

Source: West and Harrison, Bayesian Forecasting and Dynamic Models (1997), section 10.8, who discount nu, with the
smoother; Shephard,
Local scale models, J. Econometrics 60 (1994). The random walk in place of the discount, and k, are ours. Cost: O(1).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array, State, kernel
from driftfit.trackers.student import log_student, wider

FIELDS = {
    "outputs": ("degrees", "unwidened"), "density": "degrees", "smoother_fields": ("r", "spread", "degrees"),
}  # fmt: skip
"""What a tracker with these steps stores of every sample: nu and v before it, and r and 1 / nu after it."""


def known_noise(volatility: float) -> Mapping[str, Any]:
    """Fields before the first sample; ``spread`` is 1 / nu."""
    return {"volatility": volatility, "spread": 0.0, "degrees": np.inf, "unwidened": np.nan}


@kernel
def variance(s: State, l: int) -> None:
    """v, nu and s."""
    s.degrees[l], s.unwidened[l] = 1.0 / s.spread[l], s.h[l] + s.r[l] * s.noise[l]
    s.s[l] = s.unwidened[l] * wider(s.degrees[l])


@kernel
def learn(s: State, l: int) -> None:
    """r and 1 / nu after the sample, if it is used and had a prediction."""
    noise = s.r[l] * s.noise[l]
    v = s.h[l] + noise
    share = s.spread[l] * noise / v if (s.ok[l] > 0.0) & (v < np.inf) else 0.0
    s.r[l] *= (1.0 + share * (s.e[l] * s.e[l] / v if share > 0.0 else 0.0)) / (1.0 + share)
    s.spread[l] /= 1.0 + share


@kernel
def store(o: State, s: State, l: int) -> None:
    """What the densities are computed from."""
    o.degrees[l], o.unwidened[l] = s.degrees[l], s.unwidened[l]


@kernel
def store_for_smoother(o: State, s: State, l: int) -> None:
    o.r[l], o.spread[l], o.degrees[l] = s.r[l], s.spread[l], s.degrees[l]


@lru_cache
def volatile(steps: TrackerSteps) -> TrackerSteps:
    """The steps of a filter whose noise variance s.r moves, from those of the filter that is given it."""
    predict, correct = steps.predict, steps.correct

    @kernel
    def predict_both(s: State, l: int) -> None:
        predict(s, l)
        s.spread[l] += 0.5 * s.volatility[l] * s.dt[l]

    @kernel
    def correct_both(s: State, l: int) -> None:
        correct(s, l)
        learn(s, l)

    start = None if steps.start is None else volatile(steps.start)
    return steps._replace(
        predict=predict_both, correct=correct_both, variance=variance, store=store, start=start,
        store_for_smoother=store_for_smoother,
    )  # fmt: skip


def smoothed_noise(fields: Mapping[str, Array]) -> Array:
    """r of every sample (T,) given all of them."""
    precision, kept = 1.0 / fields["r"], fields["spread"][:-1] * fields["degrees"][1:]
    for t in range(len(kept) - 1, -1, -1):
        precision[t] += kept[t] * (precision[t + 1] - precision[t])
    return np.asarray(1.0 / precision)


def log_density(out: Array) -> Array:
    """Student's log density of every sample (T, L)."""
    return log_student(out["e"], out["unwidened"], out["degrees"])
