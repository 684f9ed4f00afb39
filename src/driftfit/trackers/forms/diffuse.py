"""The diffuse start: no information before the first sample, no large number instead of it, and no preferred unit.

Until the samples determine all of theta, and afterwards for as long as they determine it badly, the information is a
square root (`driftfit.trackers.forms.information`): S theta = d, with S an upper triangle. A zero row is a direction
without information; its column is called free, and with R = S^-1 on the other columns the vector

    R_.j = (-S_pp^-1 S_pj, 1)                     of each free column j

is orthogonal to all regressors so far. A regressor phi is in their span if u_j = phi' R_.j = 0 for all free j. Then it
is an ordinary correction, s = |S^-T phi|^2 + r. Otherwise s is infinite, the first j with u_j != 0 is no longer free,
and the contribution to the diffuse log-likelihood is -1/2 log F, F = u_j^2 det(N_after' N_after) / det(N' N), with N
the matrix of these vectors: the limit of s / kappa for P0 = kappa I.

Rotations treat each column in its own unit: multiplying one by a power of 2 changes only the exponents. The same holds
for the rank, because u_j counts as 0 only if rounding explains it. In directions that are not spanned, theta keeps its
value: with isotropic q this is the solution nearest to theta0. With other q the exact limit may move theta in
directions without information; here it does not move.

The filter continues with theta and P once the variance inflation P_ii |S column i|^2 <= `WORST` for all parameters:
the covariance form loses as many digits. Otherwise it stays with S, also at full rank.

Source: Bierman, Factorization Methods for Discrete Sequential Estimation (1977), chapter 5, for the start from zero
information; Durbin and Koopman, Time Series Analysis by State Space Methods (2012), section 5.2, for the likelihood.
Departures: the decision on rank; the change of form. Cost per sample: O(n^3) until the change, O(n^2) after it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache, partial
from types import MappingProxyType
from typing import Any

import numpy as np

from driftfit.engine.drivers import TrackerSteps, in_units_of_noise
from driftfit.engine.kernel import Array, State, Step, cubes, exp, floats, kernel, log, machine, packed, shared, wholes
from driftfit.trackers.forms.covariance import LEFT, prediction
from driftfit.trackers.forms.information import spread

WITHIN_SPAN = 1e-13
"""Share of its terms up to which the part of a regressor outside the span may be rounding: 2^-53 for each of some
hundred operations, with a margin."""

WORST = 1e6
"""Largest variance inflation for which a covariance is used: ten of sixteen digits remain."""

ALMOST_ANY = 1e13
"""The same for trackers that cannot wait longer: they are least squares without drift before the change of form."""

SIZE, STD, LOOSE, ROW, WORK = range(5)
"""Rows of ``work``: norms of the columns of S and of the rows of R, the scale of the error of R, a row to absorb."""

Y, NOISE, OK, AGE, BEFORE, SQUARE, VOLUME, INFLATION, ENTERING, NOW = range(10)
"""Entries of ``at_start``: output, noise variance, whether there is a sample, the age of `unseen`; results: the
variance of the prediction without noise, u^2 of a new direction or 0, log det N' N after it, the largest inflation, and
the column by which a regressor enters.
"""

AT_S, AT_D, AT_R, AT_P, AT_THETA, AT_PHI, AT_WORK, AT_NOW, AT_VAR, ADDRESSES = range(10)
"""Addresses that `machine_learn` is given."""


KNOWN = 1e150
"""Root of the information on a parameter that is known for certain: its square is finite, and its inverse's is not."""
PASSES = 4
"""Times that a direction is made orthogonal to others at most."""
SCRATCH = ("H", "pivot", "work", "at_start")
"""Fields of the start that carry nothing from one sample to the next."""


@lru_cache
def knowing_nothing(n: int, worst: float = WORST) -> Mapping[str, Any]:
    """Fields for a diffuse start of n parameters; ``root`` is 1 while S and d, and not theta and P, are the state."""
    square = np.zeros((n, n))
    fields = {
        "S": square, "d": np.zeros(n), "R": np.eye(n), "H": square, "pivot": np.zeros(n), "work": np.zeros((WORK, n)),
        "at_start": np.zeros(NOW), "F": np.ones(n), "volume": 0.0, "rank": 0, "root": 1, "worst": worst,
    }  # fmt: skip
    for value in fields.values():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)  # all trackers share them
    return MappingProxyType(fields)


