"""Forecasts of theta and y beyond the end of a record.

    theta_{T+h} = theta_T,   Cov = P_T + h q                               (what `predict` does, h times)
    y_{T+h}     = phi' theta,  Var = phi' (P_T + h q) phi + r                  without output lags

An output lag that is not known yet is replaced by its own forecast, whose error depends on that of theta. With l the
lags (L,), a the entries of theta that multiply them, C_ll and C_tl the covariances of their errors,

    y - y_hat   = phi' dtheta + a' dl + da' dl + v
    Var         = phi' P phi + r + 2 phi' C_tl a + a' C_ll a + tr(P_aa C_ll) + tr(C_al C_al)

for normal errors. The last two terms are the product da' dl, which matters while parameters are uncertain. C_ll and
C_tl follow from the same line, sample by sample; the drift of theta enters when it happens. Cost O(h (n + L)^2). While
an unstable system is still likely, the outputs have tails that no variance describes; the bands are then those of the
central part. With several outputs, their noises are assumed to be independent. Other models feed errors back
through the response psi of y to one noise, C / (A D) for polynomial models and 1 / A for Hammerstein-Wiener models:

    Var_h       = S_h' P S_h + r sum_{j<h} (psi_j^2 + var psi_j),     S_h = sum_{j<h} psi_j phi_{h-j}

with phi the gradient of one step and var psi that of the delta method: while D is hardly known, most of the variance
is there. A Hammerstein-Wiener model is fitted to w = F(y), so its errors are those of w, and everything is divided by
the slope F'(y_hat).

The response of equations with output lags depends on the operating point. There `DRAWS` futures are drawn one sample
after the other, each from the distribution that the tracker predicts after it has learned from those before, p(y_1)
p(y_2 | y_1) ..:

    y_std_h     = half-width about y_hat of the central 68 % of the mixture of N(y_h, s_h) over the futures

with y_h and s_h their predictions of sample h, and with fixed and antithetic normal numbers. A mean of squares would be
that of the few futures with an unstable theta. Cost: 2 DRAWS h updates.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from driftfit.data.arguments import inputs_for
from driftfit.data.clock import Clock
from driftfit.data.record import time_text
from driftfit.engine.drivers import one_or_all
from driftfit.engine.kernel import Array
from driftfit.engine.settings import as_numbers, whole
from driftfit.engine.tiles import as_compiled
from driftfit.models.base import Model
from driftfit.run.fleet import Outputs
from driftfit.run.live.conformal import quantile
from driftfit.run.live.live import Live
from driftfit.run.program import Program, state_of
from driftfit.run.result import Track
from driftfit.show.text import Printed, path_table
from driftfit.use.system import spread

if TYPE_CHECKING:
    import polars

DRAWS = 200

CENTRAL, BISECTIONS = math.erf(math.sqrt(0.5)), 60
"""Share of futures within one half-width; and steps of its computation."""


@dataclass(frozen=True, eq=False)
class Forecast(Printed):
    """The h samples after a record: parameters, and outputs with the distribution of their errors."""

    theta: Array
    """(h, n), or (h, ny, n) for outputs with a theta each."""
    std: Array
    """The standard deviation of theta."""
    y_hat: Array
    """(h,), or (h, ny) for several outputs: NaN if an input is not known."""
    y_std: Array
    """Standard deviation of the forecast error, as y_hat; NaN for trackers without a covariance."""
    time: Array | None = None
    """(h,): when the samples are due, in UTC if there is a zone; None without times, or if they are only labels."""
    names: tuple[Any, ...] = ()
    """Names of the parameters, for each output if each has its own."""
    outputs: tuple[str, ...] = ("y",)
    axis: str = "time"
    """The name of the time."""
    zone: str | None = None
    """The time zone in which times are shown."""

    def __len__(self) -> int:
        return len(self.y_hat)

    def band(self, level: float = 0.95) -> tuple[Array, Array]:
        """(low, high) of the outputs, shaped as y_hat, from the normal distribution."""
        half = quantile(level) * self.y_std
        return self.y_hat - half, self.y_hat + half

    def time_text(self, k: int) -> str:
        """When sample k is due, in the time zone of the record, or how many samples it is ahead."""
        return str(k + 1) if self.time is None else time_text(self.time[k], self.zone)

    @property
    def table(self) -> polars.DataFrame:
        """One row per sample of each output.

        Columns: ``output`` if there are several, ``step`` (1 .. h), the time if it is known, ``y_hat``, ``y_std``, the
        95 % band ``low`` and ``high``, and for every parameter ``theta_<name>`` and ``std_<name>``.
        """
        import polars as pl  # this import takes as long as all others together

        from driftfit.data.instants import in_zone

        low, high = self.band()
        signals = {"y_hat": self.y_hat, "y_std": self.y_std, "low": low, "high": high}
        axis = {} if self.time is None else {self.axis: self.time}
        parts = []
        for j, output in enumerate(self.outputs):
            several, own = len(self.outputs) > 1, self.theta.ndim == 3
            columns: dict[str, Any] = {"step": np.arange(1, len(self) + 1), **axis}
            columns |= {name: path[:, j] if several else path for name, path in signals.items()}
            paths = [path[:, j] if own else path for path in (self.theta, self.std)]
            for i, name in enumerate(self.names[j] if own else self.names):
                columns |= {f"theta_{name}": paths[0][:, i], f"std_{name}": paths[1][:, i]}
            named = [pl.lit(output).alias("output")] if several else []
            parts.append(pl.DataFrame(columns).select(*named, pl.all()))
        return in_zone(pl.concat(parts, how="diagonal"), self.axis, self.zone if self.time is not None else None)

    def __rich_console__(self, console: Any, options: Any) -> Any:
        h = len(self)
        means, stds, due = self.y_hat.reshape(h, -1), self.y_std.reshape(h, -1), [self.time_text(k) for k in range(h)]
        yield path_table(f"Forecast of {h} samples", self.outputs, means, stds, due)
        if np.isnan(self.y_hat).all() and np.isfinite(self.theta).all():
            yield f" future inputs are needed to forecast outputs: forecast({h}, u)"
        yield " +- one standard deviation; theta and std are those of the parameters"

    def of_record(self, run: Track | Outputs) -> Forecast:
        """The same with the times and names of a record that goes on."""
        labels, several = run.labels, len(run.outputs) > 1
        time = Clock.of(labels.dt, labels.zone).ahead(run.time[-1], len(self)) if run.timed else None
        outputs = run.outputs if several else (labels.y,)
        return replace(self, time=time, names=run.names, outputs=outputs, axis=labels.time or "time", zone=labels.zone)

    def of_stream(self, live: Live) -> Forecast:
        """The same with the times and names of a stream."""
        end = live.end()
        time = Clock.of(end.dt, end.zone).ahead(end.last, len(self))
        return replace(self, time=time, names=live.names, outputs=live.model.outputs, zone=end.zone)


def forecast(run: Track, h: int, u: Any = None) -> Forecast:
    """Forecast h nominal samples.

    Parameters
    ----------
    run : Track
        The record.
    h : int
        Number of samples, at least 1.
    u : (h,), (h, m), (h, ny, m) for outputs that share one theta, or None
        Future inputs; None: not known, so that only theta is forecast.

    Raises
    ------
    ValueError
        If h is below 1, or u does not have h rows and the model's number of inputs.
    """
    if run.rows_per_instant > 1:
        model: Any = run.model
        live = Live(replace(model, regressors=run.rows.model.m), run.tracker, warm_start=run)
        return _of_outputs(live, h, u).of_record(run)
    return forecast_from(run.program, run.program.resting(run.state), future(run.model, h, u)).of_record(run)


def forecast_stream(live: Live, h: int, u: Any = None) -> Forecast:
    """`forecast` from the present state of a stream; while `apply` is outstanding, the first row of u is its input."""
    if len(live.model.outputs) > 1:
        return _of_outputs(copy(live), h, u).of_stream(live)
    ((one, tile),), inputs = live.driven_on(future(live.model, h, u))
    return forecast_from(one, tile, inputs).of_stream(live)


def forecast_outputs(run: Outputs, h: int, u: Any = None) -> Forecast:
    """Forecast h nominal samples of several outputs: theta and std (h, ny, n), y_hat and y_std (h, ny)."""
    tracker = dict(zip(run.outputs, run.trackers, strict=True))
    return _of_outputs(Live(run.model, tracker, warm_start=run), h, u).of_record(run)


def future(model: Model, h: int, u: Any) -> Array:
    """Future inputs (h, m), NaN if they are not known."""
    whole("forecast", "h", h, 1)
    inputs = np.full((h, model.m), np.nan) if u is None else inputs_for(model, u, h)
    if inputs.shape[1] != model.m:
        raise ValueError(f"forecast: the model has {model.m} inputs, but u has {inputs.shape[1]} columns.")
    return inputs


def forecast_from(program: Program, tile: Array, inputs: Array) -> Forecast:
    """Forecast from the state in a tile of one lane, which is advanced."""
    model, tracker = program.model, program.tracker
    look, h, now = tile.copy(), len(inputs), tile["theta"][0, :, 0].copy()
    lane = state_of(tile)
    lagged = LagErrors.of(model, len(now)) if tracker.covariance else None
    update = program.drivers().updater(tile, model.m)
    noise = lane["r"] * lane["scale"] if "r" in lane else np.nan
    known = tracker.output_error or lagged is not None or np.isfinite(model.noise_response(now, h)).all()
    begin = None if known or not tracker.covariance else tile.copy()
    result = Forecast(np.empty((h, len(now))), np.empty((h, len(now))), np.empty(h), np.empty(h))
    slopes, covs = np.full((h, len(now)), np.nan), np.full((h, len(now), len(now)), np.nan)
    for k in range(h):
        look[...] = tile
        y_hat, _, s, _ = update(as_compiled(look), np.nan, one_or_all(inputs[k]))
        # the forecast takes the place of the output among the lags, and is not an observation
        tile["noise"] = np.inf
        update(as_compiled(tile), y_hat, one_or_all(inputs[k]))
        tile["noise"] = 1.0
        result.theta[k], result.std[k] = tile["theta"][0, :, 0], np.sqrt(tile["var"][0, :, 0])
        result.y_hat[k], result.y_std[k] = y_hat, s
        if lagged is not None:
            P = tracker.cov(lane)[None]
            result.y_std[k] = lagged.step(lane["phi"], lane["theta"][None], P, np.array([s]))[0]
        elif tracker.covariance and len(lane["phi"]) == len(now):
            slopes[k], covs[k] = lane["phi"], tracker.cov(lane)
    if lagged is not None or tracker.output_error:  # an output error is never fed back
        return replace(result, y_std=np.sqrt(result.y_std))
    if begin is not None:
        return replace(result, y_std=_spread_of_draws(update, begin, inputs, result.y_hat))
    curved = model.implicit
    noise *= 1.0 if curved is None else curved.noise_factor(now, result.y_hat[0])
    y_std = np.sqrt(result.y_std + _fed_back(model, now, slopes, covs, float(noise)))
    return replace(result, y_std=y_std if curved is None else y_std / curved.output_slope(now, result.y_hat))


def _spread_of_draws(update: Any, begin: Array, inputs: Array, y_hat: Array) -> Array:
    """Half-widths (h,) about y_hat (h,) of the central 68 % of futures that are drawn from the state ``begin``."""
    z = np.random.default_rng(0).normal(size=(DRAWS // 2, len(inputs)))
    z, given = np.concatenate([z, -z]), [one_or_all(row) for row in inputs]
    now, look = begin.copy(), begin.copy()
    state, ahead = as_compiled(now), as_compiled(look)
    away, deviation = np.empty_like(z), np.empty_like(z)
    for draw, off, std in zip(z, away, deviation, strict=True):
        now[...] = begin
        for k, u in enumerate(given):
            look[...] = now
            mean, _, s, _ = update(ahead, np.nan, u)
            off[k], std[k] = mean - y_hat[k], np.sqrt(s)
            update(state, mean + std[k] * draw[k], u)
    spread: Array = np.where(np.maximum.accumulate(np.isinf(deviation).any(axis=0)), np.inf, np.nan)
    left = ~(np.isfinite(away) & np.isfinite(deviation))  # a future that is beyond all numbers is outside of any band
    away[left], deviation[left] = np.inf, 1.0
    known = np.isnan(spread) & (left.mean(axis=0) < 0.1)
    spread[known] = _central(away[:, known], deviation[:, known])
    return spread


def _central(away: Array, deviation: Array) -> Array:
    """Half-widths (h,) about 0 that contain `CENTRAL` of the mixtures of N(away, deviation^2), (N, h)."""
    low, high = np.zeros(away.shape[1]), np.quantile(np.abs(away) + 2.0 * deviation, 0.9, axis=0)
    for _ in range(BISECTIONS):
        x = 0.5 * (low + high)
        inside = scipy.special.ndtr((x - away) / deviation) - scipy.special.ndtr((-x - away) / deviation)
        less = inside.mean(axis=0) < CENTRAL
        low, high = np.where(less, x, low), np.where(less, high, x)
    return np.asarray(0.5 * (low + high))


def _fed_back(model: Model, theta: Array, slopes: Array, covs: Array, noise: float) -> Array:
    """What noise and errors of theta, fed back through the noise model, add to the variances (h,) of one step."""
    h = len(slopes)
    response = model.noise_response(theta, h)
    later = noise * (np.cumsum(response**2) - response[0] ** 2)
    if not np.isfinite(covs).all():
        return np.asarray(later)
    (_,), (off,) = spread(lambda many: np.array([model.noise_response(one, h) for one in many]), theta[None], covs[:1])
    total = np.stack([np.convolve(response, column)[:h] for column in slopes.T], axis=1)
    more = np.einsum("ki,kij,kj->k", total, covs, total) - np.einsum("ki,kij,kj->k", slopes, covs, slopes)
    return np.asarray(later + noise * np.cumsum(off**2) + more)


def _of_outputs(live: Live, h: int, u: Any) -> Forecast:
    """Forecast from the present state of a stream of several outputs, which is advanced."""
    model: Any = live.model
    whole("forecast", "h", h, 1)
    inputs = [None] * h if u is None else list(as_numbers("u", u))
    if len(inputs) != h:
        raise ValueError(f"forecast: u must have a row for each of the {h} samples; got shape {np.shape(u)}.")
    apart, rows = live.driven_on(np.array([live.inputs_of(row) for row in inputs]))
    if apart:
        found = [forecast_from(program, tile, rows) for program, tile in apart]
        each = ((one.theta, one.std, one.y_hat, one.y_std) for one in found)
        return _stacked(each, 1)
    if live.awaits:
        live.apply(inputs[0])
        inputs = [*inputs[1:], None]
    parts: list[tuple[Array, ...]] = []
    lagged = None if model.shared or not live.trackers[0].covariance else LagErrors.of(model, model.n)
    for row in inputs:
        y_hat, s = live.predict(row)
        live.pass_by(y_hat, row)  # the forecast takes the place of the outputs among the lags
        s = s if lagged is None else lagged.step(live.regressors, live.theta, live.cov, s)
        parts.append((live.theta, live.std, y_hat, np.sqrt(s)))
    return _stacked(parts, 0)


def _stacked(parts: Iterable[tuple[Array, ...]], axis: int) -> Forecast:
    """A forecast from theta, std, y_hat and y_std of every output (axis 1) or every sample (axis 0)."""
    theta, std, y_hat, y_std = (np.stack(part, axis=axis) for part in zip(*parts, strict=True))
    return Forecast(theta, std, y_hat, y_std)


class LagErrors:
    """Covariances of the errors of ny outputs that are forecast, if they are lags of each other; see the module."""

    def __init__(self, ny: int, na: int, n: int) -> None:
        self._shape = ny, na
        self._ll = np.zeros((ny * na, ny * na))
        self._tl = np.zeros((ny, n, ny * na))

    @classmethod
    def of(cls, model: Model, n: int) -> LagErrors | None:
        """For a model whose regressors begin with past outputs; None for others."""
        na = model.output_lags
        return cls(len(model.outputs), na, n) if na else None

    def step(self, phi: Array, theta: Array, P: Array, s: Array) -> Array:
        """Variances (ny,) of the outputs of the next sample, for phi (n,), theta (ny, n), P (ny, n, n).

        ``s`` (ny,) is the variance if all lags were known.
        """
        L = len(self._ll)
        if not np.isfinite(P).all():
            begun = np.isinf(self._ll).any()
            self._ll[:] = np.inf
            return np.full(len(s), np.inf) if begun else s
        a, tl, al = theta[:, :L], self._tl, self._tl[:, :L]
        s = np.maximum(s, np.einsum("i,oij,j->o", phi, P, phi))  # less contradicts P, and a variance could be negative
        first = np.einsum("i,oij,pj->op", phi, tl, a)
        both = first + first.T + a @ self._ll @ a.T + np.einsum("oij,pji->op", al, al)
        both[np.diag_indices(len(s))] += s + np.einsum("oij,ji->o", P[:, :L, :L], self._ll)
        with_theta = np.einsum("pij,oj->opi", tl, a)  # (output, theta of output, n)
        for o in range(len(s)):
            with_theta[o, o] += P[o] @ phi
        with_lags = np.einsum("i,oij->oj", phi, tl) + a @ self._ll
        self._shift(both, with_theta, with_lags)
        return np.diag(both).copy()

    def _shift(self, both: Array, with_theta: Array, with_lags: Array) -> None:
        """The new outputs become the first lags, and the last lags are dropped."""
        ny, na = self._shape
        if not na:
            return
        old = np.arange(ny * na).reshape(ny, na)
        kept, place, new = old[:, :-1].ravel(), old[:, 1:].ravel(), old[:, 0]
        ll, tl = np.zeros_like(self._ll), np.zeros_like(self._tl)
        ll[np.ix_(place, place)] = self._ll[np.ix_(kept, kept)]
        ll[np.ix_(new, new)], ll[np.ix_(new, place)] = both, with_lags[:, kept]
        ll[np.ix_(place, new)] = with_lags[:, kept].T
        tl[:, :, place] = self._tl[:, :, kept]
        tl[:, :, new] = np.moveaxis(with_theta, 0, 2)
        self._ll, self._tl = ll, tl
