"""Predictions k samples ahead over a record, and free simulation, both with bands and given inputs.

Output lags that are not known yet are replaced by predictions, so theta acts through them too:

    y_j  = phi_j' theta                                phi_j holds y_(j-1), .. of this recursion and the inputs
    S_j  = phi_j + sum_i a_i S_(j-i)                    = d y_j / d theta
    Var  = S_j' (P + j q) S_j + r sum_(i<j) psi_i^2     psi = response of 1 / A to one noise

`ahead` starts at every t from the outputs up to t, with theta_t and P_t as they were then: nothing looks ahead except
the inputs. `simulate` uses no output at all. q is the drift per sample that the tracker assumes, or 0 if it assumes
none; r makes the variance of the first step equal to that of the run. First-order in the parameter errors.
Cost: O(T k n^2) for `ahead`, O(h n^2) for `simulate`.

This is for ARX and Regression. Of other models that can be run forward (`Model.play`), such as Hammerstein-Wiener,
which are nonlinear in their parameters, systems and noise are drawn:

    theta_d ~ N(theta, P),  v_d ~ N(0, r)      D systems are run forward side by side (`Model.play`)
    y_hat       with theta itself and without noise
    theta_std   spread over the systems without noise, y_std with it; the band is quantiles of the latter

r is the innovation variance of the last sample that was used. The seed is fixed, so the same question has the same
answer; D draws give a 95 % limit to about 10 % of its width. The data do not determine a curve beyond the observed
outputs: an output block is inverted on their range, widened by a fifth. Cost: O(D h (n + 64)).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from driftfit.data.arguments import inputs_for
from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array
from driftfit.engine.settings import whole
from driftfit.models.base import GAP, Model
from driftfit.models.continuous.transfer import ContinuousTransfer
from driftfit.models.polynomial import PolynomialModel
from driftfit.run.live.conformal import quantile
from driftfit.run.result import Track
from driftfit.show.text import path_table, printing
from driftfit.use.forecast import DRAWS
from driftfit.use.system import covariances, filtered, spread, taken


def ahead(run: Track, k: int) -> Prediction:
    """Predict every sample from k samples before it, with given inputs; the first k samples are NaN.

    Raises
    ------
    ValueError
        If k is below 1, the model cannot be run forward, or theta has a slope.
    """
    whole("ahead", "k", k, 1)
    within("ahead", run)
    if run.tracker.slopes:
        raise ValueError(
            "ahead: predictions over a record assume a constant theta, but here it follows its slope; use run.forecast."
        )
    if not regresses_on_lags(run.model):
        return ahead_by_draws(run, k)
    na, U = input_regressors(run.model, np.where(np.abs(run.u) < LARGEST, run.u, np.nan))
    T, theta, cov = len(run), run.theta, covariances(run)
    y = np.where(np.abs(run.y) < LARGEST, run.y, np.nan)
    a = theta[:, :na]
    lags = [moved(y, i) for i in range(na)]
    slopes = [np.zeros_like(theta) for _ in range(na)]
    psi, energy, r = [np.ones(T)], np.zeros(T), np.full(T, np.nan)
    for j in range(1, k + 1):
        phi = np.column_stack([*lags, moved(U, -j)])
        y_hat = np.einsum("ti,ti->t", phi, theta)
        S = phi + sum((a[:, i, None] * slopes[i] for i in range(na)), np.zeros_like(theta))
        q = drift(run, r)
        of_theta = np.einsum("ti,tij,tj->t", S, cov, S) + j * np.einsum("ti,tij,tj->t", S, q, S)
        if j == 1:
            r = _filled(np.maximum(moved(_known(run.innovation_std) ** 2, -1) - of_theta, 0.0))
        energy = energy + psi[-1] ** 2
        psi.append(sum((a[:, i] * psi[-1 - i] for i in range(min(na, len(psi)))), np.zeros(T)))
        lags, slopes = [y_hat, *lags][:na], [S, *slopes][:na]
    whole_time = unbroken(run, na, k)
    with np.errstate(invalid="ignore"):
        found = (y_hat, np.sqrt(of_theta), np.sqrt(of_theta + r * energy))
    return Prediction(*(np.where(whole_time, moved(part, k), np.nan) for part in found))


def steps_ahead(theta: Array, phi: Array, na: int, h: int) -> Array:
    """Predictions (T,) h steps ahead, from theta (T, n) known before each sample and phi (T, n): na lags of the output,
    and regressors that are given."""
    made: list[Array] = []
    for s in range(h):
        now = moved(phi, -s)
        for i in range(min(s, na)):
            now[:, i] = made[s - 1 - i]
        made.append(np.einsum("tn,tn->t", theta, now))
    return moved(made[-1], h - 1)


def simulate(run: Track, u: Any, at: int = -1, y: Any = None) -> Prediction:
    """Free simulation of the model at one sample: the outputs that inputs u (h,) or (h, m) would cause.

    Parameters
    ----------
    run : Track
        A run of a model that can be run forward: ARX, Regression, polynomial models, HammersteinWiener, or your own
        with `play`.
    u : (h,), (h, m), or None without inputs
        Inputs. Before them the system is at rest: inputs and outputs are zero.
    at : int
        The sample whose parameters, covariance and noise are used.
    y : (h0,) or None
        The outputs of the first samples, if the system is not at rest; they are returned unchanged.

    Raises
    ------
    ValueError
        If u does not fit the model, or the model cannot be run forward.
    """
    within("simulate", run)
    h = len(u) if u is not None else len(np.atleast_1d(y if y is not None else []))
    inputs = inputs_for(run.model, u, h)
    if inputs.shape[1] != run.model.m:
        raise ValueError(f"simulate: the model has {run.model.m} inputs, but u has {inputs.shape[1]} columns.")
    given = np.zeros(0) if y is None else np.asarray(y, float)
    if isinstance(run.model, PolynomialModel | ContinuousTransfer):
        return _through_transfers(run, run.model, inputs, at, given)
    if not regresses_on_lags(run.model):
        return simulate_by_draws(run, inputs, at, given)
    na, U = input_regressors(run.model, inputs, rest=0.0)
    (theta,), (cov,) = taken(run, at)
    r = noise_at(run, at)
    out, S, energy = np.zeros(h), np.zeros((h, run.model.n)), np.zeros(h)
    psi = run.model.noise_response(theta, h)
    for k in range(h):
        lags = [out[k - i] if k >= i else 0.0 for i in range(1, na + 1)]
        phi = np.concatenate([lags, U[k]])
        S[k] = phi + sum((theta[i - 1] * S[k - i] for i in range(1, min(na, k) + 1)), np.zeros(len(theta)))
        out[k] = phi @ theta
        if k < len(given):
            out[k], S[k] = given[k], 0.0
        else:
            energy[k] = np.sum(psi[: k - len(given) + 1] ** 2)
    of_theta = np.einsum("ti,ij,tj->t", S, cov, S)
    return Prediction(out, np.sqrt(of_theta), np.sqrt(of_theta + r * energy))


def _through_transfers(
    run: Track, model: PolynomialModel | ContinuousTransfer, u: Array, at: int, given: Array
) -> Prediction:
    """Inputs (h, m) through the transfer functions of a sample, from rest, with noise through that of the noise."""
    if len(given):
        raise ValueError("simulate: transfer functions start from rest; leave y out.")
    h = len(u)

    def response(theta: Array) -> Array:
        total = np.zeros((len(theta), h))
        for j in range(model.m):
            total += filtered(*model.transfers(theta)[1][j], u[:, j])
        if model.offset:
            total += filtered(
                theta[:, -1:], np.concatenate([np.ones((len(theta), 1)), -theta[:, : model.na]], axis=1), np.ones(h)
            )
        return total

    theta, cov = taken(run, at)
    y_hat, of_theta = spread(response, theta, cov)
    used = run.innovation_var[: range(len(run))[at] + 1]
    known = used[np.isfinite(used)]
    r = known[-1] if len(known) else np.nan
    energy = np.cumsum(model.noise_response(theta[0], h) ** 2)
    return Prediction(y_hat[0], of_theta[0], np.sqrt(of_theta[0] ** 2 + r * energy))


def fit(y: Any, y_hat: Any) -> float:
    """Fit in per cent, 100 (1 - |y - y_hat| / |y - mean y|) over the samples where both are known.

    100 is perfect, 0 is as good as the mean, and negative values are worse; the measure of Ljung (1999) and of MATLAB's
    ``compare``. NaN if no value is known or y is constant.
    """
    measured, predicted = np.asarray(y, float), np.asarray(y_hat, float)
    if measured.shape != predicted.shape:
        raise ValueError(f"fit: y has shape {measured.shape}, but y_hat has {predicted.shape}.")
    known = np.isfinite(measured) & np.isfinite(predicted)
    spread = float(np.linalg.norm(measured[known] - measured[known].mean())) if known.any() else 0.0
    error = float(np.linalg.norm(measured[known] - predicted[known]))
    return 100.0 * (1.0 - error / spread) if spread > 0.0 else float("nan")


def noise_at(run: Track, at: int) -> float:
    """Noise variance at a sample: the one-step variance minus the part due to the parameters; NaN if there is none."""
    sample = range(len(run))[at]
    known = np.flatnonzero(np.isfinite(run.innovation_std[: sample + 1]) & run.ok[: sample + 1])
    if not len(known):
        return float("nan")
    t = int(known[-1])
    before = run.cov(t - 1) if t > 0 else np.full((len(run.names),) * 2, np.nan)
    na, U = input_regressors(run.model, run.u[: t + 1])
    phi = np.concatenate([[run.y[t - i] if t >= i else np.nan for i in range(1, na + 1)], U[t]])
    q = drift(run, np.full(1, run.innovation_std[t] ** 2))[0]
    r = run.innovation_std[t] ** 2 - phi @ (before + q) @ phi
    return float(r) if np.isfinite(r) and r > 0.0 else float(run.innovation_std[t] ** 2)


def regresses_on_lags(model: Model) -> bool:
    """Whether the regressors are the last outputs, the latest first, and then inputs and constants."""
    na, terms = model.output_lags or 0, model.terms
    if terms is None:
        return False
    return terms[:na] == tuple(("y", 0, i + 1) for i in range(na)) and all(what != "y" for what, *_ in terms[na:])


def input_regressors(model: Model, u: Array, rest: float = np.nan) -> tuple[int, Array]:
    """(na, the regressors (T, n - na) made of inputs); values before the record are ``rest``."""
    if model.terms is None or not regresses_on_lags(model):
        raise ValueError(
            "predictions over a record need ARX, Regression or another model that declares its regressors (`terms`), "
            f"with one output; got {model!r}."
        )
    na = model.output_lags or 0
    columns = [np.ones(len(u)) if what == "1" else moved(u[:, j], lag, rest) for what, j, lag in model.terms[na:]]
    return na, np.column_stack([np.zeros((len(u), 0)), *columns])


def _known(values: Array) -> Array:
    """Values with NaN instead of infinite ones."""
    return np.where(np.isfinite(values), values, np.nan)


def _filled(values: Array) -> Array:
    """NaN replaced by the previous number."""
    place = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), -1))
    return np.where(place >= 0, values[place], np.nan)


@printing
class Prediction(NamedTuple):
    """Outputs with the distribution of their errors, NaN if inputs or lags are missing; printing it shows a table."""

    y_hat: Array
    """(T,): at the predicted sample."""
    theta_std: Array
    """(T,): standard deviation due to the parameters alone, the band of the mean."""
    y_std: Array
    """(T,): standard deviation including the noise, the band of the output."""
    paths: Array | None = None
    """(D, T): drawn outputs, for models that are nonlinear in their parameters."""

    def __rich__(self) -> Any:
        return path_table("Prediction", ("y",), self.y_hat[:, None], self.y_std[:, None])

    def band(self, level: float = 0.95) -> tuple[Array, Array]:
        """(low, high) of the output, (T,) each: normal, or quantiles of the drawn outputs."""
        if self.paths is not None:
            known = np.isfinite(self.paths).all(axis=0)
            ends = np.quantile(np.where(known, self.paths, 0.0), [0.5 - level / 2.0, 0.5 + level / 2.0], axis=0)
            low, high = np.where(known, ends, np.nan)
            return low, high
        half = quantile(level) * self.y_std
        return self.y_hat - half, self.y_hat + half


def within(verb: str, run: Track) -> None:
    """ValueError for a run whose theta is no random walk, or whose output is not phi' theta and noise."""
    if run.tracker.beyond:
        raise ValueError(f"{verb}: {type(run.tracker).__name__} {run.tracker.beyond}; use run.forecast.")


