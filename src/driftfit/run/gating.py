"""Which gate stands before a tracker, and what it left out of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numba import types

from driftfit.data.record import Record
from driftfit.engine.drivers import ModelSteps, TrackerSteps
from driftfit.engine.kernel import Array, State, Step, kernel, nothing
from driftfit.engine.phases import forecasting
from driftfit.engine.tracker_part import seen_as, tracker_part, whole_record
from driftfit.models.base import Model
from driftfit.readings.first_samples import CODES, DRIFT, DT, NOISE, READING, TIMES, U, remember
from driftfit.readings.gate import SIGNAL, USED, Gate, gate_step, judge_of, start
from driftfit.readings.inputs import forget
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
"""Beginning of the names of the fields of a gate that has an entry for each of the outputs that share a theta."""


def _rows(record: Any) -> Any:
    """The fields ``row_..`` (.., ny, 1) of a record of one lane, as lanes (.., ny)."""
    own = ((name.removeprefix(ROW), one) for name, one in record.fields.items() if name.startswith(ROW))
    kinds = ((name, one, types.NestedArray(one.type.dtype, one.type.shape[:-1])) for name, one in own)
    fields = [(name, {"type": kind, "offset": one.offset, "alignment": one.alignment}) for name, one, kind in kinds]
    return types.Record(fields, record.size, record.aligned)


rows_of = seen_as("rows_of", _rows)


def begun(gate: Gate, model: Model, ny: int) -> Mapping[str, Any]:
    """Fields of a gate before the first sample. Before ny outputs that share one theta (0: they do not) it has an entry
    for each, with the sample that it saw last, and passes on what it decided of the present one."""
    n, m = model.n, model.m
    own = {**start(gate, n, m, model.linearised is not None), "raw_e": np.nan}
    if ny:
        sample = dict.fromkeys(
            ("y", "dt", "noise", "drift", "valid", "observed", "ok", "y_hat", "e", "s", "floor"), 0.0
        )
        each = {**own, **sample, "phi": np.zeros(n), "u": np.zeros(max(m, 1))}
        passed = {name: own[name] for name in ("reason", "raw_y", "raw_e", "gate_decided", "gate_replay", *unread())}
        rows = {ROW + name: np.repeat(np.asarray(value)[..., None], ny, axis=-1) for name, value in each.items()}
        own = {**passed, "output": 0, **rows}
    return {**own, "gate_refused": 0}


@lru_cache
def row_gate(gate: Gate, m: int, ny: int) -> Any:
    """The gate of a regression on m inputs with ny outputs that share one theta, whose samples are rows, one output
    after another. The first samples are judged when all rows of an instant are there."""
    step = judge_of(gate)

    @kernel
    def enter(s: State, g: State, l: int) -> None:
        for i in range(s.phi.shape[0]):
            g.phi[i, l] = s.phi[i, 0]
        for j in range(g.u.shape[0]):
            g.u[j, l] = s.u[j, 0]
        g.y[l], g.raw_y[l], g.y_hat[l], g.e[l], g.s[l] = s.y[0], s.raw_y[0], s.y_hat[0], s.e[0], s.s[0]
        g.dt[l], g.noise[l], g.drift[l] = s.dt[0], s.noise[0], s.drift[0]
        g.valid[l], g.observed[l], g.ok[l], g.reason[l] = s.valid[0], s.observed[0], s.ok[0], USED

    @kernel
    def leave(s: State, g: State, l: int) -> None:
        reason = g.reason[l]
        s.ok[0], s.observed[0], s.raw_e[0], s.floor[0] = g.ok[l], g.observed[l], g.raw_e[l], g.floor[l]
        s.reading[0], s.alike[0], s.finest[0] = g.reading[l], g.alike[l], g.finest[l]
        s.reason[0] = reason + SIGNAL * (1 + m) * l if reason > USED else USED
        for j in range(m if reason >= SIGNAL else 0):
            forget(g, j, l)

    @partial(kernel, inline=False)
    def decide(s: State) -> None:
        g, l = rows_of(s), s.output[0]
        enter(s, g, l)
        if (s.gate_decided[0] < 1) & (l == ny - 1):
            remember(g, 0, False)
            s.gate_decided[0], s.gate_replay[0] = g.gate_decided[0], g.gate_replay[0]
        observed = g.observed[l]
        step(g, l)
        leave(s, g, l)
        g.observed[l] = observed  # what the first samples are judged by
        s.output[0] = (l + 1) % ny

    return decide


def judging(gate: Gate, model: Model, tracker: Tracker, steps: tuple[ModelSteps, TrackerSteps], ny: int) -> Any:
    """The gate as drivers take it, of ny outputs that share one theta (0: they do not)."""
    if ny:
        return row_gate(gate, model.m, ny)
    own, foresee = steps[0], None if tracker.output_error else foreseeing(*steps)
    return gate_step(gate, own.ages, own.refuse, model.implicit is not None, not tracker.covariance, foresee)


def left_out_of(program: Any, decided: Array, y: Array, ok: Array) -> LeftOut:
    """The decisions in a run of a program, from what its gate stored for every sample (T,), its readings, and which
    samples were used once all was decided."""
    sample, names, ny = np.flatnonzero(decided), program.signals, len(program.rows) or 1
    signal, code = np.divmod(decided[sample].astype(int), SIGNAL)
    refused = sample[signal % (len(names) // ny) == 0]
    after = (sample[:, None] + np.arange(program.model.steps.ages + 1)).ravel()
    after = np.setdiff1d(after[after < len(y)], refused)
    unused = after[~ok[after] & np.isfinite(y[after])]
    return LeftOut(sample // ny, code, y[sample], np.array(names)[signal], refused, unused)


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


def replayed(tile: Array, m: int, of: str = "") -> First:
    """The first samples of a tile with ``gate_replay`` set; an input is a code if it is one for some output. ``of``
    precedes the names of the fields of outputs that share one theta, of which each has inputs of its own."""
    kept, dropped = tile[of + "gate_kept"].item(0), tile["gate_replay"].item(0) - 1
    rows = tile[of + "gate_first"][0, :kept].copy()
    rows = rows[..., 0] if of else rows
    rows[0, TIMES] += dropped
    rows = np.repeat(rows, rows[:, TIMES, 0].astype(int), axis=0)
    rows[:dropped, U : U + m] = np.nan
    rows = np.moveaxis(rows, 2, 1).reshape(-1, rows.shape[1], 1) if of else rows
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
