"""Tune: estimate settings from a record.

    "ml"       maximum likelihood of the one-step predictions, with the noise variance in closed form where possible
    "h-step"   least mean square of y_t - phi_t' theta_{t-h} after the start: settings for predicting h samples ahead
    "loo"      least mean square of leave-one-out residuals of the smoothed path, eps / (1 - leverage)
    "gcv"      (r_M^2 / N) / (1 - mean leverage)^2 of the smoothed path

Use "ml" first. If drift is a random walk it is consistent and gives intervals; if not, it was still the best method or
close to it in our reproductions. "loo" and "gcv" choose for the smoothed path and assume no distribution; "h-step" is
the only method for trackers without a variance (`AugmentedFLS`). All of them use the whole record: for a stream, use a
tracker that tunes itself.

A grid runs as lanes: 32 settings cost about as much as a few. A quasi-Newton search on log settings and profile
intervals of the likelihood follow (see `driftfit.tune`). Source: the likelihood of de Jong (1991), diffuse start;
leave-one-out after Allen (1974), GCV after Craven and Wahba (1979).

Outputs with a separate theta have separate noise, so each gets its own settings: `TunedOutputs.tracker` maps the name
of an output to its tracker, in the form that `track` and `Live` take. Regressors are those of constant parameters,
whose predictions also fill missing lags.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from driftfit.data.arguments import check_roles
from driftfit.data.arrays import columns_as_outputs
from driftfit.data.record import Reading
from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import Array
from driftfit.engine.settings import one_of, whole
from driftfit.judge.constant_fit import constant_outputs, decided_by
from driftfit.models.base import Model
from driftfit.readings.left_out import NOTHING_LEFT_OUT
from driftfit.run.live.conformal import quantile
from driftfit.run.track import decide, records_of, run_quietly, warn_of_codes
from driftfit.show.text import ByOutput
from driftfit.trackers.base import Tracker
from driftfit.tune.inference import unknown_at_start
from driftfit.tune.lanes import Task, score
from driftfit.tune.parametrisation import find_knobs
from driftfit.tune.search import Counted, Criterion, Search, along, intervals_of, minimise, run_task
from driftfit.tune.tuned import METHODS, Tuned


def tune(
    model: Model,
    tracker: Tracker,
    y: Any,
    u: Any = None,
    *,
    method: str = "ml",
    groups: Any = None,
    h: int = 1,
    bounds: tuple[float, float] | None = None,
    level: float = 0.95,
    intervals: bool = True,
    order_by: Any = None,
    data: Any = None,
    by: Any = None,
    time: Any = None,
    dt: Any = None,
    weights: Any = 1.0,
    drift: Any = 1.0,
    limits: Any = None,
    exclude: Any = None,
    missing: Any = (),
    gate: Any = None,
) -> Tuned | TunedOutputs:
    """Estimate the missing settings of a tracker: ``FLS()``, ``Kalman()``, ``Kalman(r=0.1)``, ``RLS()`` ...

    Parameters
    ----------
    model, y, u, data, time, dt, weights, drift, limits, exclude, missing
        As for `track`: with ``data`` the others name its columns.
    tracker : Tracker
        Settings that are None are estimated: mu, q, r, q and r, or forgetting. All others are kept. For a `Bank` these
        are the scales of its changes, as factors of their standard deviations, and their prior probabilities; the
        criterion is its log evidence.
    method : "ml", "h-step", "loo" or "gcv"
        The criterion, see the module.
    groups : None, "each", or n labels
        Which parameters share a drift. None: all. With `Kalman`, and with labels, a shared drift is the same *in the
        output*: q_i is proportional to the inverse of the mean square of regressor i. ``FLS`` without groups has one mu
        for all, as in its source. q of a group may be zero.
    h : int
        Samples ahead, for "h-step".
    bounds : (low, high)
        Range of the setting: of mu, q, r or forgetting, of q / r if both are estimated, of the scales of a `Bank`. A
        drift of zero is then excluded. Default: mu or r / q from 1e-4 to max(1e5, T^2) times the mean square of the
        regressors, r from 1e-9 to 1e3 times the residual variance of constant parameters, a memory of 2 n to 100 T
        samples, scales from 1e-3 to 1e3.
    level : number
        Level of the intervals.
    intervals : bool
        False leaves them out (NaN): they take most of the time of a short record.
    gate : bool, `Gate`, decisions of a run or None
        As for `track`. The gate decides once, by a run of `AdaptiveKalman`, and what it leaves out is left out for all
        settings: ``tuned.left_out``, which ``track(model, tuned.tracker, y, u, gate=tuned.left_out)`` takes.
    by : names of columns, "row" or None
        As for `track`: several records, which share the settings but not theta. The criterion is that of all of them
        together, such as the sum of their log-likelihoods, and every record begins with an unknown theta.
    order_by : (T,)
        Tune for ``run.smooth(order_by=...)``: theta is a random walk along this variable instead of time.

    Returns
    -------
    Tuned. A model with several outputs gives `driftfit.tune.tune.TunedOutputs`, one for each output (if they share
    one theta, one `Tuned` for all).

    Warns
    -----
    UserWarning
        If the optimum is at a bound of the search other than zero.

    Raises
    ------
    ValueError
        If there is nothing to estimate, the tracker does not support the method, no sample is usable, and for
        everything that `track` does not accept.
    """
    check_roles("tune", model, tracker)
    if data is not None:
        model, y = columns_as_outputs(model, y)
    one_of("tune", "method", method, tuple(METHODS))
    whole("tune", "h", h, 1)
    quantile(level, "tune")  # whether there is one
    if method != "h-step" and not tracker.covariance:
        raise ValueError(f"tune: {type(tracker).__name__} has no variance, so {method!r} is undefined; use 'h-step'.")
    reading = Reading(time, dt, weights, drift, limits=limits, exclude=exclude, missing=missing, gate=gate)
    if len(model.outputs) > 1:
        options = (method, groups, h, bounds, level if intervals else None, order_by)
        return tune_outputs(model, tracker, y, u, reading, data, by, lambda task: _tuned(task, tracker, *options))
    task = _task(model, tracker, y, u, reading, data, by)
    return _tuned(task, tracker, method, groups, h, bounds, level if intervals else None, order_by)


def _tuned(
    task: Task, tracker: Tracker, method: str, groups: Any, h: int, bounds: Any, level: float | None, order_by: Any
) -> Tuned:
    """Tune on a checked record; without a level there are no intervals."""
    if order_by is not None:
        task = along(task, tracker, order_by)
    knobs = find_knobs(task, tracker, groups, bounds)
    f = Counted(Criterion(task, knobs, method, h))
    search = Search(f, knobs, minimise(f, knobs))
    final = score(task, [knobs.run(search.x)], h)
    sigma2 = float(final.sigma2()[0])
    y = np.concatenate([record.y.ravel() for record in task.records])
    y = y[np.isfinite(y)]
    largest = float(np.max(np.abs(y), initial=0.0))
    if knobs.profiled and tracker.covariance and not sigma2 > (ROUNDING * largest) ** 2:
        raise ValueError(_without_noise(y, task.model.n))
    at_bound = [i for i, own in enumerate(knobs.owner) if search.at_bound(own)]
    stuck = [knobs.names[i] for i in at_bound if np.isfinite(search.x[knobs.owner[i]])]  # zero is a valid result
    if stuck:
        warnings.warn(
            f"tune: {', '.join(stuck)} ended at a bound of the search. The record does not determine it in that "
            "direction, and the noise variance may be wrong; give bounds=(low, high) to search further.",
            UserWarning,
            stacklevel=3,
        )
    built = knobs.build(search.x, sigma2)
    runs, left_out = run_task(task, built), task.left_out or {}
    if not task.left_out and not task.model.shared:
        warn_of_codes("tune", runs)
    return Tuned(
        tracker=built,
        method=method,
        loglik=sum(run.loglik for run in runs),
        used=sum(int(np.isfinite(run.log_density).sum()) for run in runs) if tracker.covariance else 0,
        settings=len(search.x) + int(knobs.profiled),
        unknown=sum(unknown_at_start(run) for run in runs),
        noise=sigma2 if knobs.profiled else float(getattr(knobs.run(search.x), "r", np.nan)),
        at_bound=tuple(knobs.names[i] for i in at_bound),
        interval=intervals_of(search, task, method, tracker, level),
        level=0.95 if level is None else level,
        left_out=left_out if len(left_out) > 1 else next(iter(left_out.values()), NOTHING_LEFT_OUT),
        _search=search,
    )


def _without_noise(y: Array, n: int) -> str:
    """Why known outputs y (N,) determine no noise variance beside n parameters, and what to do."""
    if len(y) <= n:
        return (
            f"tune: there is no noise to tune on: {len(y)} outputs are known, which {n} parameters explain without "
            "error. Give a longer record."
        )
    if np.ptp(y) == 0.0:
        return (
            f"tune: there is no noise to tune on: y is {y[0]:.6g} in all of {len(y)} samples. Is it the right column, "
            "and was the sensor on?"
        )
    return (
        "tune: there is no noise to tune on: parameters explain every usable sample up to rounding, as if y had been "
        "computed from the inputs. Give the settings instead, such as Kalman(q=1e-4, r=1.0)."
    )


def _task(model: Model, tracker: Tracker, y: Any, u: Any, reading: Reading, data: Any, by: Any) -> Task:
    records = records_of(model, y, u, reading, data, by)[1].for_model(model, reading)
    bound = model.bind(records.labels.u or records.u.shape[1])
    records, left_out = decide(bound, records, tracker.gated if reading.gate is None else reading.gate)
    records = records.for_trackers(bound, [tracker])
    return Task(bound, tuple(replace(records.part(k), time=None) for k in range(len(records.keys))), left_out)


class TunedOutputs(ByOutput[Tuned]):
    """The result of `tune` for a model with several outputs: one `driftfit.tune.tuned.Tuned` for each."""

    @property
    def tracker(self) -> dict[str, Tracker]:
        """The tracker of each output, by name, ready for `track` and `Live`."""
        return {name: one.tracker for name, one in self.items()}

    @property
    def left_out(self) -> dict[str, Any]:
        """What a gate left out of each output, by its name."""
        return {name: one.left_out for name, one in self.items()}

    @property
    def loglik(self) -> float:
        """Sum over the outputs."""
        return sum(one.loglik for one in self.values())

    @property
    def at_bound(self) -> dict[str, tuple[str, ...]]:
        """Settings that ended at a bound of the search, by output."""
        return {name: one.at_bound for name, one in self.items() if one.at_bound}


def tune_outputs(
    model: Model, tracker: Any, y: Any, u: Any, reading: Reading, data: Any, by: Any,
    one: Callable[[Task], Tuned],
) -> Tuned | TunedOutputs:  # fmt: skip
    """Tune every output with ``one(task)``, or the rows of a shared theta at once."""
    if not isinstance(tracker, Tracker):
        raise ValueError(f"tune: several outputs are tuned for one kind of tracker; got {tracker!r}.")
    reading = reading._replace(gate=tracker.gated if reading.gate is None else reading.gate)
    runs = constant_outputs(model, y, u, reading, data, by)
    tuned = {name: one(Task(some[0].model, *decided_by(some))) for name, some in runs.items()}
    if model.shared:
        return tuned["rows"]
    keys, trackers = records_of(model, y, u, reading, data, by)[1].keys, TunedOutputs(tuned).tracker
    gate = {key: {name: some[k].left_out for name, some in runs.items()} for k, key in enumerate(keys)}
    # lags that were missing are predictions, and those of the run are of the tracker that was found
    run: Any = run_quietly(model, trackers, y, u, reading._replace(gate=gate), data, by)
    logliks = dict.fromkeys(tuned, 0.0)
    for key, found in run.items():
        logliks[key if by is None else key[-1]] += found.loglik
    return TunedOutputs({name: replace(found, loglik=logliks[name]) for name, found in tuned.items()})
