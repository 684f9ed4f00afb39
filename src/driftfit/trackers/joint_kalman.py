"""The Kalman filter of parameters and hidden states together: extended or unscented.

    z_t = (theta_t, x_t):   theta_t = theta_(t-1) + w,   x_t = f(theta_t-1, x_(t-1)) + w,   w ~ N(0, q dt d)
    y_t = h(theta_t, x_t) + v,   v ~ N(0, r)                                      from `StateSpace`

    extended   z <- f(z);  P <- F P F' + q dt d;  y_hat = h(z);  g = P h';  s = h' P h + r / w
    unscented  points z_j = z +- sqrt(n + k) L_j,  P = L L',  and z itself with weight k / (n + k), k = max(3 - n, 0)
               z <- sum_j w_j f(z_j);  P likewise + q dt d;    new points;  y_hat = sum_j w_j h(z_j);  g, s likewise
    both       e = y - y_hat;  h = s - r / w;  z <- z + g e / s;  P <- P - g g' / s

The extended filter takes the derivatives of f and h at the estimate, which `StateSpace` computes exactly. The
unscented one evaluates f and h at 2 n + 1 points; it sees how the equations bend within the uncertainty, at up to twice
the time. The extended filter is too sure of itself after a wide prior on what is multiplied, as a gain and a state.
Where equations are linear, both are the Kalman filter. From three parameters and states on k is 0, and no weight is
negative (the cubature rule).

A parameter is held where it is by ``q`` and ``p0`` of 0. q of a state is how wrong its equation is at each sample. Both
filters are only as good as these numbers: look at ``run.diagnose()``, and compare by ``run.loglik``.

Where equations
have no finite value at the estimate, or at a point of the unscented filter, the states stay and the sample is not used.
A gap of several nominal samples repeats equations that do not use dt, at most `REPEAT_LIMIT` times.

Source: Jazwinski, Stochastic Processes and Filtering Theory (1970), theorem 8.1; Julier and Uhlmann, Unscented
filtering and nonlinear estimation, Proc. IEEE 92 (2004); Arasaratnam and Haykin, Cubature Kalman filters, IEEE Trans.
Automatic Control 54 (2009). Departures: only one triangle of P is kept; new points before the correction. Cost per
sample: O(n^2 nx) and one evaluation with derivatives; unscented O(n^3) and 4 n evaluations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import LARGEST, TrackerSteps
from driftfit.engine.kernel import Array, State, Step, kernel
from driftfit.engine.settings import one_of
from driftfit.models.state_space import StateSpace, equations_of
from driftfit.trackers.forms.covariance import LEFT, correct, read_drift, symmetric_product
from driftfit.trackers.kalman import drift_matrix
from driftfit.trackers.state_space.tracker import StateSpaceTracker

REPEAT_LIMIT = 1000.0
"""Times that equations are repeated for one gap, at most."""


@kernel
def evaluate_at(s: State, mean: Array, l: int) -> None:
    """The equations are evaluated at z (n, L)."""
    for i in range(s.theta.shape[0]):
        s.point[i, l] = mean[i, l]


@kernel
def unusable(s: State, l: int) -> None:
    """There is no prediction."""
    s.valid[l], s.ok[l], s.y_hat[l], s.e[l], s.h[l] = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(s.theta.shape[0]):
        s.phi[i, l], s.g[i, l] = 0.0, 0.0


@lru_cache
def _repeated(move: Step, timed: bool) -> Step:
    """``move`` for the interval since the last sample, if there is one, and the drift of it."""

    @kernel
    def predict(s: State, l: int) -> None:
        left = 1.0 if timed else min(max(1.0, s.dt[l]), REPEAT_LIMIT)
        left = left if s.dt[l] > 0.0 else 0.0
        while left > 0.5:
            move(s, l)
            left -= 1.0
        drift_matrix(s, l)

    return predict  # type: ignore[no-any-return]


@kernel
def moves_are_finite(s: State, hidden: int, l: int) -> bool:
    """Whether the next hidden states, their derivatives and the variances are numbers of a usable size."""
    finite = True
    for j in range(s.theta.shape[0]):
        finite = finite & (s.P[j, j, l] < LARGEST)
    for i in range(hidden):
        finite = finite & (abs(s.next[i, l]) < LARGEST)
        for j in range(s.theta.shape[0]):
            finite = finite & (abs(s.slopes[i, j, l]) < LARGEST)
    return finite


@lru_cache
def extended_moving(transition: Step, hidden: int) -> Any:
    """``move(s, mean, P, l)``: z (n, L) and the lower triangle of its covariance (n, n, L) through the equations."""

    @kernel
    def linear(s: State, P: Array, i: int, j: int, l: int) -> float:
        """Entry (i, j) of F P, for state i."""
        total = 0.0
        for k in range(s.theta.shape[0]):
            total += s.slopes[i, k, l] * (P[k, j, l] if j <= k else P[j, k, l])
        return total

    @kernel
    def move(s: State, mean: Array, P: Array, l: int) -> None:
        n = s.theta.shape[0]
        first = n - hidden
        evaluate_at(s, mean, l)
        transition(s, l)
        if moves_are_finite(s, hidden, l):
            for i in range(hidden):
                for j in range(n):
                    s.W[i, j, l] = linear(s, P, i, j, l)
            for i in range(hidden):
                mean[first + i, l] = s.next[i, l]
                for j in range(first):
                    P[first + i, j, l] = s.W[i, j, l]
                for j in range(i + 1):
                    total = 0.0
                    for k in range(n):
                        total += s.W[i, k, l] * s.slopes[j, k, l]
                    P[first + i, first + j, l] = total

    return move


@lru_cache
def _extended(equations: str, inputs: tuple[str, ...], hidden: int, timed: bool) -> TrackerSteps:
    transition, _, output, _ = equations_of(equations, inputs)
    move_both = extended_moving(transition, hidden)

    @kernel
    def move(s: State, l: int) -> None:
        move_both(s, s.theta, s.P, l)

    @kernel
    def forecast(s: State, l: int) -> None:
        evaluate_at(s, s.theta, l)
        output(s, l)
        finite = abs(s.value[l]) < LARGEST
        for i in range(s.theta.shape[0]):
            finite = finite & (abs(s.phi[i, l]) < LARGEST)
        if finite:
            y_hat = s.value[l]
            s.y_hat[l], s.e[l], s.h[l] = y_hat, s.y[l] - y_hat, max(symmetric_product(s, l), 0.0)
        else:
            unusable(s, l)

    predict = _repeated(move if hidden else _still, timed)
    return TrackerSteps(predict, forecast, correct, read_extra=read_drift, reads_model=True)


@kernel
def _still(s: State, l: int) -> None:
    """There are no states."""


@kernel
def factorise(s: State, scale: float, l: int) -> None:
    """s.L = scale times the lower Cholesky factor of P; what is known has a column of zeros."""
    n = s.theta.shape[0]
    for j in range(n):
        pivot = s.P[j, j, l]
        for k in range(j):
            pivot -= s.L[j, k, l] * s.L[j, k, l]
        root = np.sqrt(pivot) if pivot > LEFT * s.P[j, j, l] else 0.0  # or a combination of others
        s.L[j, j, l] = root
        for i in range(j + 1, n):
            total = s.P[i, j, l]
            for k in range(j):
                total -= s.L[i, k, l] * s.L[j, k, l]
            s.L[i, j, l] = total / root if root > 0.0 else 0.0
    for j in range(n):
        for i in range(j, n):
            s.L[i, j, l] *= scale


@kernel
def at_point(s: State, j: int, l: int) -> None:
    """The equations are evaluated at point j: z for the last, z + L_j and z - L_(j - n) for the others."""
    n = s.theta.shape[0]
    for i in range(n):
        up = s.L[i, j, l] if (j < n) & (i >= j) else 0.0
        down = s.L[i, j - n, l] if (j >= n) & (j < 2 * n) & (i >= j - n) else 0.0
        s.point[i, l] = s.theta[i, l] + (up - down)


def _sigma(n: int) -> tuple[float, float, float]:
    """The scale of sigma points of n numbers, and the weights of the outer ones and of the central one."""
    centre = max(3.0 - n, 0.0)
    return float(np.sqrt(n + centre)), 0.5 / (n + centre), centre / (n + centre)


def _moving(transition: Step, n: int, hidden: int) -> Step:
    """The hidden states of all sigma points move by one sample."""
    (scale, other, own), first, points = _sigma(n), n - hidden, 2 * n + 1

    @kernel
    def move(s: State, l: int) -> None:
        factorise(s, scale, l)
        finite = True
        for j in range(points):
            at_point(s, j, l)
            transition(s, l)
            for i in range(hidden):
                finite = finite & (abs(s.next[i, l]) < LARGEST)
                s.moved[i, j, l] = s.next[i, l]
        if finite:
            for i in range(hidden):
                mean = own * s.moved[i, 2 * n, l]
                for j in range(2 * n):
                    mean += other * s.moved[i, j, l]
                s.theta[first + i, l] = mean
                for j in range(points):
                    s.moved[i, j, l] -= mean
            for i in range(hidden):
                for k in range(first):
                    total = 0.0
                    for j in range(k + 1):
                        total += other * (s.moved[i, j, l] - s.moved[i, n + j, l]) * s.L[k, j, l]
                    s.P[first + i, k, l] = total
                for k in range(i + 1):
                    total = own * s.moved[i, 2 * n, l] * s.moved[k, 2 * n, l]
                    for j in range(2 * n):
                        total += other * s.moved[i, j, l] * s.moved[k, j, l]
                    s.P[first + i, first + k, l] = total

    return move  # type: ignore[no-any-return]


def _forecasting(output: Step, n: int) -> Step:
    """The mean and variance of the outputs of all sigma points."""
    (scale, other, own), points = _sigma(n), 2 * n + 1

    @kernel
    def forecast(s: State, l: int) -> None:
        factorise(s, scale, l)
        finite, y_hat, v = True, 0.0, 0.0
        for j in range(points):
            at_point(s, j, l)
            output(s, l)
            finite = finite & (abs(s.value[l]) < LARGEST)
            s.shown[j, l] = s.value[l]
            y_hat += (other if j < 2 * n else own) * s.value[l]
        for j in range(points):
            s.shown[j, l] -= y_hat
            v += (other if j < 2 * n else own) * s.shown[j, l] * s.shown[j, l]
        for i in range(n):
            g = 0.0
            for j in range(i + 1):
                g += other * (s.shown[j, l] - s.shown[n + j, l]) * s.L[i, j, l]
            s.g[i, l] = g
        if finite:
            s.y_hat[l], s.e[l], s.h[l] = y_hat, s.y[l] - y_hat, max(v, 0.0)
        else:
            unusable(s, l)

    return forecast  # type: ignore[no-any-return]


@lru_cache
def _unscented(equations: str, inputs: tuple[str, ...], n: int, hidden: int, timed: bool) -> TrackerSteps:
    _, transition, _, output = equations_of(equations, inputs)
    predict = _repeated(_moving(transition, n, hidden) if hidden else _still, timed)
    return TrackerSteps(predict, _forecasting(output, n), correct, read_extra=read_drift, reads_model=True)


@dataclass(frozen=True)
class JointKalman(StateSpaceTracker):
    """Extended or unscented Kalman filter of parameters and hidden states, for `StateSpace`.

    Parameters
    ----------
    q : number, (n,), (n, n), or mapping from name
        Variance that each parameter and state gains per nominal sample. A mapping gives 0 to those it does not name.
    r : number
        Noise variance of the output; positive.
    p0 : number, (n,), (n, n), or mapping from name
        Covariance of parameters and states before the first sample. A mapping gives 0, certainty, to those that it does
        not name.
    theta0 : (n,) or None
        Their mean. None: the ``start`` of the model.
    method : "unscented" or "extended"
        By points, or by derivatives.

    Raises
    ------
    ValueError
        If a variance is negative, r is not positive, or a name is neither parameter nor state.
    """

    q: Any = None
    r: float | None = None
    p0: Any = None
    theta0: Any = None
    method: str = "unscented"

    scratch: ClassVar[tuple[str, ...]] = ("g", "W", "L", "moved", "shown")

    def __post_init__(self) -> None:
        self._check()
        one_of("JointKalman", "method", self.method, ("extended", "unscented"))

    def state_of(self, model: StateSpace, prior: Mapping[str, Any]) -> Mapping[str, Any]:
        n, hidden = model.n, max(len(model.hidden), 1)
        own: dict[str, Array] = {"W": np.zeros((hidden, n))}
        if self.method == "unscented":
            own = {"L": np.zeros((n, n)), "moved": np.zeros((hidden, 2 * n + 1)), "shown": np.zeros(2 * n + 1)}
        return {**prior, "g": np.zeros(n), "drift_root": np.ones(n), **own}

    def steps_of(self, model: StateSpace) -> TrackerSteps:
        given = model.equations, model.input_names
        if self.method == "extended":
            return _extended(*given, len(model.hidden), model.system.timed)
        return _unscented(*given, model.n, len(model.hidden), model.system.timed)
