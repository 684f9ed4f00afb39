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
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from driftfit.data.arguments import check_roles
from driftfit.data.record import Reading, one_series
from driftfit.engine.kernel import Array
from driftfit.engine.settings import one_of, whole
from driftfit.models.base import Model
from driftfit.run.track import with_drifts
from driftfit.trackers.base import Tracker
from driftfit.tune.intervals import intervals_of
from driftfit.tune.knobs import find_knobs
from driftfit.tune.lanes import Record, score
from driftfit.tune.objective import Criterion, along
from driftfit.tune.search import Counted, Search, minimise

if TYPE_CHECKING:
    import polars
    from matplotlib.figure import Figure

METHODS = ("ml", "h-step", "loo", "gcv")


@dataclass(frozen=True)
class Tuned:
    """The result of `tune`.

    Attributes
    ----------
    tracker : Tracker
        The tracker with all its settings, ready for `track` and `Live`.
    method : str
        The criterion.
    loglik : float
        Log-likelihood of the record under ``tracker`` and ``noise``; NaN for trackers without a variance. For trackers
        that estimate their scale on-line (`RLS`, `FLS`) it is above that of a run, which knew less at the start.
    noise : float
        Estimated noise variance; unreliable if ``at_bound`` is not empty.
    at_bound : tuple of str
        Settings that ended at a bound of the search, or at zero; empty if the optimum is inside.
    interval : dict of (low, high)
        By name of setting, the interval of the likelihood at ``level``: from profiles (for "q[..]/r", "mu",
        "forgetting" and a single "q" or "r"), or from the curvature (for "q[..]" and "r" estimated together). NaN for
        other methods.
    level : float
        The level of the intervals.
    """

    tracker: Tracker
    method: str
    loglik: float
    noise: float
    at_bound: tuple[str, ...]
    interval: dict[str, tuple[float, float]]
    level: float
    _search: Search = field(repr=False, compare=False)

    @property
    def table(self) -> polars.DataFrame:
        """Every setting that was tried and its criterion, best first: log-likelihood, or mean square."""
        import polars

        points, values = self._search.tried()
        settings = np.array([self._search.knobs.values(x) for x in points])
        columns = dict(zip(self._search.knobs.names, settings.T, strict=True))
        name = {"ml": "loglik", "h-step": "mean_square"}.get(self.method, self.method)
        return polars.DataFrame({**columns, name: self._criterion(values)})

    @property
    def chosen(self) -> dict[str, float]:
        """The estimates by name of setting as in ``interval``; drifts are relative to the noise variance."""
        names, values = self._search.knobs.names, self._search.knobs.values(self._search.x)
        return {name: float(value) for name, value in zip(names, values, strict=True)}

    def _criterion(self, values: Array) -> Array:
        """Values of the objective converted to the criterion."""
        return -values if self.method == "ml" else np.exp(values)

    def curves(self) -> list[tuple[str, Array, Array]]:
        """(name, values of the setting, criterion) along each knob, for `plot`."""
        curves = []
        for i in range(len(self._search.x)):
            points, values = self._search.sweep(i)
            entry = int(np.flatnonzero(self._search.knobs.owner == i)[0])
            settings = np.array([self._search.knobs.values(x)[entry] for x in points])
            curves.append((self._search.knobs.names[entry], settings, self._criterion(values)))
        return curves

    def plot(self) -> Figure:
        """The criterion along each setting, with the others optimised if it is a likelihood; a matplotlib figure."""
        from driftfit.tune.plots import plot_tuned

        return plot_tuned(self)


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
    order_by: Any = None,
    time: Any = None,
    dt: Any = None,
    weights: Any = 1.0,
    drift: Any = 1.0,
    limits: Any = None,
    exclude: Any = None,
) -> Tuned:
    """Estimate the missing settings of a tracker: ``FLS()``, ``Kalman()``, ``Kalman(r=0.1)``, ``RLS()`` ...

    Parameters
    ----------
    model, y, u, time, dt, weights, drift, limits, exclude
        As for `track`.
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
        Range of the search: for mu or r / q in units of the mean square of the regressors (default 1e-4 to max(1e5,
        T^2)), for r in units of the residual variance of constant parameters, for the memory of RLS in samples.
    level : number
        Level of the intervals.
    order_by : (T,)
        Tune for ``run.smooth(order_by=...)``: theta is a random walk along this variable instead of time.

    Returns
    -------
    Tuned. A model with several outputs gives `driftfit.tune.outputs.TunedOutputs`, one for each output (if they share
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
    one_of("tune", "method", method, METHODS)
    whole("tune", "h", h, 1)
    if not 0.0 < level < 1.0:
        raise ValueError(f"tune: level must be between 0 and 1, such as 0.95; got {level!r}.")
    if method != "h-step" and not tracker.covariance:
        raise ValueError(f"tune: {type(tracker).__name__} has no variance, so {method!r} is undefined; use 'h-step'.")
    if len(model.outputs) > 1:
        from driftfit.tune.outputs import tune_outputs

        options = (method, groups, h, bounds, level, order_by)
        known = {"time": time, "dt": dt, "weights": weights, "drift": drift, "limits": limits, "exclude": exclude}
        found = tune_outputs(model, tracker, y, u, known, lambda record: _tuned(record, tracker, *options))
        return cast("Tuned", found)
    reading = Reading(time, dt, weights, drift, limits=limits, exclude=exclude)
    return _tuned(_record(model, tracker, y, u, reading), tracker, method, groups, h, bounds, level, order_by)


def _tuned(
    record: Record, tracker: Tracker, method: str, groups: Any, h: int, bounds: Any, level: float, order_by: Any
) -> Tuned:
    """Tune a checked record."""
    if order_by is not None:
        record = along(record, tracker, order_by)
    knobs = find_knobs(record, tracker, groups, bounds)
    f = Counted(Criterion(record, knobs, method, h))
    search = Search(f, knobs, minimise(f, knobs))
    final = score(record, [knobs.run(search.x)], h)
    sigma2 = float(final.sigma2()[0])
    tuned = Tuned(
        tracker=knobs.build(search.x, sigma2),
        method=method,
        loglik=float(final.loglik(knobs.profiled)[0]) if tracker.covariance else float("nan"),
        noise=sigma2 if knobs.profiled else float(getattr(knobs.run(search.x), "r", np.nan)),
        at_bound=tuple(name for name, i in zip(knobs.names, knobs.owner, strict=True) if search.at_bound(i)),
        interval=intervals_of(search, record, method, tracker, level),
        level=level,
        _search=search,
    )
    _warn(tuned)
    return tuned


def _warn(tuned: Tuned) -> None:
    """Warn of settings that ended at a bound of the search; zero is a valid result."""
    search = tuned._search
    stuck = [
        name
        for name, i in zip(search.knobs.names, search.knobs.owner, strict=True)
        if search.at_bound(i) and np.isfinite(search.x[i])
    ]
    if stuck:
        warnings.warn(
            f"tune: {', '.join(stuck)} ended at a bound of the search. The record does not determine it in that "
            "direction, and the noise variance may be wrong; give bounds=(low, high) to search further.",
            UserWarning,
            stacklevel=4,
        )


def _record(model: Model, tracker: Tracker, y: Any, u: Any, reading: Reading) -> Record:
    records = one_series(y, u, reading).for_model(model, reading)
    bound = model.bind(records.labels.u or records.u.shape[1])
    records = with_drifts(bound, [tracker], records)
    return Record(bound, records.y, records.u, records.known)
