"""Output-error filter: an extended Kalman filter that simulates the linear block, so that y is never a regressor.

    state       [w_t .. w_{t-na+1}, xi_t],   xi = (a, b, c_2 .., d_2 ..) a random walk of covariance q
    predict     w_t = -a'[w_{t-1} .. w_{t-na}] + sum_j b_j v_{t-nk-j+1} (- l) + N(0, q_w), v and b of every input
                row of the transition: -a | -w_{t-i} | v_{t-nk-j+1} | sum_j b_j f_k(u) | 0 | (-1), then the shifts
    measure     y_t = F^-1(w_t; d) + n_t,  n ~ N(0, r);   F' = F'(y_hat), at least 0.05 of the slope of the functions
                row of the measurement: 1 / F' for w_t, -g_k(y_hat) / F' for d_k

Measurement noise of y biases every method that has y among its regressors; here it appears in the measurement only. A
missing y only skips the measurement; a missing input is treated as v = 0 with its usual power as process noise. In
return, the filter converges only locally and needs an initial value in its basin of attraction, such as the separation
of stage one. The past w are taken from the first outputs. w is limited to three times the range of F over the observed
outputs, whatever the poles are.

innovation, its variance and the likelihood are those of y. Source: the output-error form of Ljung and Soderstrom (1983)
with the blocks of Feng and Hong (2021); the limits are ours. Cost per sample: O((na + n_x)^2).

S is the covariance of [w, xi], of which the lower triangle is kept; its first n_w = max(na, 1) entries are the last
outputs of the linear block. The model's values for the present input and output are in its memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import LARGEST, TrackerSteps
from driftfit.engine.kernel import Array, State, Step, kernel
from driftfit.engine.settings import matrix
from driftfit.models.base import Model
from driftfit.models.hammerstein_wiener.extended_kalman import Minimal, structure_of
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.output_curve import GRID, at_point, inverting, rises, trying
from driftfit.models.hammerstein_wiener.steps import Input, driven
from driftfit.models.hammerstein_wiener.structure import Structure
from driftfit.trackers.forms.covariance import LEFT

SLOPE_SHARE = 0.05
"""Least slope of F that the filter divides by, as a share of the slope of its functions."""
W_RANGE = 3.0
"""w is limited to this many times the largest w of the observed outputs."""
TINY = 1e-300
"""Smallest variance of a missing input, so that a sample without an input is marked even if b is 0."""
OUTAGE_STD = 1e3
"""Largest standard deviation of w as a multiple of that: an unstable estimate must not grow without bound in an outage.
The cross-covariances shrink along."""
POWER_WEIGHT, POWER_LIMIT = 0.01, 25.0
"""The weight of a sample in the usual power of v, and the largest multiple of that power that its square counts as, so
that a fault code cannot become the scale.
"""


@kernel
def past_levels(s: State, na: int, l: int) -> None:
    """w = F(y) at the last outputs, each of variance p_w and independent of xi."""
    for i in range(na):
        total = s.output_lags[i + 1, 0, l]
        for k in range(1, s.d_now.shape[0]):
            total += s.d_now[k, l] * s.output_lags[i + 1, k, l]
        s.w[i, l] = total if total == total else 0.0
        for x in range(i, s.S.shape[0]):
            s.S[x, i, l] = 0.0
        s.S[i, i, l] = s.p_w[l]


@kernel
def product(s: State, total: float, l: int) -> float:
    """``moved`` = S row from the lower triangle; returns row' S row, added to a total."""
    N = s.S.shape[0]
    for x in range(N):
        value = 0.0
        for z in range(x + 1):
            value += s.S[x, z, l] * s.row[z, l]
        for z in range(x + 1, N):
            value += s.S[z, x, l] * s.row[z, l]
        s.moved[x, l] = value
        total += s.row[x, l] * value
    return total


@lru_cache
def _transition(structure: Structure, inputs: tuple[Input, ...]) -> Any:
    """A kernel that fills the row of the transition for the present w; returns w."""
    lags, na, at_l = driven(inputs), structure.na, structure.n_x - structure.intercept
    count, n_x = len(lags), structure.n_x

    @kernel
    def transition(s: State, l: int) -> float:
        n_w, total = s.w.shape[0], 0.0
        for x in range(s.row.shape[0]):
            s.row[x, l] = 0.0
        for i in range(na):
            s.row[i, l] = -s.theta[i, l]
            s.row[n_w + i, l] = -s.w[i, l]
            total -= s.theta[i, l] * s.w[i, l]
        for r in range(count):
            b, bc, apart, c = lags[r, 0], lags[r, 1], lags[r, 2], lags[r, 3]
            v = -s.phi[b, l]
            for k in range(lags[r, 4]):
                f = -s.phi[bc + k * apart, l]
                v += s.theta[c + k, l] * f
                s.row[n_w + c + k, l] += s.theta[b, l] * f
            s.row[n_w + b, l] = v
            total += s.theta[b, l] * v
        for x in range(at_l, n_x):
            s.row[n_w + x, l] = -1.0
            total -= s.theta[x, l]
        return total

    return transition