def moved(values: Array, by: int, rest: float = np.nan) -> Array:
    """Values (T, ..) delayed by a number of samples (advanced if it is negative)."""
    out = np.full(values.shape, rest)
    T = len(values)
    if by >= 0:
        out[by:] = values[: max(T - by, 0)]
    else:
        out[: max(T + by, 0)] = values[-by:]
    return out


def drift(run: Track, r: Array) -> Array:
    """q per sample, (1, n, n) or (T, n, n); zero if theta itself is not a random walk."""
    n = len(run.names)
    try:
        walk = run.tracker.random_walk(run.model)
    except ValueError:
        return np.zeros((1, n, n))
    if walk.slopes:
        return np.zeros((1, n, n))
    scale = np.ones(1) if walk.r is not None else np.where(np.isfinite(r), r, 0.0)
    return np.asarray(walk.q * scale[:, None, None])


def unbroken(run: Track, na: int, k: int) -> Array:
    """Samples whose k steps, and the lags before them, have no gap in time."""
    gaps = np.broadcast_to(run.known.interval, len(run)) > GAP
    total = np.concatenate([[0], np.cumsum(gaps)])
    first = np.maximum(np.arange(len(run)) - k - max(na, 1) + 2, 0)
    return np.asarray(total[1:] == total[first])


