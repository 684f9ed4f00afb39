"""The reference of an alarm, a normal segment of a record: a number of first samples, or an interval of time."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any
from zoneinfo import ZoneInfo

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import whole
from driftfit.run.live.rule import FROZEN
from driftfit.run.result import burn_in

if TYPE_CHECKING:
    from driftfit.run.result import Track

LEAST = 20
"""Smallest number of samples of a reference after the start of the run."""


def burn(run: Track) -> int:
    """Number of samples at the beginning of a run that are not judged, because its estimate has just started."""
    return burn_in(run.model.n)


def least(kind: str, n: int) -> int:
    """Normal samples after the start of a run of n parameters that an alarm of a kind needs."""
    return max(100, 10 * n) if kind in FROZEN else LEAST


def in_samples(run: Track, reference: Any) -> Any:
    """A reference given as an interval of time, converted to samples; any other is returned unchanged."""
    if isinstance(reference, tuple | list) and len(reference) == 2:
        return tuple(_place(run, one) for one in reference)
    return reference


def normal_samples(run: Track, reference: Any) -> tuple[int, int]:
    """(first, end) of the normal samples, without the start of the run; ValueError if there are too few.

    ``reference`` is a number of first samples, or (from, to) in samples, without the last.
    """
    if len(run) < burn(run) + LEAST:
        raise ValueError(
            f"detect: a run of {len(run)} samples is too short for a reference: its first {burn(run)} samples are its "
            f"start, and at least {LEAST} normal ones are needed after them."
        )
    if isinstance(reference, tuple) and len(reference) == 2:
        first, end = reference
    elif reference is None or isinstance(reference, tuple | list):
        raise ValueError(
            'detect: give the normal range of the parameters, reference={"b1": (0.9, 1.1)}, the number of first '
            f"samples that are normal, reference=500, or an interval, reference=(from, to); got {reference!r}."
        )
    else:
        first, end = 0, whole("detect", "reference", reference, 1)
    used = max(first, burn(run))
    if not used + LEAST <= end <= len(run):
        raise ValueError(
            f"detect: the reference covers samples {first} to {end} of a run of {len(run)}, whose first {burn(run)} "
            f"are its start and do not count: {max(end - used, 0)} remain, and at least {LEAST} are needed."
            if end <= len(run)
            else f"detect: the reference ends at sample {end}, and the run has {len(run)}."
        )
    return used, end


def first_third(run: Track, usable: Array, least: int) -> tuple[int, int]:
    """(first, end) of the samples that are taken as normal where no reference was given: the first third of the record,
    and up to three quarters if fewer would have less than ``least`` ``usable`` samples.
    """
    enough = np.flatnonzero(np.cumsum(usable[burn(run) :]) >= least)
    needed = burn(run) + int(enough[0]) + 1 if enough.size else len(run)
    return normal_samples(run, max(len(run) // 3, min(needed, 3 * len(run) // 4)))


def _place(run: Track, given: Any) -> int:
    """The first sample at or after a time, or a sample number."""
    time = run.time
    if time.dtype.kind != "M":
        if isinstance(given, str | datetime | np.datetime64):
            raise ValueError(f"detect: reference names the time {given!r}, but this run has no dates (time=).")
        return int(np.searchsorted(time, float(given)))
    if isinstance(given, int | np.integer):
        return min(int(given), len(run))
    return int(np.searchsorted(time, as_date(given, run.labels.zone)))


def as_date(given: Any, zone: str | None) -> np.datetime64:
    """A date as a time of the record; one without a time zone is in that of the table that the record came from."""
    try:
        date = given if isinstance(given, np.datetime64) else datetime.fromisoformat(str(given))
    except ValueError:
        raise ValueError(f"detect: {given!r} is not a date; write it as 2024-03-01 or 2024-03-01 12:30.") from None
    if isinstance(date, np.datetime64):
        if zone is None:
            return date
        date = date.astype("datetime64[us]").item()
    if date.tzinfo is None and zone is not None:
        date = date.replace(tzinfo=ZoneInfo(zone))
    return np.datetime64(date if date.tzinfo is None else date.astimezone(UTC).replace(tzinfo=None))
