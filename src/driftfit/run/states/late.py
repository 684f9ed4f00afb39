"""Late rows: samples wait until the newest time of their series is ``hold`` after them, and are released in order of
time.

With W the newest time minus hold, before some rows arrive and of what is known by then,

    time <= W                            late, or repeated if it is the newest time: left out and counted
    time of a row that waits or arrives  repeated: the first of them stands
    otherwise                            waits, until time <= newest - hold

so a series is processed in the order of its times, whatever the order within ``hold`` in which its rows arrive: the
result is that of the sorted record. The order of rows that arrive together does not matter, other than which of several
rows at one time is the first.
"""

from __future__ import annotations

from collections import Counter
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


class HoldBack:
    """The rows of one series that wait, for a stream.

    Parameters
    ----------
    hold : number, timedelta64 or timedelta
        How far behind the newest time a row may be; 0 lets nothing wait.
    """

    def __init__(self, hold: Any) -> None:
        self.hold = np.timedelta64(hold) if hasattr(hold, "total_seconds") else hold
        if not self.hold >= (np.timedelta64(0) if isinstance(self.hold, np.timedelta64) else 0):
            raise ValueError(f"HoldBack: hold must not be negative; got {hold!r}.")
        self.newest: Any = None
        self.times: Array = np.zeros(0)
        self.rows: list[Any] = []
        self.counts: Counter[str] = Counter()

    def __len__(self) -> int:
        """How many rows wait."""
        return len(self.rows)

    def take(self, times: Sequence[Any], rows: Sequence[Any]) -> tuple[Array, list[Any]]:
        """Give rows with their times; returns those that are released now, in the order of their times."""
        given = np.asarray(times)
        given = given.astype("M8[us]" if given.dtype.kind == "M" else float)
        time = np.concatenate([self.times.astype(given.dtype), given])
        before = np.array(["NaT" if given.dtype.kind == "M" else np.nan], given.dtype)
        if self.newest is not None:
            before[0] = self.newest
        every = [*self.rows, *rows]
        waited = np.arange(len(time)) < len(self.rows)
        order, fate, (self.newest,) = sort_out(np.zeros(len(time), int), time, waited, before, self.hold)
        for code, reason in REASONS.items():
            self.counts[reason] += int((fate == code).sum())
        going, staying = order[fate == RELEASED], order[fate == WAITING]
        self.times, self.rows = time[staying], [every[k] for k in staying]
        return time[going], [every[k] for k in going]

    def rest(self) -> tuple[Array, list[Any]]:
        """The rows that still wait, when no more will arrive."""
        found = self.times, self.rows
        self.times, self.rows = self.times[:0], []
        return found
