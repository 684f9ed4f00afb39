"""The frozen reference model of the "glr" and "cusum" alarms, estimated from the normal samples of a run.

    y_t = phi_t' theta + e_t,    e an autoregression whose variance may follow a GARCH(1, 1)

theta solves the Huber equations of the reference, on rows that are whitened and divided by sqrt(h). The order of the
autoregression minimises BIC, and the GARCH part is kept if it raises the quasi-likelihood of the clipped residuals by
more than chance explains. Each is estimated again, given the others, ROUNDS times.

Source: Huber (1964); Bollerslev (1986). Cost: O(N n^2) for N samples, ten times, and 36 passes for the GARCH part.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.statistics.robust import CLIP as OF_FIT
from driftfit.judge.statistics.robust import robust_fit
from driftfit.run.live.likelihood_ratio import (
    ALPHA,
    BETA,
    CLIP,
    INSIDE,
    KAPPA,
    LONGEST,
    NORMAL,
    RAW,
    SCALE,
    SPREAD,
    WIDE,
    Frozen,
    K,
    V,
    levels,
)

CLIPPED = 2.5
"""Scores are residuals clipped at this many scales."""
ORDER = 6
ROUNDS = 3
GAIN = 4.0
"""Gain of the quasi-likelihood, twice its logarithm, for which the GARCH part is kept, per variance of g^2 / inside:
the larger the tails, the larger the gain by chance.
"""
PERSISTENCE, REACTION = (0.5, 0.7, 0.8, 0.9, 0.95, 0.98), (0.03, 0.06, 0.1, 0.15, 0.2, 0.3)
SHARE = 8
"""The noise is judged by windows of at most this part of the reference."""
UNSEEN = 1e-6
"""A direction with less than this share of the largest information has not been excited by the reference."""


class Rows(NamedTuple):
    """The N usable rows of a reference, whitened."""

    phi: Array
    """(N, n): regressors, in units."""
    x: Array
    """(N,): residuals over their standard deviation at the time."""


def frozen_model(phi: Array, y: Array, ok: Array) -> tuple[Frozen, Rows]:
    """Estimate the model from rows phi (N, n), y (N,), of which ok (N,) can be used."""
    unit = np.sqrt(np.mean(phi[ok] ** 2, axis=0))
    unit = np.where(unit > 0.0, unit, 1.0)
    rows = np.where(ok[:, None], np.column_stack([phi / unit, y]), 0.0)
    ar, root = np.zeros(0), np.ones(len(y))
    for _ in range(ROUNDS):
        used, white = _whitened(rows, ok, ar)
        theta = robust_fit(white[:, :-1] / root[used, None], white[:, -1] / root[used]).theta
        e = rows[:, -1] - rows[:, :-1] @ theta
        ar = _autoregression(e, ok)
        used, w = _whitened(e[:, None], ok, ar)
        numbers, h = noise_model(w[:, 0], len(theta))
        root = np.ones(len(y))
        root[used] = np.sqrt(h)
    used, white = _whitened(rows, ok, ar)
    w = white[:, -1] - white[:, :-1] @ theta
    numbers, h = noise_model(w, len(theta))
    x = w / (numbers[SCALE] * np.sqrt(h))
    cov = _covariance(white[:, :-1] / np.sqrt(h)[:, None], x)
    return Frozen(theta / unit, unit, np.ascontiguousarray(ar), cov, numbers), Rows(white[:, :-1], x)


def noise_model(w: Array, n: int) -> tuple[Array, Array]:
    """(`Frozen.numbers`, variances h (N,)) of white residuals w (N,) of a fit of n parameters."""
    numbers = np.zeros(NORMAL + 1)
    numbers[CLIP], numbers[NORMAL], numbers[LONGEST] = CLIPPED, len(w), max(len(w) // SHARE, 8)
    numbers[SCALE] = _scale(w, n)
    x, h = w / numbers[SCALE], np.ones(len(w))
    numbers[V] = np.mean(np.clip(x, -CLIPPED, CLIPPED) ** 2)
    numbers[INSIDE] = np.mean(np.where(np.abs(x) < CLIPPED, x * x, 0.0))
    chance = GAIN * np.var(np.clip(x, -CLIPPED, CLIPPED) ** 2) / numbers[INSIDE] ** 2
    best = levels(x, numbers, h) - chance
    chosen = (0.0, 0.0)
    for together in PERSISTENCE:
        for alpha in REACTION:
            numbers[ALPHA], numbers[BETA] = alpha, together - alpha
            if alpha < together:
                loss = levels(x, numbers, h)
                best, chosen = (loss, (alpha, together - alpha)) if loss < best else (best, chosen)
    numbers[ALPHA], numbers[BETA] = chosen
    levels(x, numbers, h)
    numbers[SCALE] *= _scale(w / (numbers[SCALE] * np.sqrt(h)), n)
    x = w / (numbers[SCALE] * np.sqrt(h))
    g = np.clip(x, -CLIPPED, CLIPPED)
    numbers[K], numbers[V], numbers[KAPPA] = np.mean(np.abs(x) < CLIPPED), np.mean(g * g), np.var(g * g)
    raw = np.clip(x, -WIDE, WIDE) ** 2
    numbers[RAW], numbers[SPREAD] = np.mean(raw), np.var(raw)
    return numbers, h


def _covariance(phi: Array, x: Array) -> Array:
    """Covariance (n, n) of a Huber fit, in units of the scale; large in directions that were not excited."""
    psi = np.clip(x, -OF_FIT, OF_FIT)
    values, vectors = np.linalg.eigh(phi.T @ phi)
    information = np.maximum(values, UNSEEN * values.max())
    factor = np.mean(psi * psi) / np.mean(np.abs(x) < OF_FIT) ** 2
    return np.ascontiguousarray(factor * (vectors / information) @ vectors.T)


def _whitened(rows: Array, ok: Array, ar: Array) -> tuple[Array, Array]:
    """(indices of the rows whose lags can all be used, those rows (N, k) less their prediction from the lags)."""
    p = len(ar)
    complete, white = ok[p:].copy(), rows[p:].copy()
    for lag, a in enumerate(ar, 1):
        complete &= ok[p - lag : len(ok) - lag]
        white -= a * rows[p - lag : len(rows) - lag]
    return p + np.flatnonzero(complete), white[complete]


def _autoregression(e: Array, ok: Array) -> Array:
    """Coefficients of the order up to ORDER with the smallest BIC; outliers are limited to three scales."""
    limit = 3.0 * 1.4826 * float(np.median(np.abs(e[ok])))
    e, most = np.clip(e, -limit, limit), min(ORDER, len(e) // 20)
    used, _ = _whitened(e[:, None], ok, np.zeros(most))
    best, chosen = len(used) * np.log(np.mean(e[used] ** 2)), np.zeros(0)
    for p in range(1, most + 1):
        lags = np.column_stack([e[used - lag] for lag in range(1, p + 1)])
        a = np.linalg.lstsq(lags, e[used], rcond=None)[0]
        bic = len(used) * np.log(np.mean((e[used] - lags @ a) ** 2)) + p * np.log(len(used))
        if bic < best:
            best, chosen = bic, a
    return chosen


def _scale(w: Array, n: int) -> float:
    """Standard deviation from the median, with the degrees of freedom of n parameters."""
    return float(1.4826 * np.median(np.abs(w)) * np.sqrt(len(w) / max(len(w) - n, 1)))
