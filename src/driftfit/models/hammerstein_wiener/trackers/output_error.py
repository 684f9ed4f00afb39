"""Output-error filter: an extended Kalman filter that simulates the linear block, so that y is never a regressor.

    state       [w_t .. w_{t-na+1}, xi_t],   xi = (a, b, c_2 .., d_2 ..) a random walk of covariance q
    predict     w_t = -a'[w_{t-1} .. w_{t-na}] + sum_j b_j v_{t-nk-j+1} (- l) + N(0, q_w), v and b of every input
                row of the transition: -a | -w_{t-i} | v_{t-nk-j+1} | sum_j b_j f_k(u) | 0 | (-1), then the shifts
    measure     y_t = F^-1(w_t; d) + n_t,  n ~ N(0, r);   F' = F'(y_hat), at least 0.05 of the slope of the functions
                row of the measurement: 1 / F' for w_t, -g_k(y_hat) / F' for d_k

Measurement noise of y biases every method that has y among its regressors; here it appears in the measurement only. A
missing y only skips the measurement; a missing input is treated as v = 0 with its usual power as process noise. In
return, the filter converges only locally and needs an initial value in its basin of attraction, from
`driftfit.models.hammerstein_wiener.results.hybrid_start`. The past w are taken from the first outputs. w is limited
to three times the range of F over the observed outputs, whatever the poles are.

innovation, its variance and the likelihood are those of y. Source: the output-error form of Ljung and Soderstrom (1983)
with the blocks of Feng and Hong (2021); the limits are ours. Cost per sample: O((na + n_x)^2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import TrackerSteps
from driftfit.engine.kernel import Array, State, Step, floats, kernel, nothing, packed
from driftfit.engine.settings import matrix, vector
from driftfit.models.base import Model
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.step_memory import GIVEN, PREDICTED, room
from driftfit.models.hammerstein_wiener.trackers.minimal import Minimal, minimal_memory, structure_of
from driftfit.models.hammerstein_wiener.trackers.output_error_steps import (
    FLATTEST,
    LEAST_SLOPE,
    OBSERVED,
    OK,
    P_W,
    Q_W,
    S2,
    TIME,
    V_POWER,
    VALID,
    E,
    H,
    follow_power,
    output_error,
)


@lru_cache
def _steps(machine: Any) -> TrackerSteps:
    @kernel
    def call(s: State, correcting: int) -> None:
        fields = packed((
            s.blocks.ctypes.data, s.theta.ctypes.data, s.phi.ctypes.data, s.q.ctypes.data, s.w.ctypes.data,
            s.S.ctypes.data, s.scratch.ctypes.data, s.own.ctypes.data, s.P.ctypes.data,
        ))  # fmt: skip
        machine(fields, s.theta.shape[0], s.phi.shape[0], correcting)

    @kernel
    def forecast(s: State, l: int) -> None:
        s.own[TIME, l] = s.dt[l] * s.drift[l]
        call(s, 0)
        given = s.blocks[GIVEN, l]
        s.valid[l], s.observed[l], s.ok[l] = s.own[VALID, l], s.own[OBSERVED, l], s.own[OK, l]
        s.e[l], s.h[l], s.y_hat[l] = s.own[E, l], s.own[H, l], s.blocks[PREDICTED, l]
        s.noise[l] = given if given < np.inf else 1.0

    @kernel
    def correct(s: State, l: int) -> None:
        s.own[OK, l], s.own[S2, l] = s.ok[l], s.s[l]
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
        An initial value in the basin of the truth; see `driftfit.models.hammerstein_wiener.results.hybrid_start`.
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
        own = np.zeros(V_POWER + model.m)
        assert isinstance(model, HammersteinWiener)
        least = FLATTEST * model.out.steepness
        own[[Q_W, P_W, LEAST_SLOPE]] = self.q_w, self.p_w, least
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
        machine = output_error(model.out.kind, model.places)
        for one in (model.out.evaluate, machine):  # the first routine calls the second
            one.load()
        return _steps(machine)

    def apply_for(self, model: Model) -> Step | None:
        assert isinstance(model, HammersteinWiener)
        return None if model.apply is None else _applying(model.apply, model.places)

    def widen(self, lane: Mapping[str, Array], p: Array) -> None:
        n_w = len(lane["w"])
        np.einsum("ii->i", lane["S"])[n_w:] += p
        np.einsum("ii->i", lane["P"])[:] += p
        lane["var"][:] += p
