"""A Kalman filter that estimates its own settings: drift ratio, noise variance and jumps, from the data as they arrive.

K random-walk filters run side by side. Filter k lets parameter i drift by ``q_ki = ratio_k w_ki r / c_i`` per nominal
sample, where r is the present noise variance and c_i the mean square of regressor i, so ratio_k w_ki is the share of r
that the drift of one parameter adds to the output per sample, whatever the units. The first ratio is 0. In the common
ladder of ratios all weights w are 1; in a second one they are learned from the record
(`driftfit.trackers.parts.modes.weights`); the filters of a third follow a trend
(`driftfit.trackers.parts.modes.drifts.trend`); those of a fourth drift in one direction, which is learned too
(`driftfit.trackers.parts.modes.drifts.one_direction`), those of a fifth about the mean regressors, beside an intercept
(`driftfit.trackers.parts.modes.drifts.about_means`); with up to eight parameters, each has a ladder on which it alone
drifts; one filter takes the last outlier for a jump (`driftfit.trackers.parts.modes.drifts.after_outlier`); and the
last comes to rest after a change (`driftfit.trackers.parts.modes.drifts.at_rest`). The filters are the modes of a
Markov chain and interact (`driftfit.trackers.parts.modes.ladder`).

The noise variance has J levels f_j r, the last an outlier's (`driftfit.trackers.parts.modes.noise_levels`). For each
filter the levels are merged at once, by a rank-one update (`driftfit.trackers.parts.modes.filters`). The variance r is
never below that due to coarse readings (`driftfit.trackers.parts.coarse.resolution`). If innovations are correlated,
the previous one is an additional regressor (`driftfit.trackers.parts.modes.coloured`).

Readings are judged by a gate (`driftfit.readings.gate`), which is on for this tracker, and not here. Outliers that keep
coming are a change of level: a leap of the parameters (`driftfit.trackers.parts.modes.ladder`), or more noise.

The results are the mean and covariance of the mixture, the latter enlarged because probabilities of filters and r are
estimates themselves (`driftfit.trackers.parts.modes.filters`). The one-step variance excludes the outlier level, so its
band is for samples that are not outliers.

The start is exact diffuse least squares without drift, in which regressors out of proportion count less too, until
there are enough residuals to estimate r; its bands are Student's (`driftfit.trackers.parts.few_residuals`). Every
filter starts from generalised least squares with its own drift over the same samples
(`driftfit.trackers.parts.modes.start`), in the directions that the regressors span. Scaling inputs or outputs changes
only the units.

Use it if nothing is known; if q and r are known, `Kalman` is as good and far cheaper. Which parameters drift is learned
in a few hundred samples; ``groups`` specifies it from the start.

Source: interacting multiple models are Blom and Bar-Shalom (1988); the ladder of ratios, its transitions, the noise
levels and the scaling are ours. Cost per sample: O(K n^2 + K J) for K modes and J levels; without groups K = 27 + 3 n
for two to eight parameters, and 27 for more.
"""

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
from driftfit.trackers.parts.coarse.resolution import resolution, resolve, unresolved
from driftfit.trackers.parts.coarse.shared_rounding import nothing_shared_among_filters, share_among_filters
from driftfit.trackers.parts.coordinates import (
    FRAME,
    frame,
    located,
    located_within,
    unseen_variance,
    whiten,
    whiten_within,
)
from driftfit.trackers.parts.covariance import prediction
from driftfit.trackers.parts.diffuse import knowing_nothing, spanned_variance
from driftfit.trackers.parts.excitation import (
    learn_information,
    learn_scales,
    learned,
    no_excitation,
    not_learned,
    window,
)
from driftfit.trackers.parts.few_residuals import RESIDUALS, widen_estimates, wider
from driftfit.trackers.parts.modes.coloured import colour, learn_colour, white, whiten_noise
from driftfit.trackers.parts.modes.drifts.about_means import learn_means
from driftfit.trackers.parts.modes.drifts.after_outlier import no_jump, suppose_jump
from driftfit.trackers.parts.modes.drifts.at_rest import come_to_rest
from driftfit.trackers.parts.modes.filters import (
    enter_filters,
    innovate,
    mixture,
    outgrown,
    predict,
    update_filters,
    weigh,
)
from driftfit.trackers.parts.modes.ladder import filters, mix
from driftfit.trackers.parts.modes.noise_levels import any_level, finest, learn_noise, noise_prior
from driftfit.trackers.parts.modes.smoother import SMOOTHER_FIELDS, estimated_variances, store_for_smoother
from driftfit.trackers.parts.modes.start import begin_with_drift, forecast_start, start_density, take_start
from driftfit.trackers.parts.modes.weights import learn_weights, machine_weights, no_weights
from driftfit.trackers.parts.proportion import (
    FIRST,
    bound_leverage,
    learn_proportion,
    no_proportion,
)


