"""Roles: what each column of a table is, so that y, u, time and key need not be given.

The time holds dates, or, where no column does, is the first whose numbers increase by even steps. The key is text with
few values, whose records follow each other or share their times, or tells the records between which the clock runs
back. A label is 0 or 1 and changes at less than `SWITCHES` of the rows, as an operator's mark of a fault. Inputs are
the other columns of numbers, without constants, copies, second clocks and what is mostly empty. Fault codes and spikes
are missing, in inputs as in y (`driftfit.readings.screen.apart`).
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import narwhals as nw
import numpy as np
import polars as pl

from driftfit.data.clock import Clock, median_interval
from driftfit.data.columns import FILE, Wanted, numbers_of, times_of_column
from driftfit.data.files import paths_of, read_file, table_frame
from driftfit.engine.kernel import Array
from driftfit.engine.settings import near
from driftfit.identify.scores import FEWEST
from driftfit.readings.screen import apart

SWITCHES = 0.02
BACK = "the clock, which runs back"
ALIKE = 1e-6
"""How far below 1 the correlation of two copies may be."""


class NoAnswerError(ValueError):
    """Raised for a record that cannot answer; the message says what it would need."""


@dataclass(frozen=True)
class Roles:
    """The columns, and the record: y (T,), U (T, m), time (T,) or None, key of every row.

    ``dt``: nominal interval, as for `track`. ``why``: why a column is no input. ``refused``: readings taken as
    missing, by column. ``missing``: readings that were missing already. ``dropped``: rows
    without a time or with one that another row has. ``options``: how the file was read, as options of the command.
    """

    output: str
    inputs: tuple[str, ...]
    clock: str | None
    by: str | None
    y: Array
    U: Array
    time: Array | None
    key: tuple[Any, ...]
    dt: float | str | None = None
    why: Mapping[str, str] = field(default_factory=dict)
    refused: Mapping[str, int] = field(default_factory=dict)
    missing: int = 0
    dropped: int = 0
    units: Mapping[str, str] = field(default_factory=dict)
    options: str = ""
    zone: str | None = None

    @property
    def plain(self) -> dict[str, Any]:
        """What is not data of single rows."""
        return {
            one: getattr(self, one) for one in ["output", "inputs", "clock", "by", "dt", "why", "refused", "missing"]
        }

    @property
    def groups(self) -> Array:
        """(T,): number of the record of every row."""
        place = {key: k for k, key in enumerate(dict.fromkeys(self.key))}
        return np.array([place[key] for key in self.key])

    @property
    def parts(self) -> list[Array]:
        """The rows of every record."""
        groups = self.groups
        return np.split(np.argsort(groups, kind="stable"), np.cumsum(np.bincount(groups))[:-1])

    def rows(self, at: Array) -> Roles:
        """Some rows."""
        time = None if self.time is None else self.time[at]
        return replace(self, y=self.y[at], U=self.U[at], time=time, key=tuple(self.key[t] for t in at))

    def last(self, count: int) -> Roles:
        """The last rows of every record; without a clock their numbers are the time."""
        at = np.sort(np.concatenate([part[-count:] for part in self.parts]))
        kept = self.rows(at)
        return kept if self.time is not None else replace(kept, time=at.astype(float), dt=1.0)

    def centred(self) -> Roles:
        """The same with signals of mean 0 in every record, because their levels may differ."""
        means = np.array([np.nanmean(np.column_stack([self.y, self.U])[at], axis=0) for at in self.parts])[self.groups]
        return replace(self, y=self.y - means[:, 0], U=self.U - means[:, 1:])

    def signals(self, inputs: Sequence[str]) -> dict[str, Any]:
        """The arguments of `track` for some inputs."""
        columns: dict[str, Any] = {self.output: self.y, **dict(zip(self.inputs, self.U.T, strict=True))}
        table = pl.DataFrame(columns | ({} if self.by is None else {self.by: self.key}))
        clock = None if self.time is None else self.clock or "number of the row"
        if clock is not None:
            time = pl.Series(clock, self.time)
            time = time.dt.replace_time_zone("UTC").dt.convert_time_zone(self.zone) if self.zone else time
            table = table.with_columns(time)
        units = {name: unit for name, unit in self.units.items() if name in (*inputs, self.output)} or None
        given = {"y": self.output, "u": list(inputs) or None, "data": table, "time": clock}
        return given | {"dt": self.dt, "units": units}

    def spread(self, longest: int) -> tuple[Array, Array, Array]:
        """y, U on a regular grid, inf in gaps of time, and the place of every row; ``longest`` rows part records."""
        steps = np.ones(len(self.y)) if self.time is None else Clock.of(self.dt, self.zone).steps(self.time)
        gap = np.clip(np.round(steps), 1, longest).astype(int)
        gap[1:][np.diff(self.groups) != 0] = longest
        place = np.cumsum(gap) - gap[0]
        y, U = np.full(place[-1] + 1, np.inf), np.full((place[-1] + 1, self.U.shape[1]), np.inf)
        y[place], U[place] = self.y, self.U
        return y, U, place


def roles(
    data: Any, y: str | None = None, *, u: Sequence[str] | None = None, not_u: Sequence[str] = (),
    time: str | None = None, dt: float | str | None = None, by: str | None = None,
    limits: Mapping[str, tuple[float | None, float | None]] | None = None, codes: bool = True,
    wanted: Wanted | None = None,
) -> Roles:  # fmt: skip
    """The roles of the columns of a table or file; ValueError for names that it does not have, and without a y."""
    frame, units = _frame(data, wanted or Wanted(()))
    if len(several := [name for name in str(y).split(",") if name in frame.columns]) > 1 and y not in frame.columns:
        raise ValueError(f"identify: it explains one output; call it for {' and for '.join(several)}.")
    for name in filter(None, (y, time, by, *(u or ()), *not_u, *(limits or ()))):
        if name not in frame.columns:
            raise ValueError(f"identify: no column {name!r}; {near(name, frame.columns)}")
    numbers, texts = _numbers(frame)
    given = {y, by, *(u or ())}
    clock, axis, zone, why = _clock(frame, numbers, texts, time, given, wanted or Wanted(()))
    why |= dict.fromkeys(not_u, "left out by --not-u")
    why |= {name: "labels of 0 and 1" for name, x in numbers.items() if name not in given and _is_label(x)}
    left = [name for name in numbers if name not in (clock, by, *why)]
    if y is None:
        left = [name for name in left if _moves(numbers[name])]
        if not left:
            raise NoAnswerError("no column holds numbers that move; one output is needed.")
        if len(left) > 1:
            raise ValueError(f"identify: name the output, y= or --y; columns of numbers: {', '.join(left)}.")
        y = left[0]
    if worded := [name for name in (y, *(u or ())) if name not in numbers]:
        cell = str(frame[worded[0]][0])
        hint = " (--decimal , reads decimal commas)" if "," in cell else ""
        raise NoAnswerError(f"{worded[0]} holds text, such as {cell!r}; numbers are needed{hint}.")
    refused, kept = {}, list(u or ())
    for name in {*left, y, *kept} & numbers.keys():
        low, high = (limits or {}).get(name) or (None, None)
        x = numbers[name]
        bad = (x < (-np.inf if low is None else low)) | (x > (np.inf if high is None else high))
        bad |= apart(np.where(bad, np.nan, x)) & codes
        numbers[name], refused[name] = np.where(bad, np.nan, x), int(bad.sum())
    why |= {name: "not in --u" for name in left if kept and name not in (y, *kept)}
    for name in (one for one in left if one != y and u is None):
        if reason := _reason(numbers, name, [y, *kept]):
            why[name] = reason
        else:
            kept.append(name)
    key, by = _key(frame, [name for name in texts if name not in not_u], by, axis)
    why |= {name: "text, see --dates and --by" for name in texts if name != by}
    U = np.column_stack([numbers[name] for name in kept]) if kept else np.zeros((len(frame), 0))
    refused = {name: refused[name] for name in (y, *kept) if refused[name]}
    missing = int(np.sum(~np.isfinite(numbers[y])) + np.sum(~np.isfinite(U))) - sum(refused.values())
    known = numbers[y][np.isfinite(numbers[y])]
    if len(known) < FEWEST:
        raise NoAnswerError(f"{len(known)} of {len(frame)} rows hold {y}; at least {FEWEST} are needed.")
    if not _moves(known):
        raise NoAnswerError(f"{y} is {known[0]:g} in all {len(known)} rows; it must move to be explained.")
    found = Roles(y, tuple(kept), clock, by, numbers[y], U, axis, key, dt, why, refused, missing, units=units,
                  options=_options(wanted or Wanted(()), limits or {}), zone=zone)  # fmt: skip
    return _in_order(found)


def _options(wanted: Wanted, limits: Mapping[str, tuple[float | None, float | None]]) -> str:
    """How a file was read, as options of the command."""
    given = [("decimal", wanted.decimal)] if wanted.decimal != "." else []
    given += [(name, text) for name in ("separator", "dates") if (text := getattr(wanted, name))]
    given += [("missing", text) for text in wanted.missing]
    ends = {name: ["" if one is None else f"{one:g}" for one in both] for name, both in limits.items()}
    given += [("limits", f"{name}={low}:{high}") for name, (low, high) in ends.items()]
    return "".join(f" --{name} {shlex.quote(text)}" for name, text in given)


def _in_order(found: Roles) -> Roles:
    """The record by key and time, without rows that repeat a time or have none, and with its interval."""
    if found.time is None:
        return found.rows(np.argsort(found.groups, kind="stable"))
    order = np.lexsort((found.time, found.groups))
    order = order[np.isfinite(found.time[order])]
    time, groups = found.time[order], found.groups[order]
    if np.bincount(groups, minlength=1).max() < 2:
        raise NoAnswerError(f"no record has two rows with a time (--time {found.clock}, --by {found.by}).")
    new = np.append(True, (time[1:] != time[:-1]) | (groups[1:] != groups[:-1]))
    dt = median_interval(time[new], found.zone)[1] if found.dt is None and new.sum() > 1 else found.dt
    return replace(found.rows(order[new]), dt=dt, dropped=len(found.time) - int(new.sum()))


def _frame(data: Any, wanted: Wanted) -> tuple[Any, dict[str, str]]:
    """The table with all columns, as narwhals sees it, and its units."""
    if isinstance(data, Mapping):
        data = pl.DataFrame({name: np.asarray(column) for name, column in data.items()})
    if not isinstance(data, str | list | tuple) and not hasattr(data, "__fspath__"):
        return table_frame(data), {}
    paths = paths_of(data)
    read = [read_file(path, wanted, path) for path in paths]
    parts = [one.to_native().with_columns(pl.lit(path).alias(FILE)) for path, (one, _) in zip(paths, read, strict=True)]
    whole = nw.from_native(pl.concat(parts, how="diagonal_relaxed"), eager_only=True) if parts[1:] else read[0][0]
    return whole, read[0][1]


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
    frame: Any, numbers: dict[str, Array], texts: list[str], time: str | None, given: set[Any], wanted: Wanted
) -> tuple[str | None, Array | None, str | None, dict[str, str]]:
    """(name of the time, times, zone, other clocks with the reason)."""
    found: dict[str, tuple[Array, str | None]] = {}
    for name in [*texts] if time is None else {time} & {*texts}:
        try:
            found[name] = times_of_column(frame[name], "identify", 1, wanted.dates, wanted.missing)
            texts.remove(name)
        except (ValueError, TypeError) as error:
            if time is not None:
                raise ValueError(f"identify: --time {time}: {error}") from None
    free = () if time is not None or len(frame) < FEWEST else numbers.keys() - given
    found |= {name: (x, None) for name, x in numbers.items() if name == time or (name in free and _counts(x))}
    clock = next(iter(found), None)
    return clock, *found.get(clock or "", (None, None)), {name: "a second clock" for name in found if name != clock}


def _counts(x: Array) -> bool:
    """Whether a column of numbers is complete and increases by even steps nearly everywhere."""
    step, middle = np.diff(x), float(np.median(np.diff(x)))
    return bool(np.mean(np.abs(step - middle) < 0.5 * middle) > 0.8 and np.mean(step > 0.0) > 0.99)


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
    """(key of every row, name of the column): given, of text with few values, or where the clock runs back.

    Text that changes to and fro in one time is a state of one plant, and no key. Few rows that are late are no records.
    """
    cells = {name: frame[name].to_list() for name in texts}
    count = {name: len(set(column)) for name, column in cells.items()}
    together = axis is not None and len(np.unique(axis)) < len(axis)
    few = [name for name, column in cells.items() if 2 <= count[name] <= len(frame) // 30
           and (together or sum(a != b for a, b in pairwise(column)) < count[name])]  # fmt: skip
    by = by or max(few, key=lambda name: count[name], default=None)
    if by is not None:
        return tuple(frame[by].to_list()), by
    back = np.append(False, axis[1:] < axis[:-1]) if axis is not None else np.zeros(len(frame), bool)
    late = np.sum(axis < np.fmax.accumulate(axis)) if axis is not None else 0
    if back.sum() <= len(frame) // 100 < late:
        return tuple(f"record {k + 1}" for k in np.cumsum(back)), BACK
    return (0,) * len(frame), None
