"""The electric arc furnace: a valve with a dead zone, a hydraulic drive, and an arc whose resistance is measured.

    v      = u - p1 above p1, u - p2 below p2, 0 between          valve; u beyond +-10 V acts as 10 V
    w_t    = -sum a_i w_{t-i} + sum_j b_j v_{t-j}                 arc length about the working point, cm
    L      = L0 + w
    U_arc  = a_arc + b_arc L                                      arc voltage, V; b_arc falls as the furnace heats
    I      = [-R_d U + sqrt(R_d^2 U^2 - (R_d^2 + X_d^2)(U^2 - U_p^2))] / (R_d^2 + X_d^2)     current, kA (mOhm, V)
    R_arc  = U / I                                                measured, mOhm

The last three equations have a closed inverse, L = (U_p R / sqrt((R + R_d)^2 + X_d^2) - a_arc) / b_arc, which increases
in R, so the whole is a Hammerstein-Wiener system. A change of b_arc changes the scale of that inverse and adds an
offset: with d_1 = 1 this appears in the b_j, and d is constant. Score a, p1, p2, the ratios b_j / b_1, and the local
gain b_1 / F'(R).

Source: Feng and Hong (2021), example 4. Departures: the working point L0 = 20 cm is our choice (the paper says "around
the working point"; around zero the length would be negative), and records whose arc leaves 2 to 45 cm are redrawn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.systems.drift import Ramp

A = (-1.637, 1.044, -0.4066)
B = (0.0378, 0.0333, 0.0097)
THRESHOLDS = (1.0, -1.0)
SUPPLY, RESISTANCE, REACTANCE, DROP = 320.0, 0.4, 0.7, 30.0
"""Transformer voltage U_p (V), R_d and X_d (mOhm), a_arc (V)."""
VOLTAGE = 10.0
"""The valve takes no more, either way: the limits of equation (61)."""
WORKING_POINT = 20.0
ARC_LENGTHS = 2.0, 45.0
"""The shortest and the longest arc, cm, of a record that is kept."""


class Furnace(NamedTuple):
    """One record: input u (T,), resistance R (T,), length L (T,), gradient b_arc (T,), and v (T,)."""

    u: Array
    R: Array
    L: Array
    gradient: Array
    v: Array

    @property
    def length_per_resistance(self) -> Array:
        """dL/dR (T,), which determines the true local gain: 0.0378 / (dL/dR)."""
        return slope(self.R, self.gradient)


def resistance(L: Array, gradient: Array) -> Array:
    """R_arc (mOhm) of an arc of length L (cm) and voltage gradient b_arc (V/cm)."""
    U = DROP + gradient * L
    size = RESISTANCE**2 + REACTANCE**2
    current = (-RESISTANCE * U + np.sqrt(RESISTANCE**2 * U**2 - size * (U**2 - SUPPLY**2))) / size
    return np.asarray(U / current)


def length(R: Array, gradient: Array) -> Array:
    """The closed inverse of `resistance`."""
    return np.asarray((SUPPLY * R / np.sqrt((R + RESISTANCE) ** 2 + REACTANCE**2) - DROP) / gradient)


def slope(R: Array, gradient: Array) -> Array:
    """dL/dR."""
    square = (R + RESISTANCE) ** 2 + REACTANCE**2
    return np.asarray(SUPPLY * (square - R * (R + RESISTANCE)) / square**1.5 / gradient)


def valve(u: Array, p1: float = THRESHOLDS[0], p2: float = THRESHOLDS[1], limit: float = VOLTAGE) -> Array:
    """The valve with its dead zone, and the limits beyond which the input has no further effect, (61)."""
    held = np.clip(u, -limit, limit)
    return np.where(held >= p1, held - p1, np.where(held <= p2, held - p2, 0.0))


def furnace(seed: int = 0, T: int = 5000, reach: float = 3.0) -> Furnace:
    """Simulate T samples under white uniform inputs within +-reach; b_arc falls from 6 to 3 V/cm."""
    gradient = Ramp(6.0, -3.0 / max(T - 1, 1)).path(T, np.random.default_rng(0))
    while True:
        u = np.random.default_rng(seed).uniform(-reach, reach, T)
        v = valve(u)
        w = [0.0, 0.0, 0.0]
        past = np.concatenate([np.zeros(3), v])
        for t in range(T):
            drive = B[0] * past[t + 2] + B[1] * past[t + 1] + B[2] * past[t]
            w.append(drive - A[0] * w[-1] - A[1] * w[-2] - A[2] * w[-3])
        L = WORKING_POINT + np.array(w[3:])
        if ARC_LENGTHS[0] < L.min() and L.max() < ARC_LENGTHS[1]:
            return Furnace(u, resistance(L, gradient), L, gradient, v)
        seed += 1000


class Switching(NamedTuple):
    """Voltage u (T,), current i (T,) and conductance g (T,) of an arc."""

    u: Array
    i: Array
    g: Array


def switching(
    seed: int = 0, T: int = 3000, half: int = 50, low: float = 0.02, high: float = 4.0, noise: float = 0.05
) -> Switching:
    """Simulate an arc that burns in every other half period of its voltage.

    i = g u + v, where u is a sine of amplitude 1 with ``half`` samples per half period, g switches between ``low`` and
    ``high``, and v is white with standard deviation ``noise``.
    """
    t = np.arange(T)
    u, g = np.sin(np.pi * (t + 0.5) / half), np.where(t // half % 2 == 0, low, high)
    return Switching(u, g * u + noise * np.random.default_rng(seed).normal(size=T), g)
