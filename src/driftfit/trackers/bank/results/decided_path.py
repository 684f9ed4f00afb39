"""The path of a complete record given the detected events: Rauch, Tung and Striebel with Q of the decided event.

    G = C(t|t) C(t+1|t)^-1,   m_s = m + G (m_s(t+1) - m(t+1|t)),   C_s = C + G (C_s(t+1) - C(t+1|t)) G'
    theta(t+1) - theta(t):  mean m_s(t+1) - m_s(t),  covariance C_s(t+1) + C_s(t) - G C_s(t+1) - C_s(t+1) G'

Samples at which the sensor was at fault have the noise variance of their fault, or are not used (additive outliers, a
frozen sensor; in ARX also later samples whose regressors contain them). Bands are conditional on the events. A diffuse
start is a prior of 1e6 times the variance that a sample leaves. Cost: O(T n^3).

The drift of a bank that was given no changes is a guess, too small where parameters walk all the time: between events
the path would be taken for certain. So it is scaled, by the factor f >= 1 of greatest likelihood given the events

    max_f sum_t log N(y_t; phi_t' m_t, s_t),   Q_t = f Q_0 between events

Source: Rauch, Tung and Striebel (1965); the covariance of an increment from the lag-one covariance G C_s(t+1).
"""

from __future__ import annotations

from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver
from driftfit.engine.settings import matrix
from driftfit.run.result import Track
from driftfit.smooth.problem import replay
from driftfit.trackers.bank.bank import Bank
from driftfit.trackers.bank.leaves.leaf_matrix import NU, WEIGHT, S
from driftfit.trackers.bank.results.events import Event

WIDER, CLOSE = 1e7, 0.05
"""Largest factor of a drift that is fitted, and how closely, in its natural logarithm."""
WIDE = 1e6
"""Variance of the start of a diffuse run, in units of the variance that one sample leaves."""


class Problem(NamedTuple):
    """A regression whose coefficients have a separate drift covariance before every sample."""

    phi: Array
    y: Array
    r: Array
    """(T,): noise variance; inf for samples that are not used."""
    Q: Array
    """(T, n, n): covariance of the step before each sample."""
    m0: Array
    C0: Array
    widened: float = 1.0
    """What the drift was multiplied by."""


class EventSmoothed:
    """Parameters of a record given the events, each estimated from the whole record.

    ``theta``, ``std`` (T, n); ``covs`` (T, n, n); ``events`` are those that it is conditional on; ``widened`` is the
    factor of the drift between them, 1 where the changes of the bank were given.
    """

    def __init__(self, run: Track, events: list[Event]) -> None:
        self.run, self.events, self.names, self.time = run, events, run.names, run.time
        self.problem = problem_of(run, events)
        self.widened = self.problem.widened
        self.theta, self.covs, self.gains = solve(self.problem)

    @property
    def std(self) -> Array:
        """inf for what the record never told apart."""
        return np.where(np.isinf(self.run.std[-1]), np.inf, np.sqrt(np.einsum("tii->ti", self.covs)))

    def band(self, level: float = 0.95) -> tuple[Array, Array]:
        """(low, high), each (T, n)."""
        half = NormalDist().inv_cdf(0.5 + level / 2.0) * self.std
        return self.theta - half, self.theta + half

    def increment(self, t: int) -> tuple[Array, Array]:
        """Mean (n,) and covariance (n, n) of theta_t - theta_{t-1}."""
        lag = self.gains[t - 1] @ self.covs[t]
        return self.theta[t] - self.theta[t - 1], self.covs[t] + self.covs[t - 1] - lag - lag.T


def problem_of(run: Track, events: list[Event]) -> Problem:
    """The random walk behind a run of a bank, with the covariances of the events."""
    bank: Any = run.tracker
    if any(change.forgets for change in bank.all_changes):
        raise ValueError(
            "smooth: only random walks can be smoothed, and a Change that forgets or resets is not one; give its q "
            "instead, or cut the record at the changes with driftfit.smooth.piecewise.piecewise(run)."
        )
    measured = measurements(run, events)
    n = measured.phi.shape[1]
    which = np.zeros(len(run), int)
    for event in events:
        if event.kind == "change":
            which[event.span.date] = bank.change_names.index(event.name)
    drift = measured.drift * np.where(which > 0, 1.0, measured.dt)  # an event happens once, whatever the interval
    steps = np.array(steps_of(run, measured))[which] * drift[:, None, None]
    C0 = np.diag(WIDE * measured.unit) if bank.p0 is None else np.asarray(_full(bank, n)) * measured.relative
    m0 = np.broadcast_to(np.asarray(bank.theta0, float), n).copy()
    problem = Problem(measured.phi, measured.y, measured.r, steps, m0, C0)
    return problem if bank.changes is not None else with_drift(problem, which == 0)


def with_drift(problem: Problem, quiet: Array) -> Problem:
    """The same with the steps of ``quiet`` samples scaled by the factor of greatest likelihood."""
    from scipy.optimize import minimize_scalar

    def wider(log_factor: float) -> Problem:
        factor = np.exp(log_factor)
        return problem._replace(Q=problem.Q * np.where(quiet, factor, 1.0)[:, None, None], widened=float(factor))

    def unlikely(log_factor: float) -> float:
        tried, shape = wider(log_factor), problem.phi.shape
        m, C = np.empty(shape), np.empty((*shape, shape[1]))
        return -float(forward(tried.phi, tried.y, tried.r, tried.Q, tried.m0, tried.C0.copy(), m, C))

    best = minimize_scalar(unlikely, bounds=(0.0, np.log(WIDER)), method="bounded", options={"xatol": CLOSE})
    return wider(best.x) if best.fun < unlikely(0.0) else problem


