"""Jumps that were none: readings out of place, after which the parameters return to where they were.

A bank whose sensors include no outlier can explain a spike by a jump only, and its end by another one. After a jump of
the plant the parameters stay away. An innovation of more than `LARGE` standard deviations counts as a spike if, `LATER`
samples after it, the parameter that went farthest is within the share `NEAR` of that distance again. Cost: O(n) per
large innovation.
"""

from __future__ import annotations

from typing import Any

import numpy as np

LARGE, LATER, NEAR = 6.0, 10, 0.3
FEWEST, SHARE = 3, 0.0025
"""Number of spikes, and their share of the samples, from which on they are evident."""


def spikes(run: Any) -> int:
    """How many jumps of a run were taken back."""
    with np.errstate(divide="ignore", invalid="ignore"):
        large = np.flatnonzero(np.abs(run.innovation) > LARGE * run.innovation_std)
        count = 0
        for t in large[(large > 0) & (large + LATER < len(run))]:
            away = np.max(np.abs(run.theta[t : t + LATER + 1] - run.theta[t - 1]) / run.std[t - 1], axis=1)
            count += bool(away[-1] < NEAR * np.max(away))
    return count


def evident(run: Any) -> int:
    """Their number if it is more than chance, otherwise 0."""
    count = spikes(run)
    return count if count >= max(FEWEST, SHARE * len(run)) else 0
