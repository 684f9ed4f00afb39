"""Jumps that were taken back: readings out of place, after which the parameters return to where they were.

A bank whose sensors include no outlier can explain a spike by a jump only, and its end by another one. After a jump of
the plant the parameters stay away. An innovation of more than `LARGE` standard deviations counts as a spike if, `LATER`
samples after it, the parameter that went farthest is within the share `NEAR` of that distance again. A pulse of the
plant that lasts longer than `LATER` samples is none. Cost: O(n) per large innovation.
"""

from __future__ import annotations

from typing import Any

import numpy as np

LARGE, LATER, NEAR = 6.0, 4, 0.3
FEWEST, SHARE = 3, 0.0025
"""Number of spikes, and their share of the samples, from which on they are evident."""
BLOCK = 1024
"""Samples that are looked at together: temporary arrays are no longer than that."""


def spikes(run: Any) -> int:
    """How many jumps of a run were taken back."""
    innovation, expected, theta, var, count = run.innovation, run.innovation_var, run.theta, run.var, 0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for first in range(1, len(run) - LATER, BLOCK):
            block = slice(first, min(first + BLOCK, len(run) - LATER))
            for t in first + np.flatnonzero(innovation[block] ** 2 > LARGE**2 * expected[block]):
                away = np.max(np.abs(theta[t : t + LATER + 1] - theta[t - 1]) / np.sqrt(var[t - 1]), axis=1)
                count += bool(away[-1] < NEAR * np.max(away))
    return count


def evident(run: Any) -> int:
    """Their number if it is more than chance, otherwise 0."""
    count = spikes(run)
    return count if count >= max(FEWEST, SHARE * len(run)) else 0
