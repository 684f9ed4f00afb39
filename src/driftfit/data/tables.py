"""Tables: columns of data frames and files become records.

Anything that narwhals reads is a table (pandas, polars, pyarrow, lazy frames); so is a file (`driftfit.data.files`).

Rows belong to units (``by``) and are sorted by time within each unit, also by an index of dates if no time is given; of
several rows at the same time the first is used. Rows without a unit or without a time never become samples; they are
counted.
"""

from __future__ import annotations

import os
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import narwhals as nw
import numpy as np

from driftfit.data.arguments import dated, noise_of, ordered, warn_of_order, warn_of_repeats, warn_of_skipped_periods
from driftfit.data.arrays import named_outputs, noise_of_outputs
from driftfit.data.clock import LABEL, Clock
from driftfit.data.columns import Columns, Wanted
from driftfit.data.files import Files, read
from driftfit.data.instants import warn_of_counted_years, warn_of_written_numbers
from driftfit.data.limits import marks
from driftfit.data.record import Known, Labels, Reading, Records
from driftfit.engine.kernel import Array
from driftfit.engine.settings import factor, warn
from driftfit.models.base import Model


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
    output, inputs, keyed = _name("y", y), _names("u", u), _names("by", by)
    weights, drift = reading.weights, reading.drift
    if output in inputs:
        raise ValueError(
            f"u contains the output {output!r}, which would explain itself; its past is in models such as ARX."
        )
    each = () if isinstance(drift, str) or np.ndim(drift) == 0 else _names("drift", drift)
    factors = [*(name for name in (weights, drift) if isinstance(name, str)), *each]
    numbers = tuple(dict.fromkeys([output, *inputs, *factors]))
    data, axis, indexed = _dated(data, (*numbers, *keyed), reading)
    if axis == output:
        raise ValueError(f"time and y are both the column {output!r}.")
    columns, failed = read(data, Wanted(numbers, axis, keyed, marks(reading.missing)[0]))
    keys, code = _codes(columns)
    dt = reading.dt
    if axis is not None and columns.time is not None and reading.time is None:
        dt = LABEL if dt is None else dt
        if not _in_order(columns.time, code, axis, indexed):
            axis, columns = None, replace(columns, time=None)
    dropped: dict[Hashable, dict[str, int]] = {}
    order, times = _order(columns.time, code, keys, dropped)
    length = np.bincount(code[order], minlength=len(keys))
    failed |= {keys[k]: "no row has a time" for k in np.flatnonzero(length == 0)}
    there = np.flatnonzero(length)
    if not there.size and not keyed:
        why = f"none of the {columns.rows} rows has a time" if columns.rows else "the table has no rows"
        raise ValueError(f"there is nothing to track: {why}.")
    first = (np.cumsum(length) - length)[there]
    values = {name: column[order] for name, column in columns.numbers.items()}
    clock = Clock.of(dt, columns.zone)
    if times is not None:
        warn_of_counted_years(times)
        if clock.kind != LABEL:
            warn_of_written_numbers(times)
    gaps: Any = 1.0
    if times is not None:
        gaps = clock.steps(times)
        gaps[first] = 1.0
    known = Known.of(
        gaps,
        _factor(weights, values, noise_of),
        _factor(1.0 if each else drift, values, partial(factor, "drift")),
    )
    drifts = np.stack([_factor(name, values, partial(factor, "drift")) for name in each], axis=1) if each else None
    signals = np.stack([values[name] for name in inputs], axis=1) if inputs else np.zeros((len(order), 0))
    units = {**columns.units, **(reading.units or {})}
    labels = Labels(y, inputs, axis, units, columns.zone, {}, keyed, dt=clock.plain)
    found = tuple(keys[k] for k in there)
    return Records(found, first, length[there], values[y], signals, known, times, labels, dropped, drifts), failed


def _dated(data: Any, used: Sequence[str], reading: Reading) -> tuple[Any, str | None, bool]:
    """(the table, the column of its times, whether that was its index).

    If no time is given, dates label the rows: an index of dates, or the only column of dates that is not ``used``.
    """
    if reading.time is not None or not reading.indexed or isinstance(data, str | os.PathLike | list | tuple | Files):
        return data, None if reading.time is None else _name("time", reading.time), False
    index: Any = getattr(data, "index", None)
    if dated(index):
        names = (index.name if isinstance(index.name, str) else "time", "time", "index of dates")
        axis = next(name for name in names if name not in data.columns)
        if reading.dt is None:
            warn_of_skipped_periods(index.unique().sort_values())
        stamps = index.to_timestamp() if hasattr(index, "to_timestamp") else index
        return data.set_axis(stamps).reset_index(names=axis), axis, True
    frame = nw.from_native(data, pass_through=True)
    schema = frame.collect_schema() if isinstance(frame, nw.DataFrame | nw.LazyFrame) else {}
    dates = [name for name, kind in schema.items() if kind in (nw.Date, nw.Datetime) and name not in used]
    return data, dates[0] if len(dates) == 1 else None, False


