"""The frozen reference model of alarms, estimated from the normal samples of a run.

    y_t = phi_t' theta + e_t,    e an autoregression whose variance may follow a GARCH(1, 1)

theta solves the Huber equations of the reference, on rows that are whitened and divided by sqrt(h). The order of the
autoregression minimises BIC. alpha and beta of the GARCH part are averages over candidates, weighted by how probable
the quasi-likelihood of the clipped residuals leaves each: a short reference seldom shows whether the variance changes,
and the most likely model is then constant noise. Each is estimated again, given the others, ROUNDS times.

Source: Huber (1964); Bollerslev (1986); averages instead of a choice are Leamer's (1978).
Cost: O(N n^2) for N samples, ten times, and 31 passes for the GARCH part.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import Array, Driver
from driftfit.judge.changes.fit import HELD, ORDER, complete, lags_of, regressed
from driftfit.judge.statistics.robust import CLIP as OF_FIT
from driftfit.judge.statistics.robust import deviation, noisy, robust_fit
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
    NOISE_FACTOR,
    NORMAL,
    NUMBERS,
    OK,
    RAW,
    SCALE,
    SPREAD,
    WIDE,
    Frozen,
    K,
    V,
    Y,
)
from driftfit.smooth.solvers.rank import column_sizes

CLIPS = (2.5, 3.0, 3.5, 4.0)
"""Scores are residuals clipped at one of these numbers of scales."""
LOUDER = 1.5
"""The factor of the noise that scores should show as soon as possible."""
ROUNDS = 3
FAULTY = 30.0
"""Deviations from which on a residual of the reference is a fault code."""
PERSISTENCE, REACTION = (0.5, 0.7, 0.8, 0.9, 0.95, 0.98), (0.03, 0.06, 0.1, 0.15, 0.2, 0.3)
GARCH = np.array([(0.0, 0.0), *((a, both - a) for both in PERSISTENCE for a in REACTION if a < both)])
GARCH = np.ascontiguousarray(GARCH.T)
"""alpha and beta of the candidates (2, C), constant noise first."""
PRIOR = 1.0 / (1.0 - GARCH.sum(axis=0)) ** 2
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


class Known(NamedTuple):
    """What a reference says of its noise."""

    at: Array
    """(k,): its usable rows."""
    x: Array
    """(k,): their residuals over their standard deviation at the time."""


def frozen_model(
    rows: Array, constant: int = -1, lags: Sequence[int] = (), order: int | None = None
) -> tuple[Frozen, Known] | None:
    """Estimate the model from rows (N, n + 4), regressors and the columns of `ROW`; None if they have no noise.

    Regressors that are far from zero are centred on column ``constant``, if it is not negative. ``lags`` are columns of
    earlier outputs. ``order`` is that of the autoregression; None estimates it. Fault codes, and rows whose inputs are
    blamed, are residuals of the noise model as any other, but say nothing of theta or the autoregression.
    """
    phi, rest = rows[:, :-4], rows[:, -4:]
    judged, ok = rest[:, OK] > 0.0, rest[:, OK] > BLAMED
    own = 1.0 / np.sqrt(np.where(judged, rest[:, NOISE_FACTOR], 1.0))
    phi, y = np.where(judged[:, None], phi, 0.0) * own[:, None], np.where(judged, rest[:, Y], 0.0) * own
    mean = means(phi[ok], constant) if constant >= 0 else np.zeros(0)
    phi = centred(phi, mean, constant)
    unit = column_sizes(phi[ok])
    rows = np.column_stack([phi / unit, y])
    ar, root = np.zeros(0), np.ones(len(y))
    for _ in range(ROUNDS if order is None else ROUNDS - 1):
        used, white = _whitened(rows, ok, ar)
        white /= root[used, None]
        fit = robust_fit(white[:, :-1], white[:, -1])
        if not noisy(fit, white[:, :-1], white[:, -1]):
            return None
        e = rows[:, -1] - rows[:, :-1] @ fit.theta
        ok = ok & (np.abs(e) <= FAULTY * deviation(e[ok]))
        ar = _autoregression(e, ok, order)
        used, w = _whitened(e[:, None], ok, ar, judged)
        numbers, h = noise_model(w[:, 0], len(unit))
        root = np.ones(len(y))
        root[used] = np.sqrt(h)
    x, white = w[:, 0] / (numbers[SCALE] * np.sqrt(h)), _whitened(rows[:, :-1], ok, ar, judged)[1]
    fitted = ok[used]
    cov, unseen = _covariance((white / np.sqrt(h)[:, None])[fitted], x[fitted])
    numbers[CONSTANT] = constant
    lag = np.isin(np.arange(len(unit)), lags).astype(float)
    return Frozen(fit.theta / unit, unit, np.ascontiguousarray(ar), cov, numbers, unseen, mean, lag), Known(used, x)


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


def noise_model(w: Array, n: int) -> tuple[Array, Array]:
    """(`Frozen.numbers`, variances h (N,)) of white residuals w (N,) of a fit of n parameters."""
    N = len(w)
    numbers, freedom = np.zeros(NUMBERS), np.sqrt(N / max(N - n, 1))
    numbers[EVEN], numbers[NORMAL], numbers[LONGEST] = EVENNESS, N, max(N // SHARE, 8)
    numbers[SCALE] = deviation(w) * freedom
    x = w / numbers[SCALE]
    clip = numbers[CLIP] = _clip(x)
    numbers[V] = np.mean(np.clip(x, -clip, clip) ** 2)
    numbers[INSIDE] = np.mean(np.where(np.abs(x) < clip, x * x, 0.0))
    numbers[[ALPHA, BETA]] = averaged(plausible(x, numbers))
    h = np.empty(N)
    variances(x, numbers, False, h)
    numbers[SCALE] *= deviation(x / np.sqrt(h)) * freedom
    x = w / (numbers[SCALE] * np.sqrt(h))
    square = np.clip(x, -clip, clip) ** 2
    numbers[K], numbers[V], numbers[KAPPA] = np.mean(np.abs(x) < clip), square.mean(), square.var()
    raw = np.clip(x, -WIDE, WIDE) ** 2
    numbers[RAW], numbers[SPREAD] = raw.mean(), raw.var()
    return numbers, h


@Driver
def variances(x: Array, numbers: Array, scores: bool, h: Array) -> None:
    """h (T,) of residuals x (T,) in units of their scale; with ``scores`` x are these over sqrt(h).

    h_(t+1) = 1 - alpha - beta + (alpha g_t^2 / v + beta) h_t,   g_t = x_t / sqrt(h_t) clipped at +-clip
    """
    alpha, beta, most, level = numbers[ALPHA], numbers[BETA], numbers[CLIP] * numbers[CLIP], 1.0
    for t in range(x.shape[0]):
        h[t] = level
        square = min(x[t] * x[t] / (1.0 if scores else level), most)
        level = 1.0 - alpha - beta + (alpha * square / numbers[V] + beta) * level


@Driver
def losses(x: Array, numbers: Array, weights: Array, state: Array, total: Array) -> None:
    """sum log h + g^2 / inside of residuals x (T,) for candidates of the GARCH part into total (C,).

    ``weights`` (2, C) are their alpha and beta, ``state`` (2, C) is scratch. With this factor h = 1 is the best
    constant for every distribution of x.
    """
    most, v, inside = numbers[CLIP] * numbers[CLIP], numbers[V], numbers[INSIDE]
    for c in range(total.shape[0]):
        state[0, c], state[1, c], total[c] = 1.0, 1.0, 0.0
    for t in range(x.shape[0]):
        own = x[t] * x[t]
        for c in range(total.shape[0]):
            h = state[0, c]
            square = own / h
            square = most if square > most else square
            state[1, c] *= h  # the product of some h, whose logarithm is that of all of them
            total[c] += square / inside
            state[0, c] = 1.0 - weights[0, c] - weights[1, c] + (weights[0, c] * square / v + weights[1, c]) * h
        if t % 16 == 15 or t == x.shape[0] - 1:
            for c in range(total.shape[0]):
                total[c] += np.log(state[1, c])
                state[1, c] = 1.0


def plausible(x: Array, numbers: Array) -> Array:
    """Probabilities (C,) of the candidates `GARCH` for residuals x (N,) in units of their scale; the quasi-likelihood
    counts by as much as the tails allow."""
    total, clip = np.zeros(GARCH.shape[1]), numbers[CLIP]
    losses(x, numbers, GARCH, np.empty(GARCH.shape), total)
    total *= numbers[INSIDE] ** 2 / np.var(np.clip(x, -clip, clip) ** 2)
    share = PRIOR * np.exp(total.min() - total)
    return np.asarray(share / share.sum())


def averaged(share: Array) -> tuple[float, float]:
    """alpha and beta from the probabilities (C,) of the candidates: the mean of alpha, and the mean of alpha + beta
    weighted by alpha too, as constant noise has no persistence."""
    alpha, both = float(GARCH[0] @ share), float(GARCH[0] * share @ GARCH.sum(axis=0))
    return alpha, both / alpha - alpha if alpha > 0.0 else 0.0


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
    p, usable = len(ar), ok if judged is None else judged
    if not p:
        return np.flatnonzero(usable), rows[usable]
    at = np.flatnonzero(usable[p:])
    at = p + at[np.all([ok[p - lag :][at] for lag in range(1, p + 1)], axis=0)]
    return at, rows[at] - sum(a * rows[at - lag] for lag, a in enumerate(ar, 1))


def _autoregression(e: Array, ok: Array, order: int | None) -> Array:
    """Coefficients of an order, the one of least BIC if it is None, of residuals that are limited as the verdict's."""
    limit = HELD * deviation(e[ok])
    lags = lags_of(e, ORDER, ok, season=0) if order is None else np.arange(1, order + 1)
    whole = np.zeros(len(e))
    whole[complete(ok, lags)] = 1.0
    return regressed(np.clip(e, -limit, limit), whole, lags)


def _clip(x: Array) -> float:
    """Where to clip residuals x (N,): where a noise `LOUDER` moves the mean of their squares by most deviations."""
    moved = []
    for clip in CLIPS:
        square, louder = (np.minimum(np.abs(factor * x), clip) ** 2 for factor in (1.0, LOUDER))
        moved.append((louder.mean() - square.mean()) / square.std())
    return CLIPS[int(np.argmax(moved))]
