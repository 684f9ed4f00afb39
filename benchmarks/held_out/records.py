"""Scenarios: inputs that rest, coarse meters, units far from 0, codes, gaps and weights, one function each."""

from __future__ import annotations

import numpy as np

from benchmarks.held_out.case import Case, Generator, T, arx, case, held, only, regression, slow, walk
from driftfit import ARMAX, ARX, Regression
from driftfit.engine.kernel import Array

LONG = 60_000
"""Samples of a record whose least squares are the truth of a coarse meter."""


def armax_at(rng: Generator, temperature: float) -> Case:
    """A room about this temperature: y_t = .85 y_t-1 + .6 u_t-1 + e_t + .5 e_t-1 + offset; the gain walks."""
    path = walk(rng, [0.85, 0.6, 0.5, 0.15 * temperature], only(4, 1, 0.008))
    u, e = rng.normal(size=T), 0.15 * rng.normal(size=T)
    y, phi = np.full(T, temperature), np.full((T, 4), np.nan)
    for t in range(1, T):
        phi[t] = [y[t - 1], u[t - 1], e[t - 1], 1.0]
        y[t] = path[t] @ phi[t] + e[t]
    return case(ARMAX(1, 1, 1, offset=True), y, u, phi, path, e)


def celsius_armax(rng: Generator) -> Case:
    """ARMAX with an offset about 20 C."""
    return armax_at(rng, 20.0)


def kelvin_armax(rng: Generator) -> Case:
    """The same in Kelvin."""
    return armax_at(rng, 293.15)


def kelvin_arx(rng: Generator) -> Case:
    """ARX with an intercept about 293 K; the gain walks."""
    path = walk(rng, [0.9, 0.5, 29.315], only(3, 1, 0.008))
    return arx(rng, path, (1, 1, 1), rng.normal(size=T), 0.15, True, before=293.15)


def rare_pulses(rng: Generator) -> Case:
    """Pulses in 2 % of samples, whose gain is 5, 1 from 500, and 4 from 1000."""
    u = (rng.random(1500) < 0.02).astype(float)
    path = np.repeat([5.0, 1.0, 4.0], 500)[:, None]
    return regression(rng, path, 0.1, u[:, None], kind="jumps", jumps=np.full((1, 1, 1), 9.0), rate=0.002)


def idle_start(rng: Generator) -> Case:
    """A plant at rest for 40 samples in hardly any noise, which then runs in 50 times as much."""
    length = 600
    u, std = rng.normal(size=length), np.where(np.arange(length) < 40, 0.001, 0.05)
    u[:40] = 0.0
    return arx(rng, walk(rng, [0.8, 0.5], 0.0, length), (1, 1, 1), u, std, kind="constant", burn=45)


def coarse(rng: Generator, theta: Array, step: float, noise: float, level: float) -> Case:
    """ARX(1, 1) or AR(1) with an intercept, read in steps: theta is what least squares of an endless record gives."""
    driven = len(theta) == 3
    x, u = np.zeros(LONG), slow(rng, LONG, 0.9, 1.0)
    e = noise * rng.normal(size=LONG)
    for t in range(1, LONG):
        x[t] = theta[0] * x[t - 1] + (theta[1] * u[t - 1] if driven else 0.0) + e[t]
    y = step * np.round((x + level) / step)
    phi = np.column_stack([y[:-1], *([u[:-1]] if driven else []), np.ones(LONG - 1)])
    truth = np.linalg.lstsq(phi, y[1:], rcond=None)[0]
    phi = np.concatenate([np.full((1, len(theta)), np.nan), phi[: T - 1]])
    model, inputs = ARX(1, 1 if driven else 0, intercept=True), u[:T, None][:, : int(driven)]
    v = np.nan_to_num(y[:T] - phi @ truth)
    return case(model, y[:T], inputs, phi, truth, v, kind="constant")


def integer_sensor(rng: Generator) -> Case:
    """An autoregression with pole .9 about 20, read in whole numbers, in noise of .15, .3 or .6."""
    return coarse(rng, np.array([0.9, 0.0]), 1.0, float(rng.choice([0.15, 0.3, 0.6])), 20.0)


