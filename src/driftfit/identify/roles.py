"""Roles: what each column of a table is, so that y, u, time and key need not be given.

| role | a column |
|---|---|
| time | that holds dates, or, where none does, the first whose numbers increase by even steps |
| key | of text with few values; or the records between the places where the clock runs back |
| label | of 0 and 1 that changes at less than `SWITCHES` of the rows, such as an operator's mark of a fault |
| left out | of other text, a constant, a copy of another column, a second clock, mostly empty |
| output | named, or the only column of numbers that is left |
| inputs | the other columns of numbers |

Fault codes and spikes are missing, in inputs as in y: a reading, single or repeated in all digits, between which and
all others there is a gap of `FAR` times their range.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import narwhals as nw
import numpy as np
import polars as pl

from driftfit.data.columns import FILE, Wanted, numbers_of, times_of_column
from driftfit.data.files import paths_of, read_file
from driftfit.engine.kernel import Array
from driftfit.engine.settings import near

FAR = 3.0
CALENDAR = {"month": (28.0, 31.0), "quarter": (90.0, 92.0), "year": (365.0, 366.0)}
"""Days of the steps of the calendar."""
FEW = 50
"""Values that a column of text may have to be a key."""
SWITCHES = 0.02
ALIKE = 1e-6
"""How far below 1 the correlation of two copies may be."""


class NoAnswerError(ValueError):
    """Raised for a record that cannot answer; the message says what it would need."""


@dataclass(frozen=True)
class Roles:
    """The columns, and the record: y (T,), U (T, m), time (T,) or None, key of every row.

    ``step``: nominal interval, in seconds for dates. ``why``: why a column is no input. ``refused``: readings taken as
    missing, by column. ``missing``: readings that were missing already.
    """

    output: str
    inputs: tuple[str, ...]
    clock: str | None
    by: str | None
    y: Array
    U: Array
    time: Array | None
    key: tuple[Any, ...]
    step: float = 1.0
    why: Mapping[str, str] = field(default_factory=dict)
    refused: Mapping[str, int] = field(default_factory=dict)
    missing: int = 0
    units: Mapping[str, str] = field(default_factory=dict)
    zone: str | None = None

    @property
    def dated(self) -> bool:
        return self.time is not None and self.time.dtype.kind == "M"

    @property
    def dt(self) -> float | str | None:
        """dt= of `track`: a number, a step of the calendar, or seconds."""
        if not self.dated:
            return None if self.time is None else self.step
        days = self.step / 86400.0
        steps = (step for step, (low, high) in CALENDAR.items() if low <= days <= high)
        return next(steps, f"{round(1e6 * self.step)}us" if self.step % 1.0 else f"{self.step:.0f}s")

    @property
    def groups(self) -> Array:
        """(T,): number of the record of every row."""
        place = {key: k for k, key in enumerate(dict.fromkeys(self.key))}
        return np.array([place[key] for key in self.key])

    def rows(self, at: Array) -> Roles:
        """Some rows."""
        time = None if self.time is None else self.time[at]
        return replace(self, y=self.y[at], U=self.U[at], time=time, key=tuple(self.key[t] for t in at))

    def record(self, key: Any) -> Roles:
        """The rows of one key."""
        return replace(self.rows(np.array([t for t, one in enumerate(self.key) if one == key])), by=None)

    def centred(self) -> Roles:
        """The same with signals of mean 0 in every record, because their levels may differ."""
        y, U, groups = self.y.copy(), self.U.copy(), self.groups
        for k in range(groups.max() + 1):
            y[groups == k] -= np.nanmean(y[groups == k])
            U[groups == k] -= np.nanmean(U[groups == k], axis=0)
        return replace(self, y=y, U=U)

    def table(self) -> pl.DataFrame:
        """The record as a table that `track` reads."""
        columns: dict[str, Any] = {self.output: self.y, **dict(zip(self.inputs, self.U.T, strict=True))}
        columns |= ({} if self.clock is None else {self.clock: self.time}) | (
            {} if self.by is None else {self.by: self.key}
        )
        table = pl.DataFrame(columns)
        if self.zone is None or self.clock is None:
            return table
        return table.with_columns(pl.col(self.clock).dt.replace_time_zone("UTC").dt.convert_time_zone(self.zone))

    def signals(self, inputs: Sequence[str]) -> dict[str, Any]:
        """The arguments of `track` for some inputs."""
        units = {name: unit for name, unit in self.units.items() if name in (*inputs, self.output)} or None
        given = {"y": self.output, "u": list(inputs) or None, "data": self.table(), "time": self.clock}
        return given | {"dt": self.dt, "units": units}

    def spread(self, longest: int) -> tuple[Array, Array, Array]:
        """y, U on a regular grid, inf in gaps of time, and the place of every row; ``longest`` rows part records."""
        gap = np.ones(len(self.y), dtype=int)
        if self.time is not None:
            gap[1:] = np.clip(np.round(_steps(self.time) / self.step), 1, longest)
        gap[1:][np.diff(self.groups) != 0] = longest
        place = np.cumsum(gap) - 1
        y, U = np.full(place[-1] + 1, np.inf), np.full((place[-1] + 1, self.U.shape[1]), np.inf)
        y[place], U[place] = self.y, self.U
        return y, U, place


def roles(
    data: Any, y: str | None = None, *, u: Sequence[str] | None = None, not_u: Sequence[str] = (),
    time: str | None = None, dt: float | None = None, by: str | None = None,
    limits: Mapping[str, tuple[float | None, float | None]] | None = None, codes: bool = True,
    wanted: Wanted | None = None,
) -> Roles:  # fmt: skip
    """The roles of the columns of a table or file; ValueError for names that it does not have, and without a y."""
    frame, units = _frame(data, wanted or Wanted(()))
    for name in filter(None, (y, time, by, *(u or ()), *not_u, *(limits or ()))):
        if name not in frame.columns:
            raise ValueError(f"identify: no column {name!r}; {near(name, frame.columns)}")
    numbers, texts = _numbers(frame)
    given = {y, by, *(u or ())}
    clock, axis, zone, why = _clock(frame, numbers, texts, time, given)
    why |= dict.fromkeys(not_u, "left out by --not-u")
    why |= {name: "labels of 0 and 1" for name, x in numbers.items() if name not in given and _is_label(x)}
    left = [name for name in numbers if name not in (clock, by, *why)]
    if y is None:
        left = [name for name in left if _moves(numbers[name])]
        if len(left) != 1:
            raise ValueError(f"identify: name the output with --y; the columns of numbers are {', '.join(left)}.")
        y = left[0]
    if y not in numbers:
        raise NoAnswerError(f"the output {y} holds text, such as {frame[y][0]!r}; numbers are needed.")
    refused = {}
    for name in {*left, y, *(u or ())} & numbers.keys():
        low, high = (limits or {}).get(name, (None, None))
        x = numbers[name]
        bad = (x < (-np.inf if low is None else low)) | (x > (np.inf if high is None else high))
        bad |= far_off(np.where(bad, np.nan, x)) & codes
        numbers[name], refused[name] = np.where(bad, np.nan, x), int(bad.sum())
    kept: list[str] = []
    for name in (one for one in left if one != y and u is None):
        why |= {name: reason} if (reason := _reason(numbers, name, [y, *kept])) else {}
        kept += [] if name in why else [name]
    kept = list(u) if u is not None else kept
    why |= {name: "not in --u" for name in left if u is not None and name not in (y, *u)}
    key, by = _key(frame, texts, by, axis)
    why |= {name: "text" for name in texts if name != by}
    U = np.column_stack([numbers[name] for name in kept]) if kept else np.zeros((len(frame), 0))
    refused = {name: refused[name] for name in (y, *kept) if refused[name]}
    missing = int(np.sum(~np.isfinite(numbers[y])) + np.sum(~np.isfinite(U))) - sum(refused.values())
    found = Roles(y, tuple(kept), clock, by, numbers[y], U, axis, key, dt or 1.0, why, refused, missing, units, zone)
    return _in_order(found, dt)


def _in_order(found: Roles, dt: float | None) -> Roles:
    """The record by key and time, without rows that repeat a time or have none, and with its interval."""
    if found.time is None:
        return found
    time, groups = found.time, found.groups
    order = np.lexsort((time, groups))
    order = order[~(np.isnat(time) if found.dated else ~np.isfinite(time))[order]]
    new = (_steps(time[order]) != 0.0) | (np.diff(groups[order]) != 0)
    found = found.rows(order[np.append(True, new)])
    within = np.diff(found.groups) == 0
    step = float(np.median(_steps(found.time)[within])) if within.any() else 1.0  # type: ignore[arg-type]
    return replace(found, step=step if dt is None else dt)


def _steps(time: Array) -> Array:
    """Intervals (T - 1,), in seconds for dates."""
    return np.diff(time) / np.timedelta64(1, "s") if time.dtype.kind == "M" else np.diff(time)


def far_off(x: Array) -> Array:
    """Which readings are fault codes or spikes."""
    bad = np.zeros(len(x), bool)
    for sign in (1.0, -1.0) * 5:
        known = np.sort(sign * x[np.isfinite(x) & ~bad])
        others = known[known < known[-1]] if len(known) else known
        if len(others) < 20 or len(others) < 0.8 * len(known) or len(np.unique(others)) < 3:
            continue
        span = np.ptp(others[len(others) // 200 : len(others) - len(others) // 200])
        if known[-1] - others[-1] > FAR * span > 0.0:
            bad |= sign * x == known[-1]
    return bad


def _frame(data: Any, wanted: Wanted) -> tuple[Any, dict[str, str]]:
    """The table with all columns, as narwhals sees it, and its units."""
    if isinstance(data, Mapping):
        data = pl.DataFrame({name: np.asarray(column) for name, column in data.items()})
    if not isinstance(data, str | list | tuple) and not hasattr(data, "__fspath__"):
        frame = nw.from_native(data)
        return (frame.collect() if isinstance(frame, nw.LazyFrame) else frame), {}
    paths = paths_of(data)
    read = [read_file(path, wanted, path) for path in paths]
    if len(read) == 1:
        return read[0]
    parts = [one.to_native().with_columns(pl.lit(path).alias(FILE)) for path, (one, _) in zip(paths, read, strict=True)]
    return nw.from_native(pl.concat(parts, how="diagonal_relaxed"), eager_only=True), read[0][1]


def _numbers(frame: Any) -> tuple[dict[str, Array], list[str]]:
    """The columns of numbers, and the names of the others."""
    numbers, texts = {}, []
    for name in frame.columns:
        try:
            x = numbers_of(frame[name], "", 1)
            numbers[name] = np.where(np.abs(x) < 1e100, x, np.nan)
        except (ValueError, TypeError):
            texts.append(name)
    return numbers, texts


def _clock(
    frame: Any, numbers: dict[str, Array], texts: list[str], time: str | None, given: set[Any]
) -> tuple[str | None, Array | None, str | None, dict[str, str]]:
    """(name of the time, times, zone, other clocks with the reason)."""
    found: dict[str, tuple[Array, str | None]] = {} if time not in numbers else {time: (numbers[time], None)}
    for name in [*texts] if time is None else {time} & {*texts}:
        try:
            found[name] = times_of_column(frame[name], "identify", 1)
            texts.remove(name)
        except (ValueError, TypeError) as error:
            if time is not None:
                raise ValueError(f"identify: --time {time}: {error}") from None
    counting = [name for name, x in numbers.items() if time is None and name not in given and _counts(x)]
    found = found or {name: (numbers[name], None) for name in counting}
    if not found:
        return None, None, None, {}
    clock = next(iter(found))
    return clock, *found[clock], {name: "a second clock" for name in (*found, *counting) if name != clock}


def _counts(x: Array) -> bool:
    """Whether a column of numbers is complete and increases by even steps nearly everywhere."""
    if len(x) < 3 or not np.isfinite(x).all():
        return False
    step, usual = np.diff(x), float(np.median(np.diff(x)))
    return bool(np.mean(step > 0.0) > 0.99 and np.mean(np.abs(step - usual) < 0.5 * usual) > 0.8)


def _is_label(x: Array) -> bool:
    known = x[np.isfinite(x)]
    return _moves(x) and bool(np.isin(known, (0.0, 1.0)).all()) and float(np.mean(np.diff(known) != 0.0)) < SWITCHES


def _moves(x: Array) -> bool:
    known = x[np.isfinite(x)]
    return len(known) > 1 and bool(np.ptp(known) > 1e-12 * np.max(np.abs(known)))


def _reason(numbers: Mapping[str, Array], name: str, others: Iterable[str]) -> str:
    """Why a column of numbers is no input; empty if it is one."""
    x = numbers[name]
    if not _moves(x):
        return "constant"
    if np.mean(np.isfinite(x)) < 0.5:
        return "mostly empty"
    for other in others:
        both = np.isfinite(x) & np.isfinite(numbers[other])
        pair = np.stack([x[both], numbers[other][both]])
        if both.sum() > 2 and np.ptp(pair, axis=1).all() and abs(np.corrcoef(pair)[0, 1]) > 1.0 - ALIKE:
            return f"a copy of {other}"
    return ""


def _key(frame: Any, texts: Sequence[str], by: str | None, axis: Array | None) -> tuple[tuple[Any, ...], str | None]:
    """(key of every row, name of the column): given, of text with few values, or where the clock runs back."""
    count = {name: len(set(frame[name].to_list())) for name in texts}
    few = [name for name in texts if 2 <= count[name] <= min(FEW, len(frame) // 30)]
    by = by or max(few, key=lambda name: count[name], default=None)
    if by is not None:
        return tuple(frame[by].to_list()), by
    back = np.append(False, _steps(axis) < 0.0) if axis is not None else np.zeros(len(frame), bool)
    if 0 < back.sum() <= len(frame) // 100:
        return tuple(f"record {k + 1}" for k in np.cumsum(back)), "record"
    return (0,) * len(frame), None
