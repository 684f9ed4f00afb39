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
from driftfit.models.hammerstein_wiener.curves.basis import Thresholds
from driftfit.models.hammerstein_wiener.output_curve import WIDER
from driftfit.models.hammerstein_wiener.results.run_blocks import blocks_of
from driftfit.models.hammerstein_wiener.separation.paths import Blocks
from driftfit.models.hammerstein_wiener.step_memory import GRID
from driftfit.run.result import burn_in

if TYPE_CHECKING:
    from driftfit.run.result import Track


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
    y, w, v = np.full((3, T), np.nan)
    result = FreeRun(y, w, v, np.ones(T, bool), np.ones(T, bool))
    nks, curves = found.model.delays, [inputs(found, run.u[:, i], i) for i in range(found.model.m)]
    result.v[:] = np.sum(curves, axis=0)
    levels = np.sum(found.model.out.value(run.y) * found.d, axis=1)
    result.w[:begin] = np.where(np.isfinite(levels[:begin]), levels[:begin], 0.0)
    grid = _Grid(found, run.y)
    radius = found.radius
    for t in range(begin, T):
        grid.upto(t)
        a = found.a[t - 1]
        if radius[t - 1] >= 1.0:
            a, result.stable[t] = reflected(a), False
        lags = result.w[max(t - na, 0) : t][::-1]
        result.w[t] = _drive(found, curves, nks, t) - a[: len(lags)] @ lags
        result.y[t], result.rising[t] = grid.invert(found.d[t - 1], result.w[t])
    result.w[:begin] = np.nan
    return result


def inputs(found: Blocks, u: Array, i: int = 0) -> Array:
    """v (T,) of input i, each with the coefficients of the previous sample; a missing input is 0."""
    basis, c = found.model.bases[i], found.of_input(i)[1]
    late = np.concatenate([c[:1], c[:-1]])
    if isinstance(basis, Thresholds):
        f = basis.split(u, u >= late[:, 1] / late[:, 0], u <= late[:, 2] / late[:, 0])
    else:
        f = basis.value(u)
    v = np.sum(f * late, axis=1)
    return np.where(np.abs(v) < LARGEST, v, 0.0)


def _drive(found: Blocks, curves: list[Array], nks: tuple[int, ...], t: int) -> float:
    """The contribution of the inputs to w_t."""
    total, at = 0.0 if found.intercept is None else -float(found.intercept[t - 1]), 0
    for v, nb, nk in zip(curves, found.model.structure.nb, nks, strict=True):
        past = v[max(t - nk - nb + 1, 0) : max(t - nk + 1, 0)][::-1]
        total += float(found.b[t - 1, at : at + len(past)] @ past)
        at += nb
    return total


def reflected(a: Array) -> Array:
    """Coefficients with poles outside the unit circle moved to 1 / conj(z), and poles on it to just inside."""
    poles = np.roots(np.concatenate([[1.0], a]))
    size = np.abs(poles)
    moved = np.where(size >= 1.0, poles / np.maximum(size, 1.0 + 1e-6) ** 2, poles)
    return np.asarray(np.poly(moved).real[1:])


def believed(y: Array) -> tuple[Array, Array]:
    """Least and largest output up to each sample, (T,); NaN before the first."""
    known = np.where(np.abs(y) < LARGEST, y, np.nan)
    return np.fmin.accumulate(known), np.fmax.accumulate(known)


class _Grid:
    """The functions of the output block over the accepted outputs so far."""

    def __init__(self, found: Blocks, y: Array) -> None:
        self.basis = found.model.out
        self.low, self.high = believed(y)
        self.y, self.known = np.empty(0), False

    def upto(self, t: int) -> None:
        """Build the grid for the outputs before sample t, if it does not contain them."""
        low, high = float(self.low[t - 1]), float(self.high[t - 1])
        known = bool(np.isfinite(low) and np.isfinite(high))
        alone = self.basis.scale or (WIDER * abs(high) if known else 0.0) or 1.0
        low, high = (low, high) if known else (-alone, alone)
        if not self.y.size or known > self.known or low < self.y[0] or high > self.y[-1]:
            self.known = known
            margin = WIDER * (high - low) or alone
            bottom, top = self.basis.limits
            self.y = np.linspace(max(low - margin, bottom), min(high + margin, top), GRID)
            self.curve = self.basis.value(self.y)

    def invert(self, d: Array, w: float) -> tuple[float, bool]:
        """(y, whether F increases), refined by Newton's method if it does."""
        level = self.curve @ d
        rising = bool((np.diff(level) > 0.0).all())
        if not rising:
            half = GRID // 2
            level[half:] = np.maximum.accumulate(level[half:])
            level[: half + 1] = np.minimum.accumulate(level[half::-1])[::-1]
        y = float(np.interp(w, level, self.y))
        if rising and level[0] < w < level[-1]:
            for _ in range(3):
                slope = float(self.basis.derivative(y) @ d)
                y += (w - float(self.basis.value(y) @ d)) / slope if slope > 0.0 else 0.0
            y = float(np.clip(y, self.y[0], self.y[-1]))
        return y, rising
