"""Curves in pieces: lines that bend at knots, and B-splines.

B-splines after Piegl and Tiller, The NURBS Book (1997), section 2.5; the scratch space of their recursion is at the end
of their parameters p = [degree, knots.., scratch.., values at the anchor..].
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, Self

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import numbers, whole
from driftfit.models.hammerstein_wiener.curves import kernels
from driftfit.models.hammerstein_wiener.curves.curve import Basis, values_and_slopes


def knots_of(owner: str, value: Any, least: int, name: str = "knots") -> tuple[float, ...]:
    given = numbers(owner, name, value)
    knots = given if isinstance(given, tuple) else (given,)
    if len(knots) < least or any(b <= a for a, b in pairwise(knots)):
        raise ValueError(
            f"{owner}: {name} must be at least {least} strictly increasing numbers (a repeated one would make two "
            f"columns equal); got {value!r}."
        )
    return knots


@dataclass(frozen=True)
class PiecewiseLinear(Basis):
    """A line that bends at increasing ``knots``; its first coefficient is the slope of the piece that contains 0."""

    knots: Any

    code: ClassVar[int] = kernels.HINGES

    @classmethod
    def from_words(cls, words: tuple[Any, ...]) -> Self:
        return cls(words)

    def __post_init__(self) -> None:
        self._set("knots", knots_of("PiecewiseLinear", self.knots, 1))

    @property
    def rise_between(self) -> tuple[float, float]:
        """A point well beyond the last knot, since a curve may be constant between the knots."""
        return 0.0, max(self.knots[-1], 0.0) + max(map(abs, self.knots))

    @property
    def n(self) -> int:
        return 1 + len(self.knots)

    @property
    def own_numbers(self) -> Array:
        return np.array(self.knots)

    @property
    def names(self) -> tuple[str, ...]:
        return ("x", *(f"bend at {k:g}" for k in self.knots))


@dataclass(frozen=True)
class BSpline(Basis):
    """B-splines of a degree on increasing ``knots``, clamped at both ends, zero together at ``anchor``.

    They add up to 1, so one of them is left out and the constant is removed: n = len(knots) + degree - 2.
    """

    degree: int
    knots: Any
    anchor: float = 0.0

    code: ClassVar[int] = kernels.SPLINES

    @classmethod
    def from_words(cls, words: tuple[Any, ...]) -> Self:
        return cls(words[0], words[1:])

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
    def expected(self) -> tuple[float, float]:
        return self.limits

    @property
    def limits(self) -> tuple[float, float]:
        return self.knots[0], self.knots[-1]

    @property
    def own_numbers(self) -> Array:
        ends = np.pad(self.knots, self.degree, mode="edge")
        p = np.concatenate([[self.degree, len(ends)], ends, np.zeros(self.degree + 1 + self.n)])
        coded = np.concatenate([[float(self.code)], p])
        p[-self.n :] = values_and_slopes(self.evaluate, np.array([self.anchor]), coded, self.n)[0][0]
        return p

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"B{k + 2}" for k in range(self.n))
