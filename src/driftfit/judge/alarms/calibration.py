"""Limits by simulation: records like one that was seen, but with parameters that stay.

    y*_t = phi*_t' theta + v_t,     v drawn from the residuals of the run

phi* holds the lags of y* itself and the inputs that were recorded; each record is tracked by the tracker of the run.
A residual is y_t - phi_t' theta_s with s = t - 1 or s = t + LATER, whichever is smaller: an innovation that is large
because the tracker was mistaken for a moment (a change that it saw where there was none) is no noise, and would be
drawn again and again. The v are scaled so that innovations of a simulated record are as large as those that were seen.
Both scales leave the tails out, and both of the simulated ones are of the same draws, so that the factor is known to a
fraction of a percent: a tracker that is given r sees many more changes in noise that is a few percent larger.

The limit is the number that the statistic begins to exceed once in ``every`` samples. It is read off TIMES alarms, so
that the rate is known to about 1 / sqrt(TIMES).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array
from driftfit.judge.alarms.onsets import onsets
from driftfit.judge.statistics.scale import core
from driftfit.models.arx import ARX
from driftfit.models.regression import Regression
from driftfit.run.result import Track, burn_in
from driftfit.use.prediction import moved
from driftfit.use.simulate import input_regressors

TIMES = 50.0
"""Expected false alarms in all simulated records together."""
MOST = 4000
"""Records at the most."""
STEPS = 6
"""Halvings of the interval in which the rate of one of several columns is looked for."""
LATER = 10
"""Samples after which a tracker knows better what it saw."""


def null_records(run: Track, every: float, at: int, seed: int) -> Iterator[Track]:
    """Runs over simulated records with the parameters of sample ``at``; ValueError for models with other regressors."""
    if not isinstance(run.model, ARX | Regression) or len(run.model.outputs) > 1:
        raise ValueError(
            "detect: a calibration simulates records, which needs ARX or Regression with one output; "
            f"this run has {run.model!r}. Give a reference= instead."
        )
    rng = np.random.default_rng(seed)
    na, U = input_regressors(run.model, np.where(np.abs(run.u) < LARGEST, run.u, np.nan))
    pool, U, theta = residuals(run, na, U), _last_known(U), run.theta[at]
    noise = np.broadcast_to(np.where(np.isfinite(run.known.noise), np.sqrt(run.known.noise), 1.0), len(run))

    def played() -> tuple[Array, Track]:
        v = rng.choice(pool, len(run))
        return v, run.again(_played(theta, na, U, noise * v))

    v, made = played()
    # innovations are larger than noise, by what the parameters add to them: scale until they are as large as those seen
    larger = core(innovations(made)) / core(v)
    pool = pool * float(np.clip(np.sqrt(core(innovations(run)) / (core(pool) * larger)), 0.2, 5.0))
    for _ in range(min(MOST, int(np.ceil(TIMES * every / len(run))))):
        yield played()[1]


def innovations(run: Track) -> Array:
    """Innovations after the start, at weight 1."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return _later(run, run.innovation / np.sqrt(run.known.noise))


def residuals(run: Track, na: int, U: Array) -> Array:
    """What the parameters just before or a little later leave of the outputs, the smaller of both, at weight 1."""
    y = np.where(np.abs(run.y) < LARGEST, run.y, np.nan)
    phi = np.column_stack([*(moved(y, i + 1) for i in range(na)), U])
    with np.errstate(invalid="ignore", divide="ignore"):
        e = run.innovation
        later = y - np.sum(phi * moved(run.theta, -LATER), axis=1)
        smaller = np.where(np.abs(later) < np.abs(e), later, e)
        return _later(run, smaller / np.sqrt(run.known.noise))


def _later(run: Track, e: Array) -> Array:
    """The finite ones after the start."""
    e = e[min(burn_in(run.model.n), len(run) // 2) :]
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

    ``made``: (statistic (T, c), first sample judged) of records. Columns have the same rate, and as much of it as they
    can have together: those that exceed at the same time begin one alarm.
    """
    parts = [np.where(np.isfinite(part), part, -np.inf) for part in (statistic[start:] for statistic, start in made)]
    allowed = sum(len(part) for part in parts) / every
    columns = parts[0].shape[1]

    rates = [_begun([part[:, column] for part in parts]) for column in range(columns)]

    def limits(share: float) -> Array:
        return np.array([_least(*rate, share) for rate in rates])

    low, high = allowed / columns, allowed
    for _ in range(STEPS if columns > 1 else 0):
        middle = 0.5 * (low + high)
        begun = sum([len(onsets(np.any(part > limits(middle), axis=1))) for part in parts])
        low, high = (middle, high) if begun <= allowed else (low, middle)
    return limits(low)


def _begun(series: Sequence[Array]) -> tuple[Array, Array]:
    """(limits, how often each is begun to be exceeded), for every limit that makes a difference.

    A step from a to b > a begins to exceed the limits c with a <= c < b, so that the number at c is that of the a up to
    it less that of the b up to it.
    """
    before = np.concatenate([np.concatenate([[-np.inf], values[:-1]]) for values in series])
    after = np.concatenate(list(series))
    rising = after > before
    low, high = np.sort(before[rising]), np.sort(after[rising])
    limits = np.unique(after)
    return limits, np.searchsorted(low, limits, side="right") - np.searchsorted(high, limits, side="right")


def _least(limits: Array, begun: Array, allowed: float) -> float:
    """The least limit from which upwards no limit is begun to be exceeded more than ``allowed`` times.

    The number grows and falls again as the limit comes down, when what is normal exceeds it: the search is from above.
    """
    often = np.flatnonzero(begun > allowed)
    return float(limits[min(often[-1] + 1, len(limits) - 1)] if len(often) else limits[0])
