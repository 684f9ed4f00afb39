"""Tables: columns of data frames and files become records.

Anything that narwhals reads is a table (pandas, polars, pyarrow, lazy frames); so is a file (`driftfit.data.files`).

Rows belong to units (``by``) and are sorted by time within each unit; of several rows at the same time the first is
used. Rows without a unit or without a time never become samples; they are counted.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from driftfit.data.clock import LABEL, Clock
from driftfit.data.columns import Columns, Wanted
from driftfit.data.files import read
from driftfit.data.known import Known
from driftfit.data.labels import dated, warn_of_skipped_periods
from driftfit.data.limits import marks
from driftfit.data.record import Labels, Reading, Records, drift_of
from driftfit.data.signals import noise_of
from driftfit.data.times.instants import warn_of_counted_years, warn_of_summer_time, warn_of_written_numbers
from driftfit.engine.kernel import Array


def read_records(
    data: Any, y: str, u: str | Sequence[str] | None, by: str | Sequence[str] | None, reading: Reading
) -> tuple[Records, dict[Hashable, str]]:
    """Columns of a table as records, and the reasons why units and files have none.

    Raises
    ------
    ValueError
        For a column that does not exist (with near matches), a cell that is not a number (with row and value), a file
        that cannot be read, or a single series without a usable row. With ``by``, a unit without a usable row is left
        out and has a reason; all units may be left out.
    """
    data, reading = _dated(data, by, reading)
    output, inputs = _name("y", y), _names("u", u)
    weights, drift, time = reading.weights, reading.drift, reading.time
    if output in inputs:
        raise ValueError(
            f"u contains the output {output!r}, which would explain itself; its past is in models such as ARX."
        )
    axis = None if time is None else _name("time", time)
    if axis == output:
        raise ValueError(f"time and y are both the column {output!r}.")
    each = () if isinstance(drift, str) or np.ndim(drift) == 0 else _names("drift", drift)
    factors = [*(name for name in (weights, drift) if isinstance(name, str)), *each]
    wanted = Wanted(
        tuple(dict.fromkeys([output, *inputs, *factors])), axis, _names("by", by), marks(reading.missing)[0]
    )
    columns, failed = read(data, wanted)
    keys, code = _codes(columns)
    dropped: dict[Hashable, dict[str, int]] = {}
    order, times = _order(columns.time, columns.zone, code, keys, dropped)
    length = np.bincount(code[order], minlength=len(keys))
    failed |= {keys[k]: "no row has a time" for k in np.flatnonzero(length == 0)}
    there = np.flatnonzero(length)
    if not there.size and not wanted.by:
        why = f"none of the {columns.rows} rows has a time" if columns.rows else "the table has no rows"
        raise ValueError(f"there is nothing to track: {why}.")
    first = (np.cumsum(length) - length)[there]
    values = {name: column[order] for name, column in columns.numbers.items()}
    clock = Clock.of(reading.dt, columns.zone)
    if times is not None:
        warn_of_counted_years(times)
        if clock.kind != LABEL:
            warn_of_written_numbers(times)
    known = Known.of(
        1.0 if times is None else _gaps(times, first, clock),
        _factor(weights, values, noise_of),
        _factor(1.0 if each else drift, values, drift_of),
    )
    drifts = np.stack([_factor(name, values, drift_of) for name in each], axis=1) if each else None
    signals = np.stack([values[name] for name in inputs], axis=1) if inputs else np.zeros((len(order), 0))
    labels = Labels(
        y, inputs, axis, {**columns.units, **(reading.units or {})}, columns.zone, {}, wanted.by, dt=clock.plain
    )
    named = tuple(keys[k] for k in there)
    return Records(named, first, length[there], values[y], signals, known, times, labels, dropped, drifts), failed


def _dated(data: Any, by: Any, reading: Reading) -> tuple[Any, Reading]:
    """A data frame with an index of dates in order, if no time is given: the index as a column that labels samples."""
    index: Any = getattr(data, "index", None)
    if reading.time is not None or by is not None or not reading.indexed or not dated(index):
        return data, reading
    if not (index.is_monotonic_increasing and index.is_unique):
        return data, reading
    name = index.name if isinstance(index.name, str) else "time"
    if name in data.columns:
        return data, reading
    if reading.dt is None:
        warn_of_skipped_periods(index)
    stamps = index.to_timestamp() if hasattr(index, "to_timestamp") else index
    return data.set_axis(stamps).reset_index(names=name), reading._replace(
        time=name, dt=LABEL if reading.dt is None else reading.dt
    )


def _name(argument: str, value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"with data=, {argument} is the name of a column; got a {type(value).__name__}.")
    return value


def _names(argument: str, value: Any) -> tuple[str, ...]:
    given = () if value is None else (value,) if isinstance(value, str) else tuple(value)
    return tuple(_name(argument, name) for name in given)


def _codes(columns: Columns) -> tuple[list[Hashable], Array]:
    """(keys in order of appearance, the index of each row's key, -1 for rows without a key)."""
    if not columns.by:
        return [0], np.zeros(columns.rows, dtype=np.int64)
    index: dict[Hashable, int] = {}
    rows: Iterator[Hashable] = iter(columns.by[0]) if len(columns.by) == 1 else _tuples(columns.by)
    code = np.fromiter((-1 if key is None else index.setdefault(key, len(index)) for key in rows), np.int64)
    return list(index), code


def _tuples(by: Sequence[Sequence[Any]]) -> Iterator[Hashable]:
    for row in zip(*by, strict=True):
        yield None if None in row else row


def _order(
    time: Array | None,
    zone: str | None,
    code: Array,
    keys: Sequence[Hashable],
    dropped: dict[Hashable, dict[str, int]],
) -> tuple[Array, Array | None]:
    """(the rows that become samples, unit by unit and sorted by time; their times); the other rows are counted."""
    _count(dropped, [None], np.zeros(int((code < 0).sum()), dtype=np.int64), "without a unit")
    if time is None:
        order = np.argsort(code, kind="stable")
        return order[code[order] >= 0], None
    timeless = np.isnat(time) if time.dtype.kind == "M" else ~np.isfinite(time)
    _count(dropped, keys, code[timeless & (code >= 0)], "without a time")
    order = np.lexsort((time, code))
    order = order[(code[order] >= 0) & ~timeless[order]]
    repeated = np.zeros(len(order), dtype=bool)
    repeated[1:] = (np.diff(code[order]) == 0) & (time[order][1:] == time[order][:-1])
    _count(dropped, keys, code[order[repeated]], "at a repeated time")
    warn_of_summer_time(time[order[repeated]], zone)
    order = order[~repeated]
    return order, time[order]


def _count(dropped: dict[Hashable, dict[str, int]], keys: Sequence[Hashable], code: Array, reason: str) -> None:
    for k, count in zip(*np.unique(code, return_counts=True), strict=True):
        dropped.setdefault(keys[k], {})[reason] = int(count)


def _gaps(time: Array, first: Array, clock: Clock) -> Array:
    """Nominal intervals since the previous sample of the same unit; 1 at the first."""
    gaps = clock.steps(time)
    gaps[first] = 1.0
    return gaps


def _factor(given: Any, values: Mapping[str, Array], convert: Any) -> Array:
    """A known factor, given as one number or the name of a column; a cell without a value is 1."""
    if not isinstance(given, str):
        return np.asarray(convert(given))
    column = np.where(np.isfinite(values[given]), values[given], 1.0)
    return np.asarray(convert(column, len(column)))
