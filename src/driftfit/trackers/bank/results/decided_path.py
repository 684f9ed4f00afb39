"""The path of a complete record given the detected events: Rauch, Tung and Striebel with Q of the decided event.

    theta(t+1) - theta(t):  mean m_s(t+1) - m_s(t),  covariance C_s(t+1) + C_s(t) - G C_s(t+1) - C_s(t+1) G'

Samples at which the sensor was at fault have the noise variance of their fault, or are not used (additive outliers, a
frozen sensor; in ARX also later samples whose regressors contain them). Bands are conditional on the events. A diffuse
start is a prior of 1e6 times the variance that a sample leaves.

The drift of a bank that was given no changes is a guess, and is fitted (`driftfit.trackers.bank.results.fitted_drift`).

Source: Rauch, Tung and Striebel (1965); the covariance of an increment from the lag-one covariance G C_s(t+1).
"""

from __future__ import annotations

from functools import cached_property
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import matrix
from driftfit.run.result import Track
from driftfit.smooth.problem import replay
from driftfit.trackers.bank.bank import Bank
from driftfit.trackers.bank.leaves.leaf_matrix import NU, WEIGHT, S
from driftfit.trackers.bank.results.events import Event
from driftfit.trackers.bank.results.fitted_drift import FittedDrift
from driftfit.trackers.bank.results.given_steps import Problem, solve

WIDE = 1e6
"""Variance of the start of a diffuse run, in units of the variance that one sample leaves."""


class EventSmoothed:
    """Parameters of a record given the events, each estimated from the whole record.

    ``theta``, ``std`` (T, n); ``covs`` (T, n, n); ``events`` are those that it is conditional on; ``widened`` (n,) are
    the factors of the drift between them, 1 where the changes of the bank were given.
    """

    def __init__(self, run: Track, events: list[Event]) -> None:
        self.run, self.events, self.names, self.time = run, events, run.names, run.time
        self.problem, self.widened = problem_of(run, events), np.ones(len(run.names))
        self._fitted: FittedDrift | None = None
        if run.tracker.changes is None:  # type: ignore[attr-defined]
            self._fitted = fitted = fitted_drift(run, self.problem, events)
            self.problem, self.widened = fitted.problem, fitted.widened
            self.events = [event for event in events if event.kind != "change" or event.span.date in fitted.dates]
        self.theta, self._given, self.gains = solve(self.problem)

    def __repr__(self) -> str:
        return f"Smoothed path of {len(self.theta)} samples given {len(self.events)} events: {self.run.tracker!r}"

    @cached_property
    def covs(self) -> Array:
        """(T, n, n), including the uncertainty of a fitted drift."""
        return self._given if self._fitted is None else self._given + self._fitted.spread()

    @property
    def std(self) -> Array:
        """inf for parameters that the record never distinguished."""
        return np.where(np.isinf(self.run.std[-1]), np.inf, np.sqrt(np.einsum("tii->ti", self.covs)))

    def band(self, level: float = 0.95) -> tuple[Array, Array]:
        """(low, high), each (T, n)."""
        half = NormalDist().inv_cdf(0.5 + level / 2.0) * self.std
        return self.theta - half, self.theta + half

    def increment(self, t: int) -> tuple[Array, Array]:
        """Mean (n,) and covariance (n, n) of theta_t - theta_{t-1}."""
        given = self._given
        lag = self.gains[t - 1] @ given[t]
        return self.theta[t] - self.theta[t - 1], given[t] + given[t - 1] - lag - lag.T


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
    return Problem(measured.phi, measured.y, measured.r, steps, m0, C0)


def fitted_drift(run: Track, problem: Problem, events: list[Event]) -> FittedDrift:
    """The same with the drift that is likely, without the changes that such a drift explains."""
    bank: Any = run.tracker
    measured = measurements(run, [])
    time = (measured.drift * measured.dt)[:, None, None]
    prior = bank.event_probabilities[1].reshape(len(bank.all_changes), -1).sum(axis=1)
    prob = dict(zip(bank.change_names, prior, strict=True))
    changes = {event.span.date: float(prob[event.name]) for event in events if event.kind == "change"}
    return FittedDrift(problem, steps_of(run, measured)[0] * time, changes, bank.all_sensors[0].r is None)


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
    replayed = replay(run)
    ok, phi = replayed["ok"][:, 0] > 0.0, np.ascontiguousarray(replayed["phi"][..., 0])
    noise = noise_variance(bank, run)
    factor = replayed["used_noise"][:, 0]
    squares = np.mean(phi[ok] ** 2 / factor[ok, None], axis=0) if ok.any() else np.ones(phi.shape[1])
    unit = np.where(squares > 0.0, noise / np.where(squares > 0.0, squares, 1.0), noise)
    relative = noise if bank.all_sensors[0].r is None and bank.all_sensors[0].guess is None else 1.0
    r = np.where(ok, noise * factor, np.inf) * faults(bank, run, events)
    drift = run.known.over(len(phi)).drift.copy()
    return Measured(phi, replayed["y"][:, 0].copy(), r, replayed["dt"][:, 0].copy(), drift, unit, relative)


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
