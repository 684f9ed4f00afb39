"""Record mode for several outputs: arrays, tables, fleets and grids; see `driftfit.track`."""

from __future__ import annotations

from collections.abc import Hashable, ItemsView, Iterator, KeysView, Mapping, Sequence, ValuesView
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from driftfit.data.clock import LABEL, Clock, warn_of_gaps
from driftfit.data.known import INTERVAL, Known
from driftfit.data.labels import Held, held, order_of, ordered, times_of, together
from driftfit.data.limits import Limits, within_each
from driftfit.data.record import PLAIN, Labels, Reading, Record
from driftfit.data.signals import as_inputs, intervals, noise_of
from driftfit.engine.arrays import as_numbers, factor
from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.run.fleet import Many
from driftfit.run.output_lanes import programs_of
from driftfit.run.outputs import Outputs, lanes_of
from driftfit.run.program import Program, tile_of
from driftfit.run.result import Track, track_record
from driftfit.run.shared_outputs import Shared, row_model
from driftfit.run.warm_start import Run, carried, first_interval
from driftfit.trackers.base import Tracker


class Signals(NamedTuple):
    """A checked record: y (T, ny), time (T,) or None, and the known factors of every sample."""

    y: Array
    u: Array
    """(T, m), or (T, ny, m) if the outputs share one theta."""
    time: Array | None
    gaps: Array
    """(T,): nominal intervals."""
    noise: Array
    """(T, ny): factors of the noise variance."""
    drift: Array
    """(T,) or (T, n): factors of the drift."""
    labels: Labels = PLAIN


class OutputsFleet(Many):
    """Results of many records with several outputs, by key; ``failed`` gives the reason of each without a result.

    Verdict, diagnosis, summary and report treat every output of every record, with keys (key, output), or every record
    if its outputs share one theta.
    """

    def __init__(
        self, records: Mapping[Hashable, Outputs | Shared], failed: Mapping[Hashable, str],
        by: Sequence[str] = ("series",),
    ) -> None:  # fmt: skip
        self._records, self._by, self.failed = dict(records), tuple(by), dict(failed)

    @property
    def by(self) -> tuple[str, ...]:
        return self._by

    @property
    def model(self) -> Model:
        """The model of all records."""
        return next(iter(self._records.values())).model

    def __repr__(self) -> str:
        return f"Records of several outputs: {', '.join(map(repr, self))}"

    def __getitem__(self, key: Hashable) -> Outputs | Shared:
        return self._records[key]

    def __iter__(self) -> Iterator[Hashable]:
        return iter(self._records)

    def __len__(self) -> int:
        return len(self._records)

    def __contains__(self, key: object) -> bool:
        return key in self._records

    def keys(self) -> KeysView[Hashable]:
        """Keys of the records that have a result."""
        return self._records.keys()

    def values(self) -> ValuesView[Outputs | Shared]:
        """The results."""
        return self._records.values()

    def items(self) -> ItemsView[Hashable, Outputs | Shared]:
        """Keys and results."""
        return self._records.items()

    def runs(self) -> dict[Hashable, Track]:
        found: dict[Hashable, Track] = {}
        for key, run in self._records.items():
            found |= {key: run.rows} if isinstance(run, Shared) else {(key, name): run[name] for name in run.outputs}
        return found


def track_outputs(
    model: Model, tracker: Any, y: Any, u: Any, data: Any, by: Any, reading: Reading, keep: str, before: Any
) -> Outputs | Shared | OutputsFleet:
    """Track a model with several outputs; the arguments are those of `track`."""
    failed: Mapping[Hashable, str] = {}
    if reading.units is not None and data is None:
        raise ValueError("track: units= maps the names of columns to their units, so data= is needed.")
    if data is not None:
        model, found, failed = of_table(model, y, u, data, by, reading)
    elif by == "row":
        found = of_rows(model, y, u, reading)
    elif by is not None:
        raise ValueError(f"track: by={by!r} names a column of a table, so data= is needed; rows are by='row'.")
    else:
        model, one = of_arrays(model, y, u, reading)
        found = {0: one}
    found = restricted(model, found, reading)
    _warn(model, found)
    if by is None and not isinstance(tracker, Sequence):
        return run_one(model, tracker, found[0], keep, before)
    if by is None:
        return OutputsFleet({k: run_one(model, one, found[0], keep, before) for k, one in enumerate(tracker)}, {})
    if isinstance(tracker, Sequence):
        raise ValueError("track: a grid of trackers over several outputs is for one record; leave by= out.")
    if before is not None and not isinstance(before, OutputsFleet):
        raise ValueError(f"warm_start: with by= pass the result of such a run, from key to record; got {before!r}.")
    starts = {} if before is None else dict(before.items())
    runs = {key: run_one(model, tracker, one, keep, starts.get(key)) for key, one in found.items()}
    return OutputsFleet(runs, failed, ("series",) if by == "row" else (by,) if isinstance(by, str) else by)