def coarse_arx(rng: Generator) -> Case:
    """ARX(1, 1) on a meter of .2."""
    return coarse(rng, np.array([0.85, 0.3, 0.0]), 0.2, 0.05, 5.0)


def step_test(rng: Generator) -> Case:
    """One step after 100 samples of rest, and a ten thousandth of noise; a plant of second order."""
    length, at = 400, 80 + int(rng.integers(40))
    u = (np.arange(length) >= at).astype(float)
    path = walk(rng, [1.5, -0.56, 0.05, 0.02], 0.0, length)
    return arx(rng, path, (2, 2, 1), u, 1e-4, kind="constant", burn=at + 20, least=1e-3)


def saturated_valve(rng: Generator) -> Case:
    """A gain falls along a line until its valve is fully open, and stays so for 450 samples."""
    u, gain = 0.7 + slow(rng, T, 0.8, 0.12), 2.0 - 1e-3 * np.minimum(np.arange(T), 500)
    u[500:950] = 1.0
    path = np.column_stack([gain, np.full(T, 0.5)])
    return regression(rng, path, 0.05, np.column_stack([np.clip(u, 0.0, 1.0), np.ones(T)]))


def doubled_at_rest(rng: Generator) -> Case:
    """The gain of a plant doubles while its input rests for 150 samples."""
    u = rng.normal(size=T)
    u[400:550] = 0.0
    path = np.column_stack([np.full(T, 0.5), np.where(np.arange(T) < 475, 0.5, 1.0)])
    return arx(rng, path, (1, 1, 1), u, 0.05, kind="jumps", jumps=np.diag([0.0, 0.25])[None], rate=0.002)


def codes(rng: Generator) -> Case:
    """-999 in 2 % of y, alone and in runs, and 9999 in 1 % of an input; gains walk."""
    one = regression(rng, walk(rng, rng.normal(size=3), 0.03))
    y, u = one.y.copy(), one.u.copy()
    wrong, strange = rng.random(T) < 0.01, rng.random(T) < 0.01
    wrong[:50] = strange[:50] = False
    for start in (300, 640):
        wrong[start : start + 6] = True
    y[wrong], u[strange, 1] = -999.0, 9999.0
    return case(Regression(3), y, u, one.phi, one.theta, one.noise, blind=wrong | strange)


def gaps(rng: Generator) -> Case:
    """Uneven times with pauses of 40, 15 % of y and 5 % of an input missing; gains drift with time."""
    interval = rng.choice([1.0, 1.0, 1.0, 2.0], T)
    interval[200:T:150] = 40.0
    path = walk(rng, rng.normal(size=3), 0.02 * np.sqrt(interval)[:, None])
    one = regression(rng, path)
    y, u = np.where(rng.random(T) < 0.15, np.nan, one.y), one.u.copy()
    u[rng.random(T) < 0.05, 0] = np.nan
    reading = {"time": np.cumsum(interval), "dt": 1.0}
    return case(Regression(3), y, u, u, path, one.noise, r=one.r, interval=interval, reading=reading)


def weights(rng: Generator) -> Case:
    """The noise variance is known up to a factor, and differs by a factor of 100."""
    given = 10.0 ** rng.uniform(-1.0, 1.0, T)
    one = regression(rng, walk(rng, rng.normal(size=3), 0.03), noise=0.3 / np.sqrt(given))
    return case(one.model, one.y, one.u, one.phi, one.theta, one.noise, r=one.r, reading={"weights": given})


def dead_time(rng: Generator) -> Case:
    """A dead time of five samples and set-points held for 30 to 80; the gain wanders and jumps once."""
    u = held(rng, T, 30, 80, [0.0, 0.5, 1.0, 1.5])
    gain = 0.3 + slow(rng, T, 0.995, 0.03) + 0.12 * (np.arange(T) > 600)
    path = np.column_stack([np.full(T, 0.85), gain])
    return arx(rng, path, (1, 1, 5), u, 0.03)
