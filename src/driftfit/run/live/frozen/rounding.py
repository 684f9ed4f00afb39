"""Readings of a coarse sensor, drawn again within their step.

    z = m + S Phi^-1(Phi(a) + U (Phi(b) - Phi(a))),   a, b = (y -+ h - m) / S,   U uniform

m is the prediction, S the noise and 2 h the step of the sensor. If m and S are those of the system, z has the errors of
a fine sensor, whatever the inputs do: the error of rounding, which is the same for as long as they are held, is gone
(`driftfit.judge.statistics.parts.coarse_readings`). U is a function of the number of the sample and of a seed, which is
made from readings: a stream and a record draw the same, and other records draw other numbers.

Source: Dunn and Smyth (1996), whose residuals these are; Steele, Lea and Flood (2014) for the numbers.
"""

from __future__ import annotations

from zlib import crc32

import numpy as np
import scipy

from driftfit.engine.kernel import Array

GOLDEN, FIRST, SECOND = (np.uint64(one) for one in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


def seed_of(y: Array, step: Array | float) -> int:
    """A number below 2^32 that readings y (N,), counted in steps from the first, determine, whatever their unit."""
    steps = y / step
    return crc32(np.round(steps - steps[:1]).astype(np.int64).tobytes())


def chances(first: int, count: int, seed: int) -> Array:
    """U (count,) of the samples from number ``first`` on."""
    z = (np.arange(first + 1, first + 1 + count).astype(np.uint64) + (np.uint64(seed) << np.uint64(31))) * GOLDEN
    z = (z ^ (z >> np.uint64(30))) * FIRST
    z = (z ^ (z >> np.uint64(27))) * SECOND
    return np.asarray(((z ^ (z >> np.uint64(31))) >> np.uint64(11)) * 2.0**-53)


def drawn(y: Array, m: Array, S: Array | float, h: Array | float, chance: Array) -> Array:
    """z (N,) of readings y (N,) with predictions m (N,)."""
    low, high = (y - h - m) / S, (y + h - m) / S
    side = np.where(low + high > 0.0, -1.0, 1.0)  # tails have digits on the left
    low, high = np.where(side > 0.0, low, -high), np.where(side > 0.0, high, -low)
    below = scipy.special.ndtr(low)
    with np.errstate(divide="ignore"):
        w = np.clip(scipy.special.ndtri(below + chance * (scipy.special.ndtr(high) - below)), low, high)
    return np.asarray(m + S * side * w)
