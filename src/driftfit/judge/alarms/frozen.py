"""The frozen reference model of the "glr" and "cusum" alarms, estimated from the normal samples of a run.

    y_t = phi_t' theta + e_t,    e an autoregression whose variance may follow a GARCH(1, 1)

theta solves the Huber equations of the reference, on rows that are whitened and divided by sqrt(h). The order of the
autoregression minimises BIC. alpha and beta of the GARCH part are averages over candidates, weighted by how probable
the quasi-likelihood of the clipped residuals leaves each: a short reference seldom shows whether the variance changes,
and the most likely model is then constant noise. Each is estimated again, given the others, ROUNDS times.

Source: Huber (1964); Bollerslev (1986); averages instead of a choice are Leamer's (1978).
Cost: O(N n^2) for N samples, ten times, and 36 passes for the GARCH part.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.drivers import ROUNDING, SMALLEST
from driftfit.engine.kernel import Array
from driftfit.engine.simd import WIDTH
from driftfit.judge.alarms.variances import losses, variances
from driftfit.judge.statistics.robust import CLIP as OF_FIT
from driftfit.judge.statistics.robust import LEAST, deviation, medians, noisy, robust_fit
from driftfit.run.live.reference_model import (
    ALPHA,
    BETA,
    BLAMED,
    CLIP,
    CONSTANT,
    EVEN,
    FLAT,
    INSIDE,
    KAPPA,
    LONGEST,
    NORMAL,
    NUMBERS,
    RAW,
    SAME,
    SCALE,
    SPREAD,
    WIDE,
    Frozen,
    K,
    V,
    through_zero,
)
from driftfit.smooth.parts.rank import column_sizes

CLIPS = (2.5, 3.0, 3.5, 4.0)
"""Scores are residuals clipped at one of these numbers of scales."""
LOUDER = 1.5
"""The factor of the noise that scores should show as soon as possible."""
ORDER, COMPLETE = 6, 60
ROUNDS = 3
FAULTY = 30.0
"""Deviations from which on a residual of the reference is a fault code."""
PERSISTENCE, REACTION = (0.5, 0.7, 0.8, 0.9, 0.95, 0.98), (0.03, 0.06, 0.1, 0.15, 0.2, 0.3)
GARCH = np.array([(0.0, 0.0), *((a, both - a) for both in PERSISTENCE for a in REACTION if a < both)])
GARCH = np.ascontiguousarray(np.vstack([GARCH, np.repeat(GARCH[-1:], -len(GARCH) % WIDTH, axis=0)]).T)
"""alpha and beta of the candidates (2, C), constant noise first, the last repeated to fill a vector."""
TIME = np.where(np.arange(GARCH.shape[1]) <= len(PERSISTENCE) * len(REACTION), 1.0 / (1.0 - GARCH.sum(axis=0)), 0.0)
"""Time constants of the candidates in samples, 0 of the repeated one (C,)."""
PRIOR = TIME**2
PRIOR[0] = 0.5 * PRIOR[1:].sum()
"""How probable each candidate is before the reference, in relation (C,): constant noise half as probable as all others
together, and those in proportion to the square of their time constant, since short references show long bursts least
and long bursts alarm most.
"""
NEAR = 0.2
"""A regressor whose mean is a smaller part of its spread stays as it is: its slope about the mean is that through 0."""
DUST = 1e-9
"""An entry of a direction, which has length 1, below which it is the rounding of 0: where all else of a row is 0, as of
an idle input, such an entry alone would say that the row excites the direction.
"""
EVENNESS = 0.5
"""`EVEN`: at 1, long windows would have as many false alarms as short ones, and large changes would be found later."""
SHARE = 8
"""The noise is judged by windows of at most this part of the reference."""


class Rows(NamedTuple):
    """The N usable rows of a reference, whitened."""

    phi: Array
    """(N, n): regressors, in units."""
    x: Array
    """(N,): residuals over their standard deviation at the time."""


def frozen_model(phi: Array, y: Array, ok: Array, constant: int = -1) -> tuple[Frozen, Rows] | None:
    """Estimate the model from rows phi (N, n), y (N,) with `OK` in ok (N,); None if they have no noise.

    Regressors that are far from zero are centred on column ``constant``, if it is not negative. Fault codes, and rows
    whose inputs are blamed, are residuals of the noise model as any other, but say nothing of theta or the
    autoregression.
    """
    judged, ok = ok > 0.0, ok > BLAMED
    mean = means(phi[ok], constant) if constant >= 0 else np.zeros(0)
    phi = centred(phi, mean, constant)
    unit = column_sizes(phi[ok])
    rows = np.where(judged[:, None], np.column_stack([phi / unit, y]), 0.0)
    ar, root = np.zeros(0), np.ones(len(y))
    for _ in range(ROUNDS):
        used, white = _whitened(rows, ok, ar)
        white /= root[used, None]
        fit = robust_fit(white[:, :-1], white[:, -1])
        if not noisy(fit, white[:, :-1], white[:, -1]):
            return None
        e = rows[:, -1] - rows[:, :-1] @ fit.theta
        ok = ok & (np.abs(e) <= FAULTY * deviation(e[ok]))
        ar = _autoregression(e, ok, len(unit))
        used, w = _whitened(e[:, None], ok, ar, judged)
        numbers, h = noise_model(w[:, 0], len(unit))
        root = np.ones(len(y))
        root[used] = np.sqrt(h)
    x, white = w[:, 0] / (numbers[SCALE] * np.sqrt(h)), _whitened(rows[:, :-1], ok, ar, judged)[1]
    fitted = ok[used]
    cov, unseen = _covariance((white / np.sqrt(h)[:, None])[fitted], x[fitted])
    numbers[CONSTANT] = constant
    white[~fitted] = _shortened(white[~fitted], cov, 1.0 / len(x))
    return Frozen(fit.theta / unit, unit, np.ascontiguousarray(ar), cov, numbers, unseen, mean), Rows(white, x)


def _shortened(phi: Array, cov: Array, most: float) -> Array:
    """Rows phi (k, n) whose leverage phi' C phi is at most that."""
    leverage = np.einsum("ti,ij,tj->t", phi, cov, phi)
    return np.asarray(phi * np.sqrt(most / np.maximum(leverage, most))[:, None])


