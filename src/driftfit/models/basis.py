"""Basis functions of static curves, f(x) = sum_k c_k f_k(x): what stands in the blocks of a Hammerstein-Wiener model.

    Polynomial(degree)           x, x^2, ..
    Legendre(degree, range)      P_1(s), P_2(s), ..,  s = (x - middle) / half-width
    Chebyshev(degree, range)     T_1(s), T_2(s), ..
    PiecewiseLinear(knots)       x, then for each knot k: max(0, x - k) if k >= 0, min(0, x - k) if k < 0
    BSpline(degree, knots)       B_k(x) - B_k(anchor), k = 2 .. K, clamped at the ends
    DeadZone(u_max)              ([u>=p1] + [u<=p2]) u, -[u>=p1], -[u<=p2],  coefficients (1, p1, p2)
    Functions(values, slopes, n) any two compilable functions of your own

None has a constant: constants of the input and of the output block cannot be told apart, and a model has one
``intercept`` for both. Scaling and range are given, never taken from the data.

Raw powers are fine up to degree 3 on data of unit size; beyond that their columns are nearly collinear, and `Legendre`
on the range of the data is the remedy. B-splines say nothing outside their knots: samples there count as missing.

Every basis gives `value(x)`, `derivative(x)`, n and names (`driftfit.models.curves`).
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self, cast

import numpy as np

from driftfit.kernel import Array
from driftfit.models import curve_kernels
from driftfit.models.curves import Basis, Functions
from driftfit.models.splines import BSpline, PiecewiseLinear
from driftfit.settings import numbers, one_of, whole

__all__ = [
    "BSpline",
    "Basis",
    "Chebyshev",
    "DeadZone",
    "Functions",
    "Legendre",
    "PiecewiseLinear",
    "Polynomial",
    "basis_of",
]


def basis_of(value: Any) -> Basis | None:
    """A basis, what `Basis.plain` wrote of one, or its words ("legendre", 4, -2, 2); None is the identity."""
    if value is None or isinstance(value, Basis):
        return value
    if isinstance(value, Mapping) and value.get("class") in _kinds():
        return _kinds()[value["class"]].from_settings(dict(value["settings"]))
    words = tuple(value) if isinstance(value, (tuple, list)) else (value,)
    kind = {name.lower(): kind for name, kind in _kinds().items()}.get(str(words[0]).replace("-", "").lower())
    if kind is None or kind is Functions or len(words) < 2:
        raise ValueError(
            f"a block takes one of {', '.join(_kinds())}, or None for the identity; on the command line "
            "polynomial/DEGREE, legendre/DEGREE/LOW/HIGH, chebyshev/DEGREE/LOW/HIGH, piecewise-linear/KNOT/.., "
            f"bspline/DEGREE/KNOT/.. or dead-zone/U_MAX; got {value!r}."
        )
    return kind.from_words(words[1:])


def _kinds() -> dict[str, type[Basis]]:
    return {kind.__name__: kind for kind in (Polynomial, Legendre, Chebyshev, PiecewiseLinear, BSpline, DeadZone,
                                             Functions)}  # fmt: skip


@dataclass(frozen=True)
class Polynomial(Basis):
    """Raw powers x .. x^degree; from degree 4 on, `Legendre` is the better choice and a warning says so."""

    degree: int

    code: ClassVar[int] = curve_kernels.POWERS

    def __post_init__(self) -> None:
        self._set("degree", whole("Polynomial", "degree", self.degree, 1))
        if self.degree > 3:
            warnings.warn(
                f"Polynomial({self.degree}): powers beyond 3 are nearly collinear, and estimates suffer; "
                f"use Legendre({self.degree}, (low, high)) on the range of the data.",
                UserWarning,
                stacklevel=3,
            )

    @property
    def n(self) -> int:
        return self.degree

    @property
    def names(self) -> tuple[str, ...]:
        return tuple("x" if k == 0 else f"x^{k + 1}" for k in range(self.degree))


def _ordered(owner: str, name: str, value: Any) -> tuple[float, float]:
    given = numbers(owner, name, value)
    if not isinstance(given, tuple) or len(given) != 2 or not given[0] < given[1]:
        raise ValueError(f"{owner}: {name} must be (low, high) with low below high; got {value!r}.")
    return given


@dataclass(frozen=True)
class _Orthogonal(Basis):
    """Orthogonal polynomials on a range; outside it they are continued."""

    degree: int
    range: Any

    @classmethod
    def from_words(cls, words: tuple[Any, ...]) -> Self:
        return cls(words[0], words[1:])

    def __post_init__(self) -> None:
        self._set("degree", whole(type(self).__name__, "degree", self.degree, 1))
        self._set("range", _ordered(type(self).__name__, "range", self.range))

    @property
    def n(self) -> int:
        return self.degree

    @property
    def expected(self) -> tuple[float, float]:
        return cast("tuple[float, float]", self.range)

    @property
    def own_numbers(self) -> Array:
        low, high = self.range
        return np.array([0.5 * (low + high), 0.5 * (high - low)])

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"{type(self).__name__[0].replace('C', 'T').replace('L', 'P')}{k + 1}" for k in range(self.degree))


@dataclass(frozen=True)
class Legendre(_Orthogonal):
    """Legendre polynomials P_1 .. P_degree of s = (x - middle) / half-width on ``range`` = (low, high)."""

    code: ClassVar[int] = curve_kernels.LEGENDRE


@dataclass(frozen=True)
class Chebyshev(_Orthogonal):
    """Chebyshev polynomials T_1 .. T_degree of s = (x - middle) / half-width on ``range`` = (low, high)."""

    code: ClassVar[int] = curve_kernels.CHEBYSHEV


@dataclass(frozen=True)
class DeadZone(Basis):
    """A dead zone between p2 < 0 < p1: v = u - p1 above it, u - p2 below, 0 inside; an input block only.

    In coefficients that is v = f_1 + p1 f_2 + p2 f_3, where f_1 = u outside the dead zone, f_2 = -1 above it and
    f_3 = -1 below it, 0 elsewhere. Where it begins the functions of an input take from the estimates of p1 and p2 of
    the sample before it, held within 0 .. 0.97 u_max and -0.97 u_max .. 0: a Gauss-Newton step in p.

    Parameters
    ----------
    u_max : number
        The largest size of the input, above 0.
    start : number
        Where both thresholds begin, in size.
    fed : "least-squares" or "average"
        A filter of products has nb estimates of each threshold, the products b_j p1 beside the b_j. They are fed back
        as sum_j b_j (b_j p1) / sum_j b_j^2, or as the mean over j of (b_j p1) / b_j, which Feng and Hong (2021) have
        and a b_j near zero throws off. With minimal parameters (`ExtendedKalman`) p1 and p2 are estimated themselves.

    Raises
    ------
    ValueError
        For a u_max that is not above 0, a start below 0, or another ``fed``.
    """

    u_max: float
    start: float = 0.01
    fed: str = "least-squares"

    code: ClassVar[int] = curve_kernels.DEAD_ZONE
    adaptive: ClassVar[bool] = True

    def __post_init__(self) -> None:
        self._set("u_max", numbers("DeadZone", "u_max", self.u_max, ndim=0, low=0.0, strict=True))
        self._set("start", numbers("DeadZone", "start", self.start, ndim=0, low=0.0))
        one_of("DeadZone", "fed", self.fed, ("least-squares", "average"))

    @property
    def n(self) -> int:
        return 3

    @property
    def own_numbers(self) -> Array:
        return np.array([self.start, -self.start, self.u_max, float(self.fed == "average")])

    @property
    def expected(self) -> tuple[float, float]:
        return (-self.u_max, self.u_max)

    @property
    def names(self) -> tuple[str, ...]:
        return ("outside", "p1", "p2")

    def known(self, p1: float, p2: float) -> Functions:
        """The basis with thresholds that are known, for simulations."""
        return Functions(curve_kernels.dead_zone, curve_kernels.dead_zone_slopes, 3, (p1, p2, self.u_max), self.names)