def _in_order(time: Array, code: Array, axis: str, indexed: bool) -> bool:
    """Whether dates that nobody named as the time are the times: those of an index, or of a column if no two rows of a
    series share one. Warns if the table is in another order.
    """
    listed, sorts = np.argsort(code, kind="stable"), np.lexsort((time, code))
    inside, advance = (code[listed][1:] == code[listed][:-1]), (time[listed][1:] >= time[listed][:-1])
    again = (time[sorts][1:] == time[sorts][:-1]) & inside
    lost = int(again.sum() + np.isnat(time).sum())
    sort = indexed or not lost
    if not advance[inside].all():
        if sort:
            warn_of_order(axis)
        else:
            warn(
                f"data: the rows are not in the order of {axis!r}, in which {lost} of them have no date or that of "
                f"another row, and are used in the order of the table; give time={axis!r}, by= the column that tells "
                "series apart, or sort the table."
            )
    return sort


def _name(argument: str, value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"with data=, {argument} is the name of a column; got {type(value).__name__}.")
    return value


def _names(argument: str, value: Any) -> tuple[str, ...]:
    given = () if value is None else (value,) if isinstance(value, str) else tuple(value)
    return tuple(_name(argument, name) for name in given)


def _codes(columns: Columns) -> tuple[list[Hashable], Array]:
    """(keys in order of appearance, the index of each row's key, -1 for rows without a key)."""
    if not columns.by:
        return [0], np.zeros(columns.rows, dtype=np.int64)
    index: dict[Hashable, int] = {}
    tuples = (None if None in row else row for row in zip(*columns.by, strict=True))
    rows: Iterable[Hashable] = columns.by[0] if len(columns.by) == 1 else tuples
    code = np.fromiter((-1 if key is None else index.setdefault(key, len(index)) for key in rows), np.int64)
    return list(index), code


def _order(
    time: Array | None, code: Array, keys: Sequence[Hashable], dropped: dict[Hashable, dict[str, int]]
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
    if repeated.any():
        warn_of_repeats(int(repeated.sum()), len(order))
    order = order[~repeated]
    return order, time[order]


def _count(dropped: dict[Hashable, dict[str, int]], keys: Sequence[Hashable], code: Array, reason: str) -> None:
    for k, count in zip(*np.unique(code, return_counts=True), strict=True):
        dropped.setdefault(keys[k], {})[reason] = int(count)


def _factor(given: Any, values: Mapping[str, Array], convert: Any) -> Array:
    """A known factor, given as one number or the name of a column; a cell without a value is 1."""
    if not isinstance(given, str):
        return np.asarray(convert(given))
    column = np.where(np.isfinite(values[given]), values[given], 1.0)
    return np.asarray(convert(column, len(column)))


def from_table(
    model: Model, y: Any, u: Any, data: Any, by: Any, reading: Reading
) -> tuple[Model, Records, Mapping[Hashable, str]]:
    """(the model with its outputs named, a series for each unit, the reasons of units without one) from a table.

    ``y`` names the column of the output, or lists those of several; ``u`` those of the inputs (with shared=True a list
    for each output). Errors are those of `read_records`.
    """
    u, ny = model.input_names or None if u is None else u, len(model.outputs)
    if ny == 1:
        return model, *read_records(data, y, u, by, reading)
    given = [y] if isinstance(y, str) else list(y)
    if len(given) != ny:
        raise ValueError(f"track: y must name {ny} columns, one for each output; got {y!r}.")
    model, place = named_outputs(model, given)
    given = [given[j] for j in place]
    inputs = [] if u is None else [u] if isinstance(u, str) else list(u)
    if model.shared:
        inputs = [name for row in inputs for name in ([row] if isinstance(row, str) else row)]
    weights: Any = reading.weights
    own = [] if isinstance(weights, str) or np.ndim(weights) == 0 else list(weights)
    own = [own[j] for j in place] if len(own) == ny else own
    common = reading._replace(weights=1.0 if own else weights)
    read, failed = read_records(data, given[0], [*given[1:], *inputs, *own], by, common)
    N, end = len(read.y), ny - 1 + len(inputs)
    outputs, signals, factors = np.split(read.u, [ny - 1, end], axis=1)
    signals, names = np.ascontiguousarray(signals), tuple[str, ...]()
    if model.shared:
        signals = signals.reshape(N, ny, -1)
    else:
        signals, names = ordered(model, signals, inputs)
    noise = np.repeat(read.known.over(N).noise[:, None], ny, axis=1)
    if own:
        noise = noise_of_outputs(np.where(np.isfinite(factors), factors, 1.0), N, ny)
    labels = replace(read.labels, y="y", u=names)
    both, known = np.column_stack([read.y, outputs]), read.known.for_outputs(noise)
    return model, read._replace(y=both, u=signals, known=known, labels=labels, outputs=model.outputs), failed
