"""Several samples of a stream at once: the loop that drives records, on the tile of the stream.

It gives the same bits as `update` for one sample after the other, because both run the same compiled step.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from driftfit.data.clock import LOOK, Clock, Pace, instant
from driftfit.data.known import NOISE, Known
from driftfit.data.labels import times_of
from driftfit.data.limits import Gate
from driftfit.data.record import Reading, Record, Records
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.run.live.alarm import LiveAlarm
from driftfit.run.live.fixed_lag import Window
from driftfit.run.live.interventions import HELD
from driftfit.run.live.late_input import check_applied
from driftfit.run.live.rule import FROZEN
from driftfit.run.program import Program, lanes_of
from driftfit.run.track import records_of
from driftfit.trackers.base import Tracker

SCALARS = ("y_hat", "e", "s", "ok")
"""What belongs to one sample, as opposed to the state after it."""


class Batch:
    """What a stream reports of T samples: the columns of `track`, a row for each sample.

    A sample that was ignored for its time has no prediction and is not used; theta and std are those before it.

    Attributes
    ----------
    theta, std : (T, n), (T, ny, n) for several outputs, (T, n) where these share one theta
        Parameters after each sample, and their standard deviations.
    prediction, innovation, innovation_std : (T,) or (T, ny)
        One-step prediction made before the output was observed, its error, and the standard deviation of that error.
    ok : (T,) or (T, ny), bool
        Which samples were used.
    """

    def __init__(self, out: Array, rows: int = 1) -> None:
        """``out`` is what the driver wrote, ``rows`` rows for each sample."""
        self._out, self._rows = out, rows

    def __len__(self) -> int:
        return len(self._out) // self._rows

    def __repr__(self) -> str:
        return f"Batch of {len(self)} samples"

    def written(self, name: str) -> Array:
        """A field that the tracker stores for every sample, such as one of its ``outputs``."""
        field: Array = self._out[name]
        field = field[..., 0] if field.shape[-1] == 1 else np.moveaxis(field, -1, 1)
        if self._rows == 1:
            return field
        return field.reshape(len(self), self._rows) if name in SCALARS else field[self._rows - 1 :: self._rows]

    @property
    def theta(self) -> Array:
        return self.written("theta")

    @property
    def var(self) -> Array:
        """Variances of the parameters, in the shape of theta."""
        return self.written("var")

    @property
    def std(self) -> Array:
        return np.sqrt(self.var)

    @property
    def prediction(self) -> Array:
        return self.written("y_hat")

    @property
    def innovation(self) -> Array:
        return self.written("e")

    @property
    def innovation_var(self) -> Array:
        """Variances of the innovations, in their shape."""
        return self.written("s")

    @property
    def innovation_std(self) -> Array:
        return np.sqrt(self.innovation_var)

    @property
    def ok(self) -> Array:
        return self.written("ok") > 0.0


def row_of(tile: Array, dtype: np.dtype[Any]) -> Array:
    """The present state of a tile as one row of the driver's output."""
    row = np.empty(1, dtype)
    for name in dtype.names or ():
        row[name] = tile[name]
    return row


def with_ignored(out: Array, before: Array, taken: Array) -> Array:
    """The rows of the samples that were ``taken``, and for each other sample the state that it found.

    ``before`` is the row of the state before the first sample.
    """
    rows: Array = np.concatenate([before, out])[np.cumsum(taken)]
    for name in SCALARS:
        rows[name][~taken] = 0.0 if name == "ok" else np.nan
    return rows


