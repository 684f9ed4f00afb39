"""Roles: what each column of a table is, so that y, u, time and key need not be given.

| role | a column |
|---|---|
| time | that holds dates, or, where none does, the first whose numbers only increase |
| key | of text with few values; or the records between the places where the clock runs back |
| label | of 0 and 1 that seldom changes, such as an operator's mark of a fault |
| left out | of other text, a constant, a copy of another column, a second clock |
| output | named, or the only column of numbers that is left |
| inputs | the other columns of numbers |

Fault codes and spikes are missing, in inputs as in y: a reading so far from all others that the gap between them is
`FAR` times their range, single or repeated in all digits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
"""Ranges of the other readings by which a fault code is away from them."""
FEW = 50
"""Values that a column of text may have to be a key."""
SWITCHES = 0.02
"""Share of rows at which a column of 0 and 1 may change to be a label."""
ALIKE = 1e-6
"""How far below 1 the correlation of two copies may be."""


@dataclass(frozen=True)
class Roles:
    """What each column is, and the record: y (T,), U (T, m), time (T,) or None, key of every row.

    ``why``: the reason for which a column is no input. ``refused``: readings taken as missing, by column. ``missing``:
    readings that were missing already. ``step``: the nominal interval, in seconds for dates, 1 without a time.
    """

    output: str
    inputs: tuple[str, ...]
    clock: str | None
    by: str | None
    y: Array
    U: Array
    time: Array | None
    key: tuple[Any, ...]
    step: float
    why: Mapping[str, str] = field(default_factory=dict)
    refused: Mapping[str, int] = field(default_factory=dict)
    missing: int = 0
    units: Mapping[str, str] = field(default_factory=dict)
    zone: str | None = None
    labels: tuple[str, ...] = ()

    @property
    def dt(self) -> Any:
        """dt= of `track`."""
        if self.time is None:
            return None
        return np.timedelta64(round(self.step * 1e6), "us") if self.time.dtype.kind == "M" else self.step

    @property
    def share_refused(self) -> float:
        """Share of the readings taken as missing, of the column that has most of them."""
        return max(self.refused.values(), default=0) / max(len(self.y), 1)

    def record(self, key: Any) -> Roles:
        """The rows of one key."""
        at = np.array([one == key for one in self.key])
        return self.rows(np.flatnonzero(at))

    def rows(self, at: Array) -> Roles:
        time = None if self.time is None else self.time[at]
        return replace(self, y=self.y[at], U=self.U[at], time=time, key=tuple(self.key[t] for t in at), by=None)

    def centred(self) -> Roles:
        """The same with signals of mean 0 in every record, whose levels may differ."""
        y, U, keys = self.y.copy(), self.U.copy(), np.array([str(one) for one in self.key])
        for key in dict.fromkeys(keys):
            at = keys == key
            y[at], U[at] = y[at] - np.nanmean(y[at]), U[at] - np.nanmean(U[at], axis=0)
        return replace(self, y=y, U=U)

    def table(self) -> pl.DataFrame:
        """The record as a table that `track` reads."""
        columns: dict[str, Any] = {self.output: self.y, **dict(zip(self.inputs, self.U.T, strict=True))}
        if self.clock is not None:
            columns[self.clock] = self.time
        table = pl.DataFrame(columns if self.by is None else {**columns, self.by: self.key})
        if self.zone is not None and self.clock is not None:
            zoned = pl.col(self.clock).dt.replace_time_zone("UTC").dt.convert_time_zone(self.zone)
            table = table.with_columns(zoned)
        return table

    def spread(self, longest: int) -> tuple[Array, Array, Array]:
        """y, U on a regular grid, inf where a gap in time is, and the place of every row; ``longest`` rows part records."""
        gap = np.ones(len(self.y), dtype=int)
        if self.time is not None:
            seconds = np.diff(self.time) / (np.timedelta64(1, "s") if self.time.dtype.kind == "M" else 1.0)
            gap[1:] = np.clip(np.round(seconds / self.step), 1, longest)
        if self.by is not None:
            gap[1:][[a != b for a, b in zip(self.key, self.key[1:], strict=False)]] = longest
        place = np.cumsum(gap) - 1
        y, U = np.full(place[-1] + 1, np.inf), np.full((place[-1] + 1, self.U.shape[1]), np.inf)
        y[place], U[place] = self.y, self.U
        return y, U, place


class NoAnswerError(ValueError):
    """Raised for a record that cannot answer; the message says what it would need."""


def roles(
    data: Any,
    y: str | None = None,
    *,
    u: Sequence[str] | None = None,
    not_u: Sequence[str] = (),
    time: str | None = None,
    dt: float | None = None,
    by: str | None = None,
    limits: Mapping[str, tuple[float | None, float | None]] | None = None,
    wanted: Wanted | None = None,
) -> Roles:
    """The roles of the columns of a table or file; ValueError for names that it does not have, and without a y."""
    frame, units = _frame(data, wanted or Wanted(()))
    names = frame.columns
    for name in filter(None, (y, time, by, *(u or ()), *not_u)):
        if name not in names:
            raise ValueError(f"identify: no column {name!r}; {near(name, names)}")
    numbers, texts = _numbers(frame, names)
    clock, axis, zone, why = _clock(frame, names, numbers, texts, time, {y, by, *(u or ())})
    refused: dict[str, int] = {}
    for name, x in numbers.items():
        low, high = (limits or {}).get(name, (None, None))
        outside = (x < (-np.inf if low is None else low)) | (x > (np.inf if high is None else high))
        bad = outside | far_off(np.where(outside, np.nan, x))
        if bad.any() and name != clock:
            numbers[name], refused[name] = np.where(bad, np.nan, x), int(bad.sum())
    given = {y, *(u or ())}
    labels = tuple(name for name in numbers if name not in given and name != by and _is_label(numbers[name]))
    why |= dict.fromkeys(labels, "labels of 0 and 1")
    why |= {name: "left out by --not-u" for name in not_u}
    left = [name for name in numbers if name not in (clock, by, *why)]
    if y is None:
        candidates = [name for name in left if _moves(numbers[name])]
        if len(candidates) != 1:
            raise ValueError(f"identify: name the output with --y; the columns of numbers are {', '.join(candidates)}.")
        y = candidates[0]
    if y not in numbers:
        raise NoAnswerError(f"The output {y} is text: {texts.get(y, '')!r} is not a number. Numbers are needed.")
    kept: list[str] = []
    for name in left if u is None else u:
        if name == y:
            continue
        reason = "" if u is not None else _reason(name, numbers, [y, *kept], axis)
        if reason:
            why[name] = reason
        else:
            kept.append(name)
    if u is not None:
        why |= {name: "not in --u" for name in left if name not in (y, *u)}
    key, by = _key(frame, texts, by, axis)
    why |= {name: "text" for name in texts if name not in (by, clock)}
    U = np.column_stack([numbers[name] for name in kept]) if kept else np.zeros((len(frame), 0))
    found = Roles(y, tuple(kept), clock, by, numbers[y], U, axis, key, 1.0, why, refused, 0, units, zone, labels)
    return _sorted(found, dt)


def _sorted(found: Roles, dt: float | None) -> Roles:
    """The record by key and time, without rows that repeat a time or have none, and its interval."""
    step = 1.0 if dt is None else dt
    if found.time is not None:
        place = {key: k for k, key in enumerate(dict.fromkeys(found.key))}
        number = np.array([place[key] for key in found.key])
        time = found.time
        timely = ~np.isnat(time) if time.dtype.kind == "M" else np.isfinite(time)
        order = np.lexsort((time, number))
        order = order[timely[order]]
        again = np.append(False, (np.diff(time[order]) == np.zeros(1, time.dtype) - np.zeros(1, time.dtype))
                          & (np.diff(number[order]) == 0))  # fmt: skip
        found = found.rows(order[~again]) if found.by is None else replace(found.rows(order[~again]), by=found.by)
        if dt is None:
            steps = np.diff(found.time)[[a == b for a, b in zip(found.key, found.key[1:], strict=False)]]
            steps = steps / np.timedelta64(1, "s") if time.dtype.kind == "M" else steps
            step = float(np.median(steps)) if len(steps) else 1.0
    missing = int(np.sum(~np.isfinite(found.y)) + np.sum(~np.isfinite(found.U))) - sum(
        found.refused.get(name, 0) for name in (found.output, *found.inputs)
    )
    kept = {name: count for name, count in found.refused.items() if name in (found.output, *found.inputs)}
    return replace(found, step=step, missing=max(missing, 0), refused=kept)


def far_off(x: Array) -> Array:
    """Which readings are fault codes or spikes."""
    bad = np.zeros(len(x), bool)
    for _ in range(10):
        rest = np.where(bad, np.nan, x)
        known = np.sort(rest[np.isfinite(rest)])
        if len(known) < 20:
            break
        found = False
        for extreme, others in ((known[0], known[known > known[0]]), (known[-1], known[known < known[-1]])):
            if len(others) < 0.8 * len(known):
                continue
            span = np.ptp(others[int(0.005 * len(others)) : max(int(0.995 * len(others)), 1)])
            away = np.min(np.abs(others - extreme))
            if span > 0.0 and away > FAR * span and len(np.unique(others)) > 2:
                bad |= x == extreme
                found = True
        if not found:
            break
    return bad


def _frame(data: Any, wanted: Wanted) -> tuple[pl.DataFrame | Any, dict[str, str]]:
    """The table with all columns, as narwhals sees it, and units."""
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


def _numbers(frame: Any, names: Sequence[str]) -> tuple[dict[str, Array], dict[str, str]]:
    """The columns of numbers, and of the others a cell that is none."""
    numbers, texts = {}, {}
    for name in names:
        try:
            x = numbers_of(frame[name], "", 1)
            numbers[name] = np.where(np.abs(x) < 1e100, x, np.nan)
        except (ValueError, TypeError):
            cells = [cell for cell in frame[name].to_list() if cell is not None and not _number(cell)]
            texts[name] = str(cells[0]) if cells else ""
    return numbers, texts


def _number(cell: Any) -> bool:
    try:
        float(cell)
    except (TypeError, ValueError):
        return False
    return True


def _clock(
    frame: Any,
    names: Sequence[str],
    numbers: dict[str, Array],
    texts: dict[str, str],
    time: str | None,
    taken: set[Any],
) -> tuple[str | None, Array | None, str | None, dict[str, str]]:
    """(name of the time, times, zone, other clocks with the reason)."""
    found: dict[str, tuple[Array, str | None]] = {}
    for name in names if time is None else [time]:
        if name in texts:
            try:
                found[name] = times_of_column(frame[name], "identify", 1)
            except (ValueError, TypeError) as error:
                if time is not None:
                    raise ValueError(f"identify: --time {time}: {error}") from None
        elif name == time:
            found[name] = numbers[name], None
    counting = [name for name in numbers if time is None and name not in taken and _increases(numbers[name])]
    found |= {name: (numbers[name], None) for name in counting if not found}
    why = {name: "a second clock" for name in (*found, *counting)}
    if not found:
        return None, None, None, why
    clock = next(iter(found))
    del why[clock]
    for name in found:
        texts.pop(name, None)
    return clock, *found[clock], why


def _increases(x: Array) -> bool:
    """Whether a column of numbers counts: complete, and increasing by even steps nearly everywhere."""
    if len(x) < 3 or not np.isfinite(x).all():
        return False
    step = np.diff(x)
    return bool(np.mean(step > 0.0) > 0.99 and np.mean(np.abs(step - np.median(step)) < 0.5 * np.median(step)) > 0.8)


def _is_label(x: Array) -> bool:
    known = x[np.isfinite(x)]
    return bool(len(known)) and bool(np.isin(known, (0.0, 1.0)).all()) and _moves(x) and bool(
        np.mean(np.diff(known) != 0.0) < SWITCHES
    )  # fmt: skip


def _moves(x: Array) -> bool:
    known = x[np.isfinite(x)]
    return len(known) > 1 and bool(np.ptp(known) > 1e-12 * np.max(np.abs(known)))


def _reason(name: str, numbers: Mapping[str, Array], others: Sequence[str], axis: Array | None) -> str:
    """Why a column of numbers is no input; empty if it is one."""
    x = numbers[name]
    if not _moves(x):
        return "constant"
    if np.mean(np.isfinite(x)) < 0.5:
        return f"{100.0 * np.mean(~np.isfinite(x)):.0f} % missing"
    for other in others:
        both = np.isfinite(x) & np.isfinite(numbers[other])
        if both.sum() > 2 and np.ptp(x[both]) > 0.0 and np.ptp(numbers[other][both]) > 0.0:
            if abs(np.corrcoef(x[both], numbers[other][both])[0, 1]) > 1.0 - ALIKE:
                return f"a copy of {other}"
    return ""


def _key(
    frame: Any, texts: Mapping[str, str], by: str | None, axis: Array | None
) -> tuple[tuple[Any, ...], str | None]:
    """(key of every row, name of the column): given, of text with few values, or where the clock runs back."""
    T = len(frame)
    if by is not None:
        return tuple(frame[by].to_list()), by
    kinds = {name: frame[name].to_list() for name in texts}
    few = {name: len(set(cells)) for name, cells in kinds.items() if 2 <= len(set(cells)) <= min(FEW, T // 30)}
    if few:
        name = max(few, key=lambda one: few[one])
        return tuple(kinds[name]), name
    if axis is not None:
        back = np.append(False, np.diff(axis) < np.zeros(1, axis.dtype) - np.zeros(1, axis.dtype))
        if 0 < back.sum() <= T // 100:
            return tuple(f"record {k + 1}" for k in np.cumsum(back)), "record"
    return (0,) * T, None
