"""A Hammerstein-Wiener model run forward: many systems in parallel, with predicted outputs fed back.

    F(y_t; d) = sum_j sum_k (b_j c_k) f_k(u_(t-nk-j+1)) - sum_i sum_k (a_i d_k) g_k(y_(t-i)) - l - v_t

with the products of theta themselves, so that nothing needs to be separated. F is inverted on a grid over a span of
outputs, widened by a fifth; if it does not increase, its monotone envelope is inverted. Cost per sample and system:
O(n + 64).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.models.hammerstein_wiener.basis import Basis
from driftfit.models.hammerstein_wiener.output_curve import WIDER
from driftfit.models.hammerstein_wiener.structure import GRID
from driftfit.models.hammerstein_wiener.thresholds import INSIDE, Thresholds

NEWTON_STEPS = 3


def play(model: Any, theta: Array, y: Array, u: Array, noise: Array, span: tuple[Any, Any]) -> Array:
    """Outputs (D, h) of a `HammersteinWiener` model; arguments as for `driftfit.models.base.Model.play`."""
    na, nbs, n_ins, n_out, intercept = model.structure
    at_b, (_, at_bc, at_ad) = na, model.structure.starts
    D, p, h = len(theta), y.shape[1], noise.shape[1]
    a, driven = theta[:, :na], np.zeros((D, p + h))
    A = np.stack([a, *(theta[:, at_ad + k * na : at_ad + (k + 1) * na] for k in range(n_out - 1))], axis=2)
    for i, (nb, n_in, nk, basis) in enumerate(zip(nbs, n_ins, model.delays, model.bases, strict=True)):
        b = theta[:, at_b : at_b + nb]
        B = np.stack([b, *(theta[:, at_bc + k * nb : at_bc + (k + 1) * nb] for k in range(n_in - 1))], axis=2)
        f = _inputs(basis, B, u[:, :, i])
        at_b, at_bc = at_b + nb, at_bc + nb * (n_in - 1)
        for j in range(nb):
            driven[:, p:] += np.sum(B[:, None, j] * f[:, p - nk - j : p + h - nk - j], axis=2)
    g = np.full((D, p + h, n_out), np.nan)
    g[:, :p] = model.out.value(y)
    out = np.empty((D, h))
    inverse = None if model.linear else Inverse(model, model.output_weights(theta), span)
    for k in range(h):
        t = p + k
        right = driven[:, t] - noise[:, k] - (theta[:, -1] if intercept else 0.0)
        for i in range(na):
            right = right - np.sum(A[:, i] * g[:, t - 1 - i], axis=1)
        out[:, k] = right if inverse is None else inverse(right)
        g[:, t] = model.out.value(out[:, k])
    return out


def _inputs(basis: Basis, B: Array, u: Array) -> Array:
    """Functions of an input, (D or 1, T, n_in)."""
    if not isinstance(basis, Thresholds):
        return basis.value(u)
    b = B[:, :, 0]
    if basis.fed == "average":
        upper, lower = (np.mean(B[:, :, k] / b, axis=1) for k in (1, 2))
    else:
        upper, lower = (np.sum(b * B[:, :, k], axis=1) / np.sum(b * b, axis=1) for k in (1, 2))
    most = INSIDE * basis.u_max
    above, below = u >= np.clip(upper, 0.0, most)[:, None], u <= np.clip(lower, -most, 0.0)[:, None]
    return basis.split(u, above, below)


class Inverse:
    """The output blocks of D systems, weights d (D, n_out), inverted on a grid over the span of each."""

    def __init__(self, model: Any, d: Array, span: tuple[Any, Any]) -> None:
        self.basis, self.d = model.out, d
        least, most = (np.atleast_1d(np.asarray(end, float)) for end in span)
        margin = WIDER * np.where(most > least, most - least, 1e-9)
        low, high = np.maximum(least - margin, self.basis.limits[0]), np.minimum(most + margin, self.basis.limits[1])
        self.y = np.linspace(low, high, GRID, axis=1)
        self.own = np.arange(len(d)) if len(low) > 1 else np.zeros(len(d), int)
        level = np.einsum("rgk,rk->rg", np.broadcast_to(self.basis.value(self.y), (len(d), GRID, d.shape[1])), d)
        self.rising = np.all(np.diff(level, axis=1) > 0.0, axis=1)
        middle = GRID // 2
        level[:, middle:] = np.maximum.accumulate(level[:, middle:], axis=1)
        level[:, : middle + 1] = np.minimum.accumulate(level[:, middle::-1], axis=1)[:, ::-1]
        self.level = level

    def __call__(self, right: Array) -> Array:
        """Outputs (D,) at which the blocks have the values ``right`` (D,), within the grid."""
        row, top = np.arange(len(right)), GRID - 1
        cell = np.clip(np.sum(self.level <= right[:, None], axis=1) - 1, 0, top - 1)
        low, high = self.level[row, cell], self.level[row, cell + 1]
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(high > low, (right - low) / (high - low), 0.0)
        left, right_end = self.y[self.own, cell], self.y[self.own, cell + 1]
        y = left + np.clip(share, 0.0, 1.0) * (right_end - left)
        inside = self.rising & (right > self.level[:, 0]) & (right < self.level[:, -1])
        for _ in range(NEWTON_STEPS):
            slope = np.sum(self.basis.derivative(y) * self.d, axis=1)
            short = right - np.sum(self.basis.value(y) * self.d, axis=1)
            with np.errstate(invalid="ignore", divide="ignore"):
                y = np.where(inside & (slope > 0.0), np.clip(y + short / slope, left, right_end), y)
        return np.where(np.isfinite(right), y, np.nan)
