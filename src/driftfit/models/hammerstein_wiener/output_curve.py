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

from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array, part, shared
from driftfit.models.hammerstein_wiener.basis import Basis
from driftfit.models.hammerstein_wiener.curve_kernels import LEGENDRE, POWERS, legendre, powers
from driftfit.models.hammerstein_wiener.structure import AT, GRID, NUMBER, Places
from driftfit.models.hammerstein_wiener.thresholds import INSIDE, Thresholds

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

Kind = tuple[Any, int]
"""The compiled routine of a basis, and its code."""


@lru_cache
def values_of(kind: Kind, numbers: int, following: int, count: int) -> Any:
    """A part (m, p, x, at, slopes) that fills two arrays with the functions of a block at x, and their slopes.

    Every basis is evaluated by its compiled routine, called by symbol. Raw powers and Legendre polynomials, the most
    common ones, are computed inline.
    """
    evaluate, code = kind
    inline: Any = {POWERS: powers, LEGENDRE: legendre}.get(code)

    def called(m: Array, p: Places, x: float, at: int, slopes: int) -> None:
        own, L = p[numbers], m.shape[1]
        base, size = m.ctypes.data, 8 * L
        evaluate(x, base + size * own, p[following] - own, base + size * at, base + size * slopes, p[count], L)

    def inlined(m: Array, p: Places, x: float, at: int, slopes: int) -> None:
        own = m[p[numbers] + 1 : p[following], 0]
        inline(x, own, m[at : at + p[count], 0], m[slopes : slopes + p[count], 0])

    return part(called if inline is None else inlined)


@lru_cache
def level_of(kind: Kind) -> Any:
    """A part (m, p, y) that returns the level of the output block at y and its slope; it may fill trial, trial_bend."""
    fill_trial = values_of(kind, AT.out, AT.curve, AT.n_out)

    def at_output(m: Array, p: Places, y: float) -> tuple[float, float]:
        d, g, h = p[AT.d_now], p[AT.trial], p[AT.trial_bend]
        fill_trial(m, p, y, g, h)
        value, slope = m[g, 0], m[h, 0]
        for k in range(1, p[AT.n_out]):
            value += m[d + k, 0] * m[g + k, 0]
            slope += m[d + k, 0] * m[h + k, 0]
        return value, slope

    def horner(m: Array, p: Places, y: float) -> tuple[float, float]:
        value, slope = 0.0, 0.0
        for k in range(p[AT.n_out] - 1, -1, -1):
            slope = slope * y + value
            value = value * y + (m[p[AT.d_now] + k, 0] if k > 0 else 1.0)
        return value * y, slope * y + value

    return part(horner if kind[1] == POWERS else at_output)


@part
def believe(m: Array, y: float) -> None:
    """Include an output in the range of accepted outputs."""
    if y < m[NUMBER.lowest, 0] or y > m[NUMBER.highest, 0]:
        m[NUMBER.lowest, 0], m[NUMBER.highest, 0] = min(m[NUMBER.lowest, 0], y), max(m[NUMBER.highest, 0], y)
        m[NUMBER.moved, 0] = 1.0


@part
def level(m: Array, p: Places, at: int, i: int) -> Any:
    """sum_k d_k times function k of the table at ``at``: the level (curve) or its slope (bend) at a grid point."""
    d, place = p[AT.d_now], at + i
    total = m[place, 0]
    for k in range(1, p[AT.n_out]):
        total += m[d + k, 0] * m[place + k * GRID, 0]
    return total


