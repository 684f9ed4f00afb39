"""Limits by simulation: records like one that was seen, but with parameters that stay.

    y*_t = phi*_t' theta + v_t,     v drawn from the innovations of the run

phi* holds the lags of y* itself and the inputs that were recorded; each record is tracked by the tracker of the run.
The v are scaled so that its innovations are as large as those that were seen. The limit is the number that the
statistic begins to exceed once in ``every`` samples.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from driftfit.drivers import LARGEST
from driftfit.judges.onsets import onsets
from driftfit.kernel import Array
from driftfit.simulate import input_regressors
from driftfit.track import drive

if TYPE_CHECKING:
    from driftfit.result import Track

TIMES = 5.0
"""Expected false alarms in all simulated records together."""
MOST = 400
"""Records at the most."""


def null_records(run: Track, every: float, at: int, seed: int) -> Iterator[Track]:
    """Runs over simulated records with the parameters of sample ``at``; ValueError for models with other regressors."""
    rng = np.random.default_rng(seed)
    na, U = input_regressors(run.model, np.where(np.abs(run.u) < LARGEST, run.u, np.nan))
    U, pool, theta = _last_known(U), innovations(run), run.theta[at]
    noise = np.broadcast_to(np.where(np.isfinite(run._known[:, 1]), np.sqrt(run._known[:, 1]), 1.0), len(run))

    def played() -> Track:
        return _tracked(run, _played(theta, na, U, noise * rng.choice(pool, len(run))))

    # innovations are larger than noise, by what the parameters add to them: scale until they are as large as those seen
    pool = pool * np.clip(np.std(pool) / np.std(innovations(played())), 0.2, 1.0)
    for _ in range(min(MOST, int(np.ceil(TIMES * every / len(run))))):
        yield played()


def _tracked(run: Track, y: Array) -> Track:
    """The run's tracker over another output."""
    from driftfit.result import Track

    tile = run._fresh_tile()
    out = drive(run.model, run.tracker, tile, y, run.u, run._known)
    return Track(run.model, run.tracker, y, run.u, None, run._known, out, tile)


def innovations(run: Track) -> Array:
    """Innovations after the start, at weight 1."""
    with np.errstate(invalid="ignore", divide="ignore"):
        e = run.innovation / np.sqrt(run._known[:, 1])
    e = e[min(max(50, 5 * run.model.n), len(run) // 2) :]
    e = e[np.isfinite(e)]
    if len(e) < 20:
        raise ValueError(f"detect: a calibration needs at least 20 innovations after the start; this run has {len(e)}.")
    return e


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
