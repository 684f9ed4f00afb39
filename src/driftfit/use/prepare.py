"""Preparation: small functions that record their operations, so that results can be converted back to the user's units.

    flow = prepare.scale(prepare.remove_level(flow_raw, first=200), first=200)
    valve = prepare.scale(valve_raw, first=200)
    run = track(ARX(2, 2), tracker, flow, valve)
    result = prepare.restore(run, flow, valve)      # theta, bands, predictions in the units of flow_raw and valve_raw

Every operation that keeps the samples is an affine map, raw_t = factor * value_t + offset_t, and maps compose. Fits use
the past only: a level or a trend is fitted to the first samples, or at each sample to those before it; nothing looks
ahead. `delay` and `feedback` judge a whole record and belong before a run, not inside it.

Source: Ljung, System Identification (1999), chapter 14 (levels, trends, scaling, delays); Box, Jenkins and Reinsel,
Time Series Analysis (1994), section 11.2 (prewhitening before a cross-correlation); Granger (1969) (the test of
feedback). Departure: levels and trends are never fitted to samples after the one from which they are removed,
except within the first ``first`` samples.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from driftfit.data.clock import Clock
from driftfit.data.instants import instants
from driftfit.engine.kernel import Array
from driftfit.engine.settings import as_numbers, one_of, whole
from driftfit.run.result import Track


@dataclass(frozen=True)
class Prepared:
    """A prepared signal: raw_t = factor * value_t + offset_t.

    `track` takes it like an array of its ``values`` (T,). ``notes`` lists the operations, in order.
    """

    values: Array
    factor: float
    offset: Array
    notes: tuple[str, ...]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        return np.array(self.values, dtype=dtype, copy=copy)

    def __len__(self) -> int:
        return len(self.values)

    def raw(self, values: Any) -> Array:
        """Values (T,) in the user's units."""
        return np.asarray(self.factor * np.asarray(values) + self.offset)


def prepared(values: Any) -> Prepared:
    """A signal to which no operation has been applied yet."""
    if isinstance(values, Prepared):
        return values
    array = as_numbers("values", values)
    if array.ndim != 1 or not len(array):
        raise ValueError(f"prepare: a signal is (T,), not empty; got shape {array.shape}.")
    return Prepared(array, 1.0, np.zeros(len(array)), ())


def _shift(before: Prepared, offset: Array, note: str) -> Prepared:
    return Prepared(
        before.values - offset, before.factor, before.offset + before.factor * offset, (*before.notes, note)
    )


def _finite(before: Prepared, first: int | None) -> tuple[Array, int]:
    """(positions, count) of the finite values among the first ``first``; ValueError if there are none."""
    count = len(before) if first is None else whole("prepare", "first", first, 1)
    places = np.flatnonzero(np.isfinite(before.values[:count]))
    if not places.size:
        raise ValueError(f"prepare: the first {count} samples contain no value.")
    return places, count


def remove_level(values: Any, first: int | None = None, level: float | None = None) -> Prepared:
    """Subtract the operating point.

    Parameters
    ----------
    values : (T,) or Prepared
    first : int or None
        The mean of this many samples at the start is the operating point. None: at each sample the mean of all
        earlier samples (0 before the first), which tracks a level that is not known beforehand.
    level : number or None
        The operating point, if it is known.
    """
    before = prepared(values)
    if level is not None:
        return _shift(before, np.full(len(before), float(level)), f"level {level:g} removed")
    if first is not None:
        places, count = _finite(before, first)
        mean = float(before.values[places].mean())
        return _shift(before, np.full(len(before), mean), f"level {mean:g}, the mean of the first {count}, removed")
    known = np.isfinite(before.values)
    total, number = np.cumsum(np.where(known, before.values, 0.0)), np.cumsum(known)
    mean_before = np.concatenate([[0.0], (total / np.maximum(number, 1))[:-1]])
    return _shift(before, mean_before, "mean of all samples before removed")


def remove_trend(values: Any, first: int) -> Prepared:
    """Subtract a straight line that was fitted to the first ``first`` samples (T,) and is continued from there."""
    before = prepared(values)
    places, count = _finite(before, first)
    if places.size < 2:
        raise ValueError(f"prepare: a trend needs two values; the first {count} samples contain one.")
    slope, level = np.polyfit(places, before.values[places], 1)
    line = level + slope * np.arange(len(before))
    return _shift(before, line, f"line {level:g} + {slope:g} t, fitted to the first {count}, removed")