def run_one(model: Model, tracker: Any, signals: Signals, keep: str, before: Run | None) -> Outputs | Shared:
    """One record."""
    if before is not None:
        gaps, time = signals.gaps.copy(), signals.time
        gaps[0] *= first_interval(before, None if time is None else time[0], signals.labels)
        signals = signals._replace(gaps=gaps)
    if model.shared:
        return run_shared(model, tracker, signals, keep, before)
    programs = programs_of(model.bind(signals.labels.u or signals.u.shape[1]), tracker)
    for lane, one in enumerate(programs):
        (one.model if one.alone is None else one.alone.model).inspect(signals.y[:, lane], signals.u)
    starts = carried(before, programs)
    record = Record(signals.y, signals.u, known_of(programs[0], signals), signals.time, signals.labels)
    tile, keep = tile_of(programs, starts), keep_of(keep, programs[0].tracker)
    out = programs[0].written(tile, len(record), keep)
    programs[0].drivers(keep).run(tile, *lanes_of(record), out)
    return Outputs(programs, record, out, tile, starts)


def restricted(model: Model, found: Mapping[Hashable, Signals], reading: Reading) -> dict[Hashable, Signals]:
    """The records with NaN outside valid ranges and in excluded intervals, which are counted."""
    if not reading.limits and not reading.exclude:
        return dict(found)
    keys, out = list(found), {}
    for k, (key, one) in enumerate(found.items()):
        m = one.u.shape[-1]
        limits = Limits(reading.limits or {}, model.outputs, one.labels.u or model.input_names, m)
        out_y, out_u = limits.outside(one.y, one.u)
        number = np.arange(len(one.y))
        excluded = within_each(reading.exclude, keys, np.full(len(number), k), one.time, number, one.labels.zone)
        inputs = np.moveaxis(out_u, -1, 0).reshape(m, len(number), -1).sum(axis=2)
        counts = [*(out_y & ~excluded[:, None]).sum(axis=0), *(inputs * ~excluded).sum(axis=1)]
        said = {f"of {name} outside its limits": int(c) for name, c in zip(limits.names, counts, strict=True) if c}
        said |= {"excluded": int(excluded.sum())} if excluded.any() else {}
        y = np.where(out_y | excluded[:, None], np.nan, one.y)
        u = np.where(out_u | excluded.reshape(-1, *(1,) * (one.u.ndim - 1)), np.nan, one.u)
        out[key] = one._replace(y=y, u=u, labels=replace(one.labels, missing=said))
    return out


def _warn(model: Model, found: Mapping[Hashable, Signals]) -> None:
    """Warn if most samples cannot be used because of dt."""
    timed = [one for one in found.values() if one.time is not None]
    if timed:
        time, gaps = (np.concatenate(parts) for parts in zip(*((one.time, one.gaps) for one in timed), strict=True))
        length = np.array([len(one.gaps) for one in timed])
        labels = timed[0].labels
        warn_of_gaps(Clock.of(labels.dt), time, gaps, np.cumsum(length) - length, model.reach, labels.zone)


def keep_of(keep: str, tracker: Tracker) -> str:
    """What is kept of a tracker that has it."""
    if keep == "cov" and not tracker.covariance:
        raise ValueError(f"track: {type(tracker).__name__} carries no covariance to keep; use keep='std'.")
    return keep


