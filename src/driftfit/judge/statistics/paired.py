"""Paired tests of one-step errors: is one predictor better than another on the same samples?

    d_t = e_rival,t^2 - e_t^2,     t = mean(d) / sqrt(v / N),     v = Bartlett sum of autocovariances

The lags are floor(4 (N / 100)^(2/9)). The p-value is one-sided, for the claim that the run is better. Where parameters
are constant a tracker is a little worse than constant least squares, so that the test rejects too seldom.

Source: Diebold and Mariano (1995); the variance is that of Newey and West (1987).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array

LEAST = 10
"""Smallest number of errors that are compared."""


class Paired(NamedTuple):
    """A rival of the run: its root mean square error, the t statistic and p-value of being worse than the run."""

    name: str
    rms: float
    t: float
    p: float


def newey_west(d: Array, about: Array | float | None = None) -> Array:
    """Long-run variance of d (N, ..) about its mean, or about a value that is known."""
    N = len(d)
    d = d - (d.mean(axis=0) if about is None else about)
    lags = min(int(4.0 * (N / 100.0) ** (2.0 / 9.0)), N - 1)
    v = np.sum(d * d, axis=0)
    for k in range(1, lags + 1):
        v += 2.0 * (1.0 - k / (lags + 1.0)) * np.sum(d[k:] * d[:-k], axis=0)
    return np.asarray(v / N)


def paired(name: str, rival: Array, own: Array) -> Paired:
    """Compare the one-step errors (N,) of a rival with those of a run; NaN for fewer than ten, or no rival."""
    rms = float(np.sqrt(np.mean(rival * rival))) if len(rival) else float("nan")
    if len(own) < LEAST or np.isnan(rms):
        return Paired(name, rms, float("nan"), float("nan"))
    unit = max(np.abs(rival).max(), np.abs(own).max()) or 1.0  # squares of squares would leave the range of numbers
    d = (rival / unit) ** 2 - (own / unit) ** 2
    mean, v = float(d.mean()), float(newey_west(d))
    # where every sample has the same difference, v is 0
    t = mean / math.sqrt(v / len(d)) if v > 0.0 else math.copysign(math.inf, mean) if mean else 0.0
    return Paired(name, rms, t, 0.5 * math.erfc(t / math.sqrt(2.0)))
