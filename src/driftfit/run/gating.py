"""Which gate stands before a tracker, and what it left out of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import types

from driftfit.data.record import Record
from driftfit.engine.drivers import ModelSteps, TrackerSteps
from driftfit.engine.kernel import Array, State, Step, kernel, nothing
from driftfit.engine.phases import forecasting
from driftfit.engine.tracker_part import seen_as, tracker_part, whole_record
from driftfit.models.base import Model
from driftfit.readings.first_samples import CODES, DRIFT, DT, NOISE, READING, TIMES, U
from driftfit.readings.gate import AT_START, SIGNAL, Gate, gate_step, start
from driftfit.readings.left_out import LeftOut
from driftfit.readings.repeats import unread
from driftfit.trackers.base import Tracker


def gate_of(tracker: Tracker, gate: Gate | bool | None) -> Gate | None:
    """The gate before a tracker: one with its settings, True for the usual one, False for none; None: as it asks."""
    if isinstance(gate, Gate):
        return gate
    if gate is not None and not isinstance(gate, bool):
        raise ValueError(f"gate must be True, False, None or a Gate; got {gate!r}.")
    return Gate() if (tracker.gated if gate is None else gate) else None


@lru_cache(maxsize=256)
def foreseeing(model: ModelSteps, tracker: TrackerSteps) -> Step | None:
    """`ModelSteps.foreseeing` with the tracker's forecast once more: no time passes, and no reading is taken in."""
    started, part = tracker.start is not None, whole_record if tracker.reads_model else tracker_part
    usual, first = (forecasting(one._replace(predict=nothing)) for one in (tracker, tracker.start or tracker))

    @kernel
    def forecast(s: State, l: int) -> None:
        ok, observed = s.ok[l], s.observed[l]
        s.ok[l], s.observed[l] = 0.0, 0.0
        if started and s.root[l] > 0:
            first(part(s), l)
        else:
            usual(part(s), l)
        s.ok[l], s.observed[l] = ok, observed

    return model.foreseeing and model.foreseeing(forecast)


ROW = "row_"
"""Beginning of the names of fields (.., rows, 1) that a record of one lane has for several rows of an instant."""


def _rows(record: Any) -> Any:
    """The type of those fields with a row for a lane, (.., rows)."""
    own = ((name.removeprefix(ROW), one) for name, one in record.fields.items() if name.startswith(ROW))
    kinds = ((name, one, types.NestedArray(one.type.dtype, one.type.shape[:-1])) for name, one in own)
    fields = [(name, {"type": kind, "offset": one.offset, "alignment": one.alignment}) for name, one, kind in kinds]
    return types.Record(fields, record.size, record.aligned)


rows_of = seen_as("rows_of", _rows)
"""rows_of(s): the fields for several rows of an instant, without `ROW`, as a record with a lane for each."""

OF_SAMPLE = ("reason", "raw_y", "raw_e", "gate_decided", "gate_replay", "gate_refused", "shift", "floor")
"""Fields of the sample, or of all outputs together; of the others every output has its own."""


def begun(gate: Gate, model: Model, rows: int) -> Mapping[str, Any]:
    """Fields of a gate before the first sample, and of ``rows`` outputs that share one theta (0: they do not)."""
    own = start(gate, model.n, model.m, model.linearised is not None)
    if rows == 0:
        return own
    several = ((name, np.asarray(one)[..., None]) for name, one in own.items() if name not in OF_SAMPLE)
    each = {ROW + name: np.repeat(one, rows, axis=-1) for name, one in several}
    return {"output": 0, **{name: own[name] for name in (*OF_SAMPLE, *unread())}, **each}


def judging(gate: Gate, model: Model, tracker: Tracker, steps: tuple[ModelSteps, TrackerSteps], rows: int) -> Any:
    """The gate as drivers take it, of so many outputs that share one theta (0: they do not)."""
    own, foresee = steps[0], None if tracker.output_error else foreseeing(*steps)
    implicit, lends = model.implicit is not None, not tracker.covariance
    return gate_step(gate, own.ages, own.refuse, implicit, lends, foresee, rows and (rows_of, rows, 1 + model.m))


def left_out_of(program: Any, decided: Array, y: Array, ok: Array, start: Any) -> LeftOut:
    """The decisions in a run of a program, from what its gate stored for every sample (T,), its readings, which samples
    were used once all was decided, and what `decided_record` found."""
    sample, names, ny = np.flatnonzero(decided), program.signals, len(program.rows) or 1
    signal, code = np.divmod(decided[sample].astype(int), SIGNAL)
    refused = sample[signal % (len(names) // ny) == 0]
    after = (sample[:, None] + np.arange(program.model.steps.ages + 1)).ravel()
    after = np.setdiff1d(after[after < len(y)], refused)
    unused = after[~ok[after] & np.isfinite(y[after])]
    when = np.where(code == AT_START, start[2] if start else 0, sample) // ny
    return LeftOut(sample // ny, code, y[sample], np.array(names)[signal], when, refused, unused)


class First(NamedTuple):
    """The first samples of L outputs, each as often as it came, up to the present one."""

    y: Array
    """Readings (k, L)."""
    u: Array
    """Inputs (k, m, L), the same for all outputs; of samples that made room for others NaN."""
    known: Array
    """Intervals since the sample before, factors of the noise variance and of the drift (k, 3, L)."""
    codes: Array
    """Which signals (k, 1 + m, L), the output first, are codes."""
    reason: Array
    """What was decided (k, L), as a gate stores it."""

    def without_codes(self) -> tuple[Array, Array]:
        """(readings (k, L), inputs (k, m, L)), NaN where they are codes."""
        return np.where(self.codes[:, 0], np.nan, self.y), np.where(self.codes[:, 1:], np.nan, self.u)


def replayed(tile: Array, m: int, rows: int = 0) -> First:
    """The first samples of a tile with ``gate_replay`` set; an input is a code if it is one for some output. Of
    ``rows`` outputs that share one theta each has inputs of its own."""
    of, dropped = ROW if rows else "", tile["gate_replay"].item(0) - 1
    first = tile[of + "gate_first"][0, : tile[of + "gate_kept"].item(0)].copy()
    first = first[..., 0] if rows else first
    first[0, TIMES] += dropped
    first = np.repeat(first, first[:, TIMES, 0].astype(int), axis=0)
    first[:dropped, U : U + m] = np.nan
    first = np.moveaxis(first, 2, 1).reshape(-1, first.shape[1], 1) if rows else first
    codes = (first[:, [CODES]].astype(int) >> np.arange(1 + m)[:, None]) % 2 == 1
    codes[:, 1:] = codes[:, 1:].any(axis=2, keepdims=True)
    y = first[:, READING]
    return First(y, first[:, U : U + m], first[:, [DT, NOISE, DRIFT]], codes, np.zeros_like(y))


def without_codes(record: Record, last: int, first: First) -> Record:
    """A record without the codes that were found among its first samples, at sample ``last``."""
    count = min(last + 1, len(first.y))
    part = slice(last + 1 - count, last + 1)
    y, u, (outputs, inputs) = record.y.copy(), record.u.copy(), first.without_codes()
    y[part], u[part] = outputs[-count:].reshape(count, *y.shape[1:]), inputs[-count:, :, 0]
    return replace(record, y=y, u=u)