@kernel
def advance(s: State, w: float, q_w: float, reach: float, l: int) -> None:
    """The time update of w, which is held within reach whatever the poles do, and of S."""
    n_w, N = s.w.shape[0], s.S.shape[0]
    own = product(s, q_w, l)
    for i in range(n_w - 1, 0, -1):
        s.w[i, l] = s.w[i - 1, l]
        for j in range(i, 0, -1):
            s.S[i, j, l] = s.S[i - 1, j - 1, l]
        for x in range(n_w, N):
            s.S[x, i, l] = s.S[x, i - 1, l]
    most = OUTAGE_STD * OUTAGE_STD * reach * reach
    shrink = np.sqrt(most / own) if own > most else 1.0
    for x in range(1, N):
        s.S[x, 0, l] = shrink * (s.moved[x - 1, l] if x < n_w else s.moved[x, l])
    s.S[0, 0, l] = min(own, most)
    s.w[0, l] = min(max(w, -reach), reach)


@kernel
def absorb(s: State, l: int) -> None:
    """The measurement update for an innovation e of variance s, with ``moved`` = S h of the forecast."""
    n_w = s.w.shape[0]
    for x in range(s.S.shape[0]):
        k = s.moved[x, l] / s.s[l]
        if x < n_w:
            s.w[x, l] += k * s.e[l]
        else:
            s.theta[x - n_w, l] += k * s.e[l]
        for z in range(x):
            s.S[x, z, l] -= k * s.moved[z, l]
        s.S[x, x, l] = max(s.S[x, x, l] - k * s.moved[x, l], LEFT * s.S[x, x, l])


@lru_cache
def _power(inputs: tuple[Input, ...]) -> tuple[Any, Any]:
    """Two kernels for the usual power of v: the variance that missing inputs leave in w, sum b_j^2 times that power, 0
    where all are there; and the update of the power.
    """
    lags, newest = driven(inputs), np.array([(one.lags, one.c, one.n_in - 1) for one in inputs])
    count, m = len(lags), len(inputs)

    @kernel
    def unknown_power(s: State, l: int) -> float:
        total = 0.0
        for r in range(count):
            missing, b = 0, lags[r, 0]
            for k in range(lags[r, 4] + 1):
                missing += 0 if abs(s.input_lags[lags[r, 5] + k, l]) < LARGEST else 1
            power = s.theta[b, l] * s.theta[b, l] * s.v_power[lags[r, 6], l]
            total += max(power, TINY) if missing > 0 else 0.0
        return total

    @kernel
    def follow_power(s: State, l: int) -> None:
        for i in range(m):
            f, c = newest[i, 0], newest[i, 1]
            v = s.input_lags[f, l]
            for k in range(newest[i, 2]):
                v += s.theta[c + k, l] * s.input_lags[f + 1 + k, l]
            if abs(v) < LARGEST:
                moved = POWER_WEIGHT * (min(v * v, POWER_LIMIT * s.v_power[i, l]) - s.v_power[i, l])
                s.v_power[i, l] += moved if s.v_power[i, l] > 0.0 else v * v

    return unknown_power, follow_power


@kernel
def reach_of(s: State, curved: bool, l: int) -> float:
    """The largest |w| that the outputs observed so far allow."""
    low, high = s.y_lowest[l], s.y_highest[l]
    if curved:
        rising, last = rises(s, l), GRID - 1
        low = at_point(s, s.grid_values, 0, l) if rising else s.envelope[0, l]
        high = at_point(s, s.grid_values, last, l) if rising else s.envelope[last, l]
    reach = W_RANGE * max(abs(low), abs(high))
    return reach if reach > 0.0 and reach < LARGEST else LARGEST


