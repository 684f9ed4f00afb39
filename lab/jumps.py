"""Systems whose parameters jump, with sensors that fail; banks of hypotheses are tested on them.

    y_t = a1 y_{t-1} + a2 y_{t-2} + b0 u_t + e_t,   e ~ N(0, 0.3^2), u ~ N(0, 1)

a1 is uniform in (-1.6, 1.6) and a2 in (-0.9, 0.6), redrawn until both poles are below 0.93; b0 is uniform in
+-(0.5, 2). After 30 samples a jump occurs with probability 0.01: four in ten jumps change b0 alone by +-(0.7, 2), the
others redraw all parameters. Between jumps the parameters drift by 0.002 per step, with poles below 0.96.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.models.arx import ARX

SIGMA, DRIFT, JUMPS, START = 0.3, 0.002, 0.01, 30
MODEL = ARX(2, 1, nk=0, start="zero")


class Jumping(NamedTuple):
    """One record with its true parameters."""

    y: Array
    """(T,), as measured."""
    u: Array
    theta: Array
    """(T, 3)"""
    jumps: Array
    """Samples of the jumps."""
    kinds: Array
    """(T,): the covariance that was active before each sample (0 drift, 1 all, 2 gain), or the regime."""
    bad: Array
    """(T,) bool: outliers, or a frozen sensor."""


def poles(a1: float, a2: float) -> float:
    """The largest modulus of the poles, the roots of z^2 - a1 z - a2."""
    return abs(0.5 * abs(a1) + complex((0.5 * a1) ** 2 + a2) ** 0.5)


def draw(rng: np.random.Generator) -> Array:
    """Parameters of a stable plant."""
    while True:
        a1, a2 = rng.uniform(-1.6, 1.6), rng.uniform(-0.9, 0.6)
        if poles(a1, a2) < 0.93:
            return np.array([a1, a2, rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 2.0)])


def drifted(rng: np.random.Generator, theta: Array, size: float) -> Array:
    """One step of drift that keeps the plant stable."""
    while True:
        moved = theta + size * rng.standard_normal(3)
        if poles(moved[0], moved[1]) < 0.96:
            return moved


def jumping(seed: int, T: int = 600, fault: str = "none", K: float = 10.0, sigma: float = SIGMA) -> Jumping:
    """Simulate a record; ``fault`` is "none", "innovation", "additive", "frozen" or "regimes"; ``sigma`` scales e."""
    rng = np.random.default_rng(seed)
    theta, u = draw(rng), rng.standard_normal(T)
    path, kinds, bad = np.empty((T, 3)), np.zeros(T, int), np.zeros(T, bool)
    x, y = np.zeros(T), np.zeros(T)
    until, fast = -1, False
    for t in range(T):
        kind = 0
        if fault == "regimes":
            fast = rng.random() < (0.975 if fast else 0.01)
            kind = int(fast)
            theta = drifted(rng, theta, 0.06 if fast else DRIFT)
        elif t > START and rng.random() < JUMPS:
            kind = 2 if rng.random() < 0.4 else 1
            step = np.array([0.0, 0.0, rng.choice([-1.0, 1.0]) * rng.uniform(0.7, 2.0)])
            theta = theta + step if kind == 2 else draw(rng)
        else:
            theta = drifted(rng, theta, DRIFT)
        path[t], kinds[t] = theta, kind
        spike = fault in ("innovation", "additive") and rng.random() < 0.05
        e = sigma * (K if spike and fault == "innovation" else 1.0) * rng.standard_normal()
        x[t] = theta @ [x[t - 1] if t else 0.0, x[t - 2] if t > 1 else 0.0, u[t]] + e
        y[t] = x[t] + (K * sigma * rng.standard_normal() if spike and fault == "additive" else 0.0)
        if fault == "frozen":
            if t > 40 and t > until and rng.random() < 0.004:
                until = t + 14
            if t <= until:
                y[t], spike = y[t - 1] + 1e-3 * rng.standard_normal(), True
        bad[t] = spike
    jumps = np.flatnonzero(kinds) if fault != "regimes" else np.zeros(0, int)
    return Jumping(y, u, path, jumps, kinds, bad)
