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
from driftfit.engine.kernel import Array, State, Step, floats, kernel, nothing, part, shared
from driftfit.engine.settings import matrix, vector
from driftfit.models.base import Model
from driftfit.models.hammerstein_wiener.extended_kalman import Minimal, minimal_memory, structure_of
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.output_curve import Kind, inverting, level, rises, values_of
from driftfit.models.hammerstein_wiener.structure import AT, GRID, INPUT, NUMBER, Places, room
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


@shared
def past_levels(m: Array, p: Places, w: Array, S: Array, p_w: float) -> None:
    """w = F(y) at the last outputs, each of variance p_w and independent of xi."""
    n_out, d, g = p[AT.n_out], p[AT.d_now], p[AT.g_past]
    for i in range(p[AT.na]):
        total = m[g + (i + 1) * n_out, 0]
        for k in range(1, n_out):
            total += m[d + k, 0] * m[g + (i + 1) * n_out + k, 0]
        w[i] = total if total == total else 0.0
        for x in range(i, len(S)):
            S[x, i] = 0.0
        S[i, i] = p_w


@part
def product(S: Array, row: Array, moved: Array, total: float) -> float:
    """moved = S row from the lower triangle; returns row' S row, added to a total."""
    N = len(S)
    for x in range(N):
        value = 0.0
        for z in range(x + 1):
            value += S[x, z] * row[z]
        for z in range(x + 1, N):
            value += S[z, x] * row[z]
        moved[x] = value
        total += row[x] * value
    return total


@part
def transition(p: Places, theta: Array, phi: Array, w: Array, row: Array) -> float:
    """The row of the transition for the present w but for the intercept; returns w."""
    n_w, total = len(w), 0.0
    for x in range(len(row)):
        row[x] = 0.0
    for i in range(p[AT.na]):
        row[i] = -theta[i]
        row[n_w + i] = -w[i]
        total -= theta[i] * w[i]
    for i in range(p[AT.inputs]):
        own = AT.count + INPUT.count * i
        nb, b, c, bc = p[own + INPUT.nb], p[own + INPUT.b], p[own + INPUT.c], p[own + INPUT.bc]
        for j in range(nb):
            v = -phi[b + j]
            for k in range(p[own + INPUT.n_in] - 1):
                f = -phi[bc + k * nb + j]
                v += theta[c + k] * f
                row[n_w + c + k] += theta[b + j] * f
            row[n_w + b + j] = v
            total += theta[b + j] * v
    return total


@shared
def advance(p: Places, theta: Array, phi: Array, w: Array, S: Array, scratch: Array, q_w: float, reach: float) -> None:
    """The time update of w, which is held within reach whatever the poles do, and of S."""
    n_w, N, row, moved = len(w), len(S), scratch[0], scratch[1]
    total = transition(p, theta, phi, w, row)
    for x in range(n_w + p[AT.x_d] + p[AT.n_out] - 1, N):
        row[x] = -1.0
        total -= theta[x - n_w]
    own = product(S, row, moved, q_w)
    for i in range(n_w - 1, 0, -1):
        w[i] = w[i - 1]
        for j in range(i, 0, -1):
            S[i, j] = S[i - 1, j - 1]
        for x in range(n_w, N):
            S[x, i] = S[x, i - 1]
    most = OUTAGE_STD * OUTAGE_STD * reach * reach
    shrink = np.sqrt(most / own) if own > most else 1.0
    for x in range(1, N):
        S[x, 0] = shrink * (moved[x - 1] if x < n_w else moved[x])
    S[0, 0] = min(own, most)
    w[0] = min(max(total, -reach), reach)


@shared
def absorb(e: float, s: float, theta: Array, w: Array, S: Array, moved: Array) -> None:
    """The measurement update for an innovation e of variance s, with ``moved`` = S h of the forecast."""
    n_w = len(w)
    for x in range(len(S)):
        k = moved[x] / s
        if x < n_w:
            w[x] += k * e
        else:
            theta[x - n_w] += k * e
        for z in range(x):
            S[x, z] -= k * moved[z]
        S[x, x] = max(S[x, x] - k * moved[x], LEFT * S[x, x])


