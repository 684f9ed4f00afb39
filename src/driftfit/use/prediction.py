"""Predictions over a record: their errors, and their parts."""

from __future__ import annotations

from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.models.base import GAP
from driftfit.run.result import Track


class Prediction(NamedTuple):
    """Outputs with the distribution of their errors; NaN if inputs or lags are missing."""

    y_hat: Array
    """(T,): at the predicted sample."""
    theta_std: Array
    """(T,): standard deviation due to the parameters alone, the band of the mean."""
    y_std: Array
    """(T,): standard deviation including the noise, the band of the output."""
    paths: Array | None = None
    """(D, T): drawn outputs, for models that are nonlinear in their parameters."""

    def band(self, level: float = 0.95) -> tuple[Array, Array]:
        """(low, high) of the output, (T,) each: normal, or quantiles of the drawn outputs."""
        if self.paths is not None:
            known = np.isfinite(self.paths).all(axis=0)
            ends = np.quantile(np.where(known, self.paths, 0.0), [0.5 - level / 2.0, 0.5 + level / 2.0], axis=0)
            low, high = np.where(known, ends, np.nan)
            return low, high
        half = NormalDist().inv_cdf(0.5 + level / 2.0) * self.y_std
        return self.y_hat - half, self.y_hat + half


def within(verb: str, run: Track) -> None:
    """ValueError for a run whose theta is no random walk, or whose output is not phi' theta and noise."""
    if run.tracker.beyond:
        raise ValueError(f"{verb}: {type(run.tracker).__name__} {run.tracker.beyond}; use run.forecast.")


def moved(values: Array, by: int, rest: float = np.nan) -> Array:
    """Values (T, ..) delayed by a number of samples (advanced if it is negative)."""
    out = np.full(values.shape, rest)
    T = len(values)
    if by >= 0:
        out[by:] = values[: max(T - by, 0)]
    else:
        out[: max(T + by, 0)] = values[-by:]
    return out


def drift(run: Track, r: Array) -> Array:
    """q per sample, (1, n, n) or (T, n, n); zero if theta itself is not a random walk."""
    n = len(run.names)
    try:
        walk = run.tracker.random_walk(run.model)
    except ValueError:
        return np.zeros((1, n, n))
    if walk.slopes:
        return np.zeros((1, n, n))
    scale = np.ones(1) if walk.r is not None else np.where(np.isfinite(r), r, 0.0)
    return np.asarray(walk.q * scale[:, None, None])


def unbroken(run: Track, na: int, k: int) -> Array:
    """Samples whose k steps, and the lags before them, have no gap in time."""
    gaps = np.broadcast_to(run.known.interval, len(run)) > GAP
    total = np.concatenate([[0], np.cumsum(gaps)])
    first = np.maximum(np.arange(len(run)) - k - max(na, 1) + 2, 0)
    return np.asarray(total[1:] == total[first])