@kernel
def interact(s: State, l: int) -> None:
    if s.ok[l] > 0.0:
        # now, not before the next sample: its prediction may not depend on whether its output will be there
        mix(s, l)


@kernel
def go_on(s: State, l: int) -> None:
    """The estimate of the mixture, and the interaction of the filters, while columns may be free."""
    if s.ok[l] > 0.0:
        located_within(s, l)
    interact(s, l)
    unseen_variance(s, l)


@partial(kernel, short=True)
def settle(s: State, l: int) -> None:
    """Start the filters from least squares once there are residuals to estimate r: z = M theta ~ N(d, r I)."""
    s.r[l] = max(s.scale[l], finest(s, l))
    s.scale[l] = 1.0
    s.settled[l] = 1
    for i in range(s.theta.shape[0]):
        for k in range(s.modes[l]):
            s.m[i, k, l] = s.d[i, l]
            s.C[i, i, k, l] = 1.0 if s.S[i, i, l] > 0.0 else 0.0
    frame(s, l)
    begin_with_drift(s, finest(s, l), l)
    mixture(s, l)
    go_on(s, l)


@partial(kernel, inline=False)
def look_ahead(s: State, entering: int, l: int) -> None:
    """Prediction of the running filters, and its variance; ``entering`` is the column in a new direction, or -1."""
    s.column[l] = entering
    resolve(s, l)
    noise_prior(s, l)
    bound_leverage(s, l)
    innovate(s, l)
    if entering >= 0:
        s.y_hat[l] = prediction(s, l)
        s.e[l], s.s[l] = s.y[l] - s.y_hat[l], np.inf


@partial(kernel, inline=False)
def follow(s: State, l: int) -> None:
    """One sample of the running filters."""
    s.outlier[l], s.weighed[l] = 0.0, 0
    column = s.column[l] if s.column[l] >= 0 else outgrown(s, l)
    if s.ok[l] > 0.0 and column >= 0:
        enter_filters(s, column, l)
    elif s.ok[l] > 0.0:
        s.weighed[l] = 1
        weigh(s, l)
        suppose_jump(s, l)
        update_filters(s, l)
        come_to_rest(s, l)
        learn_weights(s, l)
        learn_noise(s, l)
    learn_colour(s, l)
    learn_scales(s, l)
    learn_means(s, l)
    learn_information(s, s.leverage[l] * s.noise[l], l)
    learn_proportion(s, l, s.outlier[l])


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
    share_among_filters(s, l)
    if s.ok[l] > 0.0:
        located(s, l)
    interact(s, l)


@kernel
def forecast_first(s: State, l: int) -> None:
    """That of least squares until the filters start; afterwards of the running filters, while there are directions
    without information.
    """
    if s.settled[l] > 0:
        whiten_noise(s, l)
        look_ahead(s, whiten_within(s, s.white.ctypes.data, l), l)
    else:
        resolve(s, l)
        forecast_start(s, l)
        s.s[l] *= wider(s.count[l])


