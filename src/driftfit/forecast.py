"""Forecasts beyond the end of a record: what theta and y will be when nobody has looked.

    theta_{T+h} = theta_T,   Cov = P_T + h q                               (what `predict` does, h times)
    y_{T+h}     = phi' theta,  Var = phi' (P_T + h q) phi + r sum_{j<h} psi_j^2

where an output lag that is not known yet is its own forecast, and psi is the response of y to one noise: 1 for models
without output lags, the response of 1 / A(z) for ARX. Parameter and noise errors are added as if independent, and the
product of the two is neglected, so bands of an ARX forecast are approximate beyond the first step. With several outputs
psi is a matrix, and the noises of the outputs are taken to be independent. A Hammerstein-Wiener model is fitted to
w = F(y): its errors are those of w, psi the response of 1 / A(z), divided by the slope F'(y_hat).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import types

from driftfit import storage
from driftfit.drivers import INPUTS, drivers, make_tile, tile_type
from driftfit.frames import inputs_for
from driftfit.kernel import Array
from driftfit.settings import whole
from driftfit.signals import as_numbers

if TYPE_CHECKING:
    from driftfit.outputs import Outputs
    from driftfit.result import Track
    from driftfit.shared_outputs import Shared


STANDING = ("interval", "noise", "drift", "each")
"""Fields that hold what is known of one sample."""


class Forecast(NamedTuple):
    """The h samples after a record."""

    theta: Array
    """(h, n)"""
    std: Array
    """(h, n): its standard deviation."""
    y_hat: Array
    """(h,): NaN where an input is not known."""
    y_std: Array
    """(h,): standard deviation of the error of y_hat; NaN for trackers without a covariance."""


def forecast(run: Track, h: int, u: Any = None) -> Forecast:
    """Forecast h nominal samples.

    Parameters
    ----------
    run : Track
        The record.
    h : int
        How many samples, at least 1.
    u : (h,), (h, m) or None
        Future inputs; None: not known, which leaves the forecast of theta.

    Raises
    ------
    ValueError
        If h is below 1, or u has not h rows and the model's number of inputs.
    """
    whole("forecast", "h", h, 1)
    model = run.model
    inputs = np.full((h, model.m), np.nan) if u is None else inputs_for(run.model, u, h)
    if inputs.shape[1] != model.m:
        raise ValueError(f"forecast: the model has {model.m} inputs, but u has {inputs.shape[1]} columns.")
    tile = final_state(run)
    look = tile.copy()
    steps = drivers(model.steps, run.tracker.steps_for(model))
    update = steps.update.entry(tile_type(tile), types.float64, INPUTS)
    n = len(run.names)
    result = Forecast(np.empty((h, n)), np.empty((h, n)), np.empty(h), np.empty(h))
    for k in range(h):
        look[...] = tile
        y_hat, _, s, _ = update(look, np.nan, inputs[k])
        # the forecast takes the place of the output among the lags, and is no observation
        tile["noise"] = np.inf
        update(tile, y_hat, inputs[k])
        tile["noise"] = 1.0
        result.theta[k], result.std[k] = tile["theta"][0, :, 0], np.sqrt(tile["var"][0, :, 0])
        result.y_hat[k], result.y_std[k] = y_hat, s
    if run.tracker.output_error:  # its innovation is that of y, whose noise is never fed back
        return result._replace(y_std=np.sqrt(result.y_std))
    response = model.noise_response(run.theta[-1], h)
    noise = tile["r"][0, 0] * tile["scale"][0, 0] if "r" in storage.fields(tile) else np.nan
    later = noise * model.noise_factor(run.theta[-1], result.y_hat[0]) * (np.cumsum(response**2) - response[0] ** 2)
    return result._replace(y_std=np.sqrt(result.y_std + later) / model.output_slope(run.theta[-1], result.y_hat))


def forecast_outputs(run: Outputs | Shared, h: int, u: Any = None) -> Forecast:
    """Forecast h nominal samples of several outputs: theta and std (h, ny, n) or (h, n), y_hat and y_std (h, ny)."""
    from driftfit.live_outputs import LiveOutputs

    whole("forecast", "h", h, 1)
    shared = run.model.shared
    inputs = [None] * h if u is None else list(as_numbers("u", u))
    if len(inputs) != h:
        raise ValueError(f"forecast: u must have a row for each of the {h} samples; got shape {np.shape(u)}.")
    end: Any = run.end()
    model: Any = run.model
    tracker = end.tracker[0] if shared else dict(zip(run.outputs, end.tracker, strict=True))
    if shared:
        model = replace(model, regressors=run.rows.model.m)
    live = LiveOutputs(model, tracker, warm_start=run)
    parts: list[tuple[Array, ...]] = []
    for row in inputs:
        y_hat, s = live.predict(row)
        live.pass_by(y_hat, row)  # the forecast takes the place of the outputs among the lags
        parts.append((live.theta, live.std, y_hat, s))
    theta, std, means, variances = (np.array(part) for part in zip(*parts, strict=True))
    if not shared and hasattr(run.model, "output_lags"):
        noise = np.broadcast_to(end.state["r"] * end.state["scale"] if "r" in end.state else np.nan, len(run.outputs))
        response = run.model.noise_response(run.theta[-1], h) ** 2 @ noise
        variances = variances + np.cumsum(response, axis=0) - response[0]
    return Forecast(theta, std, means, np.sqrt(variances))


def final_state(run: Track) -> Array:
    """The state after the last sample, as a tile of one lane; what was known of that sample alone is left behind."""
    tile = make_tile(run.model.n, run.model.m, run.model.memory(), [run.tracker.state_for(run.model)])
    for name in storage.fields(tile):
        if name not in STANDING:
            tile[name][0, ..., 0] = run._tile[name][0, ..., run._lane]
    return tile
