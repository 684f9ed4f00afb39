"""Several samples of a stream at once: the loop that drives records, on the tile of the stream.

It gives the same bits as `update` for one sample after the other, because both run the same compiled step.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from driftfit.data.arguments import times_of
from driftfit.data.clock import PACE_SAMPLES
from driftfit.data.instants import instant
from driftfit.data.record import Known, Reading, Records
from driftfit.engine.drivers import DRIFT, INTERVAL, NOISE
from driftfit.engine.kernel import Array
from driftfit.readings.gate import AT_START, SIGNAL
from driftfit.run.columns import SCALARS, Columns, attribute
from driftfit.run.gating import First
from driftfit.run.lanes import Lane
from driftfit.run.live.stream import HELD, Stream, Tally, check_applied
from driftfit.run.program import Program, lanes_of
from driftfit.run.result import Track
from driftfit.run.track import records_of, warn_ungated


class Batch(Columns):
    """What a stream reports of T samples: the columns of `track`, a row for each sample.

    A sample that was ignored for its time has no prediction and is not used; theta and std are those before it.
    """

    def __init__(self, out: Array, rows_per_instant: int = 1) -> None:
        """``out`` is the array that the driver filled."""
        self._out, self._rows_per_instant = out, rows_per_instant

    @property
    def rows_per_instant(self) -> int:
        return self._rows_per_instant

    def __len__(self) -> int:
        return len(self._out) // self.rows_per_instant

    def __repr__(self) -> str:
        return f"Batch of {len(self)} samples"

    def in_rows(self, name: str) -> Array:
        field: Array = self._out[name]
        return field[..., 0] if field.shape[-1] == 1 else np.moveaxis(field, -1, 1)


def row_of(tile: Array, dtype: np.dtype[Any]) -> Array:
    """The present state of a tile as one row of the driver's output."""
    row = np.empty(1, dtype)
    for name in dtype.names or ():
        row[name] = tile[name]
    return row


def with_ignored(out: Array, before: Array, taken: Array) -> Array:
    """The rows of the samples that were ``taken``; every other sample gets the state before it.

    ``before`` is the row of the state before the first sample.
    """
    rows: Array = np.concatenate([before, out])[np.cumsum(taken)]
    for name in SCALARS:
        rows[name][~taken] = 0.0 if name == "ok" else np.nan
    return rows


