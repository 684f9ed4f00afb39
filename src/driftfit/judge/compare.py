"""The comparison in every summary: the errors of simpler predictors on the same samples.

*persistence*   the last known output
*constant LS*   recursive least squares without forgetting on the same regressors (fitted only to the past)
*with lags*     the same with the last two outputs and regressors added: constants with correlated noise
*constant ARX*  the same on ARX(2, 1 per input) with intercept

All are one-step predictions. A model with hidden states has no regressors, and is compared with the others only. They
are scored on the samples after max(50, 5 n) complete ones that all of them could predict; in a record of which that
would be most, after a tenth of its samples, or n if these are more. None of them learns from a
sample that the run left out, and none is scored on it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from driftfit.data.record import Known, Record
from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array
from driftfit.judge.constant_fit import constant_errors, constant_least_squares
from driftfit.models.arx import ARX
from driftfit.models.base import Model
from driftfit.run.result import Track, burn_in, root_mean_square

LAGS = 2
"""Number of lags of y and of all regressors that are added to the regressors of a run."""
LEARNED = 2
"""Samples for each parameter until the errors of constants are those of the noise."""


class Comparison(NamedTuple):
    """Root mean square one-step errors on ``samples`` samples; NaN where a record is too short to score."""

    tracked: float
    persistence: float
    constant_ls: float
    constant_arx: float
    samples: int


def persistence(y: Array, rows: int = 1) -> Array:
    """For every sample the last known output before it; NaN before the first.

    Where outputs share one theta, an instant has several ``rows``, and the last value of a row is that of its output.
    """
    if rows > 1:
        return np.stack([persistence(one) for one in y.reshape(-1, rows).T], axis=1).ravel()
    place = np.where(np.isfinite(y), np.arange(len(y)), -1)
    last = np.concatenate([[-1], np.maximum.accumulate(place)[:-1]])
    return np.where(last >= 0, y[last], np.nan)


def _error(y: Array, prediction: Array, innovation: Array) -> Array:
    """Error of the prediction of y; the innovation of a model may be the residual of something else."""
    return np.where(np.isfinite(innovation), y - prediction, np.nan)


def left_at_start(run: Track) -> int:
    """Samples at the start of a run that are not scored: max(50, 5 n), or where that is most of it max(n, T / 10)."""
    n, T = run.model.n, len(run)
    return burn_in(n) if 2 * burn_in(n) <= T else max(n, T // 10)


class Errors(NamedTuple):
    """One-step errors of all predictors, (T,) each, and which samples are scored."""

    tracked: Array
    persistence: Array
    constant_ls: Array
    lagged_ls: Array
    constant_arx: Array
    scored: Array
    arx: Array
    """(T,): records of constant ARX, as of `constant_least_squares`."""


@lru_cache(16)
def _constant_arx(inputs: int) -> ARX:
    return ARX(2, 1 if inputs else 0, inputs=inputs, intercept=True)


def errors(run: Track, record: Record, burn: int | None = None, steady: Array | None = None) -> Errors:
    """One-step errors of a run, of persistence, of constants without and with lags, and of constant ARX.

    Where lags are missing, the constants without lags predict. The first ``burn`` complete samples are not scored; by
    default those of `left_at_start`. ``record`` is what they learn from (`Track.used_record`); ``steady`` are the
    constants of the run, if they are known.
    """
    y, u = np.where(np.abs(record.y) < LARGEST, record.y, np.nan), record.u
    steady = constant_least_squares(run.model, record) if steady is None else steady
    gaps, unused = record.known.interval, np.broadcast_to(record.known.noise == np.inf, len(y)).copy()
    unused[1:] |= unused[:-1] & np.isfinite(y[:-1])  # an input that may be to blame is the lag of the next sample
    gaps = np.where(gaps > 0.0, gaps, 1.0)  # 0 before the lags were filled
    known = record.known.changed(interval=gaps, noise=np.where(unused, np.inf, 1.0))
    arx = constant_least_squares(_constant_arx(u.shape[1]), Record(y, u, known))
    tracked, constant = _error(y, run.prediction, run.innovation), _error(y, steady["y_hat"][:, 0], steady["e"][:, 0])
    lagged = _with_lags(run.model, steady, y, constant, record.known)
    lagged = np.where(np.isfinite(lagged), lagged, constant)
    rows = len(run.program.whole.outputs)
    own = (tracked, y - persistence(y, rows), constant, lagged, arx["e"][:, 0])
    given = (np.abs(run.y) < LARGEST) & (np.abs(u) < LARGEST).all(axis=1)  # a start waits for what is missing
    scored = np.asarray(np.cumsum(given) - given >= (left_at_start(run) if burn is None else burn))
    for error in own if run.model.hidden is None else (own[0], own[1], own[4]):
        scored &= np.isfinite(error)
    return Errors(*own, scored, arx)


def _with_lags(model: Model, steady: Array, y: Array, constant: Array, given: Known) -> Array:
    """Errors (T,) of constants on the regressors of a run, the last outputs, and the last regressors.

    ``constant`` are the errors without lags. Regressors that hold the present output predict nothing: where a model has
    such, lags of the regressors and errors predict ``constant``, once the parameters are known.
    """
    T, used = len(y), (steady["valid"] > 0.0) & np.broadcast_to(given.noise < np.inf, len(y))[:, None]
    phi = np.where(used, steady["phi"][..., 0], np.nan)
    known = np.cumsum(steady["ok"][:, 0]) > LEARNED * model.n if model.implicit else np.isfinite(y)
    y = np.where(known, constant if model.implicit else steady["y"][:, 0], np.nan)
    last = np.full((LAGS, T, 1 + phi.shape[1]), np.nan)
    for k in range(1, min(LAGS, T - 1) + 1):
        last[k - 1, k:] = np.column_stack([y, phi])[:-k]
    columns = [*last] if model.implicit else [phi, *last]
    return constant_errors(np.column_stack(columns), y, given)


def compare(run: Track) -> Comparison:
    """Score a run against persistence, constant least squares and constant ARX."""
    made = errors(run, run.used_record)
    shown = (made.tracked, made.persistence, made.constant_ls, made.constant_arx)
    tracked, last, ls, constant = (root_mean_square(error[made.scored]) for error in shown)
    return Comparison(tracked, last, ls, constant, int(made.scored.sum()))