@kernel
def correct_first(s: State, l: int) -> None:
    if s.settled[l] > 0:
        follow(s, l)
        mixture(s, l)
        share_among_filters(s, l)
        go_on(s, l)
    else:
        residuals = s.count[l]
        take_start(s, l)
        if s.h[l] < np.inf:
            s.density[l] = start_density(s.e[l], s.s[l] / wider(residuals), residuals)
        rank, n = s.rank[l] - s.absent[l], s.parameters[l]
        # a column that enters late, as of signals that a model has to compute first, has no residuals yet
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
class AdaptiveKalman(Tracker):
    """Random-walk Kalman filter that needs no settings.

    Parameters
    ----------
    groups : sequence of sequences of indices, or None
        Parameters that drift together, such as ``[[0, 1], [2]]``: each group has filters in which it alone drifts.
        None: each of up to eight parameters has.

    Raises
    ------
    ValueError
        If an index appears in two groups, or (when it runs) does not exist.
    """

    groups: Any = None

    width: ClassVar[int] = 1
    outputs: ClassVar[tuple[str, ...]] = ("density",)
    density: ClassVar[str] = "density"
    smoother_fields: ClassVar[tuple[str, ...]] = SMOOTHER_FIELDS
    adapts: ClassVar[bool] = True
    gated: ClassVar[bool] = True
    scratch: ClassVar[tuple[str, ...]] = (
        "pivot", "at_start", "gain", "e_k", "step", "h_k", "inverse", "joint", "mu_next", "share", "row", "m_next",
        "weighted", "Z", "away", "about_drift",
    )  # fmt: skip
    """Not H and work, which `driftfit.trackers.parts.coordinates.frame` fills only where the coordinates change."""

    def __post_init__(self) -> None:
        if self.groups is not None:
            groups = tuple(
                tuple(whole("AdaptiveKalman", "an index in groups", i, 0) for i in group) for group in self.groups
            )
            members = [i for group in groups for i in group]
            if len(set(members)) != len(members) or not all(members_of for members_of in groups):
                raise ValueError(f"AdaptiveKalman: groups must be disjoint and not empty; got {self.groups!r}.")
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
            "x": np.zeros(n),
            "W": np.zeros((n, n)),
            "density": np.nan,
            "r": 1.0,
            "scale": np.nan,
            "squares": 0.0,
            "count": 0.0,
            "settled": 0,
            "weighed": 0,
            "column": -1,
            "vague": 0.0,
            "gain": np.zeros((n, K)),
            "e_k": np.zeros(K),
            "step": np.zeros(K),
            "h_k": np.zeros(K),
            "weighted": np.zeros(K),
            "mean_prior": np.zeros(K),
            "inverse": np.zeros((J, K)),
            "joint": np.zeros((J, K)),
            **knowing_nothing(n),
            **no_excitation(n),
            **no_proportion(),
            **unresolved(),
            **nothing_shared_among_filters(),
            **no_weights(n),
            **white(n),
            **no_jump(n),
            **modes,
            **levels,
        }

    @property
    def pads(self) -> bool:
        return True

    @property
    def steps(self) -> TrackerSteps:
        return TrackerSteps(
            predict,
            forecast,
            correct,
            report,
            nothing,
            TrackerSteps(predict, forecast_first, correct_first, nothing, nothing),
            store=keep_density,
            store_for_smoother=store_for_smoother,
            machines=(*FRAME, machine_weights),
            doubts=True,
            outlined=True,
        )

    def regression(self, fields: Mapping[str, Array], phi: Array, y: Array) -> tuple[Array, Array]:
        running = np.append(False, fields["settled"][:-1] > 0)  # not yet at the sample with which the filters start
        return np.where(running[:, None], fields["white"], phi), np.where(running, y - fields["explained"], y)

    def estimated_variances(
        self, model: Model, fields: Mapping[str, Array], phi: Array, e: Array, time: Array
    ) -> tuple[Array, Array, Array, Array]:
        return estimated_variances(fields, phi, e, time, self.state(model.n))

    def widen(self, lane: Mapping[str, Array], p: Array) -> None:
        if lane["settled"]:
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
        lane, names = run.state, np.array(run.names)
        never = np.isinf(lane["var"])
        lately = ~never & ~learned(lane)
        facts = []
        if never.any():
            facts.append(not_learned(run, names[never]))
        if lately.any():
            facts.append(("Not learned now", f"{', '.join(names[lately])}: not excited by the last regressors"))
        return (
            *facts,
            *resolution(lane),
            *colour(lane),
        )

    def unlearned(self, lane: Mapping[str, Array]) -> Array:
        never = np.isinf(lane["var"])
        return never & bool(lane["settled"] and lane["power_samples"] >= window(len(never)))
