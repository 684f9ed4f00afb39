"""Codes in the record of a run that had no gate: said afterwards, because such a run uses whatever it is given.

`screen` is one vectorised look at a signal of all series. Where it and `apart` find something, the record is run once
more with a gate, and what that leaves out of the values that are apart is said.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array

SUSPECT = 30.0
"""Usual distances from the median beyond which a value may be a code."""
FEWEST = 20
"""Values that a usual distance needs."""
GAP = 3.0
"""Ranges of all other values by which a fault code of a complete record is apart from them."""
SAMPLED = 64
"""Values of a series that a first look takes for its usual ones."""


def suspect(signal: Array) -> Array:
    """Which values (T,) of a signal are more than `SUSPECT` usual distances from its median: the median distance of
    those that differ from it. Missing values, and those too large to be used, are not."""
    known = np.abs(signal) < LARGEST
    if np.count_nonzero(known) < FEWEST:
        return np.zeros(len(signal), bool)
    away = np.abs(np.where(known, signal, np.nan) - np.median(signal[known]))
    moving = away[away > 0.0]
    limit = SUSPECT * float(np.median(moving)) if len(moving) >= FEWEST else 0.0
    return np.asarray(away > limit)


def apart(signal: Array) -> Array:
    """Which values (T,) of a record are `suspect`, and each beyond a gap of `GAP` times the range of all before it."""
    usual, found = np.isfinite(signal) & ~suspect(signal), np.zeros(len(signal), bool)
    if not usual.any() or not np.ptp(signal[usual]) > 0.0:
        return found
    for side in (signal, -signal):
        value = np.unique(side[side >= side[usual].max()])
        wide = np.diff(value) > GAP * (value[:-1] - side[usual].min())
        alone = int(np.logical_and.accumulate(wide[::-1]).sum())  # a cluster of values is no code
        found |= side >= (value[-alone] if alone else np.inf)
    return found


def screen(signal: Array, first: Array, length: Array) -> Array:
    """Which series (K,) of a signal (N,), ``length`` samples each from ``first`` on, may hold a `suspect` value.

    The median and the usual distance are those of `SAMPLED` values of a series, so a value is looked for within half of
    `SUSPECT` distances; a series with fewer values that differ from its median is looked at whole.
    """
    found = np.zeros(len(first), bool)
    if len(first) == 1 and _quiet(signal[first[0] : first[0] + length[0]]):
        return found
    series = np.flatnonzero(length >= FEWEST)
    if not len(series):
        return found
    begin, count = first[series, None], length[series, None]
    some = signal[begin + np.arange(SAMPLED) * count // SAMPLED]
    some[~(np.abs(some) < LARGEST)] = np.nan
    center = _middle(some)
    away = np.abs(some - center[:, None])
    away[away == 0.0] = np.nan
    few = np.sum(away > 0.0, axis=1) < np.minimum(FEWEST, count[:, 0] // 2)
    ends, padded = np.hstack([begin, begin + count]).ravel(), np.append(signal, np.nan)
    high, low = (reduce(padded, ends)[::2] for reduce in (np.fmax.reduceat, np.fmin.reduceat))
    found[series] = few | (np.fmax(high - center, center - low) > 0.5 * SUSPECT * _middle(away))
    return found


def _quiet(signal: Array) -> bool:
    """Whether a complete signal holds no such value; a quarter of the cost for a short record, of which most are."""
    some = np.sort(signal[:: len(signal) // SAMPLED + 1])
    if len(some) < FEWEST:
        return False
    center = some[len(some) // 2]
    away = np.sort(np.abs(some - center))
    limit = 0.5 * SUSPECT * away[len(away) // 2]
    return bool((signal.max() - center < limit) & (center - signal.min() < limit))  # not where one is missing


def _middle(rows: Array) -> Array:
    """The lower median of each row (K, N), NaN left out; NaN if there is nothing else."""
    known = np.sum(np.isfinite(rows), axis=1)
    return np.asarray(np.sort(rows, axis=1)[np.arange(len(rows)), np.maximum(known - 1, 0) // 2])
