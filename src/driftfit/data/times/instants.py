"""Instants: times and dates as users give them, as floats or as datetime64 in UTC, with the name of their zone."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np

from driftfit.data.times.periods import EXAMPLES, periods
from driftfit.engine.kernel import Array


def instant(time: Any) -> Any:
    """One time as a float, or as datetime64 in UTC if it is a date."""
    if isinstance(time, int | float | np.number) and not isinstance(time, np.timedelta64):
        return float(time)
    if hasattr(time, "to_datetime64"):  # a pandas time, in UTC if it has a zone
        return time.to_datetime64()
    if isinstance(time, datetime) and time.tzinfo is not None:
        time = time.astimezone(UTC).replace(tzinfo=None)
    if isinstance(time, str):
        return _of_texts([time])[0]
    return _by_days(np.asarray(time, dtype="datetime64" if isinstance(time, np.datetime64) else "datetime64[us]"))[()]


def instants(time: Any) -> tuple[Array, str | None]:
    """(times (T,) as floats or as datetime64 in UTC, their zone) of an array or a sequence."""
    axis = np.asarray(time)
    if axis.dtype.kind in "iuf":
        return axis.astype(float), None
    if axis.dtype.kind == "M":
        return _by_days(axis), None
    if axis.dtype.kind in "UT" or (axis.dtype.kind == "O" and axis.size and isinstance(axis.flat[0], str)):
        return _of_texts(axis.ravel().tolist()).reshape(axis.shape), None
    if axis.dtype.kind == "O" and axis.size and isinstance(axis.flat[0], datetime) and axis.flat[0].tzinfo is not None:
        zone = zone_name(axis.flat[0].tzinfo)
        flat = [one.astimezone(UTC).replace(tzinfo=None) for one in axis.flat]
        return np.array(flat, dtype="datetime64[us]").reshape(axis.shape), zone
    return np.asarray(time, dtype="datetime64[us]"), None


def _of_texts(texts: Sequence[str]) -> Array:
    """Dates in the form of ISO 8601, or beginnings of periods."""
    found = periods(texts)
    days = [_date_of_text(text) for text in texts] if found is None else found
    for text, day in zip(texts, days, strict=True):
        if np.isnat(day) and text.strip().lower() != "nat":
            raise ValueError(
                f"time: {text!r} is not a date; write 2024-01-31, 2024-01-31 12:00:00, or a period as in {EXAMPLES}."
            )
    return np.asarray(days, dtype="datetime64[us]")


def _date_of_text(text: str) -> np.datetime64:
    try:
        return np.datetime64(text, "us")
    except ValueError:
        return np.datetime64("NaT", "us")


def zone_name(zone: Any) -> str:
    """The name of a time zone, from a tzinfo or text; a fixed offset of whole hours has a name, others become UTC."""
    name = next((str(getattr(zone, key)) for key in ("key", "zone") if getattr(zone, key, None)), str(zone))
    try:
        ZoneInfo(name)
        return name
    except (ValueError, OSError, KeyError):  # no zone has this name
        pass
    offset = re.fullmatch(r"(?:UTC)?([+-]\d\d):00", name)
    return f"Etc/GMT{-int(offset[1]):+d}" if offset and int(offset[1]) else "UTC"


def _by_days(axis: Array) -> Array:
    """Dates in units of at most a day, because nothing can be divided by a month."""
    coarse = np.datetime_data(axis.dtype)[0] in ("Y", "M", "W", "generic")
    return axis.astype("datetime64[D]") if coarse else axis