def known_of(program: Program, signals: Signals) -> Known:
    """The known factors of every sample for the driver, (T, k, ny)."""
    gaps, noise, drift = signals.gaps, signals.noise, signals.drift
    T, ny = noise.shape
    common = np.ones(T) if drift.ndim == 2 else drift
    known = np.stack([np.repeat(gaps[:, None], ny, axis=1), noise, np.repeat(common[:, None], ny, axis=1)], axis=1)
    if drift.ndim == 1:
        return Known(known)
    columns = program.tracker.beside(program.model, T, None, drift)
    return Known(np.concatenate([known, np.repeat(columns[:, :, None], ny, axis=2)], axis=1))


def run_shared(model: Model, tracker: Any, signals: Signals, keep: str, before: Run | None) -> Shared:
    """Rows of one instant as successive samples between which no time passes."""
    (T, ny), time = signals.y.shape, signals.time
    (one,) = programs_of(model, tracker)
    program = Program(row_model(model, one.tracker, signals.u.shape[2]), one.tracker)
    starts = carried(before, [program])
    columns = np.moveaxis(known_of(program, signals).columns, 1, 2).reshape(T * ny, -1)
    known = Known(columns).changed(interval=np.where(np.arange(T * ny) % ny > 0, 0.0, columns[:, INTERVAL]))
    flat, inputs = np.ascontiguousarray(signals.y.ravel()), np.ascontiguousarray(signals.u.reshape(T * ny, -1))
    times = None if time is None else np.repeat(time, ny)
    record = Record(flat, inputs, known, times, replace(signals.labels, u=()))
    rows = track_record(program, record, keep_of(keep, one.tracker), starts[0] if starts else None)
    return Shared(rows, model, time)


def of_arrays(model: Model, y: Any, u: Any, reading: Reading) -> tuple[Model, Signals]:
    """(the model with its outputs named, a record) from arrays or data frames."""
    given = {"y": held("y", y), "u": Held(u) if model.shared else held("u", u)}
    together(**given, weights=held("weights", reading.weights), drift=held("drift", reading.drift))
    model, place = named_outputs(model, given["y"].names)
    ny = len(model.outputs)
    output = as_numbers("y", given["y"].values)
    if output.ndim != 2 or output.shape[1] != ny or len(output) == 0:
        raise ValueError(f"y must be (T, {ny}) for the outputs {', '.join(model.outputs)}; got shape {output.shape}.")
    T = len(output)
    times = times_of(reading.time, list(given.values()))
    dt = LABEL if times.labels and reading.dt is None else reading.dt
    axis, gaps = (None, np.ones(T)) if times.axis is None else intervals(times.axis, Clock.of(dt, times.zone), T)
    each = as_numbers("drift", reading.drift) if np.ndim(reading.drift) == 2 else None
    factors = np.broadcast_to(factor("drift", reading.drift, T), T) if each is None else each
    regressors = shared_inputs(u, T, ny) if model.shared else as_inputs(given["u"].values, T)
    inputs, names = ordered(model, regressors, given["u"].names)
    labels = replace(PLAIN, u=names, time=times.name, zone=times.zone, dt=Clock.of(dt).plain)
    noise = noise_of_each(reading.weights, T, ny)[:, place]
    return model, Signals(np.ascontiguousarray(output[:, place]), inputs, axis, gaps, noise, factors, labels)


def named_outputs(model: Model, names: Sequence[str]) -> tuple[Model, list[int]]:
    """(the model, its outputs named; the columns of y in their order), for columns of y with names."""
    ny = len(model.outputs)
    if len(names) != ny:
        return model, list(range(ny))
    if isinstance(model.ny, int):
        return replace(model, ny=tuple(names)), list(range(ny))  # type: ignore[type-var]
    return model, order_of(type(model).__name__, model.outputs, names, "outputs")


def shared_inputs(u: Any, T: int, ny: int) -> Array:
    """Regressors (T, ny, m): a row for each output."""
    regressors = as_numbers("u", u)
    if regressors.ndim != 3 or regressors.shape[:2] != (T, ny):
        raise ValueError(
            f"u must be (T, ny, m) = ({T}, {ny}, m) with shared=True: a row of regressors for each output; "
            f"got shape {regressors.shape}."
        )
    return regressors


