"""Plants for `driftfit.identify`: is the structure found, is drift named and dated, and is its cause named?

Each plant has five inputs, of which two matter, with delays of 0 to 15 samples, and one or two lags of the output:

    y_t = sum a_i y_(t-i) + g_t f(u1_(t-k1)) + b u2_(t-k2) + c + v_t

Inputs are white, autoregressions with 0.9, or held for 25 samples on average. The standard deviation of the effect of
the inputs is 0.3 or 1 times that of the noise. The noise is white or an autoregression with 0.6; the first input reacts
to the output (closed loop); or the meter of y prints whole numbers, about one deviation of the noise apart. What
changes: nothing; the gain g jumps by a factor of 1.8; it rises by as much during a third of the record; it is a random
walk whose deviation at the end is 0.8 of it; the pole jumps by 0.35; f is a static curve that saturates; or g depends
on the level of a third input, which returns to where it was.

Seeds below 1000 are for tuning, those from 1000 on for judging.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import signal

from driftfit.engine.kernel import Array

T = 1500
BEFORE = 200
CHANGES = ("constant", "jump", "ramp", "walk", "moving pole", "static curve", "gain by level")
INPUTS = ("white", "AR(0.9)", "held")
NOISES = ("white", "coloured", "closed loop", "whole numbers")
SNRS = (0.3, 1.0)
FACTOR = 1.8


class Plant(NamedTuple):
    """A record, and what is true of it."""

    table: dict[str, Array]
    change: str
    inputs: dict[str, int]
    """The inputs that matter, with their delays."""
    moving: str
    """The input whose effect changes; "y" for a pole, empty if nothing changes in time."""
    date: int
    cause: str
    """"", "time" or "working point"."""


def input_of(kind: str, rng: np.random.Generator, n: int) -> Array:
    """An input (n,) of variance about 1."""
    if kind == "white":
        return rng.normal(size=n)
    if kind == "AR(0.9)":
        return signal.lfilter([np.sqrt(1.0 - 0.81)], [1.0, -0.9], rng.normal(size=n))
    return rng.normal(size=n)[np.cumsum(rng.random(n) < 1.0 / 25.0)]


def plant(change: str, inputs: str, noise: str, snr: float, seed: int) -> Plant:
    """A plant drawn from a seed."""
    rng = np.random.default_rng([seed, CHANGES.index(change), INPUTS.index(inputs), NOISES.index(noise), int(10 * snr)])
    n = T + BEFORE
    U = np.column_stack([input_of(inputs, rng, n) for _ in range(5)])
    first, second, level = rng.permutation(5)[:3]
    delays = {int(first): int(rng.integers(0, 16)), int(second): int(rng.integers(0, 16))}
    if noise == "closed loop":
        delays[int(first)] = max(delays[int(first)], 1)
    pole = float(rng.uniform(0.3, 0.6)) if change == "moving pole" else float(rng.uniform(0.3, 0.85))
    a = [pole] if rng.random() < 0.5 or change == "moving pole" else [pole + 0.2, -0.2 * pole]
    date = int(rng.uniform(0.4, 0.65) * T) + BEFORE
    e = rng.normal(size=n)
    v = signal.lfilter([0.8], [1.0, -0.6], e) if noise == "coloured" else e
    b = snr / np.sqrt(2.0) * rng.choice([-1.0, 1.0], 2)
    g, t = np.ones(n), np.arange(n)
    if change == "jump":
        g = np.where(t >= date, FACTOR, 1.0)
    elif change == "ramp":
        g = 1.0 + (FACTOR - 1.0) * np.clip((t - date + T // 6) / (T // 3), 0.0, 1.0)
    elif change == "walk":
        walk = np.cumsum(np.where(t > BEFORE, rng.normal(size=n), 0.0))
        g = 1.0 + 0.8 * walk / np.sqrt(T)
    elif change == "gain by level":
        U[:, level] = signal.lfilter([np.sqrt(1.0 - 0.98**2)], [1.0, -0.98], rng.normal(size=n))
        g = 1.0 + 0.8 * np.tanh(U[:, level])
    poles = np.where(t >= date, a[0] + 0.35, a[0]) if change == "moving pole" else np.full(n, a[0])
    y = np.zeros(n)
    for k in range(20, n):
        if noise == "closed loop":
            U[k, first] -= 0.3 * y[k - 1]
        x = U[k - delays[int(first)], first]
        x = 2.0 * np.tanh(1.2 * x + 0.6) if change == "static curve" else x
        past = poles[k] * y[k - 1] + (a[1] * y[k - 2] if len(a) > 1 else 0.0)
        y[k] = past + b[0] * g[k] * x + b[1] * U[k - delays[int(second)], second] + 0.5 + v[k]
    y = np.round(y) if noise == "whole numbers" else y
    timely = change in ("jump", "ramp", "walk", "moving pole")
    return Plant(
        {"flow": y[BEFORE:], **{f"u{j + 1}": U[BEFORE:, j] for j in range(5)}},
        change,
        {f"u{j + 1}": k for j, k in delays.items()},
        "y" if change == "moving pole" else f"u{first + 1}" if timely else "",
        date - BEFORE if timely else -1,
        "time" if timely else "working point" if change in ("static curve", "gain by level") else "",
    )


def plants(seed: int) -> list[Plant]:
    """Every change with every kind of input and both sizes of noise; kinds of noise in turn."""
    found = []
    for i, change in enumerate(CHANGES):
        for j, inputs in enumerate(INPUTS):
            for k, snr in enumerate(SNRS):
                found.append(plant(change, inputs, NOISES[(i + 2 * j + k + seed) % len(NOISES)], snr, seed))
    return found
