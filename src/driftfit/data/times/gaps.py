"""Gaps: intervals across which lags do not reach, and warnings where a wrong dt makes most samples unusable."""

from __future__ import annotations

import numpy as np

from driftfit.data.clock import Clock, duration_text
from driftfit.engine.kernel import Array
from driftfit.engine.settings import warn
from driftfit.models.base import GAP

LOOK = 20
"""Number of samples after which a stream warns if most of them cannot be used."""


def median_interval(time: Array, zone: str | None = None) -> tuple[str, str]:
    """(the median interval of a record in words, the dt that fits it best)."""
    middle = np.sort(np.diff(time))[(len(time) - 1) // 2]
    if time.dtype.kind != "M":
        return f"{middle:g}", f"dt={middle:g}"
    best, name = max(0.9, float(np.mean(np.abs(np.diff(time) / middle - 1.0) < 1e-3))), duration_text(middle)
    for step in ("business day", "month", "quarter", "year"):
        fit = float(np.mean(Clock.of(step, zone).steps(time)[1:] == 1.0))
        best, name = (fit, step) if fit > best else (best, name)
    return duration_text(middle), f"dt={name!r}"


def broken(gaps: Array, first: Array, reach: int) -> Array:
    """Which samples have a gap within the ``reach`` intervals that their lags span; series begin at ``first``."""
    total, places = np.concatenate([[0], np.cumsum(gaps > GAP)]), np.arange(len(gaps))
    begin = np.repeat(first, np.diff(np.append(first, len(gaps))))
    return np.asarray(total[places + 1] > total[np.maximum(places + 1 - reach, begin)])


def warn_of_gaps(clock: Clock, time: Array, gaps: Array, first: Array, reach: int, zone: str | None = None) -> None:
    """Warn if most samples cannot be used because of dt, or if weekends cost a record of working days.

    ``time`` and ``gaps`` (N,) contain one series after the other, each beginning at its ``first`` sample.
    """
    N = len(gaps)
    if reach * int(np.count_nonzero(gaps > GAP)) <= 0.1 * N:
        return
    lost = int(broken(gaps, first, reach).sum())
    longest = int(np.argmax(np.diff(np.append(first, N))))
    axis = time[first[longest] : np.append(first, N)[longest + 1]]
    middle, better = median_interval(axis, zone)
    weekdays = "business" in better and clock.kind == "duration"
    if lost > 0.5 * N or weekdays:
        warn(
            f"{lost} of {N} samples cannot be used: the median interval is {middle}, dt is "
            f"{1 if clock.plain is None else clock.plain}, and lags do not reach across gaps above {GAP} dt. "
            f"Give {better}, or dt='label' if samples are one step apart regardless of their times."
        )


class Pace:
    """Counts the gaps of a stream, and warns once if most of its samples cannot be used because of dt."""

    def __init__(self, clock: Clock, reach: int) -> None:
        self._clock, self._reach = clock, reach
        self._count = self._gaps = 0

    def see(self, interval: float) -> None:
        """Count the nominal interval before a sample."""
        if not self._reach or self._count > LOOK:
            return
        self._count += 1
        self._gaps += interval > GAP
        if self._count == LOOK and self._gaps > LOOK // 2:
            warn(
                f"{self._gaps} of the first {LOOK} samples came after a gap: the last interval is {interval:g} times "
                f"dt={1 if self._clock.plain is None else self._clock.plain}, and lags do not reach across gaps above "
                f"{GAP} dt. Give dt= the interval between samples, or dt='label' if times are only labels."
            )
