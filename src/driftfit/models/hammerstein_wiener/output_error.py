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

from collections import namedtuple
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import LARGEST, TrackerSteps
from driftfit.engine.kernel import Array, State, Step, floats, kernel, machine, nothing, packed, part, shared, wholes
from driftfit.engine.settings import matrix, vector
from driftfit.models.base import Model
from driftfit.models.hammerstein_wiener.extended_kalman import Minimal, minimal_memory, structure_of
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.output_curve import Kind, inverse_of, level, rises, values_of
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

_Own = namedtuple("_Own", "time q_w p_w begun valid observed ok e h s least_slope v_power")
OWN = _Own(*range(12))
"""Numbers of the filter: nominal intervals times the drift, variances, whether w has begun, what the sample has, the
innovation, its variance without and with the noise, and the least slope of F; from v_power on the usual power of v of
each input.
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
def absorb(own: Array, theta: Array, w: Array, S: Array, moved: Array) -> None:
    """The measurement update, with ``moved`` = S h of the forecast."""
    n_w = len(w)
    if own[OWN.ok] > 0.0:
        for x in range(len(S)):
            k = moved[x] / own[OWN.s]
            if x < n_w:
                w[x] += k * own[OWN.e]
            else:
                theta[x - n_w] += k * own[OWN.e]
            for z in range(x):
                S[x, z] -= k * moved[z]
            S[x, x] = max(S[x, x] - k * moved[x], LEFT * S[x, x])


@shared
def unknown_power(m: Array, p: Places, theta: Array, own: Array) -> float:
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
            total += max(theta[b + j] * theta[b + j] * own[OWN.v_power + i], TINY) if missing > 0 else 0.0
    return total


@shared
def follow_power(m: Array, p: Places, theta: Array, own: Array) -> None:
    """Update the usual power of v, which is used for missing inputs."""
    for i in range(p[AT.inputs]):
        at = AT.count + INPUT.count * i
        f, v = p[at + INPUT.f], m[p[at + INPUT.f], 0]
        for k in range(p[at + INPUT.n_in] - 1):
            v += theta[p[at + INPUT.c] + k] * m[f + 1 + k, 0]
        if abs(v) < LARGEST:
            power = own[OWN.v_power + i]
            moved = POWER_WEIGHT * (min(v * v, POWER_LIMIT * power) - power)
            own[OWN.v_power + i] += moved if power > 0.0 else v * v


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
def _forecasting(out: Kind) -> Any:
    """The time update and the forecast, for the functions of an output basis."""
    fill_trial, invert = values_of(out, AT.out, AT.curve, AT.n_out), inverse_of(out)

    def output_error_work(
        m: Array, p: Places, own: Array, theta: Array, phi: Array, w: Array, S: Array, scratch: Array
    ) -> None:
        n_out, d, free = p[AT.n_out], p[AT.d_now], p[AT.x_d]
        for k in range(n_out - 1):
            m[d + k + 1, 0] = theta[free + k]
        if own[OWN.begun] == 0.0 and m[NUMBER.started, 0] > 0.0:
            past_levels(m, p, w, S, own[OWN.p_w])
            own[OWN.begun] = 1.0
        power = unknown_power(m, p, theta, own)
        advance(p, theta, phi, w, S, scratch, own[OWN.q_w] + power, reach_of(m, p))
        y_hat, y = (w[0] if p[AT.identity] > 0 else invert(m, p, w[0])), m[NUMBER.raw, 0]
        able = abs(y_hat) < np.inf
        fill_trial(m, p, y_hat if able else 0.0, p[AT.trial], p[AT.trial_bend])
        slope = 0.0
        for k in range(n_out):
            slope += m[d + k, 0] * m[p[AT.trial_bend] + k, 0]
        valid, observed = power == 0.0 and able and own[OWN.begun] > 0.0, abs(y) < np.inf
        used = valid and observed and m[NUMBER.given, 0] < np.inf
        own[OWN.valid], own[OWN.observed] = 1.0 if valid else 0.0, 1.0 if observed else 0.0
        own[OWN.ok], own[OWN.e] = 1.0 if used else 0.0, y - y_hat if used else 0.0
        row, slope = scratch[0], max(slope, own[OWN.least_slope])
        for x in range(len(S)):
            row[x] = 0.0
        row[0] = 1.0 / slope
        for k in range(1, n_out):
            row[len(w) + free + k - 1] = -m[p[AT.trial] + k, 0] / slope
        own[OWN.h] = product(S, row, scratch[1], 0.0)
        m[NUMBER.predicted, 0], m[NUMBER.late, 0] = y_hat, 0.0

    return shared(output_error_work)


@lru_cache
def output_error(out: Kind, p: tuple[int, ...]) -> Any:
    """The compiled routine, for the functions of an output basis and the places of a model: time update and forecast,
    or the correction. ``fields`` are the addresses of the arrays.
    """
    work, orders, rows = _forecasting(out), np.array(p), room(p)

    def machine_output_error(fields: int, n_x: int, n: int, correcting: int) -> None:
        at, n_w, size = wholes(fields, 1, 9), max(orders[AT.na], 1), OWN.v_power + orders[AT.inputs]
        N, m = n_w + n_x, floats(at[0, 0], rows, 1)
        theta, phi, w = floats(at[0, 1], 1, n_x)[0], floats(at[0, 2], 1, n)[0], floats(at[0, 4], 1, n_w)[0]
        q, P, S = floats(at[0, 3], n_x, n_x), floats(at[0, 8], n_x, n_x), floats(at[0, 5], N, N)
        scratch, own = floats(at[0, 6], 2, N), floats(at[0, 7], 1, size)[0]
        if correcting > 0:
            absorb(own, theta, w, S, scratch[1])
            follow_power(m, orders, theta, own)
            for i in range(n_x):
                for j in range(i + 1):
                    P[i, j] = S[n_w + i, n_w + j]
        else:
            for i in range(n_x):
                for j in range(i + 1):
                    S[n_w + i, n_w + j] += q[i, j] * own[OWN.time]
            work(m, orders, own, theta, phi, w, S, scratch)

    return machine(machine_output_error)


@lru_cache
def _steps(machine_pair: Any) -> TrackerSteps:
    @kernel
    def call(s: State, correcting: int) -> None:
        fields = packed((
            s.blocks.ctypes.data, s.theta.ctypes.data, s.phi.ctypes.data, s.q.ctypes.data, s.w.ctypes.data,
            s.S.ctypes.data, s.scratch.ctypes.data, s.own.ctypes.data, s.P.ctypes.data,
        ))  # fmt: skip
        machine_pair(fields, s.theta.shape[0], s.phi.shape[0], correcting)

    @kernel
    def forecast(s: State, l: int) -> None:
        s.own[OWN.time, l] = s.dt[l] * s.drift[l]
        call(s, 0)
        given = s.blocks[NUMBER.given, l]
        s.valid[l], s.observed[l], s.ok[l] = s.own[OWN.valid, l], s.own[OWN.observed, l], s.own[OWN.ok, l]
        s.e[l], s.h[l], s.y_hat[l] = s.own[OWN.e, l], s.own[OWN.h, l], s.blocks[NUMBER.predicted, l]
        s.noise[l] = given if given < np.inf else 1.0

    @kernel
    def correct(s: State, l: int) -> None:
        s.own[OWN.ok, l], s.own[OWN.s, l] = s.ok[l], s.s[l]
        call(s, 1)

    return TrackerSteps(nothing, forecast, correct)


@lru_cache
def _applying(place: Step, p: tuple[int, ...]) -> Step:
    """The input also updates the usual power of v."""
    orders, rows = np.array(p), room(p)

    def apply(s: State, l: int) -> None:
        place(s, l)
        m, n, k = floats(s.blocks.ctypes.data, rows, 1), s.theta.shape[0], s.own.shape[0]
        theta, own = floats(s.theta.ctypes.data, 1, n)[0], floats(s.own.ctypes.data, 1, k)[0]
        follow_power(m, orders, theta, own)

    step: Step = kernel(apply)
    return step


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
        n_w = max(structure.na, 1)
        N = n_w + structure.n_x
        own = np.zeros(OWN.v_power + model.m)
        assert isinstance(model, HammersteinWiener)
        least = SLOPE_SHARE * model.out.steepness
        own[[OWN.q_w, OWN.p_w, OWN.least_slope]] = self.q_w, self.p_w, least
        S = np.zeros((N, N))
        S[n_w:, n_w:] = matrix("OutputError", "p0", self.p0, structure.n_x)
        return {
            **self.state(structure.n_x), "blocks": minimal_memory(model), "own": own,
            "w": np.zeros(n_w), "S": S, "scratch": np.zeros(2 * N),
        }  # fmt: skip

    def steps_for(self, model: Model) -> TrackerSteps:
        structure_of("OutputError", model)
        if len(model.outputs) > 1:
            raise ValueError("OutputError: follows one output at a time; track each output by itself.")
        assert isinstance(model, HammersteinWiener)
        routine = output_error(model.out.kind, model.places)
        for one in (model.out.evaluate, routine):  # the first routine calls the second
            one.load()
        return _steps(routine)

    def apply_for(self, model: Model) -> Step | None:
        assert isinstance(model, HammersteinWiener)
        return None if model.apply is None else _applying(model.apply, model.places)

    def widen(self, lane: Mapping[str, Array], p: Array) -> None:
        n_w = len(lane["w"])
        np.einsum("ii->i", lane["S"])[n_w:] += p
        np.einsum("ii->i", lane["P"])[:] += p
        lane["var"][:] += p
