"""The inverse of an output block on a grid: the y at which sum_k d_k g_k(y) has a given level.

The grid is laid over the outputs believed so far, widened by a fifth, and laid anew when an output leaves it. An output
far beyond all others (three times the range of medians of three) is believed in no further than that, so that one
absurd number does not make the grid coarse for ever.

Where the levels rise along the grid, the cell is found by bisection and y in it by the monotone cubic through levels
and slopes at its ends, finished by Newton's method. That they rise is not looked at for every sample: with d' the
coefficients at which all differences D_i of levels were found positive, they stay positive while

    sum_k |d_k - d'_k| max_i |D_ik / D_i| < 1,       D_ik the differences of g_k

Where they do not rise, the monotone envelope (running maximum from the middle outwards, running minimum inwards) is
inverted instead and ``RISING`` is 0. Source of the cubic: Fritsch and Carlson (1980). Cost: O(log GRID n_out).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.drivers import LARGEST
from driftfit.kernel import Array, core, part
from driftfit.models.block_memory import (
    BEFORE,
    BEND,
    BOTTOM,
    CURVE,
    D_NOW,
    D_SEEN,
    EARLIER,
    FIRM_HIGH,
    FIRM_LOW,
    GRID,
    HIGHEST,
    LEVEL,
    LOW,
    LOWEST,
    N_OUT,
    REACH,
    RISING,
    STEP,
    TOP,
    TRIAL,
    TRIAL_BEND,
    Places,
)

WIDER = 0.2
"""Share of the range of the outputs by which the grid goes beyond it, at both ends."""
FAR = 3.0
"""Times the range of medians of three, beyond it: an output farther away is believed in no further."""
SAFE = 0.99
"""The bound on the change of d, less what rounding may take."""
SMALL = 1e-5
"""A Newton step of that share of a cell is the last: the next would be of its square."""
STEPS = 8
EIGHTH = GRID // 8
WIDE = 10.0
"""Times as wide as needed: a grid that was laid for an absurd first output is laid anew."""


@part
def believe(m: Array, y: float) -> None:
    """Take an output into the range of those seen."""
    one, other = m[BEFORE, 0], m[EARLIER, 0]
    m[EARLIER, 0], m[BEFORE, 0] = one, y
    if other == other:
        middle = max(min(one, other), min(max(one, other), y))
        m[FIRM_LOW, 0], m[FIRM_HIGH, 0] = min(m[FIRM_LOW, 0], middle), max(m[FIRM_HIGH, 0], middle)
        margin = FAR * (m[FIRM_HIGH, 0] - m[FIRM_LOW, 0])
        bottom, top = m[FIRM_LOW, 0] - margin, m[FIRM_HIGH, 0] + margin
        y = min(max(y, bottom), top)
        m[LOWEST, 0], m[HIGHEST, 0] = max(m[LOWEST, 0], bottom), min(m[HIGHEST, 0], top)
    m[LOWEST, 0], m[HIGHEST, 0] = min(m[LOWEST, 0], y), max(m[HIGHEST, 0], y)


@part
def level(m: Array, p: Places, at: int, i: int) -> Any:
    """sum_k d_k times row i of the table at ``at``: the level (CURVE) or its slope (BEND) at a point of the grid."""
    n_out, d = p[N_OUT], p[D_NOW]
    row = at + i * n_out
    total = m[row, 0]
    for k in range(1, n_out):
        total += m[d + k, 0] * m[row + k, 0]
    return total


@part
def beneath(m: Array, p: Places, at: int, apart: int, right: float) -> int:
    """How many of the levels 1 to 7, so many points apart, are not above ``right``, where levels rise.

    Seven levels that do not wait for each other, instead of three halvings that do.
    """
    n_out, d = p[N_OUT], p[D_NOW]
    row = apart * n_out
    one, two, three = at + row, at + 2 * row, at + 3 * row
    four, five, six, seven = at + 4 * row, at + 5 * row, at + 6 * row, at + 7 * row
    a, b, c = m[one, 0], m[two, 0], m[three, 0]
    e, f, g, h = m[four, 0], m[five, 0], m[six, 0], m[seven, 0]
    for k in range(1, n_out):
        weight = m[d + k, 0]
        a += weight * m[one + k, 0]
        b += weight * m[two + k, 0]
        c += weight * m[three + k, 0]
        e += weight * m[four + k, 0]
        f += weight * m[five + k, 0]
        g += weight * m[six + k, 0]
        h += weight * m[seven + k, 0]
    return (
        int(a <= right) + int(b <= right) + int(c <= right) + int(e <= right) + int(f <= right) + int(g <= right)
        + int(h <= right)
    )  # fmt: skip


@core
def look(m: Array, p: Places) -> None:
    """Whether the levels rise along the grid, and how far d may go before that is looked at again; else an envelope."""
    n_out, d, seen, reach, at = p[N_OUT], p[D_NOW], p[D_SEEN], p[REACH], p[CURVE]
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
                row = at + i * n_out + k
                most = max(most, abs(m[row + n_out, 0] - m[row, 0]) / (m[levels + i + 1, 0] - m[levels + i, 0]))
            m[seen + k, 0], m[reach + k, 0] = m[d + k, 0], most
    else:
        for i in range(GRID // 2, GRID - 1):
            m[levels + i + 1, 0] = max(m[levels + i + 1, 0], m[levels + i, 0])
        for i in range(GRID // 2, 0, -1):
            m[levels + i - 1, 0] = min(m[levels + i - 1, 0], m[levels + i, 0])


@core
def on_envelope(m: Array, p: Places, right: float) -> float:
    """The y at which the envelope has a level, between two of its ends."""
    levels = p[LEVEL]
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
    d, seen, reach = p[D_NOW], p[D_SEEN], p[REACH]
    moved = m[reach, 0]
    for k in range(1, p[N_OUT]):
        moved += abs(m[d + k, 0] - m[seen + k, 0]) * m[reach + k, 0]
    if not moved < SAFE:
        look(m, p)
    return bool(m[RISING, 0] > 0.0)


@part
def cubic(share: float, mean: float, first: float, last: float) -> float:
    """Where in a cell, 0 to 1, a share of its rise is reached: mean slope, and slopes at both ends."""
    one = min(mean / first, 3.0) if first > 0.0 else 3.0
    other = min(mean / last, 3.0) if last > 0.0 else 3.0
    rest = 1.0 - share
    return share * (share * (3.0 - 2.0 * share) + rest * (rest * one - share * other))


@lru_cache
def inverse_of(level_at: Any) -> Any:
    """A part (m, p, right) that inverts the output block, from one that says level and slope at a y."""

    def invert(m: Array, p: Places, right: float) -> Any:
        step, start = m[STEP, 0], m[LOW, 0]
        if not (step > 0.0 and abs(right) < LARGEST):
            return np.nan
        rising, at, last = rises(m, p), p[CURVE], GRID - 1
        low = level(m, p, at, 0) if rising else m[p[LEVEL], 0]
        high = level(m, p, at, last) if rising else m[p[LEVEL] + last, 0]
        if right < low:
            return start
        if right >= high:
            return start + last * step
        if not rising:
            return on_envelope(m, p, right)
        below = EIGHTH * beneath(m, p, at, EIGHTH, right)
        below += beneath(m, p, at + below * p[N_OUT], 1, right)
        below = min(below, last - 1)
        before, after = level(m, p, at, below), level(m, p, at, below + 1)
        rise, bends = after - before, p[BEND]
        first, final = level(m, p, bends, below), level(m, p, bends, below + 1)
        left = start + below * step
        y = left + step * cubic((right - before) / rise, rise / step, first, final)
        for _ in range(STEPS):
            value, slope = level_at(m, p, y)
            if not slope > 0.0:
                break
            change = (right - value) / slope
            y = min(max(y + change, left), left + step)
            if abs(change) <= SMALL * step:
                break
        return y

    return part(invert)


@lru_cache
def laying(values: Any) -> Any:
    """A part (m, p) that lays the grid anew where the outputs believed need another."""

    def lay(m: Array, p: Places) -> None:
        low, high = m[LOWEST, 0], m[HIGHEST, 0]
        start, end = m[LOW, 0], m[LOW, 0] + (GRID - 1) * m[STEP, 0]
        wide = high - low
        margin = WIDER * (wide if wide > 0.0 else max(abs(high), 1.0))
        short = (low < start and start > m[BOTTOM, 0]) or (high > end and end < m[TOP, 0])
        if low <= high and (m[STEP, 0] == 0.0 or short or end - start > WIDE * (wide + 2.0 * margin)):
            n_out, g, h, curve, bend = (
                p[N_OUT],
                p[TRIAL],
                p[TRIAL_BEND],
                p[CURVE],
                p[BEND],
            )
            start, end = max(low - margin, m[BOTTOM, 0]), min(high + margin, m[TOP, 0])
            m[LOW, 0], m[STEP, 0] = start, (end - start) / (GRID - 1)
            for i in range(GRID):
                values(m, p, min(start + i * m[STEP, 0], end), g, h)
                for k in range(n_out):
                    m[curve + i * n_out + k, 0] = m[g + k, 0]
                    m[bend + i * n_out + k, 0] = m[h + k, 0]
            m[p[REACH], 0] = np.inf

    return part(lay)