Span = tuple[Any, Any]

AT_ONCE = 8192
"""Number of rows that are run in parallel: their memory stays below a hundred megabytes."""


def simulate_by_draws(run: Track, u: Array, at: int, given: Array) -> Prediction:
    """Free simulation with inputs u (h, m) of the system at a sample; ``given`` are the first outputs."""
    p, known, h = run.model.reach, len(given), len(u)
    (mean,), cov = taken(run, at)
    before = np.concatenate([np.zeros(p), given])
    inputs = np.concatenate([np.zeros((p, u.shape[1])), u])
    theta = systems(run, np.concatenate([mean[None], drawn(mean[None], cov, DRAWS, 0)[:, 0]]))
    r = _noise(run)[range(len(run))[at]]
    low, high = _spans(run)
    span = low[at], high[at]

    def played(noise: Array) -> Array:
        D = len(noise)
        later = _played(run, theta[:D], np.tile(before, (D, 1)), inputs[None], noise, span)
        return np.concatenate([np.tile(given, (D, 1)), later], axis=1)

    noise = np.sqrt(r) * np.random.default_rng(1).normal(size=(DRAWS + 1, h - known))
    smooth, noisy = played(np.zeros_like(noise)), played(noise)
    return _prediction_of(smooth[0], smooth[1:], noisy[1:], run.tracker.covariance)


