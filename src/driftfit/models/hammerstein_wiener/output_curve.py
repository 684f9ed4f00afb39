"""The inverse of an output block on a grid: the y at which sum_k d_k g_k(y) has a given level.

The grid covers the range of accepted outputs so far, widened by a fifth, and is computed again when an output leaves
it. While all outputs are equal, it is widened by the scale of range, knots or centres (`Basis.scale`). An output far
beyond all others (three times the range of medians of three) widens the range only up to that limit, so that one
absurd number does not make the grid coarse for ever.

If the levels increase along the grid, the cell is found by bisection, and y in the cell by the monotone cubic through
levels and slopes at its ends, refined by Newton's method. Whether the levels increase is not checked at every sample.
Let d' be coefficients for which all differences D_i of levels were positive; they remain positive as long as

    sum_k |d_k - d'_k| max_i |D_ik / D_i| < 1,       D_ik the differences of g_k

If the levels do not increase, the monotone envelope (running maximum from the middle outwards, running minimum inwards)
is inverted instead and ``rising`` is 0. Source of the cubic: Fritsch and Carlson (1980). Cost: O(log GRID n_out).

`play` runs many systems forward in parallel, with predicted outputs fed back and the products of theta themselves,

    F(y_t; d) = sum_j sum_k (b_j c_k) f_k(u_(t-nk-j+1)) - sum_i sum_k (a_i d_k) g_k(y_(t-i)) - l - v_t

and `Inverse` inverts F on a grid over a given span of outputs. Cost per sample and system: O(n + GRID).
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array, State, kernel
from driftfit.models.hammerstein_wiener.basis import Basis
from driftfit.models.hammerstein_wiener.curve_kernels import powers
from driftfit.models.hammerstein_wiener.thresholds import INSIDE, Thresholds

GRID = 64
"""Points of the grid on which the output block is inverted."""
WIDER = 0.2
"""Share of the range of the outputs by which the grid extends beyond it at both ends."""
SAFE = 0.99
"""The bound on the change of d, reduced for rounding."""
FINE = 1e-8
"""Share of a cell; the Newton iteration stops when its error is below it."""
NEWTON_STEPS = 8
SPREAD = 10.0
"""A grid that is this many times wider than needed, because of an absurd first output, is computed again."""

CELL_STEPS = 3
"""The same of `Inverse`, which begins at the chord of the cell."""


def memory(out: Basis) -> dict[str, Any]:
    """The fields of the inverse before the first sample."""
    none, grid = np.zeros(out.n), np.zeros((out.n, GRID))
    return {
        "d_now": np.eye(1, out.n)[0],  # 1, d_2 .. before the sample
        "output_numbers": out.parameters,
        "trial": none, "trial_slopes": none,  # the functions at a trial y, and their slopes
        "y_lowest": np.inf, "y_highest": -np.inf,  # the range of accepted outputs
        "y_bottom": out.limits[0], "y_top": out.limits[1], "y_scale": out.scale,
        "grid_due": 0.0,  # whether the range changed since the grid was computed
        "grid_low": 0.0, "grid_step": 0.0, "grid_values": grid, "grid_slopes": grid,
        "grid_rises": 1.0, "envelope": grid[0],  # whether the levels increase; their envelope
        "d_checked": none, "d_reach": np.full(out.n, np.inf),  # d for which they do, and the safe distance from it
    }  # fmt: skip


@lru_cache
def trying(functions: Any) -> Any:
    """A kernel that fills ``trial`` and ``trial_slopes`` with the functions of the output block at y."""

    @kernel
    def try_output(s: State, y: float, l: int) -> None:
        functions(y, s.output_numbers[:, l], s.trial[:, l], s.trial_slopes[:, l])

    return try_output


@lru_cache
def level_of(functions: Any) -> Any:
    """A kernel that returns the level of the output block at y and its slope; it may fill ``trial``."""
    try_output = trying(functions)

    def at_output(s: State, y: float, l: int) -> tuple[float, float]:
        try_output(s, y, l)
        value, slope = s.trial[0, l], s.trial_slopes[0, l]
        for k in range(1, s.d_now.shape[0]):
            value += s.d_now[k, l] * s.trial[k, l]
            slope += s.d_now[k, l] * s.trial_slopes[k, l]
        return value, slope

    def horner(s: State, y: float, l: int) -> tuple[float, float]:
        value, slope = 0.0, 0.0
        for k in range(s.d_now.shape[0] - 1, -1, -1):
            slope = slope * y + value
            value = value * y + (s.d_now[k, l] if k > 0 else 1.0)
        return value * y, slope * y + value

    return kernel(horner if functions is powers else at_output)


@kernel
def accept(s: State, y: float, l: int) -> None:
    """Include an output in the range of accepted outputs."""
    if y < s.y_lowest[l] or y > s.y_highest[l]:
        s.y_lowest[l], s.y_highest[l] = min(s.y_lowest[l], y), max(s.y_highest[l], y)
        s.grid_due[l] = 1.0


@kernel
def at_point(s: State, table: Array, i: int, l: int) -> float:
    """sum_k d_k times entry k of a table at point i of the grid: the level of the output block, or its slope."""
    total = table[0, i, l]
    for k in range(1, s.d_now.shape[0]):
        total += s.d_now[k, l] * table[k, i, l]
    return total  # type: ignore[no-any-return]


@partial(kernel, inline=False)
def check(s: State, l: int) -> None:
    """Check whether the levels increase, and how far d may change until the next check; if not, make the envelope."""
    for i in range(GRID):
        s.envelope[i, l] = at_point(s, s.grid_values, i, l)
    falls = 0
    for i in range(GRID - 1):
        falls += 0 if s.envelope[i + 1, l] > s.envelope[i, l] else 1
    s.grid_rises[l] = 1.0 if falls == 0 else 0.0
    s.d_reach[0, l] = 0.0 if falls == 0 else np.inf
    if falls == 0:
        for k in range(1, s.d_now.shape[0]):
            most = 0.0
            for i in range(GRID - 1):
                rise = s.envelope[i + 1, l] - s.envelope[i, l]
                most = max(most, abs(s.grid_values[k, i + 1, l] - s.grid_values[k, i, l]) / rise)
            s.d_checked[k, l], s.d_reach[k, l] = s.d_now[k, l], most
    else:
        for i in range(GRID // 2, GRID - 1):
            s.envelope[i + 1, l] = max(s.envelope[i + 1, l], s.envelope[i, l])
        for i in range(GRID // 2, 0, -1):
            s.envelope[i - 1, l] = min(s.envelope[i - 1, l], s.envelope[i, l])


@kernel
def rises(s: State, l: int) -> bool:
    """Whether the output block with the present d increases along the grid."""
    moved = s.d_reach[0, l]
    for k in range(1, s.d_now.shape[0]):
        moved += abs(s.d_now[k, l] - s.d_checked[k, l]) * s.d_reach[k, l]
    if not moved < SAFE:
        check(s, l)
    return bool(s.grid_rises[l] > 0.0)


@kernel
def cubic(share: float, mean: float, first: float, last: float) -> float:
    """Where in a cell, 0 to 1, a share of its rise is reached, from the mean slope and those at both ends."""
    one = min(mean / first, 3.0) if first > 0.0 else 3.0
    other = min(mean / last, 3.0) if last > 0.0 else 3.0
    rest = 1.0 - share
    return share * (share * (3.0 - 2.0 * share) + rest * (rest * one - share * other))


@lru_cache
def inverting(functions: Any) -> Any:
    """A kernel that returns the y at which the output block has a level: NaN without a grid, within the grid if the
    levels do not increase or the level is beyond them.
    """
    level_at = level_of(functions)

    @kernel
    def solve(s: State, right: float, below: int, l: int) -> float:
        """In a cell of the grid."""
        step, start = s.grid_step[l], s.grid_low[l]
        before, after = at_point(s, s.grid_values, below, l), at_point(s, s.grid_values, below + 1, l)
        if right < before:
            return start  # type: ignore[no-any-return]
        if right >= after:
            return start + (GRID - 1) * step  # type: ignore[no-any-return]
        first, final = at_point(s, s.grid_slopes, below, l), at_point(s, s.grid_slopes, below + 1, l)
        rise, left = after - before, start + below * step
        mean = rise / step
        y = left + step * cubic((right - before) / rise, mean, first, final)
        bend = abs(first - mean) + abs(final - mean)
        for _ in range(NEWTON_STEPS):
            value, slope = level_at(s, y, l)
            if not slope > 0.0:
                break
            change = (right - value) / slope
            y = min(max(y + change, left), left + step)
            if change * change * bend <= FINE * step * step * slope:
                break
        return y  # type: ignore[no-any-return]

    @partial(kernel, inline=False)
    def invert(s: State, right: float, l: int) -> float:
        if not s.grid_step[l] > 0.0 or right != right:
            return np.nan
        rising = rises(s, l)
        below, above = 0, GRID - 1
        while above - below > 1:
            middle = (below + above) // 2
            here = at_point(s, s.grid_values, middle, l) if rising else s.envelope[middle, l]
            under = here <= right
            below = middle if under else below
            above = above if under else middle
        if rising:
            return solve(s, min(max(right, -LARGEST), LARGEST), below, l)  # type: ignore[no-any-return]
        before, after = s.envelope[below, l], s.envelope[below + 1, l]
        share = 1.0 if right >= after else (right - before) / (after - before) if right > before else 0.0
        return s.grid_low[l] + s.grid_step[l] * (below + share)  # type: ignore[no-any-return]

    return invert


@lru_cache
def laying(functions: Any) -> Any:
    """A kernel that computes the grid again if the accepted outputs need another."""
    try_output = trying(functions)

    def lay(s: State, l: int) -> None:
        s.grid_due[l] = 0.0
        low, high, scale, bottom, top = s.y_lowest[l], s.y_highest[l], s.y_scale[l], s.y_bottom[l], s.y_top[l]
        start, end = s.grid_low[l], s.grid_low[l] + (GRID - 1) * s.grid_step[l]
        wide = high - low
        alone = scale if scale > 0.0 else WIDER * (abs(high) if high != 0.0 else 1.0)
        margin = WIDER * wide if wide > 0.0 else alone
        short = (low < start and start > bottom) or (high > end and end < top)
        if low <= high and (s.grid_step[l] == 0.0 or short or end - start > SPREAD * (wide + 2.0 * margin)):
            start, end = max(low - margin, bottom), min(high + margin, top)
            s.grid_low[l], s.grid_step[l] = start, (end - start) / (GRID - 1)
            for i in range(GRID):
                try_output(s, min(s.grid_low[l] + i * s.grid_step[l], end), l)
                for k in range(s.d_now.shape[0]):
                    s.grid_values[k, i, l], s.grid_slopes[k, i, l] = s.trial[k, l], s.trial_slopes[k, l]
            s.d_reach[0, l] = np.inf

    return kernel(lay, short=True)


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
        for _ in range(CELL_STEPS):
            slope = np.sum(self.basis.derivative(y) * self.d, axis=1)
            short = right - np.sum(self.basis.value(y) * self.d, axis=1)
            with np.errstate(invalid="ignore", divide="ignore"):
                y = np.where(inside & (slope > 0.0), np.clip(y + short / slope, left, right_end), y)
        return np.where(np.isfinite(right), y, np.nan)
