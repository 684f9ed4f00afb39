"""Records: several series in flat arrays, one after the other, with the names and units of their signals.

Every run reads its samples from here, whether they came from a table, from rows of an array, or from one series with
several settings: a lane reads ``length`` samples, beginning at ``first``.
What is `Known` of every sample besides its signals is elapsed time, noise, and how far theta may move.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC
from datetime import time as clock
from functools import lru_cache
from typing import Any, NamedTuple
from zoneinfo import ZoneInfo

import numpy as np

from driftfit.data.arguments import ordered
from driftfit.data.clock import Clock, warn_of_gaps
from driftfit.data.limits import Limits, marked, marks, within_each
from driftfit.engine.drivers import COMMON, DRIFT, INTERVAL, LARGEST, NOISE, SMALLEST
from driftfit.engine.kernel import Array
from driftfit.engine.settings import warn
from driftfit.models.base import Model
from driftfit.readings.left_out import LeftOut
from driftfit.trackers.base import Tracker


@dataclass(frozen=True)
class Labels:
    """The names and units of the signals of a series, and counts of what was left out.

    ``units`` maps the name of a signal to its unit, ``zone`` is the time zone in which times are shown, ``dropped``
    counts rows that never became samples, and ``missing`` counts, by reason, numbers that were treated as missing.
    ``by`` names the columns that identify the series of a fleet. ``dt`` is the nominal interval in the form that
    `driftfit.data.clock.Clock.of` takes.
    """

    y: str = "y"
    u: tuple[str, ...] = ()
    time: str | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    zone: str | None = None
    dropped: Mapping[str, int] = field(default_factory=dict)
    by: tuple[str, ...] = ("series",)
    missing: Mapping[str, int] = field(default_factory=dict)
    dt: float | str | None = None

    def __post_init__(self) -> None:
        for name in ("u", "by"):
            if type(given := getattr(self, name)) is not tuple:  # lists, if they come from JSON
                object.__setattr__(self, name, tuple(given))

    def unit(self, power: int, j: int | None) -> str:
        """The unit of y to the power 0 or 1, divided by that of input j; empty if it is unknown or 1."""
        top = self.units.get(self.y, "") if power else ""
        bottom = "" if j is None or j >= len(self.u) else self.units.get(self.u[j], "")
        if (power and not top) or (j is not None and not bottom) or top == bottom:
            return ""
        top, bottom = (f"({unit})" if "/" in unit and bottom else unit for unit in (top or "1", bottom))
        return f"{top}/{bottom}" if bottom else top


PLAIN = Labels()
_NONE: Mapping[Any, Any] = {}


def time_text(time: Any, zone: str | None) -> str:
    """A time as text, dates in a time zone; midnight without a zone is the date alone.

    Numbers have twelve digits, so that seconds since 1970 are told apart; dates have a fraction of the second if it is
    not zero.
    """
    if not isinstance(time, np.datetime64):
        return f"{time:.12g}"
    date = time.astype("datetime64[us]").item()
    if zone is None and date.time() == clock(0):
        return f"{date:%Y-%m-%d}"
    shown = date if zone is None else date.replace(tzinfo=UTC).astimezone(ZoneInfo(zone))
    part = f".{date.microsecond:06d}".rstrip("0") if date.microsecond else ""
    return f"{shown:%Y-%m-%d %H:%M:%S}{part}{'' if zone is None else f'{shown: %Z}'}"


SIZES_SAMPLED = 1000
"""Numbers of a signal that are looked at to find its size."""


def warn_of_sizes(names: Sequence[str], values: Array) -> None:
    """Warn of columns (N, k) most numbers of which are so large that they count as missing, or so small that they count
    as 0, by a thousand numbers of each.
    """
    for name, column in zip(names, values[:: len(values) // SIZES_SAMPLED + 1].T, strict=True):
        size = np.abs(column)
        if SMALLEST < size.max(initial=0.0) < LARGEST:  # nearly always, so it must cost little
            continue
        size = size[(size > 0.0) & (size < np.inf)]
        odd = size[(size <= SMALLEST) | (size >= LARGEST)]
        if 2 * len(odd) > len(size):
            warn(
                f"most numbers of {name} are like {odd[0]:g}: sizes of {LARGEST:g} or more count as missing, those of "
                f"{SMALLEST:g} or less as 0. Give the signal in another unit."
            )


class Reading(NamedTuple):
    """How signals are to be read: the further arguments of `driftfit.run.track.track`, described there."""

    time: Any = None
    dt: Any = None
    weights: Any = 1.0
    drift: Any = 1.0
    units: Mapping[str, str] | None = None
    limits: Mapping[Any, Any] | None = None
    exclude: Any = None
    missing: Any = ()
    gate: Any = None
    indexed: bool = True
    """Whether an index of dates labels the samples if no time is given."""


@dataclass(frozen=True)
class Record:
    """One checked series: ``y`` (T,), ``u`` (T, m), what is ``known`` of every sample, ``time`` (T,) or None.

    ``y`` is (T, ny) for several outputs.
    """

    y: Array
    u: Array
    known: Known
    time: Array | None = None
    labels: Labels = PLAIN

    def __len__(self) -> int:
        return len(self.y)

    @property
    def noise(self) -> Array:
        """(T,): factors of the noise variance."""
        return np.broadcast_to(self.known.noise, len(self))

    def part(self, rows: slice) -> Record:
        """A range of consecutive samples."""
        time = None if self.time is None else self.time[rows]
        return replace(self, y=self.y[rows], u=self.u[rows], known=self.known.part(rows), time=time)


class Records(NamedTuple):
    """Series in flat arrays of N samples.

    ``y`` (N,), ``u`` (N, m), ``known`` of N samples or one row, ``time`` (N,) or None; series k is ``length[k]``
    samples from ``first[k]`` on and is called ``keys[k]``. ``dropped`` and ``missing`` count, per key, rows that
    never became samples and numbers that were taken as missing. ``drifts`` (N, k) are
    factors of the drift for each parameter or change, until `for_trackers` has made columns of ``known`` of them.
    Series with several ``outputs`` have ``y`` (N, ny), ``known`` of each, and ``u`` (N, m), or (N, ny, m) if the
    outputs share one theta (`in_rows`).
    """

    keys: tuple[Hashable, ...]
    first: Array
    length: Array
    y: Array
    u: Array
    known: Known
    time: Array | None = None
    labels: Labels = PLAIN
    dropped: Mapping[Hashable, Mapping[str, int]] = _NONE
    drifts: Array | None = None
    missing: Mapping[Hashable, Mapping[str, int]] = _NONE
    outputs: tuple[str, ...] = ()
    left_out: Mapping[Hashable, LeftOut] = _NONE
    """What was left out of each series by decisions that were made before."""

    @classmethod
    def of(cls, record: Record) -> Records:
        """A single series of one output, called 0."""
        first, length = np.zeros(1, int), np.array([len(record)])
        return cls((0,), first, length, record.y, record.u, record.known, record.time, record.labels)

    @property
    def ny(self) -> int:
        """Number of outputs of every series."""
        return len(self.outputs) or 1

    def part(self, k: int) -> Record:
        """Series k; its arrays are views."""
        begin, count = self.first.item(k), self.length.item(k)
        whole = Record(self.y, self.u, self.known, self.time, self.labels_of(k))
        return whole if count == len(self.y) else whole.part(slice(begin, begin + count))

    def some(self, a: int, b: int) -> Records:
        """Series a to b - 1; their arrays are views."""
        first, length = self.first[a:b], self.length[a:b]
        low = int(first.min())
        rows = slice(low, int((first + length).max()))
        time, known = None if self.time is None else self.time[rows], self.known.part(rows)
        y, u = self.y[rows], self.u[rows]
        return self._replace(keys=self.keys[a:b], first=first - low, length=length, y=y, u=u, known=known, time=time)

    def in_rows(self) -> Records:
        """Series with several outputs as series of one output, whose samples are the outputs of every instant in order.

        For outputs that share one theta: correcting with one of them after the other, while no time passes, equals the
        correction with all of them.
        """
        N, ny = self.y.shape
        time = None if self.time is None else np.repeat(self.time, ny)
        y, u = np.ascontiguousarray(self.y).ravel(), np.ascontiguousarray(self.u).reshape(N * ny, -1)
        known, first, length = self.known.in_rows(N), self.first * ny, self.length * ny
        return self._replace(first=first, length=length, y=y, u=u, known=known, time=time, outputs=())

    def for_trackers(self, model: Model, trackers: Iterable[Tracker], prob: Any = None) -> Records:
        """The same series with everything that is known of the samples as columns of ``known``, in the form that these
        trackers read.
        """
        if self.drifts is None and prob is None:
            return self
        columns, *others = (one.extra_columns(model, len(self.y), prob, self.drifts) for one in dict.fromkeys(trackers))
        if any(not np.array_equal(columns, other, equal_nan=True) for other in others):
            raise ValueError("track: a drift for each change is for one Bank at a time; the trackers here have others.")
        common = self.known.common.over(len(columns)).columns
        if common.ndim > 2:
            columns = np.repeat(columns[:, :, None], common.shape[2], axis=2)
        return self._replace(known=Known(np.hstack([common, columns])), drifts=None)

    def repeated(self, keys: tuple[Hashable, ...]) -> Records:
        """The only series under several keys, without copying it."""
        dropped, missing = (
            {key: counts.get(self.keys[0], {}) for key in keys} for counts in (self.dropped, self.missing)
        )
        first, length = np.repeat(self.first, len(keys)), np.repeat(self.length, len(keys))
        left_out: dict[Any, LeftOut] = {}
        for own, one in self.left_out.items():  # by series, and by the name of an output
            left_out |= {(key, own[1]) if isinstance(own, tuple) and self.outputs else key: one for key in keys}
        return self._replace(keys=keys, first=first, length=length, dropped=dropped, missing=missing, left_out=left_out)

    def labels_of(self, k: int) -> Labels:
        """The labels of series k."""
        if not self.dropped and not self.missing:
            return self.labels
        key = self.keys[k]
        counted = {"dropped": self.dropped.get(key), "missing": self.missing.get(key)}
        found: Any = {name: counts for name, counts in counted.items() if counts}
        return replace(self.labels, **found) if found else self.labels

    def for_model(self, model: Model, reading: Reading, reach: int | None = None) -> Records:
        """Sort the inputs for a model with named inputs, and apply valid ranges, marks and excluded intervals.

        Warns if most numbers of a signal are out of range, and if most samples cannot be used because of dt, with lags
        of ``reach`` samples, or those of the model.
        """
        u, names = ordered(model, self.u, self.labels.u) if self.labels.u else (self.u, ())
        warn_of_sizes(self.outputs or (self.labels.y,), self.y.reshape(len(self.y), self.ny))
        if m := u.shape[-1]:
            warn_of_sizes(names or [f"u{j + 1}" for j in range(m)], u.reshape(-1, m))
        found = self if u is self.u else self._replace(u=u, labels=replace(self.labels, u=names))
        if reading.limits or reading.exclude or reading.missing:
            found = found._restricted(names or model.input_names, reading)
        if self.time is not None and len(self.known) > 1:
            clock, zone = Clock.of(self.labels.dt), self.labels.zone
            gaps = self.known.interval.reshape(len(self.known), -1)[:, 0]
            warn_of_gaps(clock, self.time, gaps, self.first, reach or model.reach, zone)
        return found

    def _restricted(self, inputs: Sequence[str], reading: Reading) -> Records:
        """Replace values outside valid ranges, marked as missing or in excluded intervals by NaN, and count them."""
        y, u, keys = self.y.copy(), self.u.copy(), self.keys
        N, m = len(y), u.shape[-1]
        owner = np.repeat(np.arange(len(keys)), self.length)
        limits = Limits(reading.limits or {}, self.outputs or (self.labels.y,), inputs, m)
        none_y, none_u = (np.isin(signal, marks(reading.missing)[1]) for signal in (y, u))
        y[none_y], u[none_u] = np.nan, np.nan
        out_y, out_u = limits.outside(y.reshape(N, -1), u)
        number = np.arange(N) - self.first[owner]
        excluded = within_each(reading.exclude, keys, owner, self.time, number, self.labels.zone)
        counts = np.hstack([out_y, out_u.reshape(N, -1, m).sum(axis=1)]) * ~excluded[:, None]
        reasons = {f"of {name} outside its limits": of for name, of in zip(limits.names, counts.T, strict=True)}
        none = np.hstack([none_y.reshape(N, -1), none_u.reshape(N, -1)]).sum(axis=1)
        missing = marked(keys, owner, {**reasons, "marked as missing": none * ~excluded, "excluded": excluded})
        y[out_y.reshape(y.shape)] = np.nan
        u[out_u] = np.nan
        y[excluded], u[excluded] = np.nan, np.nan
        return self._replace(y=y, u=u, missing=missing)


@dataclass(frozen=True)
class Known:
    """``columns`` (T, k), or (1, k) where the same holds for every sample; k is 3, or more if there are extras.

    Samples of several outputs have columns (T, k, ny) or (1, k, ny); `for_output` gives those of one.

    ``interval``, ``noise`` and ``drift`` are its first columns: nominal intervals since the sample before, factors of
    the noise variance, and factors of the drift. ``extra`` (T, k - 3) is what `Tracker.extra_columns` made.
    """

    columns: Array

    @classmethod
    def of(cls, interval: Any = 1.0, noise: Any = 1.0, drift: Any = 1.0) -> Known:
        """The columns made of numbers or of arrays (T,)."""
        if type(interval) is type(noise) is type(drift) is float:
            return row_of(interval, noise, drift)
        parts = (interval, noise, drift)
        if not (np.ndim(interval) or np.ndim(noise) or np.ndim(drift)):
            return row_of(float(interval), float(noise), float(drift))
        return cls(np.stack(np.broadcast_arrays(*(np.atleast_1d(np.asarray(part, float)) for part in parts)), axis=1))

    def __len__(self) -> int:
        return len(self.columns)

    @property
    def interval(self) -> Array:
        """(T,) or (1,): nominal intervals since the sample before."""
        return self.columns[:, INTERVAL]

    @property
    def noise(self) -> Array:
        """(T,) or (1,): factors of the noise variance."""
        return self.columns[:, NOISE]

    @property
    def drift(self) -> Array:
        """(T,) or (1,): factors of the drift."""
        return self.columns[:, DRIFT]

    @property
    def extra(self) -> Array:
        """(T, k - 3): extra columns, which only some trackers read."""
        return self.columns[:, COMMON:]

    @property
    def common(self) -> Known:
        """The same numbers without the extra columns."""
        return Known(self.columns[:, :COMMON])

    def part(self, rows: slice | Array) -> Known:
        """The known numbers of some of the samples."""
        return self if len(self) == 1 else Known(self.columns[rows])

    def over(self, T: int) -> Known:
        """The same numbers with a row for each of T samples; the arrays must not be changed."""
        return Known(np.broadcast_to(self.columns, (T, *self.columns.shape[1:])))

    def changed(self, interval: Any = None, noise: Any = None) -> Known:
        """The same numbers with other intervals or noise factors; a single row applies to all samples."""
        given = {INTERVAL: interval, NOISE: noise}
        T = max(len(self), *(np.size(values, 0) for values in given.values() if np.ndim(values)), 1)
        columns = self.over(T).columns.copy()
        for place, values in given.items():
            if values is not None:
                columns[:, place] = np.reshape(values, (np.size(values, 0), -1)) if columns.ndim > 2 else values
        return Known(columns)

    def begun(self, factors: Mapping[int, float]) -> Known:
        """The same numbers, with the intervals before the samples of these indices multiplied by a factor."""
        columns = self.columns.copy()
        for place, times in factors.items():
            columns[place, INTERVAL] *= times
        return Known(columns)

    def for_outputs(self, noise: Array) -> Known:
        """The same numbers for each of several outputs, which have separate factors of the noise variance (T, ny)."""
        T, ny = noise.shape
        columns = np.repeat(self.over(T).columns[:, :, None], ny, axis=2)
        columns[:, NOISE] = noise
        return Known(columns)

    def for_output(self, output: int) -> Known:
        """The known numbers of one of several outputs."""
        return Known(self.columns[..., output])

    def in_rows(self, T: int) -> Known:
        """(T ny, k): one row for each output of each instant; no time passes between the rows of an instant."""
        ny = self.columns.shape[2]
        columns = np.moveaxis(self.over(T).columns, 1, 2).flatten().reshape(T * ny, -1)
        columns[np.arange(T * ny) % ny > 0, INTERVAL] = 0.0
        return Known(columns)


@lru_cache(maxsize=256)
def row_of(interval: float, noise: float, drift: float) -> Known:
    """A row that holds for every sample; it is made once and cannot be written to."""
    columns = np.array([[interval, noise, drift]])
    columns.flags.writeable = False
    return Known(columns)