def ahead_by_draws(run: Track, k: int) -> Prediction:
    """Every sample predicted from k samples before it, the inputs given."""
    p, T = run.model.reach, len(run)
    y = np.where(np.abs(run.y) < LARGEST, run.y, np.nan)
    u = np.where(np.abs(run.u) < LARGEST, run.u, np.nan)
    past = np.column_stack([np.zeros((T, 0)), *(moved(y, i) for i in range(p - 1, -1, -1))])
    inputs = np.stack([moved(u, i) for i in range(p - 1, -k - 1, -1)], axis=1)
    r, cov = _noise(run), covariances(run)
    cov = cov + k * np.maximum(drift(run, r), 0.0)
    found = [
        _ahead(run, part, past, inputs, cov, r, k)
        for part in np.array_split(np.arange(T), max(1, -(-T * DRAWS // (AT_ONCE * 16))))
    ]
    whole = unbroken(run, p, k)
    parts = (np.concatenate([part[i] for part in found]) for i in range(3))
    y_hat, theta_std, y_std = (np.where(whole, moved(part, k), np.nan) for part in parts)
    drawn_there = [part.paths.T for part in found if part.paths is not None]
    paths = np.where(whole, moved(np.concatenate(drawn_there), k).T, np.nan) if drawn_there else None
    return Prediction(y_hat, theta_std, y_std, paths)


def _ahead(run: Track, at: Array, past: Array, inputs: Array, cov: Array, r: Array, k: int) -> Prediction:
    """The samples k after each of ``at``."""
    count, (low, high) = len(at), (end[at] for end in _spans(run))
    mean = systems(run, run.theta[at])
    hat = _played(run, mean, past[at], inputs[at], np.zeros((count, k)), (low, high))[:, -1]
    if not run.tracker.covariance:
        return _prediction_of(hat, None, None, False)
    theta = systems(run, drawn(run.theta[at], cov[at], DRAWS, 0).reshape(DRAWS * count, -1))
    rows = np.tile(np.arange(count), DRAWS)
    noise = np.sqrt(r[at])[rows, None] * np.random.default_rng(1).normal(size=(DRAWS * count, k))
    smooth, noisy = np.empty(DRAWS * count), np.empty(DRAWS * count)
    for part in np.array_split(np.arange(DRAWS * count), max(1, DRAWS * count // AT_ONCE)):
        row = rows[part]
        before, given, span = past[at[row]], inputs[at[row]], (low[row], high[row])
        smooth[part] = _played(run, theta[part], before, given, np.zeros((len(part), k)), span)[:, -1]
        noisy[part] = _played(run, theta[part], before, given, noise[part], span)[:, -1]
    return _prediction_of(hat, smooth.reshape(DRAWS, count), noisy.reshape(DRAWS, count), True)


def _played(run: Track, theta: Array, y: Array, u: Array, noise: Array, span: Span) -> Array:
    """The model's outputs; measurement noise is added afterwards, equation noise is fed back."""
    fed = np.zeros_like(noise) if run.tracker.output_error else noise
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable system that was drawn ends in inf
        later = run.model.play(theta, y, u, fed, span)
    return later + noise if run.tracker.output_error else later


def systems(run: Track, theta: Array) -> Array:
    """Parameters of the regression (.., n) from those of the tracker."""
    if run.names == run.model.names:
        return theta
    found = None if run.model.implicit is None else run.model.implicit.expand(theta)
    if found is None:
        raise ValueError(
            f"simulate: {type(run.tracker).__name__} follows {', '.join(run.names)}, which do not define a system."
        )
    return found


def drawn(mean: Array, cov: Array, D: int, seed: int) -> Array:
    """D draws (D, T, n) from normals with mean (T, n) and covariance (T, n, n); NaN if the covariance is not known."""
    known: Array = np.asarray(np.isfinite(cov).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(known[:, None, None], cov, 0.0))
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    z = np.random.default_rng(seed).normal(size=(D, mean.shape[1]))
    away = np.einsum("tij,dj->dti", root, z)
    return np.where(known[:, None], mean + away, np.nan)


def _noise(run: Track) -> Array:
    """Innovation variance of the last sample used, (T,)."""
    s = np.where(run.ok & np.isfinite(run.innovation_std), run.innovation_std**2, np.nan)
    return np.asarray(s[np.maximum.accumulate(np.where(np.isfinite(s), np.arange(len(s)), 0))])


def _spans(run: Track) -> tuple[Array, Array]:
    """Smallest and largest output up to each sample, (T,) each; -1 and 1 before the first."""
    y = np.where(np.abs(run.y) < LARGEST, run.y, np.nan)
    low, high = np.fmin.accumulate(y), np.fmax.accumulate(y)
    return np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)


def _prediction_of(hat: Array, smooth: Array | None, noisy: Array | None, covariance: bool) -> Prediction:
    """Mean and spreads over draws (D, h)."""
    if not covariance or smooth is None or noisy is None:
        unknown = np.full(len(hat), np.nan)
        return Prediction(hat, unknown, unknown)
    with np.errstate(invalid="ignore", over="ignore"):
        return Prediction(hat, smooth.std(axis=0), noisy.std(axis=0), noisy)