def knowing(n: int) -> Mapping[str, Any]:
    """The same fields for a proper prior."""
    return {**knowing_nothing(n), "rank": n, "root": 0}


def before_any_sample(n: int, p0: Any) -> Mapping[str, Any]:
    """The fields for a prior covariance, or for None."""
    return knowing_nothing(n) if p0 is None else knowing(n)


@shared
def refresh(S: Array, R: Array, work: Array) -> None:
    """R = S^-1 on the rows of S; its free columns are orthogonal to all regressors so far; and, if there are any, the
    norms of both.
    """
    n, free = len(S), 0
    for j in range(n):
        free += 1 if S[j, j] == 0.0 else 0
        R[j, j] = 1.0 / S[j, j] if S[j, j] > 0.0 else 1.0
        squares = 0.0
        for i in range(j, -1, -1):
            squares += S[i, j] * S[i, j]
            if i < j:
                t = 0.0
                for k in range(i + 1, j + 1):
                    t -= S[i, k] * R[k, j]
                R[i, j] = t / S[i, i] if S[i, i] > 0.0 else 0.0
        work[SIZE, j] = np.sqrt(squares)
    if free == 0:
        return
    for i in range(n):
        squares = 0.0
        for k in range(i, n):
            squares += R[i, k] * R[i, k] if S[k, k] > 0.0 else 0.0
        work[STD, i] = np.sqrt(squares)
    for j in range(n):
        loose = work[SIZE, j]
        for i in range(j):
            loose += work[SIZE, i] * abs(R[i, j])
        work[LOOSE, j] = loose
        for i in range(j):
            if S[j, j] == 0.0 and abs(R[i, j]) <= WITHIN_SPAN * work[STD, i] * loose:
                R[i, j] = 0.0


@shared
def outside(phi: Array, S: Array, work: Array) -> tuple[int, float, float]:
    """The first free column j along which phi leaves the span, and u_j; or -1, 0 and |S^-T phi|^2 for a phi within it.

    u_j is summed as phi_j - x' S_.j with S' x = phi: its rounding grows with |x|, and not with each entry of R.
    """
    n = len(S)
    squares = 0.0
    for j in range(n):
        u = phi[j]
        for i in range(j):
            u -= S[i, j] * work[ROW, i]
        x = u / S[j, j] if S[j, j] > 0.0 else 0.0
        work[ROW, j] = x
        if S[j, j] == 0.0 and abs(u) > WITHIN_SPAN * (abs(phi[j]) + np.sqrt(squares) * work[LOOSE, j]):
            return j, u, np.inf
        squares += x * x
    return -1, 0.0, squares


@shared
def turn_in(S: Array, d: Array, row: Array, y: float, entering: int) -> None:
    """Rotate ``row' theta = y`` into (S, d), skipping free columns, where it contains rounding, up to the column by
    which it enters.
    """
    n = len(S)
    for i in range(n):
        a, b = S[i, i], row[i]
        if a > 0.0 or i == entering:
            top = max(a, abs(b))
            r = top * np.sqrt((a / top) ** 2 + (b / top) ** 2)  # squares of 1e-200 would be 0
            c, s = a / r, b / r
            S[i, i] = r
            for j in range(i + 1, n):
                t = S[i, j]
                S[i, j] = c * t + s * row[j]
                row[j] = c * row[j] - s * t
            t = d[i]
            d[i] = c * t + s * y
            y = c * y - s * t
        if i == entering:
            break


@shared
def sheared(x: Array, time: float) -> None:
    """x = (level, slope), moved by ``time``."""
    half = len(x) // 2
    for i in range(half if time != 0.0 else 0):
        x[i] += time * x[half + i]


