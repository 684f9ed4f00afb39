"""The compiled steps of `driftfit.trackers.particle_filter`."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST, TrackerSteps
from driftfit.engine.kernel import Array, State, exp, kernel, log
from driftfit.models.state_space import equations_of
from driftfit.trackers.forms.covariance import LEFT, read_drift
from driftfit.trackers.joint_kalman import REPEAT_LIMIT, evaluate_at, extended_moving
from driftfit.trackers.state_space.draws import normal, uniform

HALF_LOG_2_PI = 0.9189385332046727


@lru_cache
def _moving(equations: str, inputs: tuple[str, ...], hidden: int, timed: bool) -> Any:
    """``move(s, p, l)``: the states of a particle and their covariance through the equations."""
    move = extended_moving(equations_of(equations, inputs).move, hidden)

    @kernel
    def repeated(s: State, p: int, l: int) -> None:
        left = 1.0 if timed else min(max(1.0, s.dt[l]), REPEAT_LIMIT)
        while left > 0.5:
            move(s, s.cloud[p], s.own[p], l)
            left -= 1.0

    @kernel
    def still(s: State, p: int, l: int) -> None:
        """There are no states."""

    return repeated if hidden else still


@kernel
def draw(s: State, p: int, k: int, l: int) -> None:
    """Entry k of a particle is drawn from its distribution, and the others are conditioned on it."""
    n, var = s.theta.shape[0], s.own[p, k, k, l]
    z = normal(s.drawn[l], s.seed[l])
    s.drawn[l] += 1
    root = np.sqrt(var) if var > 0.0 else 0.0
    for i in range(n):
        c = s.own[p, i, k, l] if i >= k else s.own[p, k, i, l]
        s.column[i, l] = c / root if root > 0.0 else 0.0
    for i in range(n):
        s.cloud[p, i, l] += s.column[i, l] * z
        for j in range(i):
            s.own[p, i, j, l] -= s.column[i, l] * s.column[j, l]
        s.own[p, i, i, l] = max(s.own[p, i, i, l] - s.column[i, l] * s.column[i, l], LEFT * s.own[p, i, i, l])
    for i in range(n):
        if i >= k:
            s.own[p, i, k, l] = 0.0
        else:
            s.own[p, k, i, l] = 0.0


@kernel
def mixture(s: State, l: int) -> None:
    """theta and P from all particles."""
    n, count = s.theta.shape[0], s.weight.shape[0]
    for i in range(n):
        total = 0.0
        for p in range(count):
            total += s.weight[p, l] * s.cloud[p, i, l]
        s.theta[i, l] = total
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for p in range(count):
                apart = (s.cloud[p, i, l] - s.theta[i, l]) * (s.cloud[p, j, l] - s.theta[j, l])
                total += s.weight[p, l] * (s.own[p, i, j, l] + apart)
            s.P[i, j, l] = total


@kernel
def copy_particles(cloud: Array, own: Array, into_cloud: Array, into_own: Array, l: int) -> None:
    """Copy means (p, i) and lower triangles (p, i, j) of all particles."""
    for p in range(cloud.shape[0]):
        for i in range(cloud.shape[1]):
            into_cloud[p, i, l] = cloud[p, i, l]
            for j in range(i + 1):
                into_own[p, i, j, l] = own[p, i, j, l]


@kernel
def resample(s: State, l: int) -> None:
    """Systematic resampling, once the weights are worth fewer than half of the particles."""
    n, count, squares = s.theta.shape[0], s.weight.shape[0], 0.0
    for p in range(count):
        squares += s.weight[p, l] * s.weight[p, l]
    if squares * count > 2.0:
        start = uniform(s.drawn[l], s.seed[l])
        s.drawn[l] += 1
        source, reached = 0, s.weight[0, l]
        for p in range(count):
            while (reached * count < p + start) & (source < count - 1):
                source += 1
                reached += s.weight[source, l]
            for i in range(n):
                s.cloud_after[p, i, l] = s.cloud[source, i, l]
                for j in range(i + 1):
                    s.own_after[p, i, j, l] = s.own[source, i, j, l]
        for p in range(count):
            s.weight[p, l] = 1.0 / count
        copy_particles(s.cloud_after, s.own_after, s.cloud, s.own, l)


@lru_cache
def _forecast(equations: str, inputs: tuple[str, ...]) -> Any:
    """``forecast(s, l)``: value, variance and gain of every particle, and of the mixture; whether there is one."""
    output = equations_of(equations, inputs).show

    @kernel
    def of_particle(s: State, p: int, l: int) -> bool:
        n = s.theta.shape[0]
        evaluate_at(s, s.cloud[p], l)
        output(s, l)
        finite, v = abs(s.value[l]) < LARGEST, 0.0
        for i in range(n):
            finite = finite & (abs(s.phi[i, l]) < LARGEST)
            total = 0.0
            for j in range(n):
                total += (s.own[p, i, j, l] if j <= i else s.own[p, j, i, l]) * s.phi[j, l]
            s.gain[p, i, l] = total
        for i in range(n):
            v += s.phi[i, l] * s.gain[p, i, l]
        s.shown[p, l] = s.value[l] if finite else 0.0
        s.spread[p, l] = max(v, 0.0) if finite else -1.0
        return finite  # type: ignore[no-any-return]

    @kernel
    def forecast(s: State, l: int) -> bool:
        count, total, y_hat, v = s.weight.shape[0], 0.0, 0.0, 0.0
        for p in range(count):
            w = s.weight[p, l] if of_particle(s, p, l) else 0.0
            total += w
            y_hat += w * s.shown[p, l]
        y_hat = y_hat / total if total > 0.0 else 0.0
        for p in range(count):
            w = s.weight[p, l] if s.spread[p, l] >= 0.0 else 0.0
            away = s.shown[p, l] - y_hat
            v += w * (s.spread[p, l] + away * away)
        s.y_hat[l], s.h[l] = y_hat, v / total if total > 0.0 else 0.0
        return (total > 0.0) & (s.h[l] < LARGEST)  # type: ignore[no-any-return]

    return forecast


@kernel
def weigh(s: State, l: int) -> None:
    """Weights and log density of the sample; particles without a value lose theirs."""
    count, top = s.weight.shape[0], -np.inf
    for p in range(count):
        v, e = s.spread[p, l] + s.r[l] * s.noise[l], s.y[l] - s.shown[p, l]
        possible = (s.spread[p, l] >= 0.0) & (s.weight[p, l] > 0.0)
        fit = log(s.weight[p, l]) - 0.5 * (log(v) + e * e / v) if possible else -np.inf
        s.fit[p, l] = fit
        top = max(top, fit)
    total = 0.0
    for p in range(count):
        below = s.fit[p, l] - top  # and not fit > top - 700, which is false for the largest where that is rounding
        s.fit[p, l] = exp(below) if below > -700.0 else 0.0
        total += s.fit[p, l]
    for p in range(count):
        s.weight[p, l] = s.fit[p, l] / total
    s.log_density[l] = top + log(total) - HALF_LOG_2_PI


@kernel
def learn(s: State, l: int) -> None:
    """Every particle learns what is Gaussian in it."""
    n = s.theta.shape[0]
    for p in range(s.weight.shape[0]):
        if s.spread[p, l] >= 0.0:
            e, per = s.y[l] - s.shown[p, l], 1.0 / (s.spread[p, l] + s.r[l] * s.noise[l])
            for i in range(n):
                k = per * s.gain[p, i, l]
                s.cloud[p, i, l] += k * e
                for j in range(i):
                    s.own[p, i, j, l] -= k * s.gain[p, j, l]
                s.own[p, i, i, l] = max(s.own[p, i, i, l] - k * s.gain[p, i, l], LEFT * s.own[p, i, i, l])


@lru_cache
def steps(
    equations: str, inputs: tuple[str, ...], hidden: int, timed: bool, sampled: tuple[int, ...]
) -> TrackerSteps:  # fmt: skip
    """The steps for a system of which the entries ``sampled`` of theta are drawn."""
    move, of_all = _moving(equations, inputs, hidden, timed), _forecast(equations, inputs)
    drawn, count = sampled or (0,), len(sampled)

    @kernel
    def predict(s: State, l: int) -> None:
        n, time = s.theta.shape[0], s.dt[l] * s.drift[l]
        if s.dt[l] > 0.0:
            for p in range(s.weight.shape[0]):
                move(s, p, l)
                for i in range(n):
                    for j in range(i + 1):
                        s.own[p, i, j, l] += s.q[i, j, l] * (s.drift_root[i, l] * s.drift_root[j, l]) * time
                for k in range(count):
                    draw(s, p, drawn[k], l)
            mixture(s, l)

    @kernel
    def forecast(s: State, l: int) -> None:
        found = of_all(s, l)
        s.e[l] = s.y[l] - s.y_hat[l] if found else 0.0
        s.valid[l] = s.valid[l] if found else 0.0
        s.ok[l] = s.ok[l] if found else 0.0

    @kernel
    def correct(s: State, l: int) -> None:
        s.log_density[l] = 0.0
        if s.ok[l] > 0.0:
            weigh(s, l)
            learn(s, l)
            mixture(s, l)
            resample(s, l)
        for i in range(s.theta.shape[0]):
            s.phi[i, l] = 0.0

    return TrackerSteps(predict, forecast, correct, store=store, read_extra=read_drift, reads_model=True)


@kernel
def store(o: State, s: State, l: int) -> None:
    o.log_density[l] = s.log_density[l]
