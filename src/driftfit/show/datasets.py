"""Results as xarray datasets, with labelled dimensions.

    run.to_xarray()      dimensions time (or sample), parameter, input
    fleet.to_xarray()    the same and one dimension more, `unit`, over the union of all times (absent samples are NaN)

Variables: ``theta``, ``theta_std`` (time, parameter); ``y``, ``prediction``, ``innovation``, ``innovation_std``,
``used`` (time); ``u`` (time, input). Of several outputs with one theta each, `output` is the further dimension; of
outputs that share one theta, y and what follows it are (time, output). Units are attributes. Times are UTC where the
record had a time zone; ``attrs`` names it.

Needs xarray (``pip install "driftfit[xarray]"``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from driftfit.run.keyed_results import KeyedResults
from driftfit.run.outputs import Outputs
from driftfit.run.result import Track
from driftfit.show.parts.text import key_text

if TYPE_CHECKING:
    import xarray


def to_xarray(result: Track | KeyedResults) -> xarray.Dataset:
    """A result as a dataset; ImportError without xarray."""
    try:
        import xarray
    except ImportError:
        raise ImportError('to_xarray needs xarray: pip install "driftfit[xarray]"') from None
    if isinstance(result, KeyedResults):
        dimension = "output" if isinstance(result, Outputs) else "unit"
        keys = xarray.DataArray([key_text(key) for key in result], dims=dimension, name=dimension)
        return xarray.concat([_dataset(xarray, run) for run in result.values()], dim=keys, join="outer")
    return _dataset(xarray, result)


def _dataset(xarray: Any, run: Track) -> xarray.Dataset:
    labels = run.labels
    time = (labels.time or "time") if run.timed else "sample"
    rows: tuple[str, ...] = (time, "output") if run.rows_per_instant > 1 else (time,)
    inputs = labels.u or tuple(f"u{j + 1}" for j in range(run.u.shape[-1]))
    variables = {
        "theta": ((time, "parameter"), run.theta),
        "theta_std": ((time, "parameter"), run.std),
        "y": (rows, run.y, {"long_name": labels.y, "units": labels.units.get(labels.y, "")}),
        "prediction": (rows, run.prediction),
        "innovation": (rows, run.innovation),
        "innovation_std": (rows, run.innovation_std),
        "used": (rows, run.ok.astype(bool)),
    }
    coordinates: dict[str, Any] = {time: run.time, "parameter": list(run.names)}
    if inputs:
        variables["u"] = ((*rows, "input"), run.u)
        coordinates["input"] = list(inputs)
    if run.rows_per_instant > 1:
        coordinates["output"] = list(run.outputs)
    attributes = {"model": repr(run.model), "tracker": repr(run.tracker), "loglik": float(run.loglik)}
    if labels.zone is not None:
        attributes["time_zone"] = str(labels.zone)
    found: xarray.Dataset = xarray.Dataset(variables, coordinates, attributes)
    return found.assign_coords(unit_of_parameter=("parameter", np.array(run.units, dtype=str)))