@shared
def unseen(S: Array, R: Array, Q: Array, age: float) -> float:
    """Q = an orthonormal basis of the directions without information, one column for each free column; returns log det
    N' N.

    In very different units these are nearly parallel, and one pass leaves rounding: it is repeated until a column keeps
    most of its length.

    If theta consists of levels and slopes, both refer to the first sample, ``age`` ago; otherwise the age is 0.
    """
    n = len(S)
    volume = 0.0
    for j in range(n):
        if S[j, j] == 0.0:
            for i in range(n):
                Q[i, j] = R[i, j] if i <= j else 0.0
            sheared(Q[:, j], -age)
            passes = 0
            while passes < PASSES:
                earlier = 0
                for k in range(j):
                    if S[k, k] == 0.0:
                        earlier = 1
                        dot = 0.0
                        for i in range(n):
                            dot += Q[i, k] * Q[i, j]
                        for i in range(n):
                            Q[i, j] -= dot * Q[i, k]
                top, squares = 1e-300, 0.0
                for i in range(n):
                    top = max(top, abs(Q[i, j]))
                for i in range(n):
                    squares += (Q[i, j] / top) ** 2
                for i in range(n):
                    Q[i, j] /= top * np.sqrt(squares)
                volume += log(squares) + 2.0 * log(top)
                enough = earlier == 0 or (passes > 0 and top * top * squares > 0.5)
                passes = PASSES if enough else passes + 1
    return volume


@shared
def estimate(S: Array, d: Array, Q: Array, theta: Array, x: Array, age: float) -> None:
    """theta that solves S theta = d and is unchanged in the directions of Q, those without information."""
    n = len(S)
    for i in range(n - 1, -1, -1):
        x[i] = theta[i]
        if S[i, i] > 0.0:
            t = d[i]
            for j in range(i + 1, n):
                t -= S[i, j] * x[j]
            x[i] = t / S[i, i]
    for i in range(n):
        theta[i] -= x[i]
    sheared(theta, -age)
    sheared(x, -age)
    for j in range(n):
        if S[j, j] == 0.0:
            dot = 0.0
            for i in range(n):
                dot += Q[i, j] * theta[i]
            for i in range(n):
                x[i] += dot * Q[i, j]
    sheared(x, age)
    for i in range(n):
        theta[i] = x[i]


@shared
def covariance(S: Array, R: Array, P: Array) -> None:
    """The lower triangle of P = R R', conditional on the parameters of free columns."""
    n = len(S)
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += R[i, k] * R[j, k] if S[k, k] > 0.0 else 0.0
            P[i, j] = total if total * total > 0.0 else 0.0


@shared
def foresee(S: Array, R: Array, phi: Array, work: Array, now: Array) -> None:
    """What a sample with this regressor adds, after the time update: ``now`` is ``at_start``."""
    refresh(S, R, work)
    entering, u, now[BEFORE] = outside(phi, S, work)
    now[ENTERING], now[SQUARE] = entering, u * u


@shared
def learn(S: Array, d: Array, R: Array, P: Array, theta: Array, phi: Array, work: Array, now: Array) -> None:
    """Update by a sample, if there is one, that `foresee` has looked at."""
    n = len(S)
    if now[OK] > 0.0:
        root = np.sqrt(1.0 / now[NOISE])
        for i in range(n):
            work[ROW, i] = root * phi[i]
        turn_in(S, d, work[ROW], root * now[Y], int(now[ENTERING]))
        refresh(S, R, work)
        now[VOLUME] = unseen(S, R, P, now[AGE])
        estimate(S, d, P, theta, work[ROW], now[AGE])
    else:
        now[SQUARE] = 0.0
    covariance(S, R, P)
    worst = 0.0
    for i in range(n):
        inflation = P[i, i] * work[SIZE, i] * work[SIZE, i]
        worst = max(worst, inflation if S[i, i] > 0.0 else np.inf)
    now[INFLATION] = worst


@shared
def spanned(S: Array, R: Array, P: Array, var: Array) -> None:
    """var = diag P, inf where a free column has a share."""
    for i in range(len(var)):
        var[i] = P[i, i]
        for j in range(i, len(S)):
            if S[j, j] == 0.0 and R[i, j] != 0.0:
                var[i] = np.inf


@partial(machine, short=True)
def machine_foresee(fields: int, n: int, L: int, l: int) -> None:
    """`foresee` for lane l of L, from the addresses of fields."""
    at = wholes(fields, 1, ADDRESSES)
    S, R, phi = cubes(at[0, AT_S], n, n, L), cubes(at[0, AT_R], n, n, L), floats(at[0, AT_PHI], n, L)
    work, now = cubes(at[0, AT_WORK], WORK, n, L), floats(at[0, AT_NOW], NOW, L)
    foresee(S[:, :, l], R[:, :, l], phi[:, l], work[:, :, l], now[:, l])


