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
is inverted instead and ``RISING`` is 0. Source of the cubic: Fritsch and Carlson (1980). Cost: O(log GRID n_out).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array, part, shared
from driftfit.engine.simd import fill_four, load_four, plus, reached, times
from driftfit.models.hammerstein_wiener.evaluate_bases import Kind, level_of
from driftfit.models.hammerstein_wiener.step_memory import (
    BEND,
    BOTTOM,
    CELL,
    COARSE,
    CURVE,
    D_CHECKED,
    D_NOW,
    EIGHT,
    GRID,
    HIGHEST,
    LATE,
    LEVEL,
    LOW,
    LOWEST,
    MOVED,
    N_OUT,
    REACH,
    RISING,
    ROW,
    SCALE,
    STEP,
    TOP,
    TRIAL,
    TRIAL_BEND,
    Places,
)

WIDER = 0.2
"""Share of the range of the outputs by which the grid extends beyond it at both ends."""
SAFE = 0.99
"""The bound on the change of d, reduced for rounding."""
FINE = 1e-8
"""Share of a cell; the Newton iteration stops when its error is below it."""
STEPS = 8
WIDE = 10.0
"""A grid that is this many times wider than needed, because of an absurd first output, is computed again."""


@part
def believe(m: Array, y: float) -> None:
    """Include an output in the range of accepted outputs."""
    if y < m[LOWEST, 0] or y > m[HIGHEST, 0]:
        m[LOWEST, 0], m[HIGHEST, 0], m[MOVED, 0] = min(m[LOWEST, 0], y), max(m[HIGHEST, 0], y), 1.0


@part
def level(m: Array, p: Places, at: int, i: int) -> Any:
    """sum_k d_k times function k of the table at ``at``: the level (CURVE) or its slope (BEND) at a grid point."""
    d, place = p[D_NOW], at + i
    total = m[place, 0]
    for k in range(1, p[N_OUT]):
        total += m[d + k, 0] * m[place + k * ROW, 0]
    return total


@part
def beneath(m: Array, p: Places, at: int, row: int, right: float) -> int:
    """How many of the eight levels from ``at`` on are not above ``right``; ``row`` is the length of a row."""
    d = p[D_NOW]
    one, other = load_four(m, at, 0), load_four(m, at + 4, 0)
    for k in range(1, p[N_OUT]):
        weight = fill_four(m[d + k, 0])
        one = plus(one, times(weight, load_four(m, at + k * row, 0)))
        other = plus(other, times(weight, load_four(m, at + k * row + 4, 0)))
    given = fill_four(right)
    return reached(given, one) + reached(given, other)  # type: ignore[no-any-return]


@part
def beneath_in_lane(m: Array, p: Places, at: int, row: int, right: float) -> int:
    """The same if the numbers of a lane are not contiguous."""
    d, count = p[D_NOW], 0
    for i in range(EIGHT):
        place = at + i
        total = m[place, 0]
        for k in range(1, p[N_OUT]):
            total += m[d + k, 0] * m[place + k * row, 0]
        count += int(total <= right)
    return count