def scale(values: Any, *, by: float | None = None, first: int | None = None) -> Prepared:
    """Divide by a number: ``by``, or the standard deviation of the first ``first`` samples.

    Trackers without a covariance and penalties that are one number for all parameters need signals of one size.
    """
    before = prepared(values)
    if (by is None) == (first is None):
        raise ValueError("prepare: give either by=, a number, or first=, the samples that determine the scale.")
    if by is None:
        places, _ = _finite(before, first)
        by = float(before.values[places].std())
    if not (np.isfinite(by) and by > 0.0):
        raise ValueError(f"prepare: a scale must be positive; got {by!r} (a constant signal has none: give by=).")
    return Prepared(before.values / by, before.factor * by, before.offset, (*before.notes, f"divided by {by:g}"))


class Resampled(NamedTuple):
    """Signals on a regular grid: ``time`` (G,), ``values`` (G,) or (G, m), and how many ``samples`` (G,) in each."""

    time: Array
    values: Array
    samples: Array


def resample(time: Any, values: Any, dt: Any, how: str = "mean") -> Resampled:
    """Resample signals to a regular grid, each point from the samples of the interval that ends there.

    Parameters
    ----------
    time : (T,) numbers or datetime64, increasing
    values : (T,) or (T, m)
    dt : number or duration
        Interval of the grid, whose first point is time[0], as for `track`: 10, "15min", a timedelta.
    how : "mean" or "last"
        Mean of the interval, or the last value in it. An interval without a value gives NaN.
    """
    one_of("resample", "how", how, ("mean", "last"))
    (axis, _), array, clock = instants(time), as_numbers("values", values), Clock.of(dt)
    if clock.kind not in ("number", "duration"):
        raise ValueError(f"resample: a grid needs a fixed interval, such as 10 or '1h'; got dt={dt!r}.")
    columns = array.reshape(len(array), -1)
    steps = clock.between(axis[0], axis)
    if not (np.diff(steps) > 0.0).all():
        raise ValueError("resample: time must increase; sort the record and drop repeated times first.")
    bins = np.ceil(steps - 1e-9).astype(np.int64)
    size = int(bins[-1]) + 1
    known = np.isfinite(columns)
    counts = np.stack([np.bincount(bins, column, size) for column in known.T], axis=1)
    if how == "mean":
        sums = np.stack([np.bincount(bins, c, size) for c in np.where(known, columns, 0.0).T], axis=1)
        grid = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    else:
        grid = np.full((size, columns.shape[1]), np.nan)
        for j in range(columns.shape[1]):
            grid[bins[known[:, j]], j] = columns[known[:, j], j]  # the last of several values
    return Resampled(
        axis[0] + np.arange(size) * (clock.count if clock.duration is None else clock.duration),
        grid.reshape(size, *array.shape[1:]),
        np.bincount(bins, minlength=size),
    )


class Delay(NamedTuple):
    """An estimated delay: ``samples``, the correlation there, and the correlations (max_lag + 1,) at 0, 1, ...

    Unrelated signals exceed ``bound`` at one lag with probability 5 %. For ARX, ``nk`` is ``samples``.
    """

    samples: int
    correlation: float
    correlations: Array
    bound: float


def delay(y: Any, u: Any, max_lag: int = 50, order: int = 10) -> Delay:
    """Delay from u to y in samples, from the cross-correlation after prewhitening.

    An autoregression of ``order`` whitens u, and the same filter is applied to y (0: neither is filtered). Without it
    the autocorrelation of a slow input smears the peak. Missing samples count as the mean.
    """
    from scipy import signal  # with stats half of the time of importing the package

    signals = [_centred(y), _centred(u)]
    if len(signals[0]) != len(signals[1]):
        raise ValueError(f"delay: y has {len(signals[0])} samples, u has {len(signals[1])}.")
    T = len(signals[0])
    if max_lag + 2 * order >= T:
        raise ValueError(f"delay: {T} samples are too few for max_lag={max_lag} and order={order}.")
    if order:
        past = _past(signals[1], order)
        a, *_ = np.linalg.lstsq(past, signals[1][order:], rcond=None)
        signals = [signal.lfilter(np.concatenate([[1.0], -a]), [1.0], s)[order:] for s in signals]
    out, inp = (s - s.mean() for s in signals)
    size = float(np.sqrt((out @ out) * (inp @ inp)))
    products = signal.correlate(out, inp, mode="full")[len(inp) - 1 : len(inp) + max_lag]
    correlations = products / size if size > 0.0 else np.zeros(max_lag + 1)
    best = int(np.argmax(np.abs(correlations)))
    return Delay(best, float(correlations[best]), correlations, 1.96 / float(np.sqrt(len(inp))))


