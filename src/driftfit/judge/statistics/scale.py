"""The mean square of values without their outliers."""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array

INSIDE = 0.9733
"""Mean square of a Gaussian within three standard deviations."""


def core(z: Array) -> float:
    """Mean square of z (N,) within three of its robust deviations, 1 for a Gaussian of variance 1; NaN below ten."""
    z = z[np.isfinite(z)]
    if len(z) < 10:
        return float("nan")
    limit = 3.0 * 1.4826 * float(np.median(np.abs(z)))
    return float(np.mean(z[np.abs(z) <= limit] ** 2)) / INSIDE