@shared
def look(m: Array, p: Places) -> None:
    """Check whether the levels increase, and how far d may change until the next check; if not, make the envelope."""
    n_out, d, checked, reach, at = p[AT.n_out], p[AT.d_now], p[AT.d_checked], p[AT.reach], p[AT.curve]
    levels = p[AT.level]
    for i in range(GRID):
        m[levels + i, 0] = level(m, p, at, i)
    falls = 0
    for i in range(GRID - 1):
        falls += 0 if m[levels + i + 1, 0] > m[levels + i, 0] else 1
    m[NUMBER.rising, 0] = 1.0 if falls == 0 else 0.0
    m[reach, 0] = 0.0 if falls == 0 else np.inf
    if falls == 0:
        for k in range(1, n_out):
            most = 0.0
            for i in range(GRID - 1):
                place = at + k * GRID + i
                most = max(most, abs(m[place + 1, 0] - m[place, 0]) / (m[levels + i + 1, 0] - m[levels + i, 0]))
            m[checked + k, 0], m[reach + k, 0] = m[d + k, 0], most
    else:
        for i in range(GRID // 2, GRID - 1):
            m[levels + i + 1, 0] = max(m[levels + i + 1, 0], m[levels + i, 0])
        for i in range(GRID // 2, 0, -1):
            m[levels + i - 1, 0] = min(m[levels + i - 1, 0], m[levels + i, 0])


@part
def rises(m: Array, p: Places) -> bool:
    """Whether the output block with the present d increases along the grid."""
    d, checked, reach = p[AT.d_now], p[AT.d_checked], p[AT.reach]
    moved = m[reach, 0]
    for k in range(1, p[AT.n_out]):
        moved += abs(m[d + k, 0] - m[checked + k, 0]) * m[reach + k, 0]
    if not moved < SAFE:
        look(m, p)
    return bool(m[NUMBER.rising, 0] > 0.0)


@part
def cubic(share: float, mean: float, first: float, last: float) -> float:
    """Where in a cell, 0 to 1, a share of its rise is reached, from the mean slope and those at both ends."""
    one = min(mean / first, 3.0) if first > 0.0 else 3.0
    other = min(mean / last, 3.0) if last > 0.0 else 3.0
    rest = 1.0 - share
    return share * (share * (3.0 - 2.0 * share) + rest * (rest * one - share * other))


@part
def locate(m: Array, p: Places, right: float) -> Any:
    """The level if its cell of the grid was found, which is marked as ``late``; otherwise y: NaN without a grid, or the
    one at which the envelope has that level, within the grid.
    """
    m[NUMBER.late, 0] = 0.0
    if not m[NUMBER.step, 0] > 0.0 or right != right:
        return np.nan
    rising, levels = rises(m, p), p[AT.level]
    below, above = 0, GRID - 1
    while above - below > 1:
        middle = (below + above) // 2
        here = level(m, p, p[AT.curve], middle) if rising else m[levels + middle, 0]
        under = here <= right
        below = middle if under else below
        above = above if under else middle
    if rising:
        m[NUMBER.cell, 0], m[NUMBER.late, 0] = below, 1.0
        return min(max(right, -LARGEST), LARGEST)
    before, after = m[levels + below, 0], m[levels + below + 1, 0]
    share = 1.0 if right >= after else (right - before) / (after - before) if right > before else 0.0
    return m[NUMBER.low, 0] + m[NUMBER.step, 0] * (below + share)


@lru_cache
def refining(out: Kind) -> Any:
    """A part (m, p, right) that solves in the cell that was found."""
    level_at = level_of(out)

    def refine(m: Array, p: Places, right: float) -> Any:
        step, start, below = m[NUMBER.step, 0], m[NUMBER.low, 0], int(m[NUMBER.cell, 0])
        at, bends = p[AT.curve], p[AT.bend]
        before, after = level(m, p, at, below), level(m, p, at, below + 1)
        if right < before:
            return start
        if right >= after:
            return start + (GRID - 1) * step
        first, final, rise = level(m, p, bends, below), level(m, p, bends, below + 1), after - before
        mean, left = rise / step, start + below * step
        y = left + step * cubic((right - before) / rise, mean, first, final)
        bend = abs(first - mean) + abs(final - mean)
        for _ in range(NEWTON_STEPS):
            value, slope = level_at(m, p, y)
            if not slope > 0.0:
                break
            change = (right - value) / slope
            y = min(max(y + change, left), left + step)
            if change * change * bend <= FINE * step * step * slope:
                break
        return y

    return part(refine)


@lru_cache
def inverting(out: Kind) -> Any:
    """A core (m, p, right) that inverts the output block, where it is seldom needed."""
    refine = refining(out)

    def invert(m: Array, p: Places, right: float) -> Any:
        found = locate(m, p, right)
        return refine(m, p, found) if m[NUMBER.late, 0] > 0.0 else found

    return shared(invert)


@lru_cache
def laying(out: Kind) -> Any:
    """A core (m, p) that computes the grid again if the accepted outputs need another."""
    values = values_of(out, AT.out, AT.curve, AT.n_out)

    def lay(m: Array, p: Places) -> None:
        m[NUMBER.moved, 0] = 0.0
        low, high, scale = m[NUMBER.lowest, 0], m[NUMBER.highest, 0], m[NUMBER.scale, 0]
        bottom, top = m[NUMBER.bottom, 0], m[NUMBER.top, 0]
        start, end = m[NUMBER.low, 0], m[NUMBER.low, 0] + (GRID - 1) * m[NUMBER.step, 0]
        wide = high - low
        alone = scale if scale > 0.0 else WIDER * (abs(high) if high != 0.0 else 1.0)
        margin = WIDER * wide if wide > 0.0 else alone
        short = (low < start and start > bottom) or (high > end and end < top)
        if low <= high and (m[NUMBER.step, 0] == 0.0 or short or end - start > SPREAD * (wide + 2.0 * margin)):
            start, end = max(low - margin, bottom), min(high + margin, top)
            m[NUMBER.low, 0], m[NUMBER.step, 0] = start, (end - start) / (GRID - 1)
            table(m, p, end)
            m[p[AT.reach], 0] = np.inf

    def fill_table(m: Array, p: Places, end: float) -> None:
        n_out, g, h = p[AT.n_out], p[AT.trial], p[AT.trial_bend]
        for i in range(GRID):
            values(m, p, min(m[NUMBER.low, 0] + i * m[NUMBER.step, 0], end), g, h)
            for k in range(n_out):
                m[p[AT.curve] + k * GRID + i, 0] = m[g + k, 0]
                m[p[AT.bend] + k * GRID + i, 0] = m[h + k, 0]

    table = part(fill_table)
    return shared(lay)


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
