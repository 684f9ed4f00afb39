"""The comparison that every result carries: what a user would otherwise have done, on the same samples.

*persistence*   the last output that was seen
*constant LS*   recursive least squares without forgetting on the same regressors (fitted on the past only)
*constant ARX*  the same on ARX(2, 1 per input) with intercept

All are one-step predictions, scored on the samples after max(50, 5 n) that every one of them could predict.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.drivers import LARGEST
from driftfit.judges.seen import constant_least_squares
from driftfit.kernel import Array
from driftfit.models.arx import ARX
from driftfit.result import Track, root_mean_square
from driftfit.track import track
from driftfit.trackers.rls import RLS


class Comparison(NamedTuple):
    """Root mean square one-step errors on ``samples`` samples; NaN where a record is too short to score."""

    tracked: float
    persistence: float
    constant_ls: float
    constant_arx: float
    samples: int


def persistence(y: Array) -> Array:
    """For every sample the last output seen before it; NaN before the first."""
    seen = np.where(np.isfinite(y), np.arange(len(y)), -1)
    last = np.concatenate([[-1], np.maximum.accumulate(seen)[:-1]])
    return np.where(last >= 0, y[last], np.nan)


class Errors(NamedTuple):
    """One-step errors of everyone, (T,) each, and which samples are scored."""

    tracked: Array
    persistence: Array
    constant_ls: Array
    constant_arx: Array
    scored: Array


def errors(run: Track) -> Errors:
    """One-step errors of a run, of persistence, of constant least squares and of constant ARX."""
    y, u = np.where(np.abs(run.y) < LARGEST, run.y, np.nan), run.u
    gaps = run._known[:, 0]  # 0 before the lags are filled
    time = None if len(gaps) == 1 else np.cumsum(np.where(gaps > 0.0, gaps, 1.0))
    steady = _constant(run, y, time)
    arx = track(ARX(2, 1 if u.shape[1] else 0, intercept=True), RLS(1.0), y, u if u.shape[1] else None, time=time)
    own = (_error(run, y), y - persistence(y), steady, arx.innovation)
    scored = np.arange(len(y)) >= max(50, 5 * run.model.n)
    for error in own:
        scored &= np.isfinite(error)
    return Errors(*own, scored)


def _error(run: Track, y: Array) -> Array:
    """One-step errors of the output; a model whose regressors hold the present output has innovations of its own."""
    return np.where(run.ok, y - run.prediction, np.nan) if hasattr(run.model, "log_jacobian") else run.innovation


def _constant(run: Track, y: Array, time: Array | None) -> Array:
    """The same of constant least squares on the past."""
    if hasattr(run.model, "log_jacobian"):
        return _error(track(run.model, RLS(1.0), y, run.u, time=time), y)
    return np.asarray(constant_least_squares(run.model, run.y, run.u, run._known)["e"][:, 0])


def compare(run: Track) -> Comparison:
    """Score a run beside persistence, constant least squares and constant ARX."""
    *own, scored = errors(run)
    tracked, last, ls, constant = (root_mean_square(error[scored]) for error in own)
    return Comparison(tracked, last, ls, constant, int(scored.sum()))