@shared
def look(m: Array, p: Places) -> None:
    """Check whether the levels increase, and how far d may change until the next check; if not, make the envelope."""
    n_out, d, checked, reach, at = p[N_OUT], p[D_NOW], p[D_CHECKED], p[REACH], p[CURVE]
    levels = p[LEVEL]
    for i in range(GRID):
        m[levels + i, 0] = level(m, p, at, i)
    falls = 0
    for i in range(GRID - 1):
        falls += 0 if m[levels + i + 1, 0] > m[levels + i, 0] else 1
    m[RISING, 0] = 1.0 if falls == 0 else 0.0
    m[reach, 0] = 0.0 if falls == 0 else np.inf
    if falls == 0:
        for k in range(1, n_out):
            most = 0.0
            for i in range(GRID - 1):
                place = at + k * ROW + i
                most = max(most, abs(m[place + 1, 0] - m[place, 0]) / (m[levels + i + 1, 0] - m[levels + i, 0]))
            m[checked + k, 0], m[reach + k, 0] = m[d + k, 0], most
    else:
        for i in range(GRID // 2, GRID - 1):
            m[levels + i + 1, 0] = max(m[levels + i + 1, 0], m[levels + i, 0])
        for i in range(GRID // 2, 0, -1):
            m[levels + i - 1, 0] = min(m[levels + i - 1, 0], m[levels + i, 0])


@shared
def on_envelope(m: Array, p: Places, right: float) -> float:
    """The y at which the envelope has the level ``right``; the end of the grid for a level beyond it."""
    levels = p[LEVEL]
    if right < m[levels, 0]:
        return float(m[LOW, 0])
    if right >= m[levels + GRID - 1, 0]:
        return float(m[LOW, 0] + (GRID - 1) * m[STEP, 0])
    below, above = 0, GRID - 1
    while above - below > 1:
        middle = (below + above) // 2
        if m[levels + middle, 0] <= right:
            below = middle
        else:
            above = middle
    before, after = m[levels + below, 0], m[levels + below + 1, 0]
    return float(m[LOW, 0] + m[STEP, 0] * (below + (right - before) / (after - before)))


@part
def rises(m: Array, p: Places) -> bool:
    """Whether the output block with the present d increases along the grid."""
    d, checked, reach = p[D_NOW], p[D_CHECKED], p[REACH]
    moved = m[reach, 0]
    for k in range(1, p[N_OUT]):
        moved += abs(m[d + k, 0] - m[checked + k, 0]) * m[reach + k, 0]
    if not moved < SAFE:
        look(m, p)
    return bool(m[RISING, 0] > 0.0)


@part
def cubic(share: float, mean: float, first: float, last: float) -> float:
    """Where in a cell, 0 to 1, a share of its rise is reached, from the mean slope and those at both ends."""
    one = min(mean / first, 3.0) if first > 0.0 else 3.0
    other = min(mean / last, 3.0) if last > 0.0 else 3.0
    rest = 1.0 - share
    return share * (share * (3.0 - 2.0 * share) + rest * (rest * one - share * other))


@lru_cache
def locating(lanes: bool = False) -> Any:
    """A part (m, p, right) that finds the cell of the grid for a level; returns it, or the y if there is none."""
    count = beneath_in_lane if lanes else beneath

    def locate(m: Array, p: Places, right: float) -> Any:
        m[LATE, 0] = 0.0
        if not m[STEP, 0] > 0.0 or right != right:
            return np.nan
        right = min(max(right, -LARGEST), LARGEST)  # the level beyond all levels of the grid is infinite
        if not rises(m, p):
            return on_envelope(m, p, right)
        below = EIGHT * count(m, p, p[COARSE], EIGHT, right)
        below += count(m, p, p[CURVE] + below + 1, ROW, right)
        m[CELL, 0], m[LATE, 0] = min(below, GRID - 2), 1.0
        return right

    return part(locate)


@lru_cache
def refining(level_at: Any) -> Any:
    """A part (m, p, right) that solves in the cell that was found; ``level_at`` returns level and slope at a y."""

    def refine(m: Array, p: Places, right: float) -> Any:
        step, start, at, bends, below = m[STEP, 0], m[LOW, 0], p[CURVE], p[BEND], int(m[CELL, 0])
        before, after = level(m, p, at, below), level(m, p, at, below + 1)
        if right < before:
            return start
        if right >= after:
            return start + (GRID - 1) * step
        first, final, rise = level(m, p, bends, below), level(m, p, bends, below + 1), after - before
        mean, left = rise / step, start + below * step
        y = left + step * cubic((right - before) / rise, mean, first, final)
        bend = abs(first - mean) + abs(final - mean)
        for _ in range(STEPS):
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
def inverse_of(level_at: Any, lanes: bool = False) -> Any:
    """A part (m, p, right) that inverts the output block; ``level_at`` returns level and slope at a y."""
    locate, refine = locating(lanes), refining(level_at)

    def invert(m: Array, p: Places, right: float) -> Any:
        found = locate(m, p, right)
        return refine(m, p, found) if m[LATE, 0] > 0.0 else found

    return part(invert)


@lru_cache
def inverting(out: Kind) -> Any:
    """The same as a core, for any lane, where it is seldom needed."""
    return shared(inverse_of(level_of(out), lanes=True).py_func)


@lru_cache
def laying(values: Any) -> Any:
    """A core (m, p) that computes the grid again if the accepted outputs need another."""

    def lay(m: Array, p: Places) -> None:
        m[MOVED, 0] = 0.0
        low, high = m[LOWEST, 0], m[HIGHEST, 0]
        start, end = m[LOW, 0], m[LOW, 0] + (GRID - 1) * m[STEP, 0]
        wide = high - low
        alone = m[SCALE, 0] if m[SCALE, 0] > 0.0 else WIDER * (abs(high) if high != 0.0 else 1.0)
        margin = WIDER * wide if wide > 0.0 else alone
        short = (low < start and start > m[BOTTOM, 0]) or (high > end and end < m[TOP, 0])
        if low <= high and (m[STEP, 0] == 0.0 or short or end - start > WIDE * (wide + 2.0 * margin)):
            start, end = max(low - margin, m[BOTTOM, 0]), min(high + margin, m[TOP, 0])
            m[LOW, 0], m[STEP, 0] = start, (end - start) / (GRID - 1)
            table(m, p, end)
            m[p[REACH], 0] = np.inf

    def fill_table(m: Array, p: Places, end: float) -> None:
        n_out, g, h, curve, bend, coarse = p[N_OUT], p[TRIAL], p[TRIAL_BEND], p[CURVE], p[BEND], p[COARSE]
        for i in range(GRID):
            values(m, p, min(m[LOW, 0] + i * m[STEP, 0], end), g, h)
            for k in range(n_out):
                m[curve + k * ROW + i, 0] = m[g + k, 0]
                m[bend + k * ROW + i, 0] = m[h + k, 0]
        for k in range(n_out):
            beyond = np.inf if k == 0 else 0.0
            m[curve + k * ROW + GRID, 0] = beyond
            for j in range(EIGHT):
                m[coarse + k * EIGHT + j, 0] = m[curve + k * ROW + EIGHT * (j + 1), 0] if j < EIGHT - 1 else beyond

    table = part(fill_table)
    return shared(lay)
