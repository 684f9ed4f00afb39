"""Robust scales of values, and their mean square without outliers."""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array

INSIDE = 0.9733
"""Mean square of a Gaussian within three standard deviations."""


def median(x: Array) -> float:
    """Median of finite values x (N,), N > 0; a quarter of the time of NumPy's, which is general."""
    half = len(x) // 2
    ordered = np.partition(x, half)
    above = float(ordered[half])
    return above if len(x) % 2 else 0.5 * (above + float(ordered[:half].max()))


def deviation(x: Array) -> float:
    """Standard deviation of Gaussian values x (N,) around 0, from the median of their sizes."""
    return 1.4826 * median(np.abs(x))


def core(z: Array) -> float:
    """Mean square of z (N,) within three of its robust deviations, 1 for a Gaussian of variance 1; NaN below ten."""
    z = z[np.isfinite(z)]
    if len(z) < 10:
        return float("nan")
    limit = 3.0 * deviation(z)
    return float(np.mean(z[np.abs(z) <= limit] ** 2)) / INSIDE
