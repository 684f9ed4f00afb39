"""Scenarios: plants, markets and buildings as they are met, one function each."""

from __future__ import annotations

import numpy as np

from benchmarks.held_out.case import Case, Generator, arx, case, held, regression, slow, walk
from driftfit import ARX


def fouling(rng: Generator) -> Case:
    """A heat exchanger loses .4 of its transfer between cleanings, of which it does not recover all."""
    length, gain, lost = 1500, np.zeros(1500), 0.0
    start, new = 0, 2.0
    for t in range(length):
        if t - start > 250 and rng.random() < 0.02:
            start, new = t, new - 0.04
        lost = 0.4 * (1.0 - np.exp(-(t - start) / 200.0))
        gain[t] = new - lost
    difference = 30.0 + slow(rng, length, 0.95, 5.0)
    path = np.column_stack([gain, np.full(length, 3.0)])
    return regression(rng, path, 0.6, np.column_stack([difference, np.ones(length)]), burn=150)


def hedge_ratios(rng: Generator) -> Case:
    """Daily returns of a portfolio on two indices: ratios wander, one breaks, and volatility clusters."""
    length = 1500
    size = np.exp(0.5 * slow(rng, length, 0.97, 0.8))
    market = np.column_stack([rng.standard_t(5, length) * size, rng.standard_t(5, length)])
    first = 0.9 + slow(rng, length, 0.998, 0.2)
    second = np.where(np.arange(length) < 900, 0.4, -0.1) + walk(rng, [0.0], 0.003, length)[:, 0]
    path = np.column_stack([first, second, np.full(length, 0.02)])
    return regression(rng, path, 0.5 * size, np.column_stack([market, np.ones(length)]))


def battery(rng: Generator) -> Case:
    """Terminal voltage on duty cycles: rests, charges and discharges; resistance and open voltage wander with them."""
    length = 2000
    i = held(rng, length, 20, 90, [0.0, 0.0, 2.0, 2.0, -1.0, -3.0])
    i += np.where(i != 0.0, 0.15 * rng.normal(size=length), 0.0)
    charge = 0.5 + np.cumsum(i - 0.05 * slow(rng, length, 0.99, 1.0)) / 2.0e4
    warm = 0.05 * np.sin(2.0 * np.pi * np.arange(length) / 700.0) + np.linspace(0.0, 0.1, length)
    pole, own, later = 0.92, 0.05 * (1.0 + 4.0 * warm), -0.03 * (1.0 + 4.0 * warm)
    constant = (1.0 - pole) * (3.4 + 0.5 * charge)
    path = np.column_stack([np.full(length, pole), own, later, constant])
    return arx(rng, path, (1, 2, 0), i, 0.002, True, before=3.65, burn=200)


def seasonal_demand(rng: Generator) -> Case:
    """The logarithm of a demand: price, temperature, a week of two waves whose height changes, and a level."""
    length = 1400
    day = np.arange(length)
    price = held(rng, length, 20, 60, [-0.2, -0.1, 0.0, 0.1, 0.2]) + 0.02 * rng.normal(size=length)
    cold = np.sin(2.0 * np.pi * day / 365.0) + slow(rng, length, 0.8, 0.5)
    week = np.column_stack([np.sin(2.0 * np.pi * day / 7.0), np.cos(2.0 * np.pi * day / 7.0)])
    path = np.column_stack([
        -1.2 + 0.3 * np.sin(2.0 * np.pi * day / 500.0), 0.2 + walk(rng, [0.0], 0.002, length)[:, 0],
        0.3 + slow(rng, length, 0.998, 0.08), np.full(length, 0.1), 5.0 + walk(rng, [0.0], 0.006, length)[:, 0],
    ])  # fmt: skip
    return regression(rng, path, 0.06, np.column_stack([price, cold, week, np.ones(length)]), burn=150)


def noisy_week(rng: Generator) -> Case:
    """Five weeks of hours, in the fourth of which the noise is five times as large; the gain of the plant wanders."""
    length = 5 * 168
    std = 0.05 * np.where(np.arange(length) // 168 == 3, 5.0, 1.0)
    path = walk(rng, [0.8, 0.5], [0.0, 0.008], length)
    return arx(rng, path, (1, 1, 1), slow(rng, length, 0.7, 1.0), std)


def room(rng: Generator) -> Case:
    """A room with a thermostat, read in steps of .1 K: windows open twice, so that losses treble for an hour or two."""
    length, step = 1400, 0.1
    hour = np.arange(length)
    outside = 4.0 + 5.0 * np.sin(2.0 * np.pi * hour / 96.0) + slow(rng, length, 0.98, 2.0)
    loss, power = np.full(length, 0.03), np.zeros(length)
    for start in (500, 1000):
        start += int(rng.integers(0, 200))
        loss[start : start + 30] = 0.09
    gain = 0.5 + walk(rng, [0.0], 0.002, length)[:, 0]
    warm, on, e = np.full(length, 20.0), 1.0, 0.03 * rng.normal(size=length)
    for t in range(1, length):
        warm[t] = (1.0 - loss[t]) * warm[t - 1] + loss[t] * outside[t - 1] + gain[t] * power[t - 1] + e[t]
        wanted = 20.0 + 2.0 * (hour[t] % 96 > 30)
        on = 1.0 if warm[t] < wanted else 0.0 if warm[t] > wanted + 1.0 else on
        power[t] = on * (1.0 + 0.2 * rng.normal())
    y, u = step * np.round(warm / step), np.column_stack([outside, power])
    phi = np.full((length, 3), np.nan)
    phi[1:] = np.column_stack([y[:-1], u[:-1]])
    theta = np.column_stack([1.0 - loss, loss, gain])
    v = np.nan_to_num(y - np.sum(phi * theta, axis=1))
    return case(ARX(1, (1, 1), nk=(1, 1)), y, u, phi, theta, v, burn=150)
