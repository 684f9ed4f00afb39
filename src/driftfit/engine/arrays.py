"""Conversion of what users pass as numbers: arrays of floats, missing values as NaN, known factors of variances."""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import Array


def as_numbers(name: str, values: Any) -> Array:
    """Values as floats; None and masked entries become NaN; for text the error names its position."""
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(float), np.nan)
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        pass
    given = np.asarray(values, dtype=object)
    out = np.empty(given.shape)
    for place, value in np.ndenumerate(given):
        try:
            out[place] = np.nan if value is None or value == "" else float(value)
        except (TypeError, ValueError):
            where = f"entry {place[0] if len(place) == 1 else place}" if place else "it"
            raise ValueError(f"{name}: {where} is {value!r}, which is not a number.") from None
    return out


def factor(name: str, value: Any, T: int | None = None) -> Array:
    """A known factor of a variance: finite and not negative, one number or one per sample."""
    if type(value) is float and 0.0 <= value < np.inf:  # what most calls give, at a tenth of the cost
        return np.asarray(value)
    array = as_numbers(name, value)
    if array.ndim > 1 or (array.ndim == 1 and len(array) != T):
        raise ValueError(f"{name} must be one number or one per sample ({T}); got shape {array.shape}.")
    if not (np.isfinite(array) & (array >= 0.0)).all():
        raise ValueError(f"{name} must be finite and not negative everywhere.")
    return array
