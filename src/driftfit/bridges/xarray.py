"""Results as xarray datasets, with labelled dimensions.

    to_xarray(run)      dimensions time (or sample), parameter, input
    to_xarray(fleet)    the same and one dimension more, `unit`, over the union of all times (absent samples are NaN)

Variables: ``theta``, ``theta_std`` (time, parameter); ``y``, ``prediction``, ``innovation``, ``innovation_std``,
``used`` (time); ``u`` (time, input). Units are attributes. Times are UTC where the record had a time zone; ``attrs``
names it.

Needs xarray (``pip install "driftfit[xarray]"``).
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from driftfit.fleets import Fleet, Outputs
from driftfit.run.result import Track
from driftfit.show.parts.text import key_text


def to_xarray(result: Track | Fleet | Outputs) -> xr.Dataset:
    """A result as a dataset; TypeError for anything but a Track, a Fleet or the Outputs of one record."""
    if isinstance(result, Track):
        return _dataset(result)
    if isinstance(result, Fleet | Outputs):
        dimension = "unit" if isinstance(result, Fleet) else "output"
        keys = xr.DataArray([key_text(key) for key in result], dims=dimension, name=dimension)
        return xr.concat([_dataset(run) for run in result.values()], dim=keys, join="outer")
    raise TypeError(f"to_xarray: expected a Track, a Fleet or Outputs; got {type(result).__name__}.")


def _dataset(run: Track) -> xr.Dataset:
    time = (run.labels.time or "time") if run.timed else "sample"
    inputs = run.labels.u or tuple(f"u{j + 1}" for j in range(run.u.shape[1]))
    variables = {
        "theta": ((time, "parameter"), run.theta),
        "theta_std": ((time, "parameter"), run.std),
        "y": (time, run.y, {"long_name": run.labels.y, "units": run.labels.units.get(run.labels.y, "")}),
        "prediction": (time, run.prediction),
        "innovation": (time, run.innovation),
        "innovation_std": (time, run.innovation_std),
        "used": (time, run.ok.astype(bool)),
    }
    if inputs:
        variables["u"] = ((time, "input"), run.u)
    coordinates = {time: run.time, "parameter": list(run.names)} | ({"input": list(inputs)} if inputs else {})
    attributes = {"model": repr(run.model), "tracker": repr(run.tracker), "loglik": float(run.loglik)}
    if run.labels.zone is not None:
        attributes["time_zone"] = str(run.labels.zone)
    found = xr.Dataset(variables, coordinates, attributes)
    return found.assign_coords(unit_of_parameter=("parameter", np.array(run.units, dtype=str)))