class Feedback(NamedTuple):
    """Whether the past of y helps to predict u: the F statistic of Granger's test and its probability by chance."""

    statistic: float
    probability: float


def feedback(y: Any, u: Any, lags: int = 5, level: float = 0.001) -> Feedback:
    """Warn if the input is a function of past outputs, as with a controller or an operator who reacts.

    In closed loop, innovations and later inputs are correlated. An ARX model with enough lags and a delay of at least
    one sample still tracks correctly, but correlations (`delay`), models without noise terms and too few lags mislead.

    u is regressed on its own ``lags`` and then also on those of y. A UserWarning is issued if the second regression is
    better, with a p-value below ``level``.
    """
    from scipy import stats

    out, inp = _centred(y), _centred(u)
    own = _past(inp, lags)
    both = np.column_stack([own, _past(out, lags)])
    rest = [float(np.sum((inp[lags:] - x @ np.linalg.lstsq(x, inp[lags:], rcond=None)[0]) ** 2)) for x in (own, both)]
    freedom = len(inp) - lags - both.shape[1]
    if freedom < 1:
        raise ValueError(f"feedback: {len(inp)} samples are too few for {lags} lags.")
    statistic = (rest[0] - rest[1]) / lags / max(rest[1] / freedom, np.finfo(float).tiny)
    result = Feedback(statistic, float(stats.f.sf(statistic, lags, freedom)))
    if result.probability < level:
        warnings.warn(
            f"the past of y predicts u (F = {statistic:.1f}, p = {result.probability:.2g}): the record may be from a "
            "closed loop. Use an ARX model with enough lags and nk >= 1, and do not read delays off correlations.",
            stacklevel=2,
        )
    return result


def _centred(values: Any) -> Array:
    """Values minus their mean, with 0 for missing ones."""
    array = np.asarray(prepared(values))
    known = np.isfinite(array)
    return np.where(known, array - (array[known].mean() if known.any() else 0.0), 0.0)


def _past(values: Array, lags: int) -> Array:
    """(T - lags, lags): the values before each sample."""
    return np.stack([values[lags - k : len(values) - k] for k in range(1, lags + 1)], axis=1)


@dataclass(frozen=True)
class Restored:
    """A run in the units of the raw signals.

    ``theta``, ``std`` (T, n); ``prediction``, ``innovation``, ``innovation_std`` (T,); theta was multiplied by
    ``factors`` (n,). The intercept of a model refers to the level that was removed. ``notes`` lists the operations on
    every signal.
    """

    names: tuple[str, ...]
    theta: Array
    std: Array
    prediction: Array
    innovation: Array
    innovation_std: Array
    factors: Array
    notes: dict[str, tuple[str, ...]]


def restore(run: Track, y: Any, u: Any = ()) -> Restored:
    """Convert a run on prepared signals to the units of the raw signals.

    Parameters
    ----------
    run : Track
        What `track` returned for these signals.
    y, u : Prepared or (T,); u also a sequence of them, one per input
        The signals that were passed to `track`.

    Raises
    ------
    ValueError
        If the model does not declare the units of its parameters, or the number of inputs is not that of the model.
    """
    output = prepared(y)
    several = isinstance(u, Sequence) and not (len(u) and np.isscalar(u[0]))
    inputs = [prepared(one) for one in (u if several else [u])]
    dimensions = run.model.dimensions
    if dimensions is None or run.names != run.model.names:
        raise ValueError(f"restore: {run.model!r} does not declare the units of its parameters.")
    if len(inputs) != run.model.m:
        raise ValueError(f"restore: the model has {run.model.m} inputs, but {len(inputs)} were given.")
    factors = np.array([output.factor**p / (1.0 if j is None else inputs[j].factor) for p, j in dimensions])
    return Restored(
        run.names, run.theta * factors, run.std * np.abs(factors), output.raw(run.prediction),
        run.innovation * output.factor, run.innovation_std * output.factor, factors,
        {"y": output.notes, **{f"u{j + 1}": one.notes for j, one in enumerate(inputs)}},
    )  # fmt: skip
