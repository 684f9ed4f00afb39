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

from driftfit.engine.kernel import Array, Driver, shared

LEAST = 10
"""Smallest number of errors that are compared."""


class Paired(NamedTuple):
    """A rival of the run: its root mean square error, the t statistic and p-value of being worse than the run."""

    name: str
    rms: float
    t: float
    p: float


@shared
def long_run(d: Array) -> float:
    """Long-run variance of d (N,) about 0."""
    N, v = d.shape[0], 0.0
    lags = min(int(4.0 * (N / 100.0) ** (2.0 / 9.0)), N - 1)
    for lag in range(lags + 1):
        share = (2.0 if lag > 0 else 1.0) * (1.0 - lag / (lags + 1.0)) / N
        for t in range(lag, N):
            v += share * d[t] * d[t - lag]
    return v


@Driver
def newey_west(d: Array) -> float:
    """Long-run variance of d (N,) about its mean."""
    return long_run(d - np.mean(d))  # type: ignore[no-any-return]


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
