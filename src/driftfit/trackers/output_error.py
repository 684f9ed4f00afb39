"""Output-error filter: an extended Kalman filter that simulates the linear block, so that y is never a regressor.

    state       [w_t .. w_{t-na+1}, xi_t],   xi = (a, b, c_2 .., d_2 ..) a random walk of covariance q
    predict     w_t = -a'[w_{t-1} .. w_{t-na}] + sum_j b_j v_{t-nk-j+1} (- l) + N(0, q_w)
                row of the transition: -a | -w_{t-i} | v_{t-nk-j+1} | sum_j b_j f_k(u) | 0 | (-1), then the shifts
    measure     y_t = F^-1(w_t; d) + n_t,  n ~ N(0, r);   F' = max(F'(y_hat), 0.05)
                row of the measurement: 1 / F' for w_t, -g_k(y_hat) / F' for d_k

Measurement noise of y biases every method that has y among its regressors; here it stands in the measurement alone. A
missing y only skips the measurement; a missing input is taken as v = 0 with its usual power as process noise. The
price: the filter is local and needs a start in its basin, from `driftfit.blocks.hand_off`. The past w are taken from
the first outputs. w is held within three times the range of F over the outputs seen, whatever the poles do.

innovation, its variance and the likelihood are those of y. Source: the output-error form of Ljung and Soderstrom (1983)
with the blocks of Feng and Hong (2021); the guards are ours. Cost per sample: O((na + n_x)^2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from driftfit.drivers import LARGEST, TrackerSteps
from driftfit.kernel import Array, State, kernel, shared
from driftfit.models.base import Model
from driftfit.models.basis import PiecewiseLinear
from driftfit.models.curves import Curves
from driftfit.models.hammerstein_wiener import HammersteinWiener
from driftfit.models.hammerstein_wiener_steps import GIVEN, HIGHEST, LOWEST, PREDICTED, RAW, STARTED, inverse_of
from driftfit.settings import covariance, matrix, numbers, vector
from driftfit.trackers.base import Tracker
from driftfit.trackers.extended_kalman import minimal_cells, structure_of

FLATTEST = 0.05
"""Least slope of F that the filter divides by."""
REACH = 3.0
"""Times the largest w of the outputs seen: w is held within that."""
FARTHEST = 1e6
"""The same before any output was seen."""
LARGEST_VARIANCE = 1e20
"""Of w: an unstable estimate must not overflow in a long outage. The cross-covariances shrink along."""


@shared
def past_levels(theta: Array, g_lag: Array, orders: tuple[int, int, int, int], w: Array, S: Array, p_w: float) -> None:
    """w = F(y) at the last outputs, each of variance p_w."""
    na, nb, n_in, n_out = orders
    x_d = na + nb + n_in - 1
    for i in range(na):
        total = g_lag[0, i]
        for k in range(1, n_out):
            total += theta[x_d + k - 1] * g_lag[k, i]
        w[i] = total if total == total else 0.0
        S[i, i] = p_w


@shared
def advance(
    theta: Array, phi: Array, w: Array, S: Array, row: Array, moved: Array, orders: tuple[int, int, int, int],
    q_w: float, reach: float,
) -> None:  # fmt: skip
    """The time update of w and of S, the covariance of [w, xi]."""
    na, nb, n_in, n_out = orders
    n_w, N = w.shape[0], S.shape[0]
    at_bc = na + nb + n_out - 1
    x_c = n_w + na + nb
    total = 0.0
    for i in range(N):
        row[i] = 0.0
    for i in range(na):
        row[i] = -theta[i]
        row[n_w + i] = -w[i]
        total -= theta[i] * w[i]
    for j in range(nb):
        v = -phi[na + j]
        for k in range(n_in - 1):
            f = -phi[at_bc + k * nb + j]
            v += theta[na + nb + k] * f
            row[x_c + k] += theta[na + j] * f
        row[n_w + na + j] = v
        total += theta[na + j] * v
    for x in range(x_c + n_in - 1 + n_out - 1, N):
        row[x] = -1.0
        total -= theta[x - n_w]
    for x in range(N):
        value = 0.0
        for z in range(N):
            value += S[x, z] * row[z]
        moved[x] = value
    own = q_w
    for x in range(N):
        own += row[x] * moved[x]
    for i in range(n_w - 1, 0, -1):
        w[i] = w[i - 1]
        for j in range(i, 0, -1):
            S[i, j] = S[i - 1, j - 1]
            S[j, i] = S[i, j]
        for x in range(n_w, N):
            S[i, x] = S[i - 1, x]
            S[x, i] = S[i, x]
    for i in range(1, n_w):
        S[0, i] = moved[i - 1]
        S[i, 0] = S[0, i]
    for x in range(n_w, N):
        S[0, x] = moved[x]
        S[x, 0] = S[0, x]
    S[0, 0] = own
    if own > LARGEST_VARIANCE:
        shrink = np.sqrt(LARGEST_VARIANCE / own)
        for x in range(N):
            S[0, x] *= shrink
            S[x, 0] = S[0, x]
        S[0, 0] = LARGEST_VARIANCE
    w[0] = min(max(total, -reach), reach)


@shared
def absorb(
    e: float, slope: float, g: Array, r: float, ok: float, theta: Array, w: Array, S: Array, row: Array, moved: Array,
    at_d: int,
) -> float:  # fmt: skip
    """The measurement update; returns the variance of the innovation."""
    n_w, N, n_out = w.shape[0], S.shape[0], g.shape[0]
    for x in range(N):
        row[x] = 0.0
    row[0] = 1.0 / slope
    for k in range(1, n_out):
        row[n_w + at_d + k - 1] = -g[k] / slope
    s = r
    for x in range(N):
        value = 0.0
        for z in range(N):
            value += S[x, z] * row[z]
        moved[x] = value
    for x in range(N):
        s += row[x] * moved[x]
    if ok > 0.0:
        for x in range(N):
            k = moved[x] / s
            if x < n_w:
                w[x] += k * e
            else:
                theta[x - n_w] += k * e
            for z in range(x + 1):
                S[x, z] -= k * moved[z]
                S[z, x] = S[x, z]
    return s


@lru_cache
def _steps(orders: tuple[int, int, int, int], nk: int, out: Curves, linear: bool) -> TrackerSteps:
    na, nb, n_in, n_out = orders
    inverse, values, slopes = inverse_of(out), out.values, out.slopes
    at_d = na + nb + n_in - 1

    @kernel
    def predict(s: State, l: int) -> None:
        time = s.dt[l] * s.drift[l]
        n_w = s.w.shape[0]
        for i in range(s.theta.shape[0]):
            for j in range(s.theta.shape[0]):
                s.S[n_w + i, n_w + j, l] += s.q[i, j, l] * time

    @kernel
    def correct(s: State, l: int) -> None:
        known = 1.0
        power = 0.0
        for j in range(nb):
            for k in range(n_in):
                known = known if abs(s.f_lag[k, nk + j, l]) < LARGEST else 0.0
            power += s.theta[na + j, l] * s.theta[na + j, l]
        if s.begun[l] == 0 and s.cells[STARTED, l] > 0.0:
            past_levels(s.theta[:, l], s.g_lag[:, :, l], orders, s.w[:, l], s.S[:, :, l], s.p_w[l])
            s.begun[l] = 1
        low, high = s.cells[LOWEST, l], s.cells[HIGHEST, l]
        if not linear:
            low, high = s.level[0, l], s.level[s.level.shape[0] - 1, l]
        reach = REACH * max(abs(low), abs(high))
        reach = reach if 0.0 < reach < np.inf else FARTHEST
        noise = s.q_w[l] + (0.0 if known > 0.0 else power * s.v_power[l])
        advance(s.theta[:, l], s.phi[:, l], s.w[:, l], s.S[:, :, l], s.row[:, l], s.moved[:, l], orders, noise, reach)
        for k in range(n_out - 1):
            s.d_now[k + 1, l] = s.theta[at_d + k, l]
        y_hat = s.w[0, l]
        if not linear:
            y_hat = inverse(
                s.w[0, l], s.g_hat[:, l], s.h_hat[:, l], s.d_now[:, l], s.out[:, l], s.curve[:, :, l], s.level[:, l],
                s.cells[:, l],
            )  # fmt: skip
        y = s.cells[RAW, l]
        able = abs(y_hat) < np.inf
        values(y_hat if able else 0.0, s.out[:, l], s.g_hat[:, l])
        slopes(y_hat if able else 0.0, s.out[:, l], s.h_hat[:, l])
        slope = 0.0
        for k in range(n_out):
            slope += s.d_now[k, l] * s.h_hat[k, l]
        slope = max(slope, FLATTEST)
        s.valid[l] = 1.0 if known > 0.0 and able and s.begun[l] > 0 else 0.0
        used = s.valid[l] > 0.0 and abs(y) < np.inf and s.cells[GIVEN, l] < np.inf
        s.seen[l] = 1.0 if abs(y) < np.inf else 0.0
        s.ok[l] = 1.0 if used else 0.0
        s.e[l] = y - y_hat if used else 0.0
        s.s[l] = absorb(
            s.e[l], slope, s.g_hat[:, l], s.r[l] * s.cells[GIVEN, l] if used else s.r[l], s.ok[l], s.theta[:, l],
            s.w[:, l], s.S[:, :, l], s.row[:, l], s.moved[:, l], at_d,
        )  # fmt: skip
        s.y_hat[l] = y_hat
        s.cells[PREDICTED, l] = y_hat
        v = 0.0
        for k in range(n_in):
            c = s.theta[na + nb + k - 1, l] if k > 0 else 1.0
            v += c * s.f_lag[k, 0, l]
        s.v_power[l] += 0.01 * (v * v - s.v_power[l]) if abs(v) < 1e6 else 0.0

    @kernel
    def report(s: State, l: int) -> None:
        n_w = s.w.shape[0]
        for i in range(s.theta.shape[0]):
            for j in range(i + 1):
                s.P[i, j, l] = s.S[n_w + i, n_w + j, l]
            s.var[i, l] = s.P[i, i, l]

    return TrackerSteps(predict, correct, report)


@dataclass(frozen=True)
class OutputError(Tracker):
    """Output-error extended Kalman filter on the minimal parameters of a `HammersteinWiener` model.

    Parameters
    ----------
    q : number, (n_x,), or (n_x, n_x)
        Drift covariance of xi per nominal sample.
    r : number
        Variance of the measurement noise, in squared units of y.
    p0, theta0 : covariance and mean of xi before the first sample
        A start in the basin of the truth; see `driftfit.blocks.hand_off.hand_off`.
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

    required: ClassVar[tuple[str, ...]] = ("q", "r")
    width: ClassVar[int] = 1
    output_error: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.q is not None:
            self._set("q", covariance("OutputError", "q", self.q))
        for name in ("r", "q_w", "p_w"):
            if getattr(self, name) is not None:
                strict = name == "r"
                self._set(name, numbers("OutputError", name, getattr(self, name), ndim=0, low=0.0, strict=strict))
        self._set("p0", covariance("OutputError", "p0", self.p0))
        self._set("theta0", numbers("OutputError", "theta0", self.theta0))

    @classmethod
    def own_model(cls, na: int, nb: int, nk: int) -> HammersteinWiener:
        """With a bend in the input block, whose c_2 is 0 on linear records, where there are lags to tell it from b."""
        return HammersteinWiener(na, nb, nk, input=PiecewiseLinear([0.0]) if nb > 1 else None)

    def state(self, n: int) -> Mapping[str, Any]:
        """The part of the state that depends on the number n of minimal parameters alone."""
        return {
            "theta": vector("OutputError", "theta0", self.theta0, n),
            "P": matrix("OutputError", "p0", self.p0, n),
            "q": matrix("OutputError", "q", self.q, n),
            "r": self.r, "q_w": self.q_w, "p_w": self.p_w, "v_power": 1.0, "begun": 0, "var": np.zeros(n),
        }  # fmt: skip

    @property
    def steps(self) -> TrackerSteps:
        raise ValueError("OutputError: the steps depend on the model; see steps_for.")

    def state_for(self, model: Model) -> Mapping[str, Any]:
        structure = structure_of("OutputError", model)
        n_w, n_out = max(structure.na, 1), structure.n_out
        N = n_w + structure.n_x
        S = np.zeros((N, N))
        S[n_w:, n_w:] = matrix("OutputError", "p0", self.p0, structure.n_x)
        return {
            **self.state(structure.n_x), "cells": minimal_cells(model), "w": np.zeros(n_w), "S": S,
            "row": np.zeros(N), "moved": np.zeros(N), "g_hat": np.zeros(n_out), "h_hat": np.zeros(n_out),
        }  # fmt: skip

    def steps_for(self, model: Model) -> TrackerSteps:
        structure = structure_of("OutputError", model)
        assert isinstance(model, HammersteinWiener)
        orders = (structure.na, structure.nb, structure.n_in, structure.n_out)
        return _steps(orders, model.nk, model.out.curves, model.linear)

    def names_for(self, model: Model) -> tuple[str, ...]:
        return structure_of("OutputError", model).minimal_names

    def widen(self, lane: Mapping[str, Array], p: Array) -> None:
        n_w = len(lane["w"])
        np.einsum("ii->i", lane["S"])[n_w:] += p
        np.einsum("ii->i", lane["P"])[:] += p
        lane["var"][:] += p