class Batched(Stream):
    """A stream that takes several samples at once."""

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
        `track` has done so before. A stream of one theta without a gate warns once of readings that look like codes.

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
        rows = self._rows_per_instant
        if len(y) == 0:
            return Batch(np.empty(0, self._row_type), rows)
        records = self._records(y, u, Reading(weights=weights, drift=drift, indexed=False), prob)
        resting, extra = self.resting, records.known.columns.shape[1] > len(HELD)
        before = None if time is None else row_of(self._tile, self._row_type)
        records, taken = self._arrived(records, time)
        if resting == HELD:
            columns = np.broadcast_to(np.reshape(HELD, (3, 1)), (3, len(self.model.outputs)))
            records = records._replace(known=Known(columns[None, :, 0] if records.y.ndim == 1 else columns[None]))
        out = np.empty(rows * len(records.y), self._row_type)
        if len(out):
            record = (records.in_rows() if self.model.shared else records).part(0)
            self._samples += len(records.y)
            self._drive(*lanes_of(record), out, record.time)
            self._rest(resting)
            if extra:
                self._set_extra(None, None)
            if not self._warned and len(self.programs) == 1:
                self._warned = warn_ungated(Track(self.programs[0], record, Lane(out, self._tile)), "Live.update_many")
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
            for gap in gaps[: PACE_SAMPLES + 1]:
                self._pace.see(gap)
            known = records.known.part(taken)
            if len(axis):
                self._last, known = instant(axis[-1]), known.changed(interval=gaps)
            records = records._replace(
                y=records.y[taken], u=records.u[taken], known=known, time=axis, length=np.array([len(axis)])
            )
        if self._limits is not None:
            alone = records.y.ndim == 1
            y, u = self._limits.sample(records.y[:, None] if alone else records.y, records.u)
            records = records._replace(y=y.reshape(records.y.shape), u=u)
        return records, taken

    def _drive(self, y: Array, u: Array, known: Array, out: Array, time: Any = None) -> None:
        """Drive the tile over rows, of which ``time`` has the times, and let alarms and windows see each of them."""
        if not self._windows and not any(alarm.rule.kind == "glr" for _, alarm in self._watching):
            self._judged(y, u, known, out, time, len(y))
            for lane, alarm in self._watching:
                noise = np.broadcast_to(known[:, NOISE, min(lane, known.shape[2] - 1)], len(y))
                alarm.take_many(out, lane, y[:, lane], noise, time)
            return
        for t in range(len(y)):
            row, own = slice(t, t + 1), known[t : t + 1] if len(known) > 1 else known
            self._judged(y[row], u[row], own, out[row], None if time is None else time[row], len(y) - t)
            self._keep(y[t], own[0], None if time is None else instant(time[t]))

    def _judged(self, y: Array, u: Array, known: Array, out: Array, time: Any, left: int) -> None:
        """Drive the tile over rows, of which so many are ``left``, and note what a gate leaves out."""
        if self.programs[0].gate is None:
            self._loop(self._tile, y, u, known, out)
            return
        found: list[tuple[int, First]] = []
        self._loop(self._tile, y, u, known, out, found_too=found)
        starts, ny = dict(found), self._rows_per_instant
        first = ny * self._samples - left
        for t in sorted({*np.flatnonzero(out["reason"].any(axis=1)).tolist(), *starts}):
            at, number = None if time is None else instant(time[t]), (first + t) // ny
            for lane in np.flatnonzero(out["reason"][t]).tolist():
                if out["reason"][t, lane] % SIGNAL != AT_START:
                    code, names = out["reason"].item(t, lane), self.programs[lane].signals
                    self.left_out.add(number if at is None else at, code, y.item(t, lane), names)
            if t in starts:
                self._note_start(number, at, starts[t])

    def _noting(self, step: Any) -> Any:
        """The compiled step behind a gate, which notes what the gate leaves out."""

        def noting(tile: Any, y: float, u: Any) -> Any:
            found = step(tile, y, u)
            if not found[3] and (code := self._tile["reason"].item(0, 0)):
                self.left_out.add(
                    self._samples - 1 if self._last is None else self._last, code, y, self.programs[0].signals
                )
            return found

        return noting

    def _note_start(self, sample: int, time: Any, first: First) -> None:
        """Count what the gate decided of the first samples, at the present one, in place of what it said before."""
        self.left_out, dt, ny = Tally(), first.known[:, 0, 0], self._rows_per_instant
        begun = sample + 1 - len(first.y) // ny
        times = None if time is None else self._clock.moved(time, dt - np.cumsum(dt[::-1])[::-1])
        now = sample if time is None else time
        for k, lane in np.argwhere(first.reason).tolist():
            at, code = begun + k // ny if times is None else times[k], first.reason.item(k, lane)
            decided = now if code % SIGNAL == AT_START else None
            self.left_out.add(at, code, first.y.item(k, lane), self.programs[lane].signals, decided)

    def _keep(self, y: Array, known: Array, time: Any) -> None:
        """Give the row that was just processed, with its known factors (k, L), to alarms and windows."""
        tile, at = self._tile, None if time is None else np.array([time])
        for lane, alarm in self._watching:
            own = slice(lane, lane + 1)
            alarm.take_many(tile, lane, y[own], tile["noise"][0, own], at)
        for lane, window in enumerate(self._windows):
            window.push(self._tile, (known[INTERVAL, lane], known[NOISE, lane], known[DRIFT, lane]), lane)


def _of_output(name: str, text: str) -> Any:
    """The part of a property of a stream that belongs to one output."""
    return property(lambda self: getattr(self._stream, name)[self._lane], doc=text)


class LiveOutput:
    """A view of a stream, ``live["level"]``: it always shows the state after the last update.

    ``output`` is the name of the output, ``names`` are those of its parameters.
    """

    program: Program = _of_output("programs", "Its model and tracker.")
    tracker: Any = attribute("program.tracker", "Its tracker.")
    names: tuple[str, ...] = attribute("program.names", "Names of its parameters.")
    theta: Array = _of_output("theta", "Parameters now, (n,).")
    std: Array = _of_output("std", "Their standard deviations (n,), as those of the stream.")
    cov: Array = _of_output("cov", "Their covariance, (n, n).")
    learning: Array = _of_output("learning", "Which of them are being learned now, (n,) bool.")

    def __init__(self, stream: Any, lane: int) -> None:
        self._stream, self._lane = stream, lane
        self.output: str = stream.model.outputs[lane]

    def __repr__(self) -> str:
        return f"{self.output} of {self._stream!r}"

    @property
    def alarm(self) -> Any:
        """The alarm that watches this output, or None."""
        return self._stream.alarms.get(self.output)
