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
from driftfit.kernel import Array
from driftfit.settings import whole
from driftfit.signals import as_inputs, as_numbers

if TYPE_CHECKING:
    from driftfit.live_outputs import LiveOutputs
    from driftfit.models.base import Model
    from driftfit.outputs import Outputs
    from driftfit.result import Track
    from driftfit.shared_outputs import Shared
    from driftfit.trackers.base import Tracker


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
    return forecast_from(run.model, run.tracker, final_state(run), future(run.model, h, u))


def future(model: Model, h: int, u: Any) -> Array:
    """Future inputs (h, m), NaN where they are not known."""
    whole("forecast", "h", h, 1)
    inputs = np.full((h, model.m), np.nan) if u is None else as_inputs(u, h)
    if inputs.shape[1] != model.m:
        raise ValueError(f"forecast: the model has {model.m} inputs, but u has {inputs.shape[1]} columns.")
    return inputs


def forecast_from(model: Model, tracker: Tracker, tile: Array, inputs: Array) -> Forecast:
    """Forecast from the state in a tile of one lane, which is driven on."""
    look, h, now = tile.copy(), len(inputs), tile["theta"][0, :, 0].copy()
    steps = drivers(model.steps, tracker.steps_for(model))
    update = steps.update.entry(tile_type(tile), types.float64, INPUTS)
    noise = tile["r"][0, 0] * tile["scale"][0, 0] if "r" in storage.fields(tile) else np.nan
    result = Forecast(np.empty((h, len(now))), np.empty((h, len(now))), np.empty(h), np.empty(h))
    for k in range(h):
        look[...] = tile
        y_hat, _, s, _ = update(look, np.nan, inputs[k])
        # the forecast takes the place of the output among the lags, and is no observation
        tile["noise"] = np.inf
        update(tile, y_hat, inputs[k])
        tile["noise"] = 1.0
        result.theta[k], result.std[k] = tile["theta"][0, :, 0], np.sqrt(tile["var"][0, :, 0])
        result.y_hat[k], result.y_std[k] = y_hat, s
    if tracker.output_error:  # its innovation is that of y, whose noise is never fed back
        return result._replace(y_std=np.sqrt(result.y_std))
    response = model.noise_response(now, h)
    later = noise * model.noise_factor(now, result.y_hat[0]) * (np.cumsum(response**2) - response[0] ** 2)
    return result._replace(y_std=np.sqrt(result.y_std + later) / model.output_slope(now, result.y_hat))


def forecast_outputs(run: Outputs | Shared, h: int, u: Any = None) -> Forecast:
    """Forecast h nominal samples of several outputs: theta and std (h, ny, n) or (h, n), y_hat and y_std (h, ny)."""
    from driftfit.live_outputs import LiveOutputs

    end: Any = run.end()
    model: Any = run.model
    tracker = end.tracker[0] if model.shared else dict(zip(run.outputs, end.tracker, strict=True))
    if model.shared:
        model = replace(model, regressors=run.rows.model.m)
    return drive_on(LiveOutputs(model, tracker, warm_start=run), h, u)


def drive_on(live: LiveOutputs, h: int, u: Any) -> Forecast:
    """Forecast from where a stream of several outputs stands, which is driven on."""
    whole("forecast", "h", h, 1)
    inputs = [None] * h if u is None else list(as_numbers("u", u))
    if len(inputs) != h:
        raise ValueError(f"forecast: u must have a row for each of the {h} samples; got shape {np.shape(u)}.")
    model: Any = live.model
    state = {name: live._tile[name][0] for name in storage.fields(live._tile)}
    now, noise = live.theta, state["r"] * state["scale"] if "r" in state else np.nan
    if live.awaits:
        live.apply(inputs[0])
        inputs = [*inputs[1:], None]
    parts: list[tuple[Array, ...]] = []
    for row in inputs:
        y_hat, s = live.predict(row)
        live.pass_by(y_hat, row)  # the forecast takes the place of the outputs among the lags
        parts.append((live.theta, live.std, y_hat, s))
    theta, std, means, variances = (np.array(part) for part in zip(*parts, strict=True))
    if not model.shared and hasattr(model, "output_lags"):
        response = model.noise_response(now, h) ** 2 @ np.broadcast_to(noise, len(model.outputs))
        variances = variances + np.cumsum(response, axis=0) - response[0]
    return Forecast(theta, std, means, np.sqrt(variances))


def final_state(run: Track) -> Array:
    """The state after the last sample, as a tile of one lane."""
    return resting(run.model, run.tracker, run._tile, run._lane)


def resting(model: Model, tracker: Tracker, from_tile: Array, lane: int = 0) -> Array:
    """The state of a lane as a tile of one lane; what was known of its last sample alone is left behind."""
    tile = make_tile(model.n, model.m, model.memory(), [tracker.state_for(model)])
    for name in storage.fields(tile):
        if name not in STANDING:
            tile[name][0, ..., 0] = from_tile[name][0, ..., lane]
    return tile
