"""Recursive least squares with constant parameters: the reference against which every run is compared.

    R     upper triangular with R' R = sum phi phi' / noise,  R' z = sum phi y / noise     by Givens rotations
    R theta = z                                               solved from the last row up

A direction that the regressors have not yet spanned has a zero on the diagonal, and its parameter is 0 until they span
it. The result is the estimate of ``RLS(1.0)`` from a diffuse start, without its covariance: a start with poor
regressors is forgotten (`Linearised.settling`). One routine works on the arrays of one lane, compiled once for all
models. Cost per sample: O(n^2).

Of a model that is linearised at its estimates, the start is too poor for a comparison with trackers, which forget it as
well. Its constants are fitted twice, the second time with the linearisation held where the first ended
(`Linearised.held_at`): one step of Gauss and Newton from there, with regressors as good at the start as at the end.
Their errors are one step ahead in the constants, but not in the linearisation, which knows the whole record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.data.record import Reading, Record
from driftfit.engine.drivers import LARGEST, TrackerSteps, drivers, unknown
from driftfit.engine.kernel import Array, Driver, State, kernel, shared
from driftfit.engine.tiles import make_tile, output_type, repeat_tile
from driftfit.models.base import Model
from driftfit.readings.gate import Gate
from driftfit.run.columns import COLLECTED, collect
from driftfit.run.fleet import Fleet, Outputs
from driftfit.run.program import lanes_of
from driftfit.run.result import Track
from driftfit.run.track import Decisions, track
from driftfit.trackers.adaptive_kalman import AdaptiveKalman
from driftfit.trackers.kalman import Kalman

STILL = Kalman(q=0.0, r=1.0)
"""Constant parameters with a diffuse start."""
FLAT = 1e-11
"""A diagonal entry below this share of its column counts as zero."""


@shared
def rotate(R: Array, row: Array, size: Array, theta: Array) -> None:
    """Rotate ``row`` = [phi, y] into R (n, n + 1) = [R, z] and solve for theta; row is overwritten.

    size (n,): sum of the squares of every regressor. An entry that is rounding does not rotate: where regressors are
    collinear, as lags of an intercept are, it would turn a row by any angle into an equation that is not used.
    """
    n = theta.shape[0]
    for i in range(n):
        size[i] += row[i] * row[i]
    for i in range(n):
        if row[i] * row[i] > FLAT * FLAT * size[i]:
            length = np.sqrt(R[i, i] * R[i, i] + row[i] * row[i])  # numbers below `LARGEST` do not overflow
            c, s = R[i, i] / length, row[i] / length
            for j in range(i, n + 1):
                above, below = R[i, j], row[j]
                R[i, j] = c * above + s * below
                row[j] = c * below - s * above
    for i in range(n - 1, -1, -1):
        total = R[i, n]
        for j in range(i + 1, n):
            total -= R[i, j] * theta[j]
        theta[i] = total / R[i, i] if R[i, i] > FLAT * np.sqrt(size[i]) else 0.0


@kernel
def stay(s: State, l: int) -> None:
    """Nothing happens as time passes."""


@kernel
def forecast(s: State, l: int) -> None:
    n = s.theta.shape[0]
    y_hat = 0.0
    for i in range(n):
        y_hat += s.phi[i, l] * s.theta[i, l]
    s.y_hat[l], s.e[l], s.h[l] = y_hat, s.y[l] - y_hat, 0.0 if s.used[l] >= n else np.inf


@kernel
def learn(s: State, l: int) -> None:
    n = s.theta.shape[0]
    if s.ok[l] > 0.0:
        weight = s.weight[l] / np.sqrt(s.noise[l])
        for i in range(n):
            s.row[i, l] = weight * s.phi[i, l]
        s.row[n, l] = weight * s.y[l]
        s.used[l] += 1.0
        memory = max(s.settling_memory[l], 0.25 * s.used[l])
        s.weight[l] *= 1.0 / np.sqrt(1.0 - 1.0 / memory) if s.used[l] < s.settling[l] else 1.0
        rotate(s.R[:, :, l], s.row[:, l], s.size[:, l], s.theta[:, l])


STEPS = TrackerSteps(stay, forecast, learn, unknown, store=collect)


@lru_cache(64)
def _start(model: Model) -> Array:
    """The tile of a model before its first sample."""
    n, linearised = model.n, model.linearised
    settling = (linearised.settling, linearised.settling_memory) if linearised else (0.0, 0.0)
    state = {
        "theta": np.zeros(n), "R": np.zeros((n, n + 1)), "row": np.zeros(n + 1), "size": np.zeros(n), "used": 0.0,
        "weight": 1.0, "settling": settling[0], "settling_memory": settling[1],
    }  # fmt: skip
    return make_tile(n, model.m, model.memory(), [state])


def constant_least_squares(model: Model, record: Record) -> Array:
    """Fit constants over a record; return (T,) records of phi, y, dt, valid, e, ok and more.

    Missing lags are replaced by the predictions of these constants. The samples of a model with hidden states are not
    those of a regression: none of them is usable.
    """
    first = _fitted(model, record)
    linearised = model.linearised
    if linearised is None or linearised.settling == 0.0 or not len(record):
        return first
    return _fitted(linearised.held_at(first["theta"][-1, :, 0]), record)


def _fitted(model: Model, record: Record) -> Array:
    tile = repeat_tile(_start(model), 1)
    out = np.empty(len(record), output_type(tile, COLLECTED))
    drivers(model.steps, STEPS).run(tile, *lanes_of(replace(record, known=record.known.common)), out)
    if model.hidden is not None:
        for name, value in (("ok", 0.0), ("valid", 0.0), ("y_hat", np.nan), ("e", np.nan)):
            out[name] = value
    return out


@Driver
def _predictions(rows: Array, known: Array, e: Array) -> None:
    """Prediction errors e (T,) at the known (T,) samples; the rows [phi, y] (T, k + 1) are overwritten."""
    k = rows.shape[1] - 1
    R, size, theta = np.zeros((k, k + 1)), np.zeros(k), np.zeros(k)
    for t in range(rows.shape[0]):
        if known[t]:
            e[t] = rows[t, k]
            for i in range(k):
                e[t] -= rows[t, i] * theta[i]
            rotate(R, rows[t], size, theta)


def constant_errors(phi: Array, y: Array, weight: Array) -> Array:
    """One-step errors (T,) of constants on phi (T, k), fitted on the past with weights (T,); NaN for missing rows."""
    known = (np.abs(phi) < LARGEST).all(axis=1) & (np.abs(y) < LARGEST)
    root, e = np.sqrt(weight), np.full(len(y), np.nan)
    _predictions(np.column_stack([phi, y]) * root[:, None], known, e)
    return e / root


def decided_by(runs: Sequence[Track]) -> tuple[tuple[Record, ...], Decisions]:
    """(the records of runs, without their times, as others take them; what a gate left out of each)."""
    left_out: Decisions = {key: run.left_out for key, run in enumerate(runs) if len(run.left_out)}
    return tuple(replace(run.used_record, time=None) for run in runs), left_out


def constant_outputs(
    model: Model, y: Any, u: Any, reading: Reading, data: Any, by: Any = None
) -> dict[str, list[Track]]:
    """Each output as a separate regression, tracked with constant parameters, or by the default tracker where its gate
    decides what is left out of the record: by name, one run for every record.

    Their predictions fill missing lags. Outputs that share one theta are one regression, on all rows.
    """
    decides = reading.gate is True or isinstance(reading.gate, Gate)
    run = track(model, AdaptiveKalman() if decides else STILL, y, u, reading, data=data, by=by)
    lanes = [run.rows] if isinstance(run, Track) else [one.rows for one in run.values()]
    if model.shared:
        return {"rows": lanes}
    assert isinstance(run, Outputs | Fleet)
    names = run.outputs if isinstance(run, Outputs) else run.records.outputs
    return {name: lanes[k :: len(names)] for k, name in enumerate(names)}
