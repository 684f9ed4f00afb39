"""Moments of Gaussians that are cut to half-spaces, for all samples at once.

    p(theta) ~ N(theta; mu, S) prod_k 1[low_k <= g_k' theta <= high_k]

A plane, low = high, is exact conditioning. Half-spaces are taken by expectation propagation: each is replaced by a
Gaussian factor exp(-tau z^2 / 2 + nu z) of z = g' theta, such that mean and variance of z are those of the cut Gaussian
that all other factors leave. With one half-space this is exact; with several it is accurate to a few per cent of a
standard deviation.

Source: Cunningham, Hennig, Lacoste-Julien, Gaussian probabilities and expectation propagation (2011); Simon and Simon,
Constrained Kalman filtering via density function truncation, Int. J. Systems Science 41 (2010), is its first sweep.
Departure: moments of the cut Gaussian by quadrature on the interval where it is, which no tail makes inaccurate.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.use.constraints.half_spaces import HalfSpace

SWEEPS, SETTLED = 100, 1e-10
NODES, WEIGHTS = np.polynomial.legendre.leggauss(60)
EXPONENT = 80.0
"""Twice the exponent at which a tail ends."""
LEAST = 1e-14
"""Share of a variance below which a direction is known, and cannot be cut."""


def moments(low: Array, high: Array) -> tuple[Array, Array]:
    """Mean and variance of a standard normal variable within [low, high], (T,) each."""
    mode = np.clip(0.0, low, high)
    up = np.minimum(high - mode, np.sqrt(mode**2 + EXPONENT) - mode)
    down = np.minimum(mode - low, np.sqrt(mode**2 + EXPONENT) + mode)
    half, middle = 0.5 * (up + down), 0.5 * (up - down)
    t = middle[:, None] + half[:, None] * NODES
    density = np.exp(-t * (mode[:, None] + 0.5 * t)) * WEIGHTS
    total = density.sum(axis=1)
    mean = (density * t).sum(axis=1) / total
    variance = (density * (t - mean[:, None]) ** 2).sum(axis=1) / total
    return mode + mean, variance


def conditioned(mu: Array, S: Array, plane: HalfSpace) -> tuple[Array, Array]:
    """mu (T, n) and S (T, n, n) given g' theta = low."""
    Sg, v = S @ plane.g, np.einsum("i,tij,j->t", plane.g, S, plane.g)
    gain = np.where(v > 0.0, 1.0 / np.where(v > 0.0, v, 1.0), 0.0)[:, None] * Sg
    return mu + gain * (plane.low - mu @ plane.g)[:, None], S - gain[:, :, None] * Sg[:, None, :]


def cut(mu: Array, S: Array, within: Sequence[HalfSpace]) -> tuple[Array, Array, Array, Array]:
    """mu (T, n) and S (T, n, n) within half-spaces; and of every g' theta mean and variance without its own, (T, k)."""
    for plane in within:
        if plane.low == plane.high:
            mu, S = conditioned(mu, S, plane)
    cuts = [(k, one) for k, one in enumerate(within) if one.low < one.high]
    tau, nu, without, spread = np.zeros((4, len(mu), len(within)))
    scale = np.einsum("tii->ti", S).copy()
    for _ in range(SWEEPS if len(cuts) > 1 else 1):
        moved = 0.0
        for k, one in cuts:
            Sg = S @ one.g
            v, m = Sg @ one.g, mu @ one.g
            open_ = v > LEAST * (scale @ one.g**2)
            v = np.where(open_, v, 1.0)
            cavity = 1.0 / (1.0 / v - tau[:, k])
            left = cavity * (m / v - nu[:, k])
            std = np.sqrt(cavity)
            mean, variance = moments((one.low - left) / std, (one.high - left) / std)
            fresh = np.where(open_, (1.0 / variance - 1.0) / cavity, 0.0)
            shift = np.where(open_, (left + std * mean) / (cavity * variance) - left / cavity, 0.0)
            dt, dn = fresh - tau[:, k], shift - nu[:, k]
            gain = Sg / (1.0 + dt * v)[:, None]
            mu = mu + gain * (dn - dt * m)[:, None]
            S = S - dt[:, None, None] * gain[:, :, None] * Sg[:, None, :]
            tau[:, k], nu[:, k], without[:, k], spread[:, k] = fresh, shift, left, np.where(open_, cavity, 0.0)
            moved = max(moved, float(np.max(np.abs(dt) * v + np.abs(dn) * np.sqrt(v), initial=0.0)))
        if moved < SETTLED:
            break
    return mu, S, without, spread
