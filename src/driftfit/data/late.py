"""Late rows: samples wait until the newest time of their series is ``hold`` after them, and are released in order of
time.

Let W be the newest time minus hold before some rows arrive. A row of time t is

    t <= W                               late, or repeated if t is the newest time: left out and counted
    t is the time of another such row    repeated: the first of them is used
    otherwise                            kept until t <= newest - hold

so a series is processed in the order of its times, whatever the order within ``hold`` in which its rows arrive: the
result is that of the sorted record. The order of rows that arrive together does not matter, other than which of several
rows at one time is the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array

RELEASED, WAITING, LATE, REPEATED, UNTIMED = range(5)
"""Fates of a row."""
REASONS = {LATE: "late", REPEATED: "at a repeated time", UNTIMED: "without a time"}


class Fates(NamedTuple):
    """Fates of rows."""

    order: Array
    """The rows, sorted by series and by time; rows without a time come last in their series."""
    fate: Array
    """One of the constants above, for each row in that order."""
    newest: Array
    """(series,): the newest time of each; NaN or NaT while there is none."""


def sort_out(series: Array, time: Array, waited: Array, newest: Array, hold: Any) -> Fates:
    """Decide on rows of many series: those that have waited, before the others, and those that arrive.

    Parameters
    ----------
    series : (N,)
        The number of each row's series.
    time : (N,)
        Numbers or datetime64; NaN or NaT where a row has none.
    waited : (N,) bool
        Which rows waited before: `sort_out` has decided on them already.
    newest : (series,)
        The newest time so far, in the type of ``time``; NaN or NaT before the first row.
    hold : number or timedelta64
        Not negative.
    """
    if not hold and not waited.any() and (ends := all_in_order(series, time, newest)) is not None:
        after = newest.copy()
        after[series[ends]] = time[ends]
        return Fates(np.arange(len(time)), np.full(len(time), RELEASED), after)
    order = np.lexsort((time, series))
    series, time, arriving = series[order], time[order], ~waited[order]
    untimed = np.isnat(time) if time.dtype.kind == "M" else ~np.isfinite(time)
    after = newest.copy()
    np.fmax.at(after, series[~untimed], time[~untimed])
    # NaN and NaT compare as false
    fate = np.where(time <= (after - hold)[series], RELEASED, WAITING)
    before = newest[series]
    fate[arriving & (time <= before - hold)] = LATE
    again = np.zeros(len(time), bool)
    again[1:] = (series[1:] == series[:-1]) & (time[1:] == time[:-1])
    fate[arriving & (again | (time == before)) & ((fate != LATE) | (time == before))] = REPEATED
    fate[untimed] = UNTIMED
    return Fates(order, fate, after)


def ended(fate: Array, over: Array) -> Array:
    """Fates (N,) where rows are of a series that is ``over`` (N,): what waits is released, since nothing else comes."""
    return np.where((fate == WAITING) & over, RELEASED, fate)


def all_in_order(series: Array, time: Array, newest: Array) -> Array | None:
    """The last row of every series if all rows are sorted and each is after the one before; None otherwise.

    Most rows arrive in this order, and checking it takes a fifth of the time of sorting the rows and deciding on each.
    """
    if not len(time) or time.dtype.kind != "f" or not np.isfinite(time).all() or (series[1:] < series[:-1]).any():
        return None
    ends = np.append(np.flatnonzero(series[1:] != series[:-1]), len(series) - 1)
    before = np.empty(len(time))
    before[1:] = time[:-1]
    begin = np.append(0, ends[:-1] + 1)
    before[begin] = newest[series[begin]]
    return None if (time <= before).any() else ends


class HoldBack:
    """The rows of many series that wait, each with a time and numbers.

    Series are known by their places in the arrays (S,) of newest times that callers keep.

    Parameters
    ----------
    hold : number
        How far behind the newest time of its series a row may be; 0 lets nothing wait.
    columns : int
        Numbers of a row.
    """

    def __init__(self, hold: float, columns: int) -> None:
        if not hold >= 0:
            raise ValueError(f"HoldBack: hold must not be negative; got {hold!r}.")
        self.hold = hold
        self.series: Array = np.zeros(0, np.int64)
        self.time: Array = np.zeros(0)
        self.rows: Array = np.zeros((0, columns))

    def __len__(self) -> int:
        """How many rows wait."""
        return len(self.time)

    def judge(self, series: Array, time: Array, newest: Array) -> tuple[Array, Array]:
        """(those of the rows (N,) that `take` would take, sorted by series and time; the fates (N,) of all).

        Nothing is changed.
        """
        waiting, fates = self._sorted_out(series, time, newest)
        arriving = fates.order >= len(waiting)
        taken = arriving & ((fates.fate == RELEASED) | (fates.fate == WAITING))
        fate = np.empty(len(time), fates.fate.dtype)
        fate[fates.order[arriving] - len(waiting)] = fates.fate[arriving]
        return fates.order[taken] - len(waiting), fate

    def take(self, series: Array, time: Array, rows: Array, newest: Array) -> tuple[Array, Array, Array]:
        """Give rows (N, columns); returns (series, time, rows) of those that are released, sorted by series and time.

        ``newest`` (S,) is brought up to date.
        """
        waiting, fates = self._sorted_out(series, time, newest)
        newest[...] = fates.newest
        every = [
            np.concatenate([old[waiting], new]) for old, new in zip(self._columns(), (series, time, rows), strict=True)
        ]
        going, staying = (fates.order[fates.fate == code] for code in (RELEASED, WAITING))
        self._keep(np.delete(np.arange(len(self)), waiting), [column[staying] for column in every])
        return every[0][going], every[1][going], every[2][going]

    def of(self, one: int) -> tuple[Array, Array]:
        """(times, rows) of a series that wait."""
        own = slice(*np.searchsorted(self.series, (one, one + 1)))
        return self.time[own], self.rows[own]

    def put(self, one: int, time: Array, rows: Array) -> None:
        """Replace the waiting rows of a series."""
        own = [np.full(len(time), one), time, rows]
        self._keep(np.flatnonzero(self.series != one), own)

    def _columns(self) -> tuple[Array, Array, Array]:
        return self.series, self.time, self.rows

    def _sorted_out(self, series: Array, time: Array, newest: Array) -> tuple[Array, Fates]:
        """(the rows of these series that wait, the fates of those rows and then of the given ones)."""
        there = np.zeros(len(newest), bool)
        there[series] = True
        waiting = np.flatnonzero(there[self.series])
        waited = np.arange(len(waiting) + len(time)) < len(waiting)
        every = (np.concatenate([self.series[waiting], series]), np.concatenate([self.time[waiting], time]))
        return waiting, sort_out(*every, waited, newest, self.hold)

    def _keep(self, which: Array, more: Sequence[Array]) -> None:
        """Store these rows, and more, as all that wait, sorted by series and time."""
        if not len(which) and not len(more[0]) and not len(self):
            return
        every = [np.concatenate([old[which], new]) for old, new in zip(self._columns(), more, strict=True)]
        order = np.lexsort((every[1], every[0]))
        self.series, self.time, self.rows = (column[order] for column in every)