def means(phi: Array, constant: int) -> Array:
    """Mean of each column of phi (N, n) as a multiple of the constant's, 0 where it is near zero; empty if all are."""
    level = phi[:, constant]
    mean = level @ phi / (level @ level)
    spread = np.sqrt(np.mean((phi - level[:, None] * mean) ** 2, axis=0) / np.mean(level * level))
    moves = spread > ROUNDING * np.abs(mean)
    mean = np.where(~moves | (np.abs(mean) > NEAR * spread), mean, 0.0)
    mean[constant] = 0.0
    return mean if mean.any() else np.zeros(0)


def centred(phi: Array, mean: Array, constant: int) -> Array:
    """phi (N, n) about these means, exactly 0 where it is constant."""
    if not len(mean):
        return phi
    about = phi - phi[:, constant, None] * mean
    return np.where((mean != 0.0) & (np.abs(about) <= FLAT * np.abs(phi)), 0.0, about)


def slopes_of(frozen: Frozen) -> Array:
    """(n, 2): `through_zero` of the centred regressors that moved, 0 of the others; (0, 2) if none is centred."""
    constant, centred = int(frozen.numbers[CONSTANT]), enumerate(frozen.mean)
    moved = np.sum(frozen.unseen**2, axis=0) <= 1.0 - SAME
    every = [through_zero(frozen, j, constant) if mean != 0.0 and moved[j] else (0.0, 0.0) for j, mean in centred]
    return np.array(every).reshape(-1, 2)


def noise_model(w: Array, n: int) -> tuple[Array, Array]:
    """(`Frozen.numbers`, variances h (N,)) of white residuals w (N,) of a fit of n parameters."""
    numbers, h = noise_models(w[None], n)
    return numbers[0], h[0]