class Measured(NamedTuple):
    """The samples of a run, and the units of its bank's settings."""

    phi: Array
    y: Array
    r: Array
    """(T,): noise variance; inf for samples that are not used."""
    dt: Array
    drift: Array
    unit: Array
    """(n,): the variance that one sample leaves of each parameter."""
    relative: float
    """The unit of q and p0."""


def measurements(run: Track, events: list[Event]) -> Measured:
    """The samples of a run; those of sensor faults have little or no weight."""
    bank: Any = run.tracker
    seen = replay(run)
    ok, phi = seen["ok"][:, 0] > 0.0, np.ascontiguousarray(seen["phi"][..., 0])
    noise = noise_variance(bank, run)
    squares = np.mean(phi[ok] ** 2, axis=0) if ok.any() else np.ones(phi.shape[1])
    unit = np.where(squares > 0.0, noise / np.where(squares > 0.0, squares, 1.0), noise)
    relative = noise if bank.all_sensors[0].r is None and bank.all_sensors[0].guess is None else 1.0
    r = np.where(ok, noise * seen["used_noise"][:, 0], np.inf) * faults(bank, run, events)
    drift = run.known.over(len(phi)).drift.copy()
    return Measured(phi, seen["y"][:, 0].copy(), r, seen["dt"][:, 0].copy(), drift, unit, relative)


def steps_of(run: Track, measured: Measured) -> list[Array]:
    """The covariance (n, n) of every change."""
    bank: Any = run.tracker
    moves = [change.increments(measured.phi.shape[1]) for change in bank.all_changes]
    return [Q * measured.relative + np.diag(sizes * measured.unit) for Q, sizes in moves]


def noise_variance(bank: Bank, run: Track) -> float:
    """The known noise variance, or the bank's estimate at the end."""
    r = bank.all_sensors[0].r
    if r is not None:
        return float(r)
    lane = run.lane(-1)
    B = bank.array(run.model, lane, "leaves")
    mass = B[WEIGHT] > 0.0
    if not mass.any():
        return float(lane["scale"])
    return float(np.sum(B[WEIGHT, mass] * B[S, mass] / (B[NU, mass] - 2.0)))


def faults(bank: Bank, run: Track, events: list[Event]) -> Array:
    """Factors of the noise variance, inf where the output carries no information."""
    factor = np.ones(len(run))
    sensors = {sensor.name: sensor for sensor in bank.all_sensors}
    reach = run.model.output_lags or 0
    for event in events:
        if event.kind == "sensor":
            sensor = sensors[event.name]
            away = sensor.kind in ("additive", "frozen", "own")
            last = event.span.last + 1 + (reach if sensor.cleans and sensor.kind != "offset" else 0)
            first = event.span.first
            factor[first:last] = np.inf if away else np.maximum(factor[first:last], sensor.factor)
    return factor


def _full(bank: Bank, n: int) -> Array:
    return matrix("Bank", "p0", bank.p0, n)


def solve(problem: Problem) -> tuple[Array, Array, Array]:
    """(theta (T, n), covariances (T, n, n), gains (T, n, n))."""
    T, n = problem.phi.shape
    m, C = np.empty((T, n)), np.empty((T, n, n))
    forward(problem.phi, problem.y, problem.r, problem.Q, problem.m0, problem.C0.copy(), m, C)
    gains = np.zeros((T, n, n))
    for t in range(T - 2, -1, -1):
        ahead = C[t] + problem.Q[t + 1]
        try:
            G = np.linalg.solve(ahead, C[t]).T
        except np.linalg.LinAlgError:
            G = C[t] @ np.linalg.pinv(ahead, hermitian=True)
        gains[t] = G
        m[t] += G @ (m[t + 1] - m[t])
        smoothed = C[t] + G @ (C[t + 1] - ahead) @ G.T
        C[t] = 0.5 * (smoothed + smoothed.T)
    return m, C, gains


@Driver
def forward(phi: Array, y: Array, r: Array, Q: Array, m0: Array, P: Array, m: Array, C: Array) -> float:
    """The filter; m (T, n) and C (T, n, n) after each sample. Returns the log-likelihood, but for its constant."""
    T, n = phi.shape
    likely = 0.0
    theta = m0.copy()
    g = np.empty(n)
    for t in range(T):
        for i in range(n):
            for j in range(n):
                P[i, j] += Q[t, i, j]
        if r[t] < np.inf:
            s, e = r[t], y[t]
            for i in range(n):
                g[i] = 0.0
                for j in range(n):
                    g[i] += P[i, j] * phi[t, j]
                s += phi[t, i] * g[i]
                e -= phi[t, i] * theta[i]
            likely -= 0.5 * (np.log(s) + e * e / s)
            for i in range(n):
                theta[i] += g[i] / s * e
            for i in range(n):
                for j in range(i + 1):
                    P[i, j] -= g[i] * g[j] / s
                    P[j, i] = P[i, j]
        for i in range(n):
            m[t, i] = theta[i]
            for j in range(n):
                C[t, i, j] = P[i, j]
    return likely
