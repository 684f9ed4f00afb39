"""Codes in the record of a run that had no gate: said afterwards, because such a run uses whatever it is given.

`screen` is one vectorised look at a signal of all series. Where it and `suspect` find something, `Review` runs the
gate's step over the finished record, with the forecasts and variances of that run, and lists what a gate would have
refused. A run that was spoilt by one code may say little of later ones. Before there is a run, `apart` finds codes in a
complete record.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array, Driver, State, kernel
from driftfit.engine.tiles import make_tile
from driftfit.readings.gate import Gate, gate_step, start

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


@kernel
def nothing_refused(s: State, signal: int, age: int, l: int) -> None:
    """The memory of a model that ran already."""


class Review:
    """The gate's step over finished records with m inputs, of which the model remembered ``ages`` samples; ``lends`` as
    for `gate_step`."""

    def __init__(self, gate: Gate, m: int, ages: int, lends: bool) -> None:
        gate = replace(gate, first=0)
        self._start = start(gate, 0, m)
        step = gate_step(gate, 0, m, ages, nothing_refused, lends=lends)

        def review(tile: Any, y: Any, u: Any, y_hat: Any, s: Any, valid: Any, reason: Any) -> None:
            of, l = tile[0], 0
            for t in range(len(y)):
                for j in range(u.shape[1]):
                    of.u[j, l] = u[t, j]
                of.observed[l] = 1.0 if abs(y[t]) < np.inf else 0.0
                of.y[l] = y[t] if abs(y[t]) < np.inf else 0.0
                of.valid[l] = 1.0 if valid[t] else 0.0
                of.ok[l] = of.observed[l] * of.valid[l]
                of.y_hat[l], of.e[l], of.s[l] = y_hat[t], of.y[l] - y_hat[t], s[t]
                step(of, l)
                reason[t] = of.reason[l]

        self._review = Driver(review)

    def __call__(self, y: Array, u: Array, y_hat: Array, s: Array, valid: Array) -> Array:
        """Reasons (T,), given readings y (T,), inputs u (T, m), forecasts and their variances (T,), and whether there
        was a forecast (T,)."""
        tile, reason = make_tile(0, u.shape[1], {}, [self._start]), np.zeros(len(y), np.int64)
        self._review(tile, y, u, np.where(valid, y_hat, 0.0), s, valid, reason)
        return reason
