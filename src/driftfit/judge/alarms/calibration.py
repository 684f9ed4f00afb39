"""Limits by simulation: records like the observed one, but with constant parameters.

    y*_t = phi*_t' theta + v_t,     v drawn from the residuals of the run

phi* contains the lags of y* itself and the recorded inputs; each record is tracked by the tracker of the run. A
residual is y_t - phi_t' theta_s with s = t - 1 or s = t + LATER, whichever is smaller: an innovation that is large
because the tracker was temporarily wrong (for example after a false change) is not noise, and would otherwise be drawn
again and again. The v are scaled so that innovations of a simulated record are as large as the observed ones. Both
scales disregard the tails, and both simulated ones use the same draws, so the factor is known to a fraction of a
percent: a tracker with a given r detects many more changes in noise that is a few percent larger.

The limit is the number that the statistic begins to exceed once in ``every`` samples. It is estimated from TIMES
alarms, so the rate is known to about 1 / sqrt(TIMES).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array
from driftfit.judge.statistics.robust import core
from driftfit.models.base import Model
from driftfit.run.result import Track, burn_in
from driftfit.use.simulate import input_regressors, moved, regresses_on_lags

TIMES = 50.0
"""Expected false alarms in all simulated records together."""
MOST = 4000
"""Largest number of records."""
STEPS = 6
"""Bisections of the interval in which the rate of one of several columns is searched."""
HIGHEST = 0.05
"""The share of all values among which a limit is searched first."""
LATER = 10
"""Number of samples after which the tracker has recovered from an error."""


def null_records(run: Track, every: float, at: int, seed: int) -> Iterator[Track]:
    """Runs over simulated records with the parameters of sample ``at``; ValueError for models with other regressors."""
    check_played(run.model)
    rng = np.random.default_rng(seed)
    na, U = input_regressors(run.model, np.where(np.abs(run.u) < LARGEST, run.u, np.nan))
    pool, U, theta = residuals(run, na, U), _last_known(U), run.theta[at]
    noise = np.broadcast_to(np.where(np.isfinite(run.known.noise), np.sqrt(run.known.noise), 1.0), len(run))

    def played() -> tuple[Array, Track]:
        v = rng.choice(pool, len(run))
        return v, run.again(_played(theta, na, U, noise * v))

    v, made = played()
    # innovations exceed the noise by the part due to the parameters: scale until they are as large as the observed ones
    larger = core(innovations(made)) / core(v)
    pool = pool * float(np.clip(np.sqrt(core(innovations(run)) / (core(pool) * larger)), 0.2, 5.0))
    for _ in range(min(MOST, int(np.ceil(TIMES * every / len(run))))):
        yield played()[1]


def check_played(model: Model) -> None:
    """Raise ValueError for a model whose records are not simulated here."""
    if not regresses_on_lags(model) or len(model.outputs) > 1:
        raise ValueError(
            "detect: a calibration simulates records, which needs ARX, Regression or another model that declares its "
            f"regressors (`terms`), with one output; this run has {model!r}. Give a reference= instead."
        )


def innovations(run: Track) -> Array:
    """Innovations after the start, scaled to weight 1."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return _later(run, run.innovation / np.sqrt(run.known.noise))


def residuals(run: Track, na: int, U: Array) -> Array:
    """Residuals with the parameters just before or a little later, the smaller of both, scaled to weight 1."""
    y = np.where(np.abs(run.y) < LARGEST, run.y, np.nan)
    phi = np.column_stack([*(moved(y, i + 1) for i in range(na)), U])
    with np.errstate(invalid="ignore", divide="ignore"):
        e = run.innovation
        later = y - np.sum(phi * moved(run.theta, -LATER), axis=1)
        smaller = np.where(np.abs(later) < np.abs(e), later, e)
        return _later(run, smaller / np.sqrt(run.known.noise))


def _later(run: Track, e: Array) -> Array:
    """The finite values after the start."""
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
    """Inputs with gaps filled by the previous value."""
    place = np.maximum.accumulate(np.where(np.isfinite(U).all(axis=1), np.arange(len(U)), 0))
    return np.where(np.isfinite(U[place]), U[place], 0.0)


def limits_of(made: Iterable[tuple[Array, int]], *every: float, shares: Sequence[float] = ()) -> list[Array]:
    """For each of the numbers ``every``: limits (c,) that the columns of the statistics together begin to exceed once
    in that many samples.

    ``made`` contains (statistic (T, c), first sample judged) of records. The rates of the columns are in proportion to
    ``shares`` (c,), equal without them, and the largest possible ones: columns that exceed at the same time begin only
    one alarm.
    """
    parts: list[Array] = []
    for statistic, start in made:
        parts += [np.full((1, statistic.shape[1]), -np.inf), statistic[start:]]
    joined = np.concatenate([part.T for part in parts], axis=1)  # -inf before each record
    joined[~np.isfinite(joined)] = -np.inf
    samples = joined.shape[1] - len(parts) // 2
    rates = [begun_over(column, samples / min(every)) for column in joined]
    part = np.array(shares) / max(shares) if len(shares) else np.ones(len(joined))
    return [_together(joined, rates, part, samples / one) for one in every]


def _together(joined: Array, rates: Sequence[tuple[Array, Array]], part: Array, allowed: float) -> Array:
    """Limits (c,) with ``allowed`` onsets of all columns together, of which each has the same multiple of its part."""
    columns = len(joined)

    def limits(share: float) -> Array:
        return np.array([_least(*rate, share * own) for rate, own in zip(rates, part, strict=True)])

    low, high = allowed / part.sum(), allowed
    for _ in range(STEPS if columns > 1 else 0):
        middle = 0.5 * (low + high)
        active = np.logical_or.reduce([column > limit for column, limit in zip(joined, limits(middle), strict=True)])
        begun = int(np.sum(active[1:] & ~active[:-1]))
        low, high = (middle, high) if begun <= allowed else (low, middle)
    return limits(low)


def begun_over(values: Array, allowed: float) -> tuple[Array, Array]:
    """(limits, largest number of onsets over each and those above it) of values (T,), -inf before each record.

    A step from a to b > a is an onset over the limits c with a <= c < b, so the number at c is that of the a up to c
    minus that of the b up to c. As the limit decreases, the number grows and falls again once normal values exceed it.
    The highest values suffice if there are more than ``allowed`` onsets over some of them; otherwise every limit that
    makes a difference is counted.
    """
    before, after = values[:-1], values[1:]
    for share in (HIGHEST, 4.0 * HIGHEST, 1.0):
        lower = int((1.0 - share) * len(after))
        high = after >= np.partition(after, lower)[lower]
        rising = high & (after > before)
        below, above = np.sort(before[rising]), np.sort(after[rising])
        limits = np.unique(after[high & np.isfinite(after)])
        begun = np.searchsorted(below, limits, side="right") - np.searchsorted(above, limits, side="right")
        most = np.maximum.accumulate(begun[::-1])[::-1]
        if len(most) and most[0] > allowed:
            break
    return limits, most


def _least(limits: Array, begun: Array, allowed: float) -> float:
    """The smallest limit from which upwards no limit has more than ``allowed`` onsets."""
    often = int(np.searchsorted(-begun, -allowed))
    return float(limits[min(often, len(limits) - 1)])