@shared
def unknown_power(m: Array, p: Places, theta: Array, v_power: Array) -> float:
    """The variance that missing inputs leave in w, sum b_j^2 times the usual power of v; 0 where all are there."""
    total = 0.0
    for i in range(p[AT.inputs]):
        at = AT.count + INPUT.count * i
        n_in, b = p[at + INPUT.n_in], p[at + INPUT.b]
        f = p[at + INPUT.f] + p[at + INPUT.nk] * n_in
        for j in range(p[at + INPUT.nb]):
            missing = 0
            for k in range(n_in):
                missing += 0 if abs(m[f + j * n_in + k, 0]) < LARGEST else 1
            total += max(theta[b + j] * theta[b + j] * v_power[i], TINY) if missing > 0 else 0.0
    return total


@shared
def follow_power(m: Array, p: Places, theta: Array, v_power: Array) -> None:
    """Update the usual power of v, which is used for missing inputs."""
    for i in range(p[AT.inputs]):
        at = AT.count + INPUT.count * i
        f, v = p[at + INPUT.f], m[p[at + INPUT.f], 0]
        for k in range(p[at + INPUT.n_in] - 1):
            v += theta[p[at + INPUT.c] + k] * m[f + 1 + k, 0]
        if abs(v) < LARGEST:
            moved = POWER_WEIGHT * (min(v * v, POWER_LIMIT * v_power[i]) - v_power[i])
            v_power[i] += moved if v_power[i] > 0.0 else v * v


@shared
def reach_of(m: Array, p: Places) -> float:
    """The largest |w| that the outputs observed so far allow."""
    low, high = m[NUMBER.lowest, 0], m[NUMBER.highest, 0]
    if p[AT.identity] == 0:
        rising, last = rises(m, p), GRID - 1
        low = level(m, p, p[AT.curve], 0) if rising else m[p[AT.level], 0]
        high = level(m, p, p[AT.curve], last) if rising else m[p[AT.level] + last, 0]
    reach = W_RANGE * max(abs(low), abs(high))
    return reach if reach > 0.0 and reach < LARGEST else LARGEST


@lru_cache
def _following(p: tuple[int, ...]) -> Step:
    """`follow_power` of a state."""
    orders, rows = np.array(p), room(p)

    @kernel
    def follow(s: State, l: int) -> None:
        n, m = s.theta.shape[0], s.v_power.shape[0]
        theta, v_power = floats(s.theta.ctypes.data, 1, n)[0], floats(s.v_power.ctypes.data, 1, m)[0]
        follow_power(floats(s.blocks.ctypes.data, rows, 1), orders, theta, v_power)

    return follow  # type: ignore[no-any-return]


@kernel
def advance_states(s: State, p: Places, m: Array, S: Array, scratch: Array, l: int) -> float:
    """The time update of xi and w; returns the variance that missing inputs leave in w."""
    n_w, n_x, d = max(p[AT.na], 1), s.theta.shape[0], p[AT.d_now]
    theta, w = floats(s.theta.ctypes.data, 1, n_x)[0], floats(s.w.ctypes.data, 1, n_w)[0]
    phi, v_power = floats(s.phi.ctypes.data, 1, p[AT.n])[0], floats(s.v_power.ctypes.data, 1, p[AT.inputs])[0]
    for i in range(n_x):
        for j in range(i + 1):
            S[n_w + i, n_w + j] += s.q[i, j, l] * (s.dt[l] * s.drift[l])
    for k in range(p[AT.n_out] - 1):
        m[d + k + 1, 0] = theta[p[AT.x_d] + k]
    if s.begun[l] == 0.0 and m[NUMBER.started, 0] > 0.0:
        past_levels(m, p, w, S, s.p_w[l])
        s.begun[l] = 1.0
    power = unknown_power(m, p, theta, v_power)
    advance(p, theta, phi, w, S, scratch, s.q_w[l] + power, reach_of(m, p))
    return power  # type: ignore[no-any-return]


