"""Limits by simulation: records like one that was seen, but with parameters that stay.

    y*_t = phi*_t' theta + sqrt(r) g_t,     g drawn from the standardised innovations of the run

phi* holds the lags of y* itself and the inputs that were recorded; each record is tracked by the tracker of the run.
The limit is the number that the statistic begins to exceed once in ``every`` samples.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from driftfit.drivers import LARGEST
from driftfit.judges.onsets import onsets
from driftfit.kernel import Array
from driftfit.simulate import input_regressors, noise_at
from driftfit.track import drive

if TYPE_CHECKING:
    from driftfit.result import Track

TIMES = 5.0
"""Expected false alarms in all simulated records together."""
MOST = 400
"""Records at the most."""


def null_records(run: Track, every: float, at: int, seed: int) -> Iterator[Track]:
    """Runs over simulated records with the parameters of sample ``at``; ValueError for models with other regressors."""
    from driftfit.result import Track

    rng = np.random.default_rng(seed)
    T, theta, r = len(run), run.theta[at], noise_at(run, at)
    z = standardised(run)
    na, U = input_regressors(run.model, np.where(np.abs(run.u) < LARGEST, run.u, np.nan))
    U = _last_known(U)
    noise = np.sqrt(np.broadcast_to(run._known[:, 1], T))
    noise = np.where(np.isfinite(noise), noise, 1.0)
    for _ in range(min(MOST, int(np.ceil(TIMES * every / T)))):
        e = np.sqrt(r) * noise * rng.choice(z, T)
        y = _played(theta, na, U, e)
        tile = run._fresh_tile()
        known = run._known
        out = drive(run.model, run.tracker, tile, y, run.u, known)
        yield Track(run.model, run.tracker, y, run.u, None, known, out, tile)


def standardised(run: Track) -> Array:
    """Innovations over their standard deviations, after the start."""
    with np.errstate(invalid="ignore", divide="ignore"):
        z = run.innovation / run.innovation_std
    z = z[min(max(50, 5 * run.model.n), len(run) // 2) :]
    z = z[np.isfinite(z)]
    return z if len(z) > 20 else np.random.default_rng(0).normal(size=1000)


def _played(theta: Array, na: int, U: Array, e: Array) -> Array:
    drive_part = (U @ theta[na:] + e).tolist()
    a, y = theta[:na].tolist(), [0.0] * na
    for value in drive_part:
        y.append(value + sum(a[i] * y[-1 - i] for i in range(na)))
    return np.array(y[na:])


def _last_known(U: Array) -> Array:
    """Inputs with gaps filled by what stood before them."""
    place = np.maximum.accumulate(np.where(np.isfinite(U).all(axis=1), np.arange(len(U)), 0))
    return np.where(np.isfinite(U[place]), U[place], 0.0)


def limit_of(made: Iterable[tuple[Array, int]], every: float) -> Array:
    """Limits (c,) that the columns of the statistics together begin to exceed once in ``every`` samples.

    ``made``: (statistic (T, c), first sample judged) of records. Columns share the rate equally.
    """
    parts = [statistic[start:] for statistic, start in made]
    count = sum(len(part) for part in parts)
    allowed = count / every / parts[0].shape[1]
    limits = []
    for column in range(parts[0].shape[1]):
        series = [np.where(np.isfinite(part[:, column]), part[:, column], -np.inf) for part in parts]
        candidates = np.unique(np.concatenate(series))
        low, high = 0, len(candidates) - 1
        # onsets are few near the top and grow downwards: the first limit from above that is not too often exceeded
        while low < high:
            middle = (low + high) // 2
            begun = sum(len(onsets(values > candidates[middle])) for values in series)
            share = sum(float(np.mean(values > candidates[middle])) for values in series) / len(series)
            low, high = (low, middle) if begun <= allowed and share < 0.5 else (middle + 1, high)
        limits.append(candidates[high])
    return np.array(limits)
