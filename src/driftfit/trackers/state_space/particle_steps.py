"""The compiled steps of `driftfit.trackers.particle_filter`, and the random numbers that they draw.

These depend on a seed and a counter alone, so that a saved stream continues with the same ones.

    u_k = (h(k, 1) + h(k, 2)) / 2^53 from 27 and 26 bits of two hashes of 32 bits;     z_k = Phi^-1(u_k)

The hash multiplies and shifts (a multiply-xorshift finaliser, twice: for the low and the high half of the counter). All
whole numbers stay below 2^49, so that C gives the same. Phi^-1 is that of Wichura, Algorithm AS 241, Applied Statistics
37 (1988), precise to 1e-16.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST, TrackerSteps
from driftfit.engine.kernel import Array, State, exp, kernel, log
from driftfit.models.state_space import equations_of
from driftfit.trackers.dynamic_glm import HALF_LOG_2_PI
from driftfit.trackers.forms.covariance import LEFT, read_drift
from driftfit.trackers.joint_kalman import REPEAT_LIMIT, evaluate_at, extended_moving

MASK = 0xFFFFFFFF
HALF = 0xFFFF
FIRST, SECOND, GOLDEN = 0x21F0AAAD, 0xD35A2D97, 0x9E3779B9


@kernel
def multiplied(x: int, by: int) -> int:
    """x by mod 2^32."""
    return ((x & HALF) * by + ((((x >> 16) * by) & HALF) << 16)) & MASK


@kernel
def mixed(x: int) -> int:
    """A bijection of 32 bits; a xor b is (a | b) - (a & b)."""
    y = x >> 16
    x = (x | y) - (x & y)
    x = multiplied(x, FIRST)
    y = x >> 15
    x = (x | y) - (x & y)
    x = multiplied(x, SECOND)
    y = x >> 15
    return (x | y) - (x & y)


@kernel
def word(counter: int, seed: int, which: int) -> int:
    """32 bits."""
    low = mixed(((counter & MASK) + multiplied(seed & MASK, GOLDEN)) & MASK)
    return mixed((low + multiplied((counter >> 32) & MASK, FIRST) + which * GOLDEN + (seed >> 32)) & MASK)  # type: ignore[no-any-return]


@kernel
def uniform(counter: int, seed: int) -> float:
    """Between 0 and 1, neither of which it is."""
    high, low = word(counter, seed, 1) >> 5, word(counter, seed, 2) >> 6
    return (high * 67108864.0 + low + 0.5) / 9007199254740992.0  # type: ignore[no-any-return]


@kernel
def normal(counter: int, seed: int) -> float:
    """Of the standard normal distribution."""
    p = uniform(counter, seed)
    q = p - 0.5
    if abs(q) <= 0.425:
        r = 0.180625 - q * q
        top = (((((((2.5090809287301226727e3 * r + 3.3430575583588128105e4) * r + 6.7265770927008700853e4) * r
               + 4.5921953931549871457e4) * r + 1.3731693765509461125e4) * r + 1.9715909503065514427e3) * r
               + 1.3314166789178437745e2) * r + 3.3871328727963666080e0)  # fmt: skip
        low = (((((((5.2264952788528545610e3 * r + 2.8729085735721942674e4) * r + 3.9307895800092710610e4) * r
               + 2.1213794301586595867e4) * r + 5.3941960214247511077e3) * r + 6.8718700749205790830e2) * r
               + 4.2313330701600911252e1) * r + 1.0)  # fmt: skip
        return q * top / low  # type: ignore[no-any-return]
    r = np.sqrt(-log(min(p, 1.0 - p)))
    if r <= 5.0:
        r -= 1.6
        top = (((((((7.74545014278341407640e-4 * r + 2.27238449892691845833e-2) * r + 2.41780725177450611770e-1) * r
               + 1.27045825245236838258e0) * r + 3.64784832476320460504e0) * r + 5.76949722146069140550e0) * r
               + 4.63033784615654529590e0) * r + 1.42343711074968357734e0)  # fmt: skip
        low = (((((((1.05075007164441684324e-9 * r + 5.47593808499534494600e-4) * r + 1.51986665636164571966e-2) * r
               + 1.48103976427480074590e-1) * r + 6.89767334985100004550e-1) * r + 1.67638483018380384940e0) * r
               + 2.05319162663775882187e0) * r + 1.0)  # fmt: skip
    else:
        r -= 5.0
        top = (((((((2.01033439929228813265e-7 * r + 2.71155556874348757815e-5) * r + 1.24266094738807843860e-3) * r
               + 2.65321895265761230930e-2) * r + 2.96560571828504891230e-1) * r + 1.78482653991729133580e0) * r
               + 5.46378491116411436990e0) * r + 6.65790464350110377720e0)  # fmt: skip
        low = (((((((2.04426310338993978564e-15 * r + 1.42151175831644588870e-7) * r + 1.84631831751005468180e-5) * r
               + 7.86869131145613259100e-4) * r + 1.48753612908506148525e-2) * r + 1.36929880922735805310e-1) * r
               + 5.99832206555887937690e-1) * r + 1.0)  # fmt: skip
    return top / low if q > 0.0 else -top / low  # type: ignore[no-any-return]


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