def noise_of_each(weights: Any, T: int, ny: int) -> Array:
    """Factors of the noise variance, (T, ny), from weights: number, (T,), or (T, ny) for outputs that differ."""
    given = as_numbers("weights", weights)
    if given.ndim < 2:
        return np.repeat(np.broadcast_to(noise_of(given, T), T)[:, None], ny, axis=1)
    if given.shape != (T, ny):
        raise ValueError(f"weights must be one number, ({T},) or ({T}, {ny}); got shape {given.shape}.")
    return noise_of(given.ravel(), given.size).reshape(T, ny)


def of_rows(model: Model, y: Any, u: Any, reading: Reading) -> dict[Hashable, Signals]:
    """Records as the first axis of arrays: y (units, T, ny), u (units, ..), time (T,) or (units, T)."""
    outputs = as_numbers("y", y)
    if outputs.ndim != 3:
        raise ValueError(f'by="row": y must be (units, T, {len(model.outputs)}); got shape {outputs.shape}.')
    inputs = None if u is None else as_numbers("u", u)
    if inputs is not None and inputs.shape[:2] != outputs.shape[:2]:
        raise ValueError(f'by="row": y has shape {outputs.shape}, so u cannot have shape {inputs.shape}.')
    axes = None if reading.time is None else np.asarray(reading.time)
    found: dict[Hashable, Signals] = {}
    for k, one in enumerate(outputs):
        time = axes[k] if axes is not None and axes.ndim > 1 else axes
        _, found[k] = of_arrays(model, one, None if inputs is None else inputs[k], replace(reading, time=time))
    return found


def of_table(
    model: Model, y: Any, u: Any, data: Any, by: Any, reading: Reading
) -> tuple[Model, dict[Hashable, Signals], Mapping[Hashable, str]]:
    """(the model with its outputs named, a record for each unit, the reasons of units without one) from a table.

    ``y`` lists the columns of the outputs, ``u`` those of the inputs (with shared=True a list for each output).
    """
    from driftfit.data.tables import read_records

    outputs = [y] if isinstance(y, str) else list(y)
    ny = len(model.outputs)
    if len(outputs) != ny:
        raise ValueError(f"track: y must name {ny} columns, one for each output; got {y!r}.")
    model, place = named_outputs(model, outputs)
    outputs = [outputs[j] for j in place]
    inputs = [] if u is None else [u] if isinstance(u, str) else list(u)
    if model.shared:
        inputs = [name for row in inputs for name in ([row] if isinstance(row, str) else row)]
    weights = reading.weights
    many = [] if isinstance(weights, str) or np.ndim(weights) == 0 else list(weights)
    many = [many[j] for j in place] if len(many) == ny else many
    columns = [*outputs[1:], *inputs, *many]
    common = replace(reading, weights=1.0 if many else weights)
    records, failed = read_records(data, outputs[0], columns, by, common)
    labels = replace(records.labels, y="y", u=(), by=("series",))
    found = {}
    for k, key in enumerate(records.keys):
        one = records.part(k)
        first, rest = one.y, one.u
        T, end, known = len(one), ny - 1 + len(inputs), one.known.over(len(one))
        each = rest[:, end:]
        noise = (
            noise_of_each(np.where(np.isfinite(each), each, 1.0), T, ny)
            if many
            else np.repeat(known.noise[:, None], ny, 1)
        )
        rows = slice(int(records.first[k]), int(records.first[k]) + T)
        factors = known.drift.copy() if records.drifts is None else records.drifts[rows]
        names: tuple[str, ...] = ()
        signals = np.ascontiguousarray(rest[:, ny - 1 : end])
        if model.shared:
            signals = signals.reshape(T, ny, -1)
        else:
            signals, names = ordered(model, signals, inputs)
        both = np.column_stack([first, rest[:, : ny - 1]])
        found[key] = Signals(both, signals, one.time, known.interval.copy(), noise, factors, replace(labels, u=names))
    return model, found, failed