@partial(machine, short=True)
def machine_learn(fields: int, n: int, m: int, L: int, l: int) -> None:
    """`learn` and `spanned` for lane l of L, from the addresses of fields; var has m <= n entries."""
    at = wholes(fields, 1, ADDRESSES)
    S, R, P = cubes(at[0, AT_S], n, n, L), cubes(at[0, AT_R], n, n, L), cubes(at[0, AT_P], n, n, L)
    S_l, R_l, P_l = S[:, :, l], R[:, :, l], P[:, :, l]
    d, theta, phi = floats(at[0, AT_D], n, L), floats(at[0, AT_THETA], n, L), floats(at[0, AT_PHI], n, L)
    work, now = cubes(at[0, AT_WORK], WORK, n, L), floats(at[0, AT_NOW], NOW, L)
    learn(S_l, d[:, l], R_l, P_l, theta[:, l], phi[:, l], work[:, :, l], now[:, l])
    spanned(S_l, R_l, P_l, floats(at[0, AT_VAR], m, L)[:, l])


@shared
def take_root(P: Array, R: Array, S: Array) -> None:
    """The triangle S with S' S = P^-1, from the lower triangle of P = R R', R an upper triangle; what is known for
    certain has the standard deviation 1 / `KNOWN`.
    """
    n = len(P)
    for j in range(n - 1, -1, -1):
        pivot = P[j, j]
        for k in range(j + 1, n):
            pivot -= R[j, k] * R[j, k]
        R[j, j] = np.sqrt(max(pivot, LEFT * P[j, j])) if P[j, j] > 0.0 else 1.0 / KNOWN
        for i in range(j):
            t = P[j, i]
            for k in range(j + 1, n):
                t -= R[i, k] * R[j, k]
            R[i, j] = t / R[j, j] if P[j, j] > 0.0 else 0.0
    for j in range(n):
        S[j, j] = 1.0 / R[j, j]
        for i in range(j - 1, -1, -1):
            t = 0.0
            for k in range(i + 1, j + 1):
                t -= R[i, k] * S[k, j]
            S[i, j] = t / R[i, i]


@partial(machine, short=True)
def machine_root(S: int, d: int, R: int, P: int, theta: int, n: int, L: int, l: int) -> None:
    """`take_root` for lane l of L, and d = S theta."""
    S_l, right, x = cubes(S, n, n, L)[:, :, l], floats(d, n, L), floats(theta, n, L)
    take_root(cubes(P, n, n, L)[:, :, l], cubes(R, n, n, L)[:, :, l], S_l)
    for i in range(n):
        right[i, l] = 0.0
        for j in range(i, n):
            right[i, l] += S_l[i, j] * x[j, l]


@partial(machine, short=True)
def machine_wander(S: int, d: int, H: int, pivot: int, n: int, L: int, l: int, size: float) -> None:
    """`spread` for lane l of L, from the addresses of fields."""
    spread(cubes(S, n, n, L), floats(d, n, L), cubes(H, n, n, L), size, floats(pivot, n, L), l)


MACHINES = (machine_foresee, machine_learn, machine_root, machine_wander)
"""The routines that the steps of a tracker with a diffuse start call; see `TrackerSteps`."""


@kernel
def wander(s: State, size: float, l: int) -> None:
    """Move theta by ``size`` s.H w with w ~ N(0, I), in square-root form."""
    n, L = s.d.shape
    machine_wander(s.S.ctypes.data, s.d.ctypes.data, s.H.ctypes.data, s.pivot.ctypes.data, n, L, l, size)


@kernel
def scale_drift(s: State, l: int) -> None:
    """s.H = E G, with E the diagonal matrix of the roots of the drift factors."""
    n = s.theta.shape[0]
    for i in range(n):
        for j in range(i, n):
            s.H[i, j, l] = s.drift_root[i, l] * s.G[i, j, l]


@kernel
def drifted(s: State, time: float, l: int) -> None:
    """The time update of the square root for a random walk of covariance ``time`` E G G' E."""
    scale_drift(s, l)
    wander(s, np.sqrt(time), l)


