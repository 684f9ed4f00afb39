"""Signals as users pass them: arrays of numbers, times, and settings that must be complete."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from driftfit.data.clock import LABEL, Clock
from driftfit.data.times.instants import instants, warn_of_counted_years, warn_of_written_numbers
from driftfit.engine.drivers import LARGEST, SMALLEST
from driftfit.engine.kernel import Array
from driftfit.engine.settings import Settings, as_numbers, factor, missing_settings, warn

S = TypeVar("S", bound=Settings)
ENOUGH = 1000
"""Numbers of a signal that are looked at to find its size."""


def check_ready(tracker: S) -> S:
    """Raise an error for a tracker with missing settings."""
    missing = missing_settings(tracker)
    if missing:
        name = type(tracker).__name__
        raise ValueError(
            f"{name}: {', '.join(missing)} must be given: {name}({', '.join(f'{m}=...' for m in missing)})."
        )
    return tracker


def as_output(y: Any) -> Array:
    """The output as an array (T,)."""
    array = as_numbers("y", y)
    if array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim != 1:
        hint = " Several outputs are for a model with ny=; elsewhere take one column." if array.ndim == 2 else ""
        raise ValueError(f"y must have one axis, (T,); got shape {array.shape}.{hint}")
    if len(array) == 0:
        raise ValueError("y is empty: there is nothing to track.")
    return array


def as_inputs(u: Any, T: int) -> Array:
    """The inputs as an array (T, m); None means that there are none."""
    if u is None:
        return np.zeros((T, 0))
    array = as_numbers("u", u)
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2:
        raise ValueError(f"u must be (T,) or (T, m); got shape {array.shape}.")
    if len(array) != T:
        hint = f" u.T has shape {array.T.shape}." if array.shape[1] == T else ""
        raise ValueError(f"y has {T} samples but u has shape {array.shape}: the first axis must be time.{hint}")
    return array


def warn_of_sizes(names: Sequence[str], values: Array) -> None:
    """Warn of columns (N, k) most numbers of which are so large that they count as missing, or so small that they count
    as 0, by a thousand numbers of each.
    """
    for name, column in zip(names, values[:: len(values) // ENOUGH + 1].T, strict=True):
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


def noise_of(weights: Any, T: int | None = None) -> Any:
    """Factor of the noise variance, 1 / w; a weight of 0 makes it infinite, which makes the sample unusable."""
    given = factor("weights", weights, T)
    if type(weights) is float and weights > 0.0:
        return 1.0 / weights
    with np.errstate(divide="ignore"):
        return np.divide(1.0, given)


def intervals(time: Any, dt: Any, T: int) -> tuple[Array, Array]:
    """(time, nominal intervals (T,)) of a record; the first interval is 1. Unsorted or repeated times raise errors."""
    axis, _ = instants(time)
    if axis.shape != (T,):
        raise ValueError(f"time has shape {axis.shape}, but y has {T} samples.")
    bad = np.flatnonzero(~(axis[1:] > axis[:-1])) + 1
    if bad.size:
        i = int(bad[0])
        raise ValueError(
            f"time must increase: time[{i - 1}] = {axis[i - 1]} is followed by time[{i}] = {axis[i]}; "
            "sort the record and drop repeated times first."
        )
    clock = Clock.of(dt)
    warn_of_counted_years(axis)
    if clock.kind != LABEL:
        warn_of_written_numbers(axis)
    return axis, clock.steps(axis)
