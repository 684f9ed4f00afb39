"""Which gate stands before a tracker, and what it left out of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from driftfit.data.record import Record
from driftfit.engine.drivers import ModelSteps, TrackerSteps
from driftfit.engine.kernel import Array, State, Step, kernel, nothing
from driftfit.engine.phases import forecasting
from driftfit.engine.tracker_part import tracker_part, whole_record
from driftfit.readings.first_samples import CODES, DRIFT, DT, NOISE, READING, TIMES, U
from driftfit.readings.gate import SIGNAL, Gate
from driftfit.readings.left_out import LeftOut
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


def left_out_of(decided: Array, y: Array, ok: Array, ages: int, names: Sequence[str]) -> LeftOut:
    """The decisions in a run, from what its gate stored for every sample (T,), its readings, which samples were used
    once all was decided, how many samples its model remembers inputs, and the names of the output and the inputs."""
    sample = np.flatnonzero(decided)
    signal, code = np.divmod(decided[sample].astype(int), SIGNAL)
    refused = sample[signal == 0]
    after = (sample[:, None] + np.arange(ages + 1)).ravel()
    after = np.setdiff1d(after[after < len(y)], refused)
    unused = after[~ok[after] & np.isfinite(y[after])]
    return LeftOut(sample, code, y[sample], np.array(names)[signal], refused, unused)


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


def replayed(tile: Array, m: int) -> First:
    """The first samples of a tile with ``gate_replay`` set; an input is a code if it is one for some output."""
    kept, dropped = tile["gate_kept"].item(0), tile["gate_replay"].item(0) - 1
    rows = tile["gate_first"][0, :kept].copy()
    rows[0, TIMES] += dropped
    rows = np.repeat(rows, rows[:, TIMES, 0].astype(int), axis=0)
    rows[:dropped, U : U + m] = np.nan
    codes = (rows[:, [CODES]].astype(int) >> np.arange(1 + m)[:, None]) % 2 == 1
    codes[:, 1:] = codes[:, 1:].any(axis=2, keepdims=True)
    y = rows[:, READING]
    return First(y, rows[:, U : U + m], rows[:, [DT, NOISE, DRIFT]], codes, np.zeros_like(y))


def without_codes(record: Record, last: int, first: First) -> Record:
    """A record without the codes that were found among its first samples, at sample ``last``."""
    count = min(last + 1, len(first.y))
    part = slice(last + 1 - count, last + 1)
    y, u, (outputs, inputs) = record.y.copy(), record.u.copy(), first.without_codes()
    y[part], u[part] = outputs[-count:].reshape(count, *y.shape[1:]), inputs[-count:, :, 0]
    return replace(record, y=y, u=u)