@kernel
def foresee_row(s: State, theta: int, phi: int, l: int) -> None:
    """`foresee` from parameters and regressors at these addresses: |S^-T phi|^2, inf in a new direction."""
    n, L = s.d.shape
    fields = packed((
        s.S.ctypes.data, s.d.ctypes.data, s.R.ctypes.data, s.P.ctypes.data, theta, phi, s.work.ctypes.data,
        s.at_start.ctypes.data, s.var.ctypes.data,
    ))  # fmt: skip
    machine_foresee(fields, n, L, l)


@kernel
def call(s: State, theta: int, phi: int, ok: float, age: float, l: int) -> None:
    """`learn` from parameters and regressors at these addresses, with the sample if ok is 1."""
    n, L = s.d.shape
    s.at_start[Y, l], s.at_start[NOISE, l], s.at_start[OK, l], s.at_start[AGE, l] = s.y[l], s.r[l] * s.noise[l], ok, age
    fields = packed((
        s.S.ctypes.data, s.d.ctypes.data, s.R.ctypes.data, s.P.ctypes.data, theta, phi, s.work.ctypes.data,
        s.at_start.ctypes.data, s.var.ctypes.data,
    ))  # fmt: skip
    machine_learn(fields, n, s.var.shape[0], L, l)


@kernel
def absorb_row(s: State, theta: int, phi: int, age: float, l: int) -> None:
    """Take in the sample, if it is used, after `foresee_row`: theta, P, a new direction."""
    call(s, theta, phi, s.ok[l], age, l)
    if s.at_start[SQUARE, l] > 0.0:
        s.F[s.rank[l], l] = s.at_start[SQUARE, l] * exp(s.at_start[VOLUME, l] - s.volume[l])
        s.rank[l] += 1
        s.volume[l] = s.at_start[VOLUME, l]


@kernel
def forecast_on_roots(s: State, l: int) -> None:
    """y_hat, e and h in square-root form."""
    y_hat = prediction(s, l)
    foresee_row(s, s.theta.ctypes.data, s.phi.ctypes.data, l)
    s.y_hat[l], s.e[l], s.h[l] = y_hat, s.y[l] - y_hat, s.at_start[BEFORE, l]


@kernel
def absorb_on_roots(s: State, l: int) -> None:
    """The sample in square-root form: theta and P."""
    absorb_row(s, s.theta.ctypes.data, s.phi.ctypes.data, 0.0, l)


@kernel
def hand_over(s: State, l: int) -> None:
    """Make the covariance the state from now on, if it is accurate enough."""
    s.root[l] = 0 if s.at_start[INFLATION, l] <= s.worst[l] else 1


@kernel
def correct_on_roots(s: State, l: int) -> None:
    """The correction in square-root form, and the change to a covariance once that is accurate."""
    absorb_on_roots(s, l)
    hand_over(s, l)


@kernel
def reform(s: State, l: int) -> None:
    """Recompute P from the square root, after a change that is not a sample."""
    foresee_row(s, s.theta.ctypes.data, s.phi.ctypes.data, l)
    call(s, s.theta.ctypes.data, s.phi.ctypes.data, 0.0, 0.0, l)


@kernel
def take_over(s: State, l: int) -> None:
    """The square root, from theta and P, for a sample after which P would be rounding (`driftfit.engine.drivers`)."""
    n, L = s.d.shape
    machine_root(s.S.ctypes.data, s.d.ctypes.data, s.R.ctypes.data, s.P.ctypes.data, s.theta.ctypes.data, n, L, l)
    s.root[l] = 1


@kernel
def spanned_variance(s: State, l: int) -> None:
    """Report the variance: infinite for every parameter that the regressors do not span yet."""
    for i in range(s.theta.shape[0]):
        var = s.var[i, l]
        s.var[i, l] = in_units_of_noise(var, s.scale[l]) if var < np.inf else np.inf


def started(
    steps: TrackerSteps, predict: Step, correct: Step = correct_on_roots, forecast: Step = forecast_on_roots
) -> TrackerSteps:
    """The steps of a tracker of theta and P, with those of its square-root form, from which it starts."""
    first = TrackerSteps(predict, forecast, correct, spanned_variance, take_over=take_over)
    return steps._replace(start=first, machines=MACHINES)
