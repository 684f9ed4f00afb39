"""The one way in for arrays, series and data frames: what a user passes as y, u, time, weights and drift.

    one series            y (T,) or (T, ny)                   u (T,), (T, m), with shared=True (T, ny, m)
    by="row"              y (units, T) or (units, T, ny)      u (units, T), (units, T, m), (units, T, ny, m)
    time                  (T,), by row also (units, T)
    weights               a number, (T,), or the shape of y; of several outputs (T, ny)
    drift                 a number, (T,), (T, n), by row also (units, T), (units, T, n)

Series and data frames bring names and an index (`driftfit.data.arguments.held`), rows of arrays bring none. Tables and
files come in by `driftfit.data.tables`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np

from driftfit.data.arguments import (
    Held,
    Times,
    as_inputs,
    as_output,
    held,
    intervals,
    noise_of,
    order_of,
    ordered,
    times_of,
    together,
)  # fmt: skip
from driftfit.data.clock import LABEL, Clock
from driftfit.data.instants import instants
from driftfit.data.record import Known, Labels, Reading, Records, row_of
from driftfit.engine.kernel import Array
from driftfit.engine.settings import as_numbers, factor
from driftfit.models.base import Model

FLOAT, ARRAY = np.dtype(np.float64), np.ndarray
BY_ROW = 'by="row": '


def from_arrays(model: Model, y: Any, u: Any, reading: Reading, by_row: bool = False) -> tuple[Model, Records]:
    """(the model, its outputs named; one series, or one for each row) as the table above lists them.

    ValueError for shapes that do not fit, for text that is no number, and for times that do not increase.
    """
    if not by_row and len(model.outputs) == 1 and (plain := _plain(y, u, reading)) is not None:
        return model, plain
    given = {"y": y, "u": u, "weights": reading.weights, "drift": reading.drift}
    parts = {name: Held(one) if by_row or (name == "u" and model.shared) else held(name, one)
             for name, one in given.items()}  # fmt: skip
    together(**parts)
    signals = (parts["y"], parts["u"])
    ny, place = len(model.outputs), [0]
    if ny > 1:
        model, place = named_outputs(model, parts["y"].names)
    output = _outputs(parts["y"].values, model.outputs, by_row)
    lead = output.shape[: 1 + by_row]
    G, T, N = output.size // (lead[-1] * ny), lead[-1], output.size // ny
    if by_row:
        times = Times() if reading.time is None else Times(*instants(reading.time))
    else:
        times = times_of(reading.time, signals if reading.indexed else (), reading.dt)
    dt = LABEL if times.labels and reading.dt is None else reading.dt
    axis, gaps = _times(times, dt, lead)
    common, drifts = _drifts(parts["drift"].values, lead)
    noise = 1.0 if ny > 1 else _per_sample("weights", parts["weights"].values, lead, noise_of)
    known = Known.of(gaps, noise, _per_sample("drift", common, lead, partial(factor, "drift")))
    inputs, names = ordered(model, _inputs(parts["u"].values, lead, ny * model.shared), parts["u"].names)
    name = parts["y"].names[0] if parts["y"].names and ny == 1 else "y"
    labels = Labels(name, names, times.name, zone=times.zone, dt=Clock.of(dt).plain)
    if ny > 1:
        known = known.for_outputs(np.tile(noise_of_outputs(parts["weights"].values, T, ny)[:, place], (G, 1)))
        output = np.ascontiguousarray(output.reshape(N, ny)[:, place])
    return model, Records(
        tuple(range(G)), np.arange(G) * T, np.full(G, T), output.reshape(N, ny) if ny > 1 else output.reshape(N),
        inputs, known, axis, labels, drifts=drifts, outputs=model.outputs if ny > 1 else (),
    )  # fmt: skip


def _plain(y: Any, u: Any, reading: Reading) -> Records | None:
    """One series of floats without times and factors, which most calls give: soon checked, with nothing to convert."""
    if not (type(y) is ARRAY and y.dtype is FLOAT and y.ndim == 1 and len(y) and reading.time is reading.dt is None):
        return None
    if not (type(reading.weights) is type(reading.drift) is float and reading.weights == reading.drift == 1.0):
        return None
    T = len(y)
    if u is None:
        u = np.zeros((T, 0))
    elif not (type(u) is ARRAY and u.dtype is FLOAT and 1 <= u.ndim <= 2 and len(u) == T):
        return None
    return Records(
        (0,), np.zeros(1, dtype=int), np.array((T,)), y, u[:, None] if u.ndim == 1 else u, row_of(1.0, 1.0, 1.0)
    )


def _outputs(y: Any, outputs: Sequence[str], by_row: bool) -> Array:
    """The outputs, (T,) or (units, T), of several with a last axis (ny,)."""
    ny = len(outputs)
    if ny == 1 and not by_row:
        return as_output(y)
    found = as_numbers("y", y)
    if found.ndim != 1 + by_row + (ny > 1) or not found.size or (ny > 1 and found.shape[-1] != ny):
        wanted = ("units, " if by_row else "") + ("T" if ny == 1 else f"T, {ny}")
        of = f", not empty, for the outputs {', '.join(outputs)}" if ny > 1 else ", not empty"
        raise ValueError(f"{BY_ROW if by_row else ''}y must be ({wanted}){of}; got shape {found.shape}.")
    return found


def _inputs(u: Any, lead: tuple[int, ...], rows: int) -> Array:
    """The inputs of all samples (N, m), or (N, rows, m) where each of several outputs has its own regressors."""
    if len(lead) == 1 and not rows:
        return as_inputs(u, lead[0])
    whole = (*lead, rows) if rows else lead
    found = np.zeros((*whole, 0)) if u is None and not rows else as_numbers("u", u)
    found = found[..., None] if found.ndim == len(whole) and not rows else found
    if found.ndim != len(whole) + 1 or found.shape[:-1] != whole:
        size = ", ".join(map(str, whole))
        wanted = f"({size}) or ({size}, m)"
        if rows:
            wanted = f"({'units, ' * (len(lead) > 1)}T, ny, m) = ({size}, m) with shared=True: a row for each output"
        raise ValueError(f"{BY_ROW if len(lead) > 1 else ''}u must be {wanted}; got shape {np.shape(u)}.")
    return found.reshape(-1, *found.shape[len(lead) :])


def _times(times: Times, dt: Any, lead: tuple[int, ...]) -> tuple[Array | None, Any]:
    """(times (N,) or None, nominal intervals before the samples) of series that have one axis, or one each."""
    if times.axis is None:
        return None, 1.0
    clock, T = Clock.of(dt, times.zone), lead[-1]
    if times.axis.ndim == 1 or len(lead) == 1:
        both = [np.broadcast_to(part, lead).ravel() for part in intervals(times.axis, clock, T)]
    elif times.axis.shape == lead:
        both = [np.concatenate(part) for part in zip(*(intervals(row, clock, T) for row in times.axis), strict=True)]
    else:
        raise ValueError(f"{BY_ROW}time must be ({T},) or {lead}; got shape {times.axis.shape}.")
    return both[0], both[1]


def _drifts(drift: Any, lead: tuple[int, ...]) -> tuple[Any, Array | None]:
    """(the factors that all parameters have, or 1; those of each parameter (N, n), or None)."""
    if np.ndim(drift) != len(lead) + 1:
        return drift, None
    each = as_numbers("drift", drift)
    if len(lead) > 1 and each.shape[:-1] != lead:
        raise ValueError(
            f"{BY_ROW}drift with a column for each parameter must be ({lead[0]}, {lead[1]}, n); got shape {each.shape}."
        )
    return 1.0, each.reshape(-1, each.shape[-1]) if len(lead) > 1 else each


def _per_sample(name: str, value: Any, lead: tuple[int, ...], convert: Any) -> Any:
    """A factor of all samples: one number, or (N,) of (T,) that all series share, or of their own."""
    if len(lead) == 1 or np.ndim(value) < 2:
        found = convert(value, lead[-1])
        return np.broadcast_to(found, lead).ravel() if np.ndim(found) else found
    array = np.asarray(value)
    if array.shape != lead:
        raise ValueError(f"{BY_ROW}{name} must be a number, ({lead[1]},) or {lead}; got shape {array.shape}.")
    return np.asarray(convert(array.ravel(), array.size))


def columns_as_outputs(model: Model, y: Any) -> tuple[Model, Any]:
    """(the model with an output for each column, y) where y lists columns of a table and the model has one output.

    ValueError for a model that cannot have several.
    """
    if isinstance(y, str) or not isinstance(y, Sequence) or len(model.outputs) > 1:
        return model, y
    if len(y) == 1:
        return model, y[0]
    if "ny" not in {field.name for field in fields(model) if field.init}:  # type: ignore[arg-type]
        named = ", ".join(map(str, y))
        raise ValueError(f"{type(model).__name__} has one output, but y names {named}; give one of them at a time.")
    return replace(model, ny=tuple(y)), y  # type: ignore[type-var]  # every model is a dataclass


def named_outputs(model: Model, names: Sequence[str]) -> tuple[Model, list[int]]:
    """(the model, its outputs named; the columns of y in their order), for columns of y with names."""
    ny = len(model.outputs)
    if len(names) != ny:
        return model, list(range(ny))
    if isinstance(model.settings().get("ny"), int):
        return replace(model, ny=tuple(names)), list(range(ny))  # type: ignore[type-var]
    return model, order_of(type(model).__name__, model.outputs, names, "outputs")


def noise_of_outputs(weights: Any, T: int, ny: int) -> Array:
    """Factors of the noise variance, (T, ny), from weights: number, (T,), or (T, ny) for outputs that differ."""
    given = as_numbers("weights", weights)
    if given.ndim < 2:
        return np.repeat(np.broadcast_to(noise_of(given, T), T)[:, None], ny, axis=1)
    if given.shape != (T, ny):
        raise ValueError(f"weights must be one number, ({T},) or ({T}, {ny}); got shape {given.shape}.")
    return np.asarray(noise_of(given.ravel(), given.size).reshape(T, ny))