@lru_cache
def _steps(structure: Structure, inputs: tuple[Input, ...], out: Any, curved: bool) -> TrackerSteps:
    """The steps for the orders of a model and the functions of its output."""
    na, n_x, more = structure.na, structure.n_x, structure.n_out - 1
    n_w, at_d = max(na, 1), n_x - structure.intercept - more
    transition, (unknown_power, follow_power) = _transition(structure, inputs), _power(inputs)
    try_output, invert = trying(out), inverting(out)

    @kernel
    def predict(s: State, l: int) -> None:
        """The time update of xi and w, and the variance that missing inputs leave in w."""
        for i in range(n_x):
            for j in range(i + 1):
                s.S[n_w + i, n_w + j, l] += s.q[i, j, l] * (s.dt[l] * s.drift[l])
        for k in range(more):
            s.d_now[k + 1, l] = s.theta[at_d + k, l]
        if s.begun[l] == 0.0 and s.started[l] > 0.0:
            past_levels(s, na, l)
            s.begun[l] = 1.0
        s.unknown[l] = unknown_power(s, l)
        advance(s, transition(s, l), s.q_w[l] + s.unknown[l], reach_of(s, curved, l), l)

    @kernel
    def forecast(s: State, l: int) -> None:
        y_hat, y = s.w[0, l], s.y_given[l]
        if curved:
            y_hat = invert(s, y_hat, l)
        able = abs(y_hat) < np.inf
        try_output(s, y_hat if able else 0.0, l)
        slope = 0.0
        for k in range(more + 1):
            slope += s.d_now[k, l] * s.trial_slopes[k, l]
        slope, given = max(slope, s.least_slope[l]), s.given_noise[l]
        valid, observed = s.unknown[l] == 0.0 and able and s.begun[l] > 0.0, abs(y) < np.inf
        used = valid and observed and given < np.inf
        s.valid[l], s.observed[l] = 1.0 if valid else 0.0, 1.0 if observed else 0.0
        s.ok[l], s.e[l] = 1.0 if used else 0.0, y - y_hat if used else 0.0
        for x in range(s.row.shape[0]):
            s.row[x, l] = 0.0
        s.row[0, l] = 1.0 / slope
        for k in range(more):
            s.row[n_w + at_d + k, l] = -s.trial[k + 1, l] / slope
        s.h[l] = product(s, 0.0, l)
        s.predicted[l], s.y_hat[l] = y_hat, y_hat
        s.noise[l] = given if given < np.inf else 1.0

    @kernel
    def correct(s: State, l: int) -> None:
        if s.ok[l] > 0.0:
            absorb(s, l)
        follow_power(s, l)
        for i in range(n_x):
            for j in range(i + 1):
                s.P[i, j, l] = s.S[n_w + i, n_w + j, l]

    return TrackerSteps(predict, forecast, correct, reads_model=True)


@lru_cache
def _applying(apply: Step, inputs: tuple[Input, ...]) -> Step:
    """The input also updates the usual power of v."""
    _, follow_power = _power(inputs)

    @kernel
    def apply_and_follow(s: State, l: int) -> None:
        apply(s, l)
        follow_power(s, l)

    return apply_and_follow  # type: ignore[no-any-return]


@dataclass(frozen=True)
class OutputError(Minimal):
    """Output-error extended Kalman filter on the minimal parameters of a `HammersteinWiener` model.

    Parameters
    ----------
    q : number, (n_x,), or (n_x, n_x)
        Drift covariance of xi per nominal sample.
    r : number
        Variance of the measurement noise, in squared units of y.
    p0, theta0 : covariance and mean of xi before the first sample
        An initial value in the basin of the truth.
    q_w, p_w : number
        Process noise of w per sample, and variance of the w before the first sample.

    Raises
    ------
    ValueError
        If q or p0 is not a covariance, r is not positive, or (when it runs) the model is no `HammersteinWiener`.
    """

    q: Any = None
    r: float | None = None
    p0: Any = 0.05
    theta0: Any = 0.01
    q_w: float = 1e-6
    p_w: float = 0.5

    width: ClassVar[int] = 1
    output_error: ClassVar[bool] = True

    def __post_init__(self) -> None:
        self._check("q_w", "p_w")

    def state(self, n: int) -> Mapping[str, Any]:
        return self._of_parameters(n)

    def state_for(self, model: Model) -> Mapping[str, Any]:
        structure = structure_of("OutputError", model)
        n_w, state = max(structure.na, 1), self.state(structure.n_x)
        N = n_w + structure.n_x
        assert isinstance(model, HammersteinWiener)
        S = np.zeros((N, N))
        S[n_w:, n_w:] = state["P"]
        return {
            **state, "q": matrix("OutputError", "q", self.q, structure.n_x), "w": np.zeros(n_w), "S": S,
            "row": np.zeros(N), "moved": np.zeros(N), "q_w": self.q_w, "p_w": self.p_w, "begun": 0.0, "unknown": 0.0,
            "least_slope": SLOPE_SHARE * model.out.steepness, "v_power": np.zeros(model.m),
        }  # fmt: skip

    def steps_for(self, model: Model) -> TrackerSteps:
        structure = structure_of("OutputError", model)
        if len(model.outputs) > 1:
            raise ValueError("OutputError: follows one output at a time; track each output by itself.")
        assert isinstance(model, HammersteinWiener)
        return _steps(structure, model.entering, model.out.functions, not model.linear)

    def apply_for(self, model: Model) -> Step | None:
        assert isinstance(model, HammersteinWiener)
        return model.steps.apply and _applying(model.steps.apply, model.entering)

    def widen(self, lane: Mapping[str, Array], p: Array) -> None:
        n_w = len(lane["w"])
        np.einsum("ii->i", lane["S"])[n_w:] += p
        np.einsum("ii->i", lane["P"])[:] += p
        lane["var"][:] += p
