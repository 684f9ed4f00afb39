"""Forward runs of models that are nonlinear in their parameters: bands from draws of systems and noise.

    theta_d ~ N(theta, P),  v_d ~ N(0, r)      D systems are run forward side by side (`Model.play`)
    y_hat       with theta itself and without noise
    theta_std   spread over the systems without noise, y_std with it; the band is quantiles of the latter

r is the innovation variance of the last sample that was used. The seed is fixed, so the same question has the same
answer; D draws give a 95 % limit to about 10 % of its width. The data do not determine a curve beyond the observed
outputs: an output block is inverted on their range, widened by a fifth. Cost: O(D h (n + 64)).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array
from driftfit.run.result import Track
from driftfit.use.prediction import Prediction, drift, moved, unbroken
from driftfit.use.system import covariances, taken

Span = tuple[Any, Any]

DRAWS = 200
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
    found = run.model.expand(theta)
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
    place = np.maximum.accumulate(np.where(np.isfinite(s), np.arange(len(s)), 0))
    return np.asarray(s[place])


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
