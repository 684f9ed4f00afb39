"""The compiled functions of the bases of the library.

A kernel ``(x, p, out, slopes)`` fills out (n,) and slopes (n,) with the functions of a basis at x and their
derivatives; p are the numbers of the basis.

B-splines after Piegl and Tiller, The NURBS Book (1997), section 2.5; the scratch that their recursion needs is at the
end of their numbers [degree, count, knots.., scratch.., values at the anchor..].
"""

from __future__ import annotations

from functools import partial

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array, exp, kernel


@kernel
def powers(x: float, p: Array, out: Array, slopes: Array) -> None:
    power, k = 1.0, 0.0
    for i in range(out.shape[0]):
        k += 1.0
        slopes[i] = k * power
        power = power * x
        out[i] = power


@kernel
def legendre(x: float, p: Array, out: Array, slopes: Array) -> None:
    # P'_(k+1) = P'_(k-1) + (2 k + 1) P_k
    s, scale = (x - p[0]) / p[1], 1.0 / p[1]
    before, now = 1.0, s
    slope_before, slope = 0.0, 1.0
    for k in range(out.shape[0]):
        out[k], slopes[k] = now, slope * scale
        slope, slope_before = slope_before + (2 * k + 3) * now, slope
        now, before = s * now + (s * now - before) * ((k + 1) / (k + 2)), now


@kernel
def chebyshev(x: float, p: Array, out: Array, slopes: Array) -> None:
    s = (x - p[0]) / p[1]
    before, now = 1.0, s
    slope_before, slope = 0.0, 1.0
    for k in range(out.shape[0]):
        out[k], slopes[k] = now, slope / p[1]
        slope_before, slope = slope, 2.0 * now + 2.0 * s * slope - slope_before
        before, now = now, 2.0 * s * now - before


@kernel
def dead_zone(x: float, p: Array, out: Array, slopes: Array) -> None:
    above, below = x >= p[0], x <= p[1]
    held = min(max(x, -p[4]), p[4]) if abs(x) < LARGEST else x
    out[0] = held if above or below or x != x else 0.0
    out[1] = -1.0 if above else 0.0
    out[2] = -1.0 if below else 0.0
    slopes[1], slopes[2] = 0.0, 0.0
    slopes[0] = 1.0 if (above or below) and abs(x) <= p[4] else 0.0


@kernel
def saturation(x: float, p: Array, out: Array, slopes: Array) -> None:
    above, below = x >= p[0], x <= p[1]
    out[0] = 0.0 if (above or below) and abs(x) < LARGEST else x
    out[1] = 1.0 if above else 0.0
    out[2] = 1.0 if below else 0.0
    slopes[1], slopes[2] = 0.0, 0.0
    slopes[0] = 0.0 if above or below else 1.0


@kernel
def tanh(z: float) -> float:
    """The library's own, with the same bits everywhere."""
    e = exp(-2.0 * abs(z))
    size = (1.0 - e) / (1.0 + e)
    return size if z >= 0.0 else -size if z < 0.0 else z


@kernel
def sigmoids(x: float, p: Array, out: Array, slopes: Array) -> None:
    n = out.shape[0]
    for k in range(n):
        level = tanh((x - p[k]) / p[n])
        out[k] = level + tanh(p[k] / p[n]) if abs(x) < LARGEST else np.nan
        slopes[k] = (1.0 - level * level) / p[n]


@kernel
def hinges(x: float, p: Array, out: Array, slopes: Array) -> None:
    out[0], slopes[0] = x, 1.0
    for k in range(1, out.shape[0]):
        knot = p[k - 1]
        away = x - knot
        out[k] = max(0.0, away) if knot >= 0.0 else min(0.0, away)
        out[k] = away if away != away else out[k]
        beyond = x > knot if knot >= 0.0 else x < knot
        slopes[k] = 1.0 if beyond else 0.0


@kernel
def local_splines(x: float, p: Array, degree: int) -> int:
    """The degree + 1 B-splines that are not zero at x, into the scratch at the end of p; returns their span."""
    order, count = int(p[0]), int(p[1])
    at, work = 2, 2 + count
    span = order
    while span < count - order - 2 and x >= p[at + span + 1]:
        span += 1
    p[work] = 1.0
    for j in range(1, degree + 1):
        saved = 0.0
        for r in range(j):
            right, left = p[at + span + r + 1] - x, x - p[at + span + 1 - j + r]
            share = p[work + r] / (right + left)
            p[work + r] = saved + right * share
            saved = left * share
        p[work + j] = saved
    return span


@partial(kernel, inline=False)
def splines(x: float, p: Array, out: Array, slopes: Array) -> None:
    order, count = int(p[0]), int(p[1])
    work, anchor = 2 + count, 2 + count + order + 1
    inside = x >= p[2] and x <= p[1 + count]
    for k in range(out.shape[0]):
        out[k], slopes[k] = -p[anchor + k] if inside else np.nan, 0.0 if inside else np.nan
    if inside:
        span = local_splines(x, p, order)
        for r in range(order + 1):
            k = span - order + r - 1  # the first of all is left out
            if k >= 0:
                out[k] += p[work + r]
        span = local_splines(x, p, order - 1)
        for r in range(order):
            k = span - order + 1 + r  # the lower B-spline that starts at knot k
            slope = order * p[work + r] / (p[2 + k + order] - p[2 + k])
            if k - 1 >= 0:
                slopes[k - 1] += slope
            if k - 2 >= 0:
                slopes[k - 2] -= slope
