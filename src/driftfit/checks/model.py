"""The promises of a model: `check_model`.

The model is run over a small record of white inputs and outputs with theta held constant, so that every number can be
compared with what the model declares. This takes about as long as compiling the model five times.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.models.base import Model
from driftfit.results import Track
from driftfit.run.parallel_lanes import FEWEST_LANES
from driftfit.smooth.problem import replay
from driftfit.streams import Live
from driftfit.trackers.base import Tracker
from driftfit.trackers.joint_kalman import JointKalman
from driftfit.trackers.kalman import Kalman
from driftfit.tracking import track

T = 60
AT = 30
"""The sample that is changed or missing."""


def check_model(model: Model, theta: Any = None) -> list[str]:
    """The promises that a model breaks, one sentence each; an empty list if it keeps them all.

    Parameters
    ----------
    model : Model
        With one output.
    theta : (n,) or None
        A system of the model that is stable and, where outputs are inverted, increasing; None: 0.1 everywhere.
    """
    bound = model.bind(model.m)
    broken = list(_settings(model)) + list(_named(bound))
    if broken:
        return broken
    value = np.full(bound.n, 0.1) if theta is None else np.asarray(theta, dtype=float)
    kind = Kalman if bound.hidden is None else JointKalman
    still = kind(q=0.0, r=1.0, p0=1e-20, theta0=tuple(value.tolist()))
    y, u = signals(bound.m)
    try:
        run = track(bound, still, y, u)
    except Exception as error:  # whatever the error is, the author of the tracker wants to read it
        first = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        return [f"It does not run: {type(error).__name__}: {first.strip()}"]
    for check in (_live, _lanes, _reach, _touched, _regressors, _density, _forward, _late_input, _follows, _shown):
        broken += check(bound, still, run)
    return broken


def signals(m: int, seed: int = 0) -> tuple[Array, Array]:
    """y (T,) and u (T, m), uniform on -1 to 1; the outputs of the first samples span all later ones."""
    rng = np.random.default_rng(seed)
    y = 0.9 * rng.uniform(-1.0, 1.0, T)
    y[:4] = 1.0, 1.0, -1.0, -1.0
    return y, rng.uniform(-1.0, 1.0, (T, m))


def _same(one: Any, other: Any) -> bool:
    return bool(np.array_equal(one, other, equal_nan=True))


def _settings(model: Model) -> Iterator[str]:
    kind = type(model).__name__
    try:
        if type(model).from_settings(json.loads(json.dumps(model.settings()))) != model:
            yield f"{kind} is not the same after its settings were written down and read back; make lists tuples."
    except (TypeError, ValueError) as error:
        yield f"The settings of {kind} are not plain data (numbers, text, None, tuples of these): {error}."


def _named(model: Model) -> Iterator[str]:
    if model.bind(model.m) != model:
        yield "bind changes a model that is bound."
    if len(set(model.names)) != model.n:
        yield f"names must be {model.n} different names; got {model.names}."
    if model.input_names and len(model.input_names) != model.m:
        yield f"input_names must be {model.m} names, or none; got {model.input_names}."
    if model.dimensions is not None and len(model.dimensions) != model.n:
        yield f"dimensions must have an entry for each of the {model.n} parameters; got {len(model.dimensions)}."
    if model.output_lags is not None and not 0 <= model.output_lags <= model.n:
        yield f"output_lags must be at most n = {model.n}; got {model.output_lags}."


def _live(model: Model, still: Tracker, run: Track) -> Iterator[str]:
    y, u = run.y.copy(), run.u.copy()
    y[AT], u[AT + 8] = np.nan, np.nan
    record, live = track(model, still, y, u), Live(model, still)
    for t in range(T):
        step = live.update(y[t], u[t])
        if not _same(step[:2], (record.prediction[t], record.innovation[t])):
            yield f"Live and track differ from sample {t} on: keep all memory in fields of the state."
            return


def _lanes(model: Model, still: Tracker, run: Track) -> Iterator[str]:
    count = max(FEWEST_LANES, still.width) + 1
    y, u = (np.stack(part) for part in zip(*(signals(model.m, seed) for seed in range(count)), strict=True))
    fleet = track(model, still, y, u, by="row")
    for key in (1, count - 1):
        alone = track(model, still, y[key], u[key])
        if not all(
            _same(getattr(fleet[key], name), getattr(alone, name)) for name in ("prediction", "innovation", "ok")
        ):
            yield "A series gives other results in a fleet than alone: index every field with [..., l]."
            return


def _reach(model: Model, still: Tracker, run: Track) -> Iterator[str]:
    y, u = run.y.copy(), run.u.copy()
    y[AT] += 0.01
    u[AT] += 0.01
    changed = np.flatnonzero((replay(track(model, still, y, u))["phi"] != replay(run)["phi"])[..., 0].any(axis=1))
    if changed.size and changed[0] < AT:
        yield f"It looks ahead: signals of sample {AT} are in the regressors of sample {changed[0]}."
    endless = model.hidden is not None or model.linearised is not None  # regressors hold its own results
    if changed.size and changed[-1] > AT + model.reach and not endless:
        yield f"reach is {model.reach}, but signals of sample {AT} are in the regressors of sample {changed[-1]}."


def _touched(model: Model, still: Tracker, run: Track) -> Iterator[str]:
    for name in ("y", *(("u",) if model.m else ())):
        y, u = run.y.copy(), run.u.copy()
        (y if name == "y" else u)[AT] = np.nan
        lost = np.flatnonzero(run.ok & ~track(model, still, y, u).ok)
        declared = None if model.implicit is None else model.implicit.touched(AT, name)
        expected = [AT] if declared is None and name == "y" else None if declared is None else list(declared)
        if expected is not None and lost.tolist() != expected:
            yield f"A missing {name} at sample {AT} makes samples {lost.tolist()} unusable; declared: {expected}."


def _regressors(model: Model, still: Tracker, run: Track) -> Iterator[str]:
    phi = replay(run)["phi"][..., 0]
    for i in range(model.output_lags or 0):
        if not _same(phi[AT, i], run.y[AT - 1 - i]):
            yield f"output_lags is {model.output_lags}, but regressor {i} is not the output {i + 1} samples before."
    if getattr(model, "intercept", False) and not (phi[run.ok, -1] == 1.0).all():
        yield "intercept is declared, but the last regressor is not 1."
    if model.terms is None:
        return
    if len(model.terms) != model.n:
        yield f"terms must have an entry for each of the {model.n} parameters; got {len(model.terms)}."
        return
    for i, (what, j, lag) in enumerate(model.terms):
        value = 1.0 if what == "1" else (run.y if what == "y" else run.u[:, j])[AT - lag]
        if not _same(phi[AT, i], value):
            yield f"terms declares regressor {i} as {(what, j, lag)}, but it has another value."


def _density(model: Model, still: Tracker, run: Track) -> Iterator[str]:
    y, ok = run.y.copy(), run.ok
    error = (run.y - run.prediction)[ok]
    if model.implicit is None:
        if not np.allclose(run.innovation[ok], error, atol=1e-9):
            yield "The innovation is not y minus its prediction; a model with another residual declares `implicit`."
        return
    step = 1e-6
    y[AT] += step
    slope = abs(track(model, still, y, run.u).innovation[AT] - run.innovation[AT]) / step
    if not np.isclose(
        np.log(slope), model.implicit.log_jacobian(run.theta[AT : AT + 1], run.y[AT : AT + 1])[0], atol=1e-4
    ):
        yield f"log_jacobian is not the logarithm of the slope of the innovation against y, which is {slope:.6g}."


def _forward(model: Model, still: Tracker, run: Track) -> Iterator[str]:
    h = 3
    past = slice(AT - model.reach, AT)
    try:
        played = model.play(
            run.theta[:1], run.y[None, past], run.u[None, past.start : AT + h], np.zeros((1, h)), (-1.0, 1.0)
        )
    except ValueError:
        return  # the model does not define how it runs forward
    live = Live(model, still)
    for t in range(AT):
        live.update(run.y[t], run.u[t])
    for k in range(h):
        expected = live.predict(run.u[AT + k])[0]
        if not abs(played[0, k] - expected) < 1e-6 * max(1.0, abs(expected)):
            yield f"play gives {played[0, k]:.9g} for {k + 1} samples ahead, but the steps predict {expected:.9g}."
            return
        live.update(played[0, k], run.u[AT + k])


def _late_input(model: Model, still: Tracker, run: Track) -> Iterator[str]:
    if model.steps.apply is None or not model.m:
        return
    live = Live(model, still)
    for t in range(T):
        step = live.update(run.y[t])
        live.apply(run.u[t])
        if not _same(step[:2], (run.prediction[t], run.innovation[t])):
            yield f"An input given by apply has another effect than one given with its output, from sample {t} on."
            return


def _follows(model: Model, still: Tracker, run: Track) -> Iterator[str]:
    if not model.follows(model):
        yield "follows returns False for the model itself, so no run could be continued."
        return
    first = track(model, still, run.y[:AT], run.u[:AT])
    if not _same(track(model, still, run.y[AT:], run.u[AT:], warm_start=first).prediction, run.prediction[AT:]):
        yield "A run continued with warm_start differs from an uninterrupted one: memory must hold the whole state."


def _shown(model: Model, still: Tracker, run: Track) -> Iterator[str]:
    if model.hidden is None:
        return
    wide = JointKalman(q=0.0, r=1.0, p0=1e-6, theta0=tuple(run.theta[0].tolist()))
    var = track(model, wide, run.y, run.u).var[-1]
    parameters = model.names[: model.n - len(model.hidden)]
    for name in [name for name, one in zip(parameters, var.tolist(), strict=False) if one > 1e-6 * (1.0 - 1e-9)]:
        yield f"The output says nothing of {name}: no line leads from it to the output, or its effect vanishes here."
