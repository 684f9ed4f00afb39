"""Scores of an outcome against a simulated truth, and detection of jumps from the innovations.

    rmse     root mean square of theta - truth over samples and parameters after ``BURN`` samples
    error    root mean square one-step error, on samples that every contestant could predict
    theta    share of parameters within their 95 % band;   y  share of outputs within the 95 % one-step band,
             outputs that were simulated as outliers left out

Jumps: d_t is the mean of z^2 over the last five used samples, z = e / (its std before the sample); without a std, z is
e over the root of an exponential mean of e^2 (factor 0.99). An alarm is raised where d exceeds a threshold that on
records without drift is exceeded in one of 1000 samples, in blocks of fifty: so all contestants are compared at the
same rate of false alarms there. A jump is found if an alarm falls within fifty samples of it (and before the next).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.run.result import root_mean_square
from lab.bench.records import Outcome, Record

BURN = 200
HALF = 1.959963984540054
WINDOW = 5
BLOCK = 50


class Score(NamedTuple):
    """Scores of one run."""

    rmse: float
    error: float
    theta: float
    y: float


def score(record: Record, outcome: Outcome, common: Array) -> Score:
    """Score a simulated run; ``common`` (T,) marks the samples that every contestant could predict."""
    assert record.truth is not None
    late = np.arange(len(record.y)) >= BURN
    e = record.y - outcome.prediction
    return Score(
        parameter_error(record, outcome),
        root_mean_square(e[common & late]),
        coverage((outcome.theta - record.truth.theta)[late], outcome.std[late]),
        coverage(e[late & ~record.truth.outlier], outcome.prediction_std[late & ~record.truth.outlier]),
    )


def parameter_error(record: Record, outcome: Outcome) -> float:
    """rmse; inf for a path that diverged."""
    assert record.truth is not None
    value = root_mean_square((outcome.theta - record.truth.theta)[BURN:])
    return value if np.isfinite(value) else float("inf")


def coverage(error: Array, std: Array) -> float:
    """Share of errors within their 95 % band, of those that have one; NaN where none has."""
    known = np.isfinite(error) & np.isfinite(std)
    return float(np.mean(np.abs(error[known]) <= HALF * std[known])) if known.any() else float("nan")


def predicted(record: Record, outcome: Outcome) -> Array:
    """Samples (T,) whose output was observed and predicted; an infinite prediction counts, it is an error."""
    return np.isfinite(record.y) & ~np.isnan(outcome.prediction)


def surprise(record: Record, outcome: Outcome) -> Array:
    """d (T,): the mean of z^2 over the last five used samples, carried over samples without one."""
    e = record.y - outcome.prediction
    used = np.isfinite(e)
    squares = e[used] ** 2
    known = np.isfinite(outcome.prediction_std).any()
    z2 = squares / (outcome.prediction_std[used] ** 2 if known else _faded(squares))
    means = np.convolve(np.nan_to_num(z2, nan=0.0, posinf=1e12), np.ones(WINDOW) / WINDOW)[: len(z2)]
    d = np.concatenate([[0.0], means])
    return np.asarray(d[np.cumsum(used)])


def _faded(squares: Array) -> Array:
    """Exponential mean of the squares before each."""
    mean = np.empty(len(squares))
    level = float(np.mean(squares[:20])) if len(squares) else 1.0
    for t, square in enumerate(squares):
        mean[t] = level
        level = 0.99 * level + 0.01 * float(square)
    return mean


def threshold(calm: list[Array]) -> float:
    """The level that d exceeds in one of twenty blocks of fifty samples, after the start, on records without drift."""
    blocks = [d[BURN : BURN + (len(d) - BURN) // BLOCK * BLOCK].reshape(-1, BLOCK).max(axis=1) for d in calm]
    return float(np.quantile(np.concatenate(blocks), 0.95))


class Detection(NamedTuple):
    """Jumps after the start, the delays of those found, false alarms and the samples in which they could occur."""

    jumps: int
    delays: tuple[int, ...]
    false: int
    quiet: int


def pooled(found: list[Detection]) -> Detection:
    """The same over several runs."""
    return Detection(
        sum(one.jumps for one in found),
        tuple(delay for one in found for delay in one.delays),
        sum(one.false for one in found),
        sum(one.quiet for one in found),
    )


def detect(record: Record, d: Array, level: float) -> Detection:
    """Alarms of one run against the jumps that were simulated."""
    assert record.truth is not None
    jumps = np.flatnonzero(record.truth.q.any(axis=1))
    alarm = d > level
    quiet = np.arange(len(d)) >= BURN
    delays = []
    jumps_after = np.append(jumps, len(d))
    for jump, following in zip(jumps, jumps_after[1:], strict=True):
        stop = min(jump + BLOCK, following)
        quiet[jump : jump + BLOCK] = False
        if jump >= BURN and alarm[jump:stop].any():
            delays.append(int(np.argmax(alarm[jump:stop])))
    return Detection(int(np.sum(jumps >= BURN)), tuple(delays), _alarms(alarm & quiet), int(quiet.sum()))


def _alarms(alarm: Array) -> int:
    """Alarms at least a block apart."""
    count, free = 0, 0
    for t in np.flatnonzero(alarm):
        if t >= free:
            count, free = count + 1, int(t) + BLOCK
    return count
