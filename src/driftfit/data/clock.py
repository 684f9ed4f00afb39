"""Time: the number of nominal intervals, dt, between two samples.

    dt = 10                                         numbers: in the unit of ``time``, 1 by default
    dt = "10ms" "1s" "15min" "1h" "30d" "2w"        durations; also timedelta, numpy.timedelta64, pandas offsets
    dt = "month" "quarter" "year" "3 months"        calendar steps, whatever their number of days
    dt = "business day"                             Monday to Friday; "business day except 2024-12-25, 2024-12-26" with
                                                    holidays, also from pandas' CustomBusinessDay(holidays=..)
    dt = "label"                                    times are labels: samples are one step apart

A month is counted from its first day, including the fraction of it that has passed: 31 January to 28 February is 0.997
months. A number of steps within a tenth of an integer is rounded to it, so that the last day, or the last trading day,
of every month are one step apart. Days and months are those of the time zone. A weekend has no business time: from
Saturday to Monday 0 steps pass. Every interval depends only on a sample and the one before it, so a stream counts
intervals as its record does.
Lags do not reach across a gap; a warning says where a wrong dt makes most samples unusable.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import cached_property
from typing import Any, NoReturn

import numpy as np

from driftfit.data.instants import zone_name
from driftfit.engine.kernel import Array
from driftfit.engine.settings import warn
from driftfit.models.base import GAP

LABEL = "label"
CALENDARS = ("month", "business")
MONTHS = {
    **dict.fromkeys(("month", "months", "MS", "ME", "BMS", "BME", "CBMS", "CBME"), 1),
    **dict.fromkeys(("quarter", "quarters", "Q", "QS", "QE", "BQS", "BQE"), 3),
    **dict.fromkeys(("year", "years", "Y", "YS", "YE", "BYS", "BYE"), 12),
}
"""Calendar steps in months, including the codes of pandas."""

BUSINESS = ("business day", "business days", "B", "C")
DURATIONS = {
    **dict.fromkeys(("ns", "us", "ms"), 1),
    **dict.fromkeys(("s", "sec", "second", "seconds"), 1),
    **dict.fromkeys(("min", "minute", "minutes"), 60),
    **dict.fromkeys(("h", "hour", "hours"), 3600),
    **dict.fromkeys(("d", "day", "days"), 86400),
    **dict.fromkeys(("w", "week", "weeks"), 604800),
}
"""Seconds of a unit, or 1 if NumPy has a unit of that name."""

MONTH, DAY = np.timedelta64(1, "M"), np.timedelta64(1, "D")
ROUNDED_WITHIN = 0.1
"""A number of calendar steps this close to an integer is rounded to it."""


@dataclass(frozen=True)
class Clock:
    """One nominal interval: ``count`` of a ``kind``, "number", "month" or "business", or a ``duration``, or a "label".

    "unset" is the default if no dt was given: 1 for numbers, and an error for dates.
    """

    kind: str
    count: float = 1.0
    duration: np.timedelta64 | None = None
    holidays: tuple[str, ...] = ()
    zone: str | None = None
    """Time zone of days and months, for times in UTC."""

    @classmethod
    def of(cls, dt: Any, zone: str | None = None) -> Clock:
        """The clock of ``dt``, for times shown in a zone; ValueError if ``dt`` is not valid."""
        if dt is None:
            return UNSET
        clock = cls._of(dt)
        return replace(clock, zone=zone) if clock.kind in CALENDARS and zone is not None else clock

    @classmethod
    def _of(cls, dt: Any) -> Clock:
        if isinstance(dt, Clock):
            return dt
        if isinstance(dt, str):
            return _of_text(dt)
        if isinstance(dt, np.timedelta64 | timedelta):
            length = dt.to_timedelta64() if hasattr(dt, "to_timedelta64") else np.timedelta64(dt)
            if np.datetime_data(length.dtype)[0] in ("Y", "M", "generic"):
                raise ValueError(
                    f"dt={dt!r} has no fixed length; give dt='month', dt='year', or a unit, as in dt='1s'."
                )
            if not length > np.timedelta64(0, "s"):
                raise ValueError(f"dt must be positive; got {dt!r}.")
            return cls("duration", duration=length)
        if isinstance(dt, int | float | np.number) and not isinstance(dt, bool):
            if not (dt > 0.0 and np.isfinite(dt)):
                raise ValueError(f"dt must be positive; got {dt!r}.")
            return cls("number", float(dt))
        if hasattr(dt, "freqstr"):
            return _of_offset(dt)
        _refuse(dt)

    @property
    def plain(self) -> float | str | None:
        """Plain data from which `of` makes the same clock."""
        if self.kind in ("unset", LABEL):
            return None if self.kind == "unset" else LABEL
        if self.kind == "number":
            return self.count
        if self.duration is not None:
            return duration_text(self.duration)
        name = "month" if self.kind == "month" else "business day"
        text = name if self.count == 1.0 else f"{self.count:g} {name}s"
        return f"{text} except {', '.join(self.holidays)}" if self.holidays else text

    def lasting(self, count: int) -> str:
        """So many intervals in words, such as "70 s", "2 months" or, without a unit, "3 samples"."""
        if self.duration is not None:
            return re.sub(r"(?<=\d)(?=\D)", " ", duration_text(count * self.duration))
        number, kind = (count, "sample") if self.kind == "number" else (int(count * self.count), self.kind)
        return f"{number} {kind}{'' if number == 1 else 's'}"

    def between(self, last: Array, time: Array) -> Array:
        """Nominal intervals from times ``last`` to ``time``, elementwise."""
        self._fits(time)
        if self.kind == LABEL:
            return np.ones(np.shape(time))
        if self.kind in ("number", "unset"):
            return np.asarray((time - last) / self.count)
        if self.duration is not None:
            return np.asarray((time - last) / self.duration)
        place = self._months if self.kind == "month" else self._business_days
        steps = (place(self._local(time)) - place(self._local(last))) / self.count
        nearest = np.rint(steps)
        return np.where((nearest >= 1.0) & (np.abs(steps - nearest) < ROUNDED_WITHIN), nearest, steps)

    def _fits(self, time: Array) -> None:
        """ValueError if this clock cannot count times of this kind."""
        dates = np.asarray(time).dtype.kind == "M"
        if self.kind == "unset" and dates:
            raise ValueError(
                "with datetimes dt must be given: the nominal interval, such as dt=timedelta(hours=1), '1h', 'month', "
                "or 'label' if samples are one step apart regardless of their dates."
            )
        if self.kind == "number" and dates:
            raise ValueError(
                f"dt={self.count:g} has no unit, but time consists of dates; give one, as in dt='{self.count:g}s'."
            )
        if self.kind not in ("number", "unset", LABEL) and not dates:
            years = ", as in dt=1 for the years 1970, 1971, .." if self.kind == "month" and self.count % 12 == 0 else ""
            raise ValueError(
                f"dt={self.plain!r} is for dates, but time is numeric: give dt in the unit of time{years}."
            )

    def at(self, time: Any) -> Clock:
        """This clock with days and months in the zone of a time that has one."""
        zone = getattr(time, "tzinfo", None)
        return self if zone is None or self.zone is not None else self.within(zone_name(zone))

    def within(self, zone: str | None) -> Clock:
        """This clock with days and months in a zone, unless it has one already."""
        known = self.zone is not None or self.kind not in CALENDARS or zone is None
        return self if known else replace(self, zone=zone)

    def _local(self, time: Array) -> Array:
        """Times in UTC converted to the wall clock of the zone."""
        if self.zone is None:
            return time
        import polars as pl

        series = pl.Series(np.atleast_1d(time).astype("datetime64[us]")).dt.replace_time_zone("UTC")
        shown = series.dt.convert_time_zone(self.zone).dt.replace_time_zone(None).to_numpy()
        return np.asarray(shown.reshape(np.shape(time)))

    def _in_utc(self, time: Array) -> Array:
        """The inverse of `_local`; NaT for times that the wall clock skips."""
        if self.zone is None:
            return time
        import polars as pl

        series = pl.Series(time.astype("datetime64[us]"))
        zoned = series.dt.replace_time_zone(self.zone, ambiguous="earliest", non_existent="null")
        return np.asarray(zoned.dt.convert_time_zone("UTC").dt.replace_time_zone(None).to_numpy())

    def _months(self, time: Array) -> Array:
        """Months since 1970, including the fraction of the month that has passed."""
        month = time.astype("datetime64[M]")
        start, end = (m.astype("datetime64[us]") for m in (month, month + MONTH))
        return np.asarray(month.astype(np.int64) + (time - start) / (end - start))

    def _business_days(self, time: Array) -> Array:
        """Business days since 1970, including the fraction of the day that has passed."""
        day = time.astype("datetime64[D]")
        part = (time - day) / DAY
        whole = np.busday_count(np.datetime64("1970-01-01"), day, busdaycal=self._calendar)
        return np.asarray(whole + np.where(np.is_busday(day, busdaycal=self._calendar), part, 0.0))

    @cached_property
    def _calendar(self) -> Any:
        return np.busdaycalendar(holidays=np.array(self.holidays, dtype="datetime64[D]"))

    def steps(self, time: Array) -> Array:
        """Nominal intervals (T,) since the previous sample; 1 at the first."""
        gaps = np.ones(len(time))
        if len(time):
            self._fits(time)
            gaps[1:] = self.between(time[:-1], time[1:])
        return gaps

    def continued(self, time: Array, first: Array, last: Array) -> Array:
        """Nominal intervals (N,) before the samples of series that begin at ``first`` (K,), after samples at ``last``
        (K,); 1 where that is NaN or NaT.
        """
        before, none = np.roll(time, 1), np.isnat(last) if last.dtype.kind == "M" else np.isnan(last)
        before[first] = np.where(none, time[first], last)
        gaps = self.between(before, time)
        gaps[first[none]] = 1.0
        return gaps

    def since(self, last: Any, time: Any) -> float:
        """Nominal intervals from one instant to another; 1 if there is none before.

        NaN if time does not advance, or is not known or infinite.
        """
        if type(time) is float and type(last) is float and self.kind in ("number", "unset"):
            return (time - last) / self.count if last < time < np.inf else float("nan")
        if time != time:
            return float("nan")
        self._fits(time)
        if not np.isfinite(time):
            return float("nan")
        if last is None:
            return 1.0
        return float(self.between(np.asarray(last), np.asarray(time))) if time > last else float("nan")

    def arrivals(self, last: Any, time: Array) -> tuple[Array, Array]:
        """(which samples (T,) come after ``last`` and all before them, nominal intervals before these): as `since`."""
        self._fits(time)
        fine = np.isfinite(time)
        none = np.array(["NaT" if time.dtype.kind == "M" else np.nan], time.dtype)
        first = none if last is None else np.atleast_1d(last)
        newest = np.fmax.accumulate(np.concatenate([first, np.where(fine, time, none)]))[:-1]
        taken = fine & ~(time <= newest)
        kept = time[taken]
        return taken, self.steps(kept) if last is None else self.steps(np.concatenate([first, kept]))[1:]

    def ahead(self, last: Any, h: int) -> Array | None:
        """The times (h,) of the nominal samples after ``last``; None if times are only labels."""
        return self.moved(last, np.arange(1, h + 1))

    def moved(self, last: Any, k: Array) -> Array | None:
        """The times k nominal intervals after ``last``, or before it for negative k; None if times are only labels, or
        dates whose interval is not given.
        """
        if self.kind == LABEL or last is None or (self.kind == "unset" and isinstance(last, np.datetime64)):
            return None
        if self.kind in ("number", "unset"):
            return np.asarray(last + k * self.count)
        if self.duration is not None:
            return np.asarray(last + k * self.duration)
        k = np.rint(k).astype(np.int64)
        local = self._local(last)
        day = local.astype("datetime64[D]")
        part, jump = local - day, k * int(self.count)
        if self.kind == "business":
            days = np.busday_offset(day, jump, roll="backward", busdaycal=self._calendar)
            return self._in_utc(np.asarray(days + part))
        month = local.astype("datetime64[M]")
        first, after = (m.astype("datetime64[D]") for m in (month + jump * MONTH, month + (jump + 1) * MONTH))
        ends = day + DAY == (month + MONTH).astype("datetime64[D]")  # the last day of a month stays the last day
        there = after - DAY if ends else np.minimum(first + (day - month.astype("datetime64[D]")), after - DAY)
        return self._in_utc(np.asarray(there + part))


UNSET = Clock("unset")
"""The clock if no dt was given."""


def _of_text(text: str) -> Clock:
    """A count and a unit; codes of pandas may contain the month or weekday to which they are anchored."""
    if text.strip() == LABEL:
        return Clock(LABEL)
    words, _, holidays = text.partition(" except ")
    match = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)?\s*([A-Za-z]+(?: [a-z]+)?)(?:-[A-Z]+)?\s*", words)
    count, unit = (float(match[1] or 1), match[2]) if match else (0.0, "")
    known = unit if unit in MONTHS or unit in BUSINESS else unit.lower()
    days = tuple(day.strip() for day in holidays.split(",") if day.strip())
    if not count or (days and known not in BUSINESS):
        _refuse(text)
    if known in BUSINESS:
        return Clock("business", _whole(text, count), holidays=days)
    if known in MONTHS:
        return Clock("month", _whole(text, count) * MONTHS[known])
    if known not in DURATIONS or unit in ("M", "m"):
        _refuse(text)
    scale, size = (1, str(known)) if known in ("ns", "us", "ms") else (10**9, "ns")
    ticks = count * DURATIONS[known] * scale
    if ticks != round(ticks):
        raise ValueError(f"dt={text!r} is not a whole number of nanoseconds.")
    if scale > 1 and round(ticks) % 1000 == 0:  # dates of the far past or future do not fit nanoseconds
        ticks, size = ticks / 1000, "us"
    return Clock("duration", duration=_delta(round(ticks), size))


def _delta(count: int, unit: str) -> np.timedelta64:
    """A duration of a number of NumPy units."""
    return np.timedelta64(count, unit)  # type: ignore[arg-type, call-overload, no-any-return, unused-ignore]


def _whole(text: str, count: float) -> float:
    if count != int(count):
        raise ValueError(f"dt={text!r}: calendar steps must be whole numbers.")
    return count


def _of_offset(offset: Any) -> Clock:
    """An offset of pandas, recognised by its attributes."""
    kwds = {name: value for name, value in getattr(offset, "kwds", {}).items() if name.endswith("s")}
    months = 12 * kwds.pop("years", 0) + kwds.pop("months", 0)
    kwds.pop("holidays", None)
    if months and not kwds:
        return Clock("month", float(months * offset.n))
    if kwds and not months:
        return Clock.of(timedelta(**kwds) * offset.n)
    clock, calendar = _of_text(offset.freqstr), getattr(offset, "calendar", None)
    if clock.kind == "business" and isinstance(calendar, np.busdaycalendar):
        if calendar.weekmask.tolist() != [True] * 5 + [False] * 2:
            raise ValueError("dt: business days are Monday to Friday; for another week give dt='label'.")
        return replace(clock, holidays=tuple(map(str, calendar.holidays)))
    return clock


def _refuse(given: Any) -> NoReturn:
    raise ValueError(
        f"dt={given!r} is not an interval; give a number in the unit of time, a duration ('10ms', '1s', '15min', '1h', "
        "'30d', '2w', a timedelta), a step of the calendar ('business day', 'month', 'quarter', 'year', '3 months'; "
        "'m' could be minutes or months, so write 'min' or 'month'), or 'label' if times are only labels."
    )


def duration_text(length: np.timedelta64) -> str:
    """A duration as an integer multiple of the largest possible unit."""
    units = {name: _delta(DURATIONS[name], "s") for name in ("d", "h", "min", "s")}
    units |= {name: _delta(1, name) for name in ("ms", "us", "ns")}
    name = next(name for name, unit in units.items() if not (length % unit).astype(int))
    return f"{length // units[name]}{name}"


PACE_SAMPLES = 20
"""Number of samples after which a stream warns if most of them cannot be used."""


def median_interval(time: Array, zone: str | None = None) -> tuple[str, float | str]:
    """(the median interval of a record in words, the dt that fits it best)."""
    middle = np.sort(np.diff(time))[(len(time) - 1) // 2]
    if time.dtype.kind != "M":
        return f"{middle:g}", float(middle)
    best, name = max(0.9, float(np.mean(np.abs(np.diff(time) / middle - 1.0) < 1e-3))), duration_text(middle)
    for step in ("business day", "month", "quarter", "year"):
        fit = float(np.mean(Clock.of(step, zone).steps(time)[1:] == 1.0))
        best, name = (fit, step) if fit > best else (best, name)
    return duration_text(middle), name


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
    text = repr(better) if isinstance(better, str) else f"{better:g}"
    weekdays = better == "business day" and clock.kind == "duration"
    if lost > 0.5 * N or weekdays:
        warn(
            f"{lost} of {N} samples cannot be used: the median interval is {middle}, dt is "
            f"{1 if clock.plain is None else clock.plain}, and lags do not reach across gaps above {GAP} dt. "
            f"Give dt={text}, or dt='label' if samples are one step apart regardless of their times."
        )


class Pace:
    """Counts the gaps of a stream, and warns once if most of its samples cannot be used because of dt."""

    def __init__(self, clock: Clock, reach: int) -> None:
        self._clock, self._reach = clock, reach
        self._count = self._gaps = 0

    def see(self, interval: float) -> None:
        """Count the nominal interval before a sample."""
        if not self._reach or self._count > PACE_SAMPLES:
            return
        self._count += 1
        self._gaps += interval > GAP
        if self._count == PACE_SAMPLES and self._gaps > PACE_SAMPLES // 2:
            warn(
                f"{self._gaps} of the first {PACE_SAMPLES} samples came after a gap: the last interval is {interval:g} "
                f"times dt={1 if self._clock.plain is None else self._clock.plain}, and lags do not reach across gaps "
                f"above {GAP} dt. Give dt= the interval between samples, or dt='label' if times are only labels."
            )