def noise_models(w: Array, n: int) -> tuple[Array, Array]:
    """The same for R references of N residuals each, w (R, N): numbers (R, k) and h (R, N)."""
    R, N = w.shape
    numbers = np.zeros((R, NUMBERS))
    numbers[:, EVEN] = EVENNESS
    numbers[:, NORMAL], numbers[:, LONGEST] = N, max(N // SHARE, 8)
    numbers[:, SCALE] = _scales(w, n)
    x = w / numbers[:, SCALE, None]
    numbers[:, CLIP] = _clips(x)
    clip = numbers[:, CLIP, None]
    square = np.clip(x, -clip, clip) ** 2
    numbers[:, V] = square.mean(axis=1)
    numbers[:, INSIDE] = np.mean(np.where(np.abs(x) < clip, x * x, 0.0), axis=1)
    numbers[:, [ALPHA, BETA]] = averaged(plausible(x, numbers))
    h = variances(x, numbers)
    numbers[:, SCALE] *= _scales(w / (numbers[:, SCALE, None] * np.sqrt(h)), n)
    x = w / (numbers[:, SCALE, None] * np.sqrt(h))
    square = np.clip(x, -clip, clip) ** 2
    numbers[:, K], numbers[:, V] = np.mean(np.abs(x) < clip, axis=1), square.mean(axis=1)
    numbers[:, KAPPA] = square.var(axis=1)
    raw = np.clip(x, -WIDE, WIDE) ** 2
    numbers[:, RAW], numbers[:, SPREAD] = raw.mean(axis=1), raw.var(axis=1)
    return numbers, h


def plausible(x: Array, numbers: Array) -> Array:
    """Probabilities (R, C) of the candidates `GARCH` for residuals x (R, N) in units of their scale; the
    quasi-likelihood counts by as much as the tails allow."""
    total = np.zeros((len(x), GARCH.shape[1]))
    losses(x, numbers, GARCH, np.empty((1, GARCH.shape[1])), total)
    clip = numbers[:, CLIP, None]
    total *= (numbers[:, INSIDE] ** 2 / np.var(np.clip(x, -clip, clip) ** 2, axis=1))[:, None]
    share = PRIOR * np.exp(total.min(axis=1, keepdims=True) - total)
    return np.asarray(share / share.sum(axis=1, keepdims=True))


def averaged(share: Array) -> Array:
    """alpha and beta (R, 2) from the probabilities (R, C) of the candidates: the mean of alpha, and the mean of
    alpha + beta weighted by alpha too, as constant noise has no persistence."""
    reaction = GARCH[0] * share
    alpha, both = reaction.sum(axis=1), reaction @ GARCH.sum(axis=0)
    some = alpha > 0.0
    return np.column_stack([alpha, np.where(some, both / np.where(some, alpha, 1.0) - alpha, 0.0)])


def _covariance(phi: Array, x: Array) -> tuple[Array, Array]:
    """(covariance (n, n) of a Huber fit in units of the scale, directions (k, n) that were not excited).

    In these it is that of the best known one, so that it has a Cholesky factor: no sample that excites them is judged.

    Residuals of a fit are smaller than errors, which Huber (1981, section 7.6) corrects by ``fitted``.
    """
    (N, n), psi = phi.shape, np.clip(x, -OF_FIT, OF_FIT)
    inside = np.mean(np.abs(x) < OF_FIT)
    fitted = N / max(N - n, 1) * (1.0 + n / N * (1.0 - inside) / inside) ** 2
    values, vectors = np.linalg.eigh(phi.T @ phi)
    excited = values > ROUNDING * values.max()
    factor = fitted * np.mean(psi * psi) / inside**2
    cov = factor * (vectors / np.where(excited, values, values.max())) @ vectors.T
    unseen = vectors[:, ~excited].T
    return np.ascontiguousarray(cov), np.ascontiguousarray(np.where(np.abs(unseen) > DUST, unseen, 0.0))


def _whitened(rows: Array, ok: Array, ar: Array, judged: Array | None = None) -> tuple[Array, Array]:
    """(indices of the rows whose lags can all be used, those rows (N, k) less their prediction from the lags).

    With ``judged``, of these rows, of which only some can be lags.
    """
    p = len(ar)
    complete, white = (ok if judged is None else judged)[p:].copy(), rows[p:].copy()
    for lag, a in enumerate(ar, 1):
        complete &= ok[p - lag : len(ok) - lag]
        white -= a * rows[p - lag : len(rows) - lag]
    return p + np.flatnonzero(complete), white[complete]


def _autoregression(e: Array, ok: Array, n: int) -> Array:
    """Coefficients of the order up to ORDER with the smallest BIC; outliers are limited to three scales.

    Each order is compared with the one below on all samples whose lags are complete, of which there must be `COMPLETE`,
    and five for each of n parameters.
    """
    limit = 3.0 * deviation(e[ok])
    e = np.clip(e, -limit, limit)
    found, gain, best = np.zeros(0), 0.0, 0.0
    for p in range(1, ORDER + 1):
        used, _ = _whitened(e[:, None], ok, np.zeros(p))
        N = len(used)
        if max(COMPLETE, 5 * n) > N:
            break
        R = np.asarray(np.linalg.qr(np.column_stack([*(e[used - lag] for lag in range(1, p + 1)), e[used]]), mode="r"))
        # the last two rows: what each order leaves
        gain += N * np.log1p((R[p - 1, p] / max(abs(R[p, p]), SMALLEST)) ** 2) - np.log(N)
        if gain > best:
            best, found = gain, np.linalg.lstsq(R[:p, :p], R[:p, -1], rcond=None)[0]
    return np.asarray(found)


def _clips(x: Array) -> Array:
    """Where to clip residuals x (R, N): where a noise `LOUDER` moves the mean of their squares by most deviations."""
    moved = []
    for clip in CLIPS:
        square, louder = (np.minimum(np.abs(factor * x), clip) ** 2 for factor in (1.0, LOUDER))
        moved.append((louder.mean(axis=1) - square.mean(axis=1)) / square.std(axis=1))
    return np.asarray(np.take(CLIPS, np.argmax(moved, axis=0)))


def _scales(w: Array, n: int) -> Array:
    """Standard deviations (R,) of w (R, N), each as `deviation`, with the degrees of freedom of n parameters."""
    N, sizes = w.shape[1], np.abs(w)
    high = np.partition(sizes, 9 * N // 10, axis=1)[:, 9 * N // 10]
    return np.asarray(np.maximum(1.4826 * medians(sizes), LEAST * high) * np.sqrt(N / max(N - n, 1)))
