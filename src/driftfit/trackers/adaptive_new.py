"""trial"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array, State, kernel, nothing
from driftfit.engine.settings import whole
from driftfit.models.base import Model
from driftfit.trackers.base import Tracker
from driftfit.trackers.parts.coordinates import FRAME, frame, located, located_within, unseen_variance, whiten, whiten_within
from driftfit.trackers.parts.covariance import prediction
from driftfit.trackers.parts.diffuse import knowing_nothing, spanned_variance
from driftfit.trackers.parts.excitation import learn_information, learn_scales, learned, no_excitation, not_learned, window
from driftfit.trackers.parts.few_residuals import RESIDUALS, widen_estimates, wider
from driftfit.trackers.parts.mixture.filters import (
    bank, enter_filters, innovate, mix, mixture, outgrown, predict, update_filters, weigh,
)
from driftfit.trackers.parts.mixture.learned import (
    colour, learn_colour, learn_drift, learn_means, machine_drift, nothing_learned, whiten_noise,
)
from driftfit.trackers.parts.mixture.noise import any_noise, learn_noise, least_noise, noise_prior, note_reading, repeated_rounding
from driftfit.trackers.parts.mixture.start import begin_with_drift, forecast_start, start_density, take_start

FIRST = 10


@kernel
def interact(s: State, l: int) -> None:
    if s.ok[l] > 0.0:
        mix(s, l)


@kernel
def go_on(s: State, l: int) -> None:
    if s.ok[l] > 0.0:
        located_within(s, l)
    interact(s, l)
    unseen_variance(s, l)


@partial(kernel, short=True)
def settle(s: State, l: int) -> None:
    s.r[l] = max(s.scale[l], least_noise(s, l))
    s.scale[l] = 1.0
    s.settled[l] = 1
    for i in range(s.theta.shape[0]):
        for k in range(s.modes[l]):
            s.m[i, k, l] = s.d[i, l]
            s.C[i, i, k, l] = 1.0 if s.S[i, i, l] > 0.0 else 0.0
    frame(s, l)
    begin_with_drift(s, least_noise(s, l), l)
    mixture(s, l)
    go_on(s, l)


@partial(kernel, inline=False)
def look_ahead(s: State, entering: int, l: int) -> None:
    s.column[l] = entering
    noise_prior(s, l)
    innovate(s, l)
    if entering >= 0:
        s.y_hat[l] = prediction(s, l)
        s.e[l], s.s[l] = s.y[l] - s.y_hat[l], np.inf


@partial(kernel, inline=False)
def follow(s: State, l: int) -> None:
    s.outlier[l], weighed = 0.0, 0.0
    note_reading(s, l)
    column = s.column[l] if s.column[l] >= 0 else outgrown(s, l)
    if s.ok[l] > 0.0 and column >= 0:
        enter_filters(s, column, l)
    elif s.ok[l] > 0.0:
        weighed = 1.0
        weigh(s, repeated_rounding(s, l), l)
        update_filters(s, l)
        learn_drift(s, l)
        learn_noise(s, l)
    learn_colour(s, weighed, l)
    learn_scales(s, l)
    learn_means(s, l)
    learn_information(s, s.noise[l], l)


@kernel
def forecast(s: State, l: int) -> None:
    whiten_noise(s, l)
    whiten(s, l)
    look_ahead(s, -1, l)


@kernel
def correct(s: State, l: int) -> None:
    follow(s, l)


@kernel
def report(s: State, l: int) -> None:
    mixture(s, l)
    if s.ok[l] > 0.0:
        located(s, l)
    interact(s, l)


@kernel
def forecast_first(s: State, l: int) -> None:
    if s.settled[l] > 0:
        whiten_noise(s, l)
        look_ahead(s, whiten_within(s, s.white.ctypes.data, l), l)
    else:
        forecast_start(s, l)
        s.s[l] *= wider(s.count[l])


@kernel
def correct_first(s: State, l: int) -> None:
    if s.settled[l] > 0:
        follow(s, l)
        mixture(s, l)
        go_on(s, l)
    else:
        residuals = s.count[l]
        take_start(s, l)
        if s.h[l] < np.inf:
            s.density[l] = start_density(s.e[l], s.s[l] / wider(residuals), residuals)
        rank, n = s.rank[l] - s.absent[l], s.parameters[l]
        early = rank == n and s.remembered[l] <= n + RESIDUALS
        enough = s.count[l] >= RESIDUALS and (early or s.remembered[l] >= FIRST)
        spanned_variance(s, l)
        if enough and s.remembered[l] - rank >= RESIDUALS:
            settle(s, l)
        else:
            widen_estimates(s, l)


@kernel
def keep_density(o: State, s: State, l: int) -> None:
    o.density[l] = s.density[l]


@dataclass(frozen=True)
class AdaptiveNew(Tracker):
    """trial"""

    groups: Any = None

    width: ClassVar[int] = 1
    outputs: ClassVar[tuple[str, ...]] = ("density",)
    density: ClassVar[str] = "density"
    adapts: ClassVar[bool] = True
    gated: ClassVar[bool] = True

    def state(self, n: int) -> Mapping[str, Any]:
        return {
            "theta": np.zeros(n),
            "P": np.zeros((n, n)),
            "x": np.zeros(n),
            "W": np.zeros((n, n)),
            "density": np.nan,
            "r": 1.0,
            "scale": np.nan,
            "squares": 0.0,
            "count": 0.0,
            "waited": 0.0,
            "settled": 0,
            "column": -1,
            "shift": 0.0,
            **knowing_nothing(n),
            **no_excitation(n),
            **nothing_learned(n),
            **bank(n, self.groups),
            **any_noise(),
        }

    @property
    def pads(self) -> bool:
        return True

    @property
    def steps(self) -> TrackerSteps:
        return TrackerSteps(
            predict, forecast, correct, report, nothing,
            TrackerSteps(predict, forecast_first, correct_first, nothing, nothing),
            store=keep_density, machines=(*FRAME, machine_drift), outlined=True,
        )

    def learning(self, lane: Mapping[str, Array]) -> Array:
        return learned(lane)

    def unlearned(self, lane: Mapping[str, Array]) -> Array:
        never = np.isinf(lane["var"])
        return never & bool(lane["settled"] and lane["power_samples"] >= window(len(never)))