class Batched(ABC):
    """A stream that takes several samples at once."""

    programs: tuple[Program, ...]
    model: Model
    _rows: Model
    _tile: Array
    _clock: Clock
    _pace: Pace
    _gate: Gate | None
    _last: Any
    _awaits: int
    _ignored: int
    _windows: list[Window]
    _watching: list[tuple[int, LiveAlarm]]

    @property
    @abstractmethod
    def trackers(self) -> tuple[Tracker, ...]:
        """The tracker of each output."""

    @property
    def held(self) -> bool:
        """Whether an operator has stopped the learning."""
        return False

    @abstractmethod
    def _settle(self, held: bool, told: bool) -> None:
        """Reset what was known of one sample; ``told`` if that was more than interval, noise and drift."""

    @cached_property
    def _loop(self) -> Any:
        """The loop that drives records."""
        return self.programs[0].drivers().run

    @cached_property
    def _row_type(self) -> np.dtype[Any]:
        """What the loop writes for one row."""
        return self.programs[0].written(self._tile, 0).dtype

    def update_many(
        self, y: Any, u: Any = None, time: Any = None, weights: Any = 1.0, drift: Any = 1.0, prob: Any = None
    ) -> Batch:
        """Process T samples at once: results and state are those of `update` for each of them in turn, bit for bit.

        Signals and factors are given as to `track`. Where nothing needs the state after every sample (no ``lag``, no
        alarm on a frozen model), the compiled loop of a record does the work, at the cost of a record per sample and
        some 30 us per call; otherwise the samples go through it one by one. The first call compiles the loop, unless
        `track` has done so before.

        Parameters
        ----------
        y : (T,), or (T, ny) for several outputs
            NaN, inf and None are missing. T may be 0.
        u : (T,), (T, m), (T, ny, m) for outputs that share one theta, or None for a model without inputs
        time : (T,) numbers or datetimes, or None
            A sample whose time is not after all before it is counted in ``ignored`` and leaves the state unchanged.
        weights, drift, prob
            Known factors of every sample, as for `track`.

        Returns
        -------
        Batch
            theta, std, prediction, innovation, innovation_std and ok of every sample.

        Raises
        ------
        ValueError
            If shapes do not fit, or the input of the last sample is outstanding (`apply`); the state is then unchanged.
        """
        check_applied(self._awaits)
        rows = len(self.model.outputs) if self.model.shared else 1
        if len(y) == 0:
            return Batch(np.empty(0, self._row_type), rows)
        records = self._records(y, u, Reading(weights=weights, drift=drift, indexed=False), prob)
        held, told = self.held, records.known.columns.shape[1] > len(HELD)
        before = None if time is None else row_of(self._tile, self._row_type)
        records, taken = self._arrived(records, time)
        if held:
            records = replace(records, known=Known.of(*HELD))
        out = np.empty(rows * len(records.y), self._row_type)
        if len(out):
            self._drive((records.in_rows() if self.model.shared else records).part(0), out)
            self._settle(held, told)
        if before is not None and not taken.all():
            out = with_ignored(out, before, np.repeat(taken, rows))
        return Batch(out, rows)

    def _records(self, y: Any, u: Any, reading: Reading, prob: Any) -> Records:
        """The samples as a record, without their times."""
        _, records, _ = records_of(self.model, y, u, reading)
        if records.u.shape[-1] != self._rows.m:
            raise ValueError(
                f"Live.update_many: the model has {self._rows.m} inputs, but u has shape {np.shape(u)}; "
                "where none is known, give NaN."
            )
        return records.for_model(self.model, Reading()).for_trackers(self._rows, self.trackers, prob)

    def _arrived(self, records: Records, time: Any) -> tuple[Records, Array]:
        """(the samples that are not ignored, with the intervals before them, within their limits; which they are)."""
        T = len(records.y)
        taken = np.ones(T, bool)
        if time is not None:
            axis, zone, *_ = times_of(time, ())
            if axis is None or axis.shape != (T,):
                raise ValueError(f"Live.update_many: time has shape {np.shape(time)}, but y has {T} samples.")
            clock = self._clock.within(zone)
            taken, gaps = clock.arrivals(self._last, axis)
            self._clock, axis = clock, axis[taken]
            self._ignored += T - len(axis)
            for gap in gaps[: LOOK + 1]:
                self._pace.see(gap)
            known = records.known if records.known.constant else Known(records.known.columns[taken])
            if len(axis):
                self._last, known = instant(axis[-1]), known.changed(interval=gaps)
            records = replace(
                records, y=records.y[taken], u=records.u[taken], known=known, time=axis, length=np.array([len(axis)])
            )
        if self._gate is not None:
            alone = records.y.ndim == 1
            y, u = self._gate.sample(records.y[:, None] if alone else records.y, records.u)
            records = replace(records, y=y.reshape(records.y.shape), u=u)
        return records, taken

    def _drive(self, record: Record, out: Array) -> None:
        """Drive the tile over the samples, and let alarms and windows see each of them."""
        y, u, known = lanes_of(record)
        if not self._windows and not any(alarm.rule.kind in FROZEN for _, alarm in self._watching):
            self._loop(self._tile, y, u, known, out)
            for lane, alarm in self._watching:
                noise = np.broadcast_to(known[:, NOISE, min(lane, known.shape[2] - 1)], len(y))
                alarm.take_many(out, lane, noise, record.time)
            return
        for t in range(len(y)):
            row, own = slice(t, t + 1), known[t : t + 1] if len(known) > 1 else known
            self._loop(self._tile, y[row], u[row], own, out[row])
            self._keep(out[t], own[0], None if record.time is None else instant(record.time[t]))

    def _keep(self, row: Array, known: Array, time: Any) -> None:
        """Give the sample that was just processed, with its known factors (k, L), to alarms and windows."""
        for lane, alarm in self._watching:
            alarm.take(self._tile, lane, float(row["e"][lane]), float(row["s"][lane]), time)
        for lane, window in enumerate(self._windows):
            window.push(self._tile, (known[0, lane], known[1, lane], known[2, lane]), lane)
