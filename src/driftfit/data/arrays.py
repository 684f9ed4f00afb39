"""Series with several outputs, from arrays, rows of arrays and tables."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from driftfit.data.arguments import Held, as_inputs, held, intervals, noise_of, order_of, ordered, times_of, together
from driftfit.data.clock import LABEL, Clock
from driftfit.data.record import PLAIN, Known, Reading, Records
from driftfit.engine.kernel import Array
from driftfit.engine.settings import as_numbers, factor
from driftfit.models.base import Model


def columns_as_outputs(model: Model, y: Any, data: Any) -> tuple[Model, Any]:
    """(the model with an output for each column, y) where y lists columns of a table and the model has one output.

    ValueError for a model that cannot have several.
    """
    if data is None or isinstance(y, str) or not isinstance(y, Sequence) or len(model.outputs) > 1:
        return model, y
    if len(y) == 1:
        return model, y[0]
    if "ny" not in {field.name for field in fields(model) if field.init}:  # type: ignore[arg-type]
        named = ", ".join(map(str, y))
        raise ValueError(f"{type(model).__name__} has one output, but y names {named}; give one of them at a time.")
    return replace(model, ny=tuple(y)), y  # type: ignore[type-var]  # every model is a dataclass


def of_arrays(model: Model, y: Any, u: Any, reading: Reading) -> tuple[Model, Records]:
    """(the model with its outputs named, one series) from arrays or data frames: y (T, ny)."""
    given = {"y": held("y", y), "u": Held(u) if model.shared else held("u", u)}
    together(**given, weights=held("weights", reading.weights), drift=held("drift", reading.drift))
    model, place = named_outputs(model, given["y"].names)
    ny = len(model.outputs)
    output = as_numbers("y", given["y"].values)
    if output.ndim != 2 or output.shape[1] != ny or len(output) == 0:
        raise ValueError(f"y must be (T, {ny}) for the outputs {', '.join(model.outputs)}; got shape {output.shape}.")
    T = len(output)
    times = times_of(reading.time, list(given.values()) if reading.indexed else (), reading.dt)
    dt = LABEL if times.labels and reading.dt is None else reading.dt
    axis, gaps = (None, 1.0) if times.axis is None else intervals(times.axis, Clock.of(dt, times.zone), T)
    common, drifts = (1.0, as_numbers("drift", reading.drift)) if np.ndim(reading.drift) == 2 else (reading.drift, None)
    known = Known.of(gaps, 1.0, factor("drift", common, T))
    regressors = _shared_inputs(u, T, ny) if model.shared else as_inputs(given["u"].values, T)
    inputs, names = ordered(model, regressors, given["u"].names)
    labels = replace(PLAIN, u=names, time=times.name, zone=times.zone, dt=Clock.of(dt).plain)
    noise = _noise_of_outputs(reading.weights, T, ny)[:, place]
    return model, Records(
        (0,), np.array([0]), np.array([T]), np.ascontiguousarray(output[:, place]), inputs, known.for_outputs(noise),
        axis, labels, drifts=drifts, outputs=model.outputs,
    )  # fmt: skip


def of_rows(model: Model, y: Any, u: Any, reading: Reading) -> tuple[Model, Records]:
    """Series as the first axis of arrays: y (units, T, ny), u (units, ..), time (T,) or (units, T)."""
    outputs = as_numbers("y", y)
    if outputs.ndim != 3 or len(outputs) == 0:
        raise ValueError(f'by="row": y must be (units, T, {len(model.outputs)}); got shape {outputs.shape}.')
    inputs = None if u is None else as_numbers("u", u)
    if inputs is not None and inputs.shape[:2] != outputs.shape[:2]:
        raise ValueError(f'by="row": y has shape {outputs.shape}, so u cannot have shape {inputs.shape}.')
    axes = None if reading.time is None else np.asarray(reading.time)
    found = []
    for k, one in enumerate(outputs):
        time = axes[k] if axes is not None and axes.ndim > 1 else axes
        found.append(of_arrays(model, one, None if inputs is None else inputs[k], reading._replace(time=time))[1])
    return model, _joined(found)


def _joined(series: Sequence[Records]) -> Records:
    """Series of equal labels in one, numbered."""
    length = np.concatenate([one.length for one in series])
    y, u = (np.concatenate(part) for part in zip(*((one.y, one.u) for one in series), strict=True))
    known = Known(np.concatenate([one.known.columns for one in series]))
    times, drifts = [one.time for one in series], [one.drifts for one in series]
    return Records(
        tuple(range(len(series))), np.cumsum(length) - length, length, y, u, known,
        None if times[0] is None else np.concatenate(times), series[0].labels,  # type: ignore[arg-type]
        drifts=None if drifts[0] is None else np.concatenate(drifts),  # type: ignore[arg-type]
        outputs=series[0].outputs,
    )  # fmt: skip


def of_table(
    model: Model, y: Any, u: Any, data: Any, by: Any, reading: Reading
) -> tuple[Model, Records, Mapping[Hashable, str]]:
    """(the model with its outputs named, a series for each unit, the reasons of units without one) from a table.

    ``y`` lists the columns of the outputs, ``u`` those of the inputs (with shared=True a list for each output).
    """
    from driftfit.data.tables import read_records  # importing polars takes as long as everything else

    given = [y] if isinstance(y, str) else list(y)
    ny = len(model.outputs)
    if len(given) != ny:
        raise ValueError(f"track: y must name {ny} columns, one for each output; got {y!r}.")
    model, place = named_outputs(model, given)
    given = [given[j] for j in place]
    inputs = [] if u is None else [u] if isinstance(u, str) else list(u)
    if model.shared:
        inputs = [name for row in inputs for name in ([row] if isinstance(row, str) else row)]
    weights: Any = reading.weights
    own = [] if isinstance(weights, str) or np.ndim(weights) == 0 else list(weights)
    own = [own[j] for j in place] if len(own) == ny else own
    read, failed = read_records(
        data, given[0], [*given[1:], *inputs, *own], by, reading._replace(weights=1.0 if own else weights)
    )
    N, end = len(read.y), ny - 1 + len(inputs)
    outputs, signals, factors = np.split(read.u, [ny - 1, end], axis=1)
    signals, names = np.ascontiguousarray(signals), tuple[str, ...]()
    if model.shared:
        signals = signals.reshape(N, ny, -1)
    else:
        signals, names = ordered(model, signals, inputs)
    noise = np.repeat(read.known.over(N).noise[:, None], ny, axis=1)
    if own:
        noise = _noise_of_outputs(np.where(np.isfinite(factors), factors, 1.0), N, ny)
    labels = replace(read.labels, y="y", u=names)
    both, known = np.column_stack([read.y, outputs]), read.known.for_outputs(noise)
    return model, read._replace(y=both, u=signals, known=known, labels=labels, outputs=model.outputs), failed


def named_outputs(model: Model, names: Sequence[str]) -> tuple[Model, list[int]]:
    """(the model, its outputs named; the columns of y in their order), for columns of y with names."""
    ny = len(model.outputs)
    if len(names) != ny:
        return model, list(range(ny))
    if isinstance(model.ny, int):
        return replace(model, ny=tuple(names)), list(range(ny))  # type: ignore[type-var]
    return model, order_of(type(model).__name__, model.outputs, names, "outputs")


def _shared_inputs(u: Any, T: int, ny: int) -> Array:
    """Regressors (T, ny, m): a row for each output."""
    regressors = as_numbers("u", u)
    if regressors.ndim != 3 or regressors.shape[:2] != (T, ny):
        raise ValueError(
            f"u must be (T, ny, m) = ({T}, {ny}, m) with shared=True: a row of regressors for each output; "
            f"got shape {regressors.shape}."
        )
    return regressors


def _noise_of_outputs(weights: Any, T: int, ny: int) -> Array:
    """Factors of the noise variance, (T, ny), from weights: number, (T,), or (T, ny) for outputs that differ."""
    given = as_numbers("weights", weights)
    if given.ndim < 2:
        return np.repeat(np.broadcast_to(noise_of(given, T), T)[:, None], ny, axis=1)
    if given.shape != (T, ny):
        raise ValueError(f"weights must be one number, ({T},) or ({T}, {ny}); got shape {given.shape}.")
    noise: Array = noise_of(given.ravel(), given.size).reshape(T, ny)
    return noise
