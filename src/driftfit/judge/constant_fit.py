"""Constant parameters as samples arrive, the reference against which every run is compared: `Kalman` without drift.

The start is diffuse: a parameter that the regressors have not yet determined is 0. A start with poor regressors is
forgotten by `RLS` (`Linearised.settling`).

Of a model that is linearised at its estimates, the start is too poor for a comparison with trackers, which forget it as
well. Its constants are fitted twice, the second time with the linearisation held where the first ended
(`Linearised.held_at`): one step of Gauss and Newton from there, with regressors as good at the start as at the end.
Their errors are one step ahead in the constants, but not in the linearisation, which knows the whole record. Cost per
sample: O(n^2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.data.record import Known, Reading, Record
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.models.regression import Regression
from driftfit.readings.gate import Gate
from driftfit.run.columns import COLLECTED, collect
from driftfit.run.fleet import Fleet, Outputs
from driftfit.run.program import Program, lanes_of
from driftfit.run.result import Track
from driftfit.run.track import Decisions, track
from driftfit.trackers.adaptive_kalman import AdaptiveKalman
from driftfit.trackers.kalman import Kalman
from driftfit.trackers.rls import RLS

STILL = Kalman(q=0.0, r=1.0)
"""Constant parameters with a diffuse start."""


@lru_cache(64)
def _program(model: Model) -> Program:
    return Program(model, RLS(1.0) if model.linearised else STILL)


def constant_least_squares(model: Model, record: Record) -> Array:
    """Fit constants over a record; return (T,) records of phi, y, dt, valid, e, ok and more.

    Missing lags are replaced by the predictions of these constants. The samples of a model with hidden states are not
    those of a regression: none of them is usable.
    """
    if model.hidden is not None:
        model, record = Regression(model.n), Record(record.y, np.full((len(record), model.n), np.nan), record.known)
    first = _fitted(model, record)
    linearised = model.linearised
    if linearised is None or linearised.settling == 0.0 or not len(record):
        return first
    return _fitted(linearised.held_at(first["theta"][-1, :, 0]), record)


def _fitted(model: Model, record: Record) -> Array:
    program = _program(model)
    tile = program.tile()
    out = program.inspected(tile, len(record), COLLECTED)
    run = program.drivers(steps=program.steps._replace(store=collect)).run
    run(tile, *lanes_of(replace(record, known=record.known.common)), out)
    return out


def constant_errors(phi: Array, y: Array, known: Known) -> Array:
    """One-step errors (T,) of constants on phi (T, k), fitted on the past with the noise that is known; NaN for missing
    rows."""
    return np.asarray(_fitted(Regression(phi.shape[1]), Record(y, phi, known))["e"][:, 0])


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
