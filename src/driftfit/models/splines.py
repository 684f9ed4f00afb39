"""Curves in pieces: lines that bend at knots, and B-splines.

B-splines after Piegl and Tiller, The NURBS Book (1997), section 2.5; the scratch that their recursion needs stands at
the end of their parameters p = [degree, knots.., scratch.., values at the anchor..].
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from driftfit.kernel import Array, kernel
from driftfit.models.curves import Basis, Curves, over
from driftfit.settings import numbers, whole


def knots_of(owner: str, value: Any, least: int) -> tuple[float, ...]:
    given = numbers(owner, "knots", value)
    knots = given if isinstance(given, tuple) else (given,)
    if len(knots) < least or any(b <= a for a, b in pairwise(knots)):
        raise ValueError(
            f"{owner}: knots must be at least {least} increasing numbers, each once (a knot given twice would make two "
            f"columns equal); got {value!r}."
        )
    return knots


@kernel
def _hinges(x: float, p: Array, out: Array) -> None:
    out[0] = x
    for k in range(1, out.shape[0]):
        away = x - p[k - 1]
        out[k] = max(0.0, away) if p[k - 1] >= 0.0 else min(0.0, away)
        out[k] = away if away != away else out[k]


@kernel
def _hinge_slopes(x: float, p: Array, out: Array) -> None:
    out[0] = 1.0
    for k in range(1, out.shape[0]):
        beyond = x > p[k - 1] if p[k - 1] >= 0.0 else x < p[k - 1]
        out[k] = 1.0 if beyond else 0.0


@dataclass(frozen=True)
class PiecewiseLinear(Basis):
    """A line that bends at increasing ``knots``; its first coefficient is the slope of the piece that holds 0."""

    knots: Any

    def __post_init__(self) -> None:
        self._set("knots", knots_of("PiecewiseLinear", self.knots, 1))

    @property
    def n(self) -> int:
        return 1 + len(self.knots)

    @property
    def curves(self) -> Curves:
        return Curves(_hinges, _hinge_slopes)

    @property
    def parameters(self) -> Array:
        return np.array(self.knots)

    @property
    def names(self) -> tuple[str, ...]:
        return ("x", *(f"bend at {k:g}" for k in self.knots))


@kernel
def _local_splines(x: float, p: Array, degree: int) -> int:
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


@kernel
def _splines(x: float, p: Array, out: Array) -> None:
    order, count = int(p[0]), int(p[1])
    work, anchor = 2 + count, 2 + count + order + 1
    inside = x >= p[2] and x <= p[1 + count]
    for k in range(out.shape[0]):
        out[k] = -p[anchor + k] if inside else np.nan
    if inside:
        span = _local_splines(x, p, order)
        for r in range(order + 1):
            k = span - order + r - 1  # the first of all is left out
            if k >= 0:
                out[k] += p[work + r]


@kernel
def _spline_slopes(x: float, p: Array, out: Array) -> None:
    order, count = int(p[0]), int(p[1])
    work = 2 + count
    inside = x >= p[2] and x <= p[1 + count]
    for k in range(out.shape[0]):
        out[k] = 0.0 if inside else np.nan
    if inside and order > 0:
        span = _local_splines(x, p, order - 1)
        for r in range(order):
            k = span - order + 1 + r  # the lower B-spline that starts at knot k
            slope = order * p[work + r] / (p[2 + k + order] - p[2 + k])
            if k - 1 >= 0:
                out[k - 1] += slope
            if k - 2 >= 0:
                out[k - 2] -= slope


@dataclass(frozen=True)
class BSpline(Basis):
    """B-splines of a degree on increasing ``knots``, clamped at both ends, zero together at ``anchor``.

    They add up to 1, so one is left out and the constant is taken away: n = len(knots) + degree - 2.
    """

    degree: int
    knots: Any
    anchor: float = 0.0

    def __post_init__(self) -> None:
        self._set("degree", whole("BSpline", "degree", self.degree, 1))
        self._set("knots", knots_of("BSpline", self.knots, 2))
        self._set("anchor", numbers("BSpline", "anchor", self.anchor, ndim=0))
        if not self.knots[0] <= self.anchor <= self.knots[-1]:
            raise ValueError(f"BSpline: the anchor must lie within the knots {self.knots}; got {self.anchor!r}.")

    @property
    def n(self) -> int:
        return len(self.knots) + self.degree - 2

    @property
    def curves(self) -> Curves:
        return Curves(_splines, _spline_slopes)

    @property
    def expected(self) -> tuple[float, float]:
        return self.limits

    @property
    def limits(self) -> tuple[float, float]:
        return self.knots[0], self.knots[-1]

    @property
    def parameters(self) -> Array:
        ends = np.pad(self.knots, self.degree, mode="edge")
        p = np.concatenate([[self.degree, len(ends)], ends, np.zeros(self.degree + 1 + self.n)])
        at_anchor = np.empty((1, self.n))
        over(_splines)(np.array([self.anchor]), p.copy(), at_anchor)
        p[-self.n :] = at_anchor[0]
        return p

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"B{k + 2}" for k in range(self.n))
