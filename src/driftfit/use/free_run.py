"""Free run: the output from the inputs alone, with the separated parameters of a run and no measured output.

    v_t = sum_k c_k f_k(u_t),   w_t = -sum_i a_i w_{t-i} + sum_j b_j v_{t-nk-j+1} (- l),   y_t = F^-1(w_t)

Sample t uses the coefficients that were known after sample t - 1. F is inverted on the range of the outputs observed
until then, widened by a fifth; where it does not increase, its monotone envelope is inverted and the sample is flagged.
Poles on or outside the unit circle are flagged, and reflected for that sample (z -> 1 / z).

With measurement noise a free run predicts better than the one-step prediction, which feeds noisy outputs back.
Cost per sample: O(64 n_out).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array
from driftfit.models.hammerstein_wiener.blocks import Blocks
from driftfit.models.hammerstein_wiener.forward import Inverse
from driftfit.run.result import burn_in
from driftfit.use.blocks import blocks_of

if TYPE_CHECKING:
    from driftfit.run.result import Track

SAMPLES = 512
"""Number of samples whose curves are inverted at a time."""


@dataclass(frozen=True)
class FreeRun:
    """``y``, ``w`` and ``v`` (T,), v the sum over all inputs; ``rising`` and ``stable`` (T,) bool: whether F increased,
    and whether no pole was reflected.
    """

    y: Array
    w: Array
    v: Array
    rising: Array
    stable: Array


def free_run(run: Track, method: str = "svd-joint", start: int | None = None) -> FreeRun:
    """Simulate the output of a record from sample ``start`` on (by default after max(50, 5 n) samples).

    The earlier w are taken from the measured outputs; results before ``start`` are NaN.
    """
    found = blocks_of(run, method)
    T, na = len(run), found.a.shape[1]
    begin = min(burn_in(run.model.n), T) if start is None else max(int(start), 1)
    y, rising, stable = np.full(T, np.nan), np.ones(T, bool), np.ones(T, bool)
    curves = [_curve(found, run.u[:, i], i) for i in range(found.model.m)]
    levels = np.sum(found.model.out.value(run.y) * found.d, axis=1)
    w = np.where(np.isfinite(levels), levels, 0.0)
    drive, radius = _drive(found, curves), found.radius
    for t in range(begin, T):
        a = found.a[t - 1]
        if radius[t - 1] >= 1.0:
            a, stable[t] = reflected(a), False
        lags = w[max(t - na, 0) : t][::-1]
        w[t] = drive[t] - a[: len(lags)] @ lags
    low, high = _ranges(run.y, found.model.out.scale)
    for first in range(begin, T, SAMPLES):
        now, before = slice(first, first + SAMPLES), slice(first - 1, min(first + SAMPLES, T) - 1)
        inverse = Inverse(found.model, found.d[before], (low[before], high[before]))
        y[now], rising[now] = inverse(w[now]), inverse.rising
    w[:begin] = np.nan
    return FreeRun(y, w, np.sum(curves, axis=0), rising, stable)


def _curve(found: Blocks, u: Array, i: int) -> Array:
    """v (T,) of input i, each with the coefficients of the previous sample; a missing input is 0."""
    c = found.of_input(i)[1]
    late = np.concatenate([c[:1], c[:-1]])
    v = np.sum(found.model.bases[i].for_coefficients(u, late) * late, axis=1)
    return np.where(np.abs(v) < LARGEST, v, 0.0)


def _drive(found: Blocks, curves: list[Array]) -> Array:
    """The contribution of the inputs to w (T,), with the coefficients of the previous sample."""
    T, at = len(found), 0
    total = np.zeros(T) if found.intercept is None else -found.intercept[np.maximum(np.arange(T) - 1, 0)]
    for v, nb, nk in zip(curves, found.model.structure.nb, found.model.delays, strict=True):
        for j in range(nb):
            first = max(nk + j, 1)
            total[first:] += found.b[first - 1 : -1, at + j] * v[first - nk - j : T - nk - j]
        at += nb
    return total


def _ranges(y: Array, scale: float) -> tuple[Array, Array]:
    """Least and largest output up to each sample; around one number, or none, the scale of the basis at both sides."""
    known = np.where(np.abs(y) < LARGEST, y, np.nan)
    low, high = np.fmin.accumulate(known), np.fmax.accumulate(known)
    alone = np.where(high > low, 0.0, scale or 1.0)
    low, high = (np.where(np.isfinite(end), end, 0.0) for end in (low, high))
    return low - alone, high + alone


def reflected(a: Array) -> Array:
    """Coefficients with poles outside the unit circle moved to 1 / conj(z), and poles on it to just inside."""
    poles = np.roots(np.concatenate([[1.0], a]))
    size = np.abs(poles)
    moved = np.where(size >= 1.0, poles / np.maximum(size, 1.0 + 1e-6) ** 2, poles)
    return np.asarray(np.poly(moved).real[1:])