@lru_cache
def _steps(out: Kind, p: tuple[int, ...], intercept: bool) -> TrackerSteps:
    """The steps for the functions of an output basis and the places of a model."""
    orders, rows, n_w, curved = np.array(p), room(p), max(p[AT.na], 1), not p[AT.identity]
    n_out, d, free, g, h = p[AT.n_out], p[AT.d_now], p[AT.x_d], p[AT.trial], p[AT.trial_bend]
    n_x = free + n_out - 1 + intercept
    N, follow = n_w + n_x, _following(p)
    fill_trial, invert = values_of(out, AT.out, AT.curve, AT.n_out), inverting(out)

    @kernel
    def forecast(s: State, l: int) -> None:
        m, S, scratch = (
            floats(s.blocks.ctypes.data, rows, 1),
            floats(s.S.ctypes.data, N, N),
            floats(s.scratch.ctypes.data, 2, N),
        )
        power = advance_states(s, orders, m, S, scratch, l)
        y_hat, y = s.w[0, l], m[NUMBER.raw, 0]
        if curved:
            y_hat = invert(m, orders, y_hat)
        able = abs(y_hat) < np.inf
        fill_trial(m, orders, y_hat if able else 0.0, g, h)
        slope = 0.0
        for k in range(n_out):
            slope += m[d + k, 0] * m[h + k, 0]
        slope, given = max(slope, s.least_slope[l]), m[NUMBER.given, 0]
        valid, observed = power == 0.0 and able and s.begun[l] > 0.0, abs(y) < np.inf
        used = valid and observed and given < np.inf
        s.valid[l], s.observed[l] = 1.0 if valid else 0.0, 1.0 if observed else 0.0
        s.ok[l], s.e[l] = 1.0 if used else 0.0, y - y_hat if used else 0.0
        for x in range(N):
            scratch[0, x] = 0.0
        scratch[0, 0] = 1.0 / slope
        for k in range(1, n_out):
            scratch[0, n_w + free + k - 1] = -m[g + k, 0] / slope
        s.h[l] = product(S, scratch[0], scratch[1], 0.0)
        m[NUMBER.predicted, 0], m[NUMBER.late, 0], s.y_hat[l] = y_hat, 0.0, y_hat
        s.noise[l] = given if given < np.inf else 1.0

    @kernel
    def correct(s: State, l: int) -> None:
        theta, w = floats(s.theta.ctypes.data, 1, n_x)[0], floats(s.w.ctypes.data, 1, n_w)[0]
        S, scratch = floats(s.S.ctypes.data, N, N), floats(s.scratch.ctypes.data, 2, N)
        if s.ok[l] > 0.0:
            absorb(s.e[l], s.s[l], theta, w, S, scratch[1])
        follow(s, l)
        for i in range(n_x):
            for j in range(i + 1):
                s.P[i, j, l] = S[n_w + i, n_w + j]

    return TrackerSteps(nothing, forecast, correct)


@lru_cache
def _applying(place: Step, p: tuple[int, ...]) -> Step:
    """The input also updates the usual power of v."""
    follow = _following(p)

    @kernel
    def apply(s: State, l: int) -> None:
        place(s, l)
        follow(s, l)

    return apply  # type: ignore[no-any-return]


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
        """The part of the state that depends only on the number n of minimal parameters."""
        return {
            "theta": vector("OutputError", "theta0", self.theta0, n),
            "P": matrix("OutputError", "p0", self.p0, n),
            "q": matrix("OutputError", "q", self.q, n),
            "r": self.r,
            "var": np.zeros(n),
        }

    def state_for(self, model: Model) -> Mapping[str, Any]:
        structure = structure_of("OutputError", model)
        n_w, state = max(structure.na, 1), self.state(structure.n_x)
        N = n_w + structure.n_x
        assert isinstance(model, HammersteinWiener)
        S = np.zeros((N, N))
        S[n_w:, n_w:] = state["P"]
        return {
            **state, "blocks": minimal_memory(model), "w": np.zeros(n_w), "S": S,
            "scratch": np.zeros((2, N)), "q_w": self.q_w, "p_w": self.p_w, "begun": 0.0,
            "least_slope": SLOPE_SHARE * model.out.steepness, "v_power": np.zeros(model.m),
        }  # fmt: skip

    def steps_for(self, model: Model) -> TrackerSteps:
        structure_of("OutputError", model)
        if len(model.outputs) > 1:
            raise ValueError("OutputError: follows one output at a time; track each output by itself.")
        assert isinstance(model, HammersteinWiener)
        return _steps(model.out.kind, model.places, model.intercept)._replace(machines=(model.out.evaluate,))

    def apply_for(self, model: Model) -> Step | None:
        assert isinstance(model, HammersteinWiener)
        late = model.steps.apply
        return None if late is None else _applying(late, model.places)

    def widen(self, lane: Mapping[str, Array], p: Array) -> None:
        n_w = len(lane["w"])
        np.einsum("ii->i", lane["S"])[n_w:] += p
        np.einsum("ii->i", lane["P"])[:] += p
        lane["var"][:] += p
