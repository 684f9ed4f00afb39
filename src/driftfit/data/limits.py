"""Valid ranges of signals, numbers that mean "no value", and intervals to leave out: they are missing and counted.

    limits = {"flow": (0, 80), "pressure": (None, 16)}     a number outside its range counts as missing
    missing = ["Offline", -999]                            texts of files and tables, and numbers of any signal
    exclude = [("2024-03-01", "2024-03-04"), (500, 620)]   from, to: both are included, None leaves an end open

Names are those of columns; for arrays they are "y", the names of the outputs or inputs of the model, "u" for every
input, and "u1", "u2", .. or 0, 1, .. for one of them. Intervals are given in times, or in sample numbers if there is no
time. A day, a month or a year as the end ("2024-03-04", a date) includes that whole day, month or year, and dates
without a zone are in the zone of the table.

A sample of an excluded interval is not used at all: its output and its inputs are missing, so none of them enters a
lag, and later samples whose lags reach into the interval are skipped as well. (If the signals of an interval are
correct but should not be learned from, give ``weights`` of 0: they then still enter the lags.)
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from datetime import date, datetime, timedelta
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np

from driftfit.data.instants import instant, span, with_hyphens
from driftfit.engine.kernel import Array
from driftfit.engine.settings import near


class Limits:
    """Valid ranges of ny outputs and m inputs: ``low`` and ``high`` (ny + m,), infinite if there is no limit.

    A stream's replace values outside their range by NaN, and count them.
    """

    def __init__(self, limits: Mapping[Any, Any], outputs: Sequence[str], inputs: Sequence[str], m: int) -> None:
        if not isinstance(limits, Mapping):
            raise ValueError(f"limits: give a (low, high) for each signal, as in {{'y': (0, 80)}}; got {limits!r}.")
        self.given, self.ny = dict(limits), len(outputs)
        self.names = (*outputs, *(inputs or (f"u{j + 1}" for j in range(m))))
        self.low, self.high = np.full(self.ny + m, -np.inf), np.full(self.ny + m, np.inf)
        self._counts = np.zeros(self.ny + m, dtype=np.int64)
        for key, bounds in limits.items():
            low, high = _bounds(key, bounds)
            for place in self._places(key, m):
                self.low[place], self.high[place] = low, high

    def _places(self, key: Any, m: int) -> list[int]:
        """The signals to which a key of the mapping refers."""
        if isinstance(key, int | np.integer) and 0 <= key < m:
            return [self.ny + int(key)]
        if key in self.names:
            return [place for place, name in enumerate(self.names) if name == key]
        plain = {f"u{j + 1}": [self.ny + j] for j in range(m)} | {"u": list(range(self.ny, self.ny + m))}
        plain |= {"y": [0]} if self.ny == 1 else {}
        if plain.get(key):
            return plain[key]
        raise ValueError(f"limits: there is no signal {key!r}; {near(str(key), self.names)}")

    def outside(self, y: Array, u: Array) -> tuple[Array, Array]:
        """Which values of y (.., ny) and u (.., m) are outside their ranges."""
        ny = self.ny
        out_y = (y < self.low[:ny]) | (y > self.high[:ny])
        return out_y, (u < self.low[ny:]) | (u > self.high[ny:])

    @property
    def counts(self) -> dict[str, int]:
        """How many numbers were outside their range, by signal."""
        found = zip(self.names, self._counts.tolist(), strict=True)
        return {name: count for name, count in found if count}

    def sample(self, y: Array, u: Array) -> tuple[Array, Array]:
        """Outputs (.., ny) and inputs (.., m) of one sample or several; values outside are counted."""
        out_y, out_u = self.outside(y, u)
        self._counts += np.concatenate([out.sum(axis=tuple(range(out.ndim - 1))) for out in (out_y, out_u)])
        return np.where(out_y, np.nan, y), np.where(out_u, np.nan, u)

    def inputs(self, u: Array) -> Array:
        """Inputs (.., m) of a query; values outside are not counted."""
        return np.where(self.outside(self.low[: self.ny], u)[1], np.nan, u)

    def plain(self) -> list[Any]:
        """Ranges and counts as plain data; `restore` takes the counts."""
        return [list(self.given.items()), self._counts.tolist()]

    def restore(self, counts: Sequence[int]) -> None:
        self._counts[:] = counts


def _bounds(key: Any, bounds: Any) -> tuple[float, float]:
    """(low, high) of one signal."""
    try:
        low, high = (end if end is None else float(end) for end in bounds)
    except (TypeError, ValueError):
        raise ValueError(f"limits: {key!r} must be (low, high), with None for no limit; got {bounds!r}.") from None
    found = (-np.inf if low is None else low, np.inf if high is None else high)
    if not found[0] < found[1]:
        raise ValueError(f"limits: the lower limit of {key!r} must be below the upper one; got {bounds!r}.")
    return found


def within(intervals: Any, time: Array | None, number: Array, zone: str | None = None, what: str = "exclude") -> Array:
    """Which samples are in one of the intervals; ``number`` (N,) counts the samples of each series."""
    inside = np.zeros(len(number), dtype=bool)
    axis = number if time is None else time
    for interval in intervals:
        if isinstance(interval, str) or not isinstance(interval, Sequence | np.ndarray) or len(interval) != 2:
            raise ValueError(f"{what}: each interval must be (from, to), in a list; got {interval!r}.")
        low, high = (end_of(what, one, axis, zone, upper) for upper, one in enumerate(interval))
        if low is not None and high is not None and not low <= high:
            raise ValueError(f"{what}: an interval must not end before it begins; got {interval!r}.")
        inside |= (True if low is None else axis >= low) & (True if high is None else axis <= high)
    return inside


def within_each(
    exclude: Any, keys: Sequence[Any], owner: Array, time: Array | None, number: Array, zone: str | None
) -> Array:
    """Which samples of concatenated series are excluded: one list of intervals for all, or one for each key."""
    if not isinstance(exclude, Mapping):
        return within(exclude or (), time, number, zone)
    absent = [key for key in exclude if key not in keys]
    if absent:
        raise ValueError(f"exclude: there is no series {absent[0]!r}; {near(str(absent[0]), list(map(str, keys)))}")
    inside = np.zeros(len(number), dtype=bool)
    for k, key in enumerate(keys):
        if key in exclude:
            rows = owner == k
            inside[rows] = within(exclude[key], None if time is None else time[rows], number[rows], zone)
    return inside


def end_of(what: str, given: Any, axis: Array, zone: str | None, upper: int) -> Any:
    """One end of an interval in the kind of the axis; a day or longer, as the upper end, includes its last moment."""
    if given is None:
        return None
    try:
        if axis.dtype.kind != "M":
            return float(given)
        stamp = _stamp(given, upper)
        unit = np.datetime_data(stamp.dtype)[0] if isinstance(stamp, np.datetime64) else ""
        coarse = unit in ("Y", "M", "W", "D")
        after = stamp + np.array(upper, f"m8[{unit}]") if coarse else instant(stamp)
        moment = _in_utc(after.astype("datetime64[us]") if coarse else after, stamp, zone)
        if not isinstance(moment, np.datetime64):
            raise TypeError("a number")
        return moment - np.timedelta64(1, "us") if coarse and upper else moment
    except (TypeError, ValueError):
        kind = "a date or a datetime" if axis.dtype.kind == "M" else "a number"
        raise ValueError(
            f"{what}: for this record an end of an interval must be {kind}, or None; got {given!r}."
        ) from None


def _stamp(given: Any, upper: int) -> Any:
    """Text and days as datetime64 in the resolution in which they were given, of periods the first or last day; text
    with a zone as a datetime.
    """
    if isinstance(given, date) and not isinstance(given, datetime):
        return np.datetime64(given)
    if not isinstance(given, str):
        return given
    if (found := span(given)) is not None:
        return np.datetime64(found[1] - timedelta(1) if upper else found[0])
    zoned = re.search(r"\d\d:\d\d.*([+-]\d\d:?\d\d|Z)$", given.strip())
    if not zoned and np.isnat(np.datetime64(with_hyphens(given))):
        raise ValueError("not a date")
    return datetime.fromisoformat(given) if zoned else np.datetime64(with_hyphens(given))


def _in_utc(moment: Any, given: Any, zone: str | None) -> Any:
    """A moment given without a zone is in that of the table."""
    if zone is None or getattr(given, "tzinfo", None) is not None:
        return moment
    return instant(moment.astype("datetime64[us]").item().replace(tzinfo=ZoneInfo(zone)))


def marked(keys: Sequence[Any], owner: Array, reasons: Mapping[str, Array]) -> dict[Any, dict[str, int]]:
    """Counts by key and by reason, from counts (N,) of each sample; ``owner`` (N,) is the number of its series."""
    counts: dict[Any, dict[str, int]] = {}
    for reason, numbers in reasons.items():
        found = np.bincount(owner, weights=numbers, minlength=len(keys))
        for k in np.flatnonzero(found).tolist():
            counts.setdefault(keys[k], {})[reason] = int(found[k])
    return counts


def marks(missing: Any) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """What a user says means "no value", one text or number or several of them, as (texts, numbers)."""
    texts, numbers = [], []
    for one in (missing,) if isinstance(missing, str | int | float) else missing or ():
        if isinstance(one, bool) or not isinstance(one, str | int | float | np.number):
            raise ValueError(f"missing: give texts or numbers that mean no value, as in ['Off', -999]; got {one!r}.")
        try:
            numbers.append(float(one))
        except ValueError:
            texts.append(str(one))
    return tuple(texts), tuple(numbers)
