"""Basis functions of static curves, f(x) = sum_k c_k f_k(x), for the blocks of a Hammerstein-Wiener model.

    Polynomial(degree)           x, x^2, ..
    Legendre(degree, range)      P_1(s), P_2(s), ..,  s = (x - middle) / half-width
    Chebyshev(degree, range)     T_1(s), T_2(s), ..
    PiecewiseLinear(knots)       x, then for each knot k: max(0, x - k) if k >= 0, min(0, x - k) if k < 0
    BSpline(degree, knots)       B_k(x) - B_k(anchor), k = 2 .. K, clamped at the ends
    Sigmoid(centres, width)      tanh((x - m_k) / width) + tanh(m_k / width)
    DeadZone(u_max)              ([u>=p1] + [u<=p2]) u, -[u>=p1], -[u<=p2],  coefficients (1, p1, p2)
    Saturation(u_max)            [p2<u<p1] u, [u>=p1], [u<=p2],  coefficients (1, p1, p2)
    Functions(values, slopes, n) two functions that you write and Numba compiles

No basis contains a constant: constants of the input and of the output block cannot be distinguished, and a model has
one ``intercept`` for both. Scaling and range are settings, never estimated from the data.

Raw powers are suitable up to degree 3 on data of unit size; beyond that their columns are nearly collinear, and you
should use `Legendre` on the range of the data. B-splines are undefined outside their knots: samples there are missing.

Every basis has `value(x)`, `derivative(x)`, n and names (`driftfit.models.hammerstein_wiener.curves.curve`).
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array
from driftfit.engine.settings import numbers, one_of, whole
from driftfit.models.hammerstein_wiener.curves import kernels
from driftfit.models.hammerstein_wiener.curves.curve import Basis, Functions
from driftfit.models.hammerstein_wiener.curves.splines import BSpline, PiecewiseLinear, knots_of

__all__ = [
    "BSpline",
    "Basis",
    "Chebyshev",
    "DeadZone",
    "Functions",
    "Legendre",
    "PiecewiseLinear",
    "Polynomial",
    "Saturation",
    "Sigmoid",
    "basis_of",
]


def basis_of(value: Any) -> Basis | None:
    """A basis from its description by `Basis.plain`, or from words ("legendre", 4, -2, 2); None is the identity."""
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
            "bspline/DEGREE/KNOT/.., sigmoid/WIDTH/CENTRE/.., saturation/U_MAX or dead-zone/U_MAX; got "
            f"{value!r}."
        )
    return kind.from_words(words[1:])


def _kinds() -> dict[str, type[Basis]]:
    return {kind.__name__: kind for kind in (Polynomial, Legendre, Chebyshev, PiecewiseLinear, BSpline, Sigmoid,
                                             DeadZone, Saturation, Functions)}  # fmt: skip


@dataclass(frozen=True)
class Polynomial(Basis):
    """Raw powers x .. x^degree; from degree 4 on, `Legendre` is the better choice, and a warning is issued."""

    degree: int

    code: ClassVar[int] = kernels.POWERS

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
    def scale(self) -> float:
        return 0.0

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
    """Orthogonal polynomials on a range; they are continued outside it."""

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
        low, high = self.range
        return low, high

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

    code: ClassVar[int] = kernels.LEGENDRE


@dataclass(frozen=True)
class Chebyshev(_Orthogonal):
    """Chebyshev polynomials T_1 .. T_degree of s = (x - middle) / half-width on ``range`` = (low, high)."""

    code: ClassVar[int] = kernels.CHEBYSHEV


INSIDE = 0.97
"""Limit of the thresholds of a dead zone or saturation, as a share of u_max."""


@dataclass(frozen=True)
class Thresholds(Basis):
    """The common part of dead zone and saturation: two thresholds p2 <= 0 <= p1 among the coefficients (1, p1, p2).

    The functions of an input take the thresholds from the estimates of the sample before it, limited to 0 .. 0.97 u_max
    and -0.97 u_max .. 0: a Gauss-Newton step in p. Parameters learned while they are wrong are wrong, so the tracker
    must forget: with q = 0 they approach the truth only as fast as the share of those samples falls.
    """

    u_max: float
    start: Any = None
    fed: str = "least-squares"

    adaptive: ClassVar[bool] = True
    begins: ClassVar[float]
    """Initial value of the thresholds, as a share of u_max, by default."""
    machine: ClassVar[tuple[Any, Any]]

    def __post_init__(self) -> None:
        owner = type(self).__name__
        self._set("u_max", numbers(owner, "u_max", self.u_max, ndim=0, low=0.0, strict=True))
        start = self.begins * self.u_max if self.start is None else self.start
        self._set("start", numbers(owner, "start", start, ndim=0, low=0.0))
        one_of(owner, "fed", self.fed, ("least-squares", "average"))

    @property
    def n(self) -> int:
        return 3

    @property
    def own_numbers(self) -> Array:
        return np.array([self.start, -self.start, self.u_max, float(self.fed == "average")])

    @property
    def expected(self) -> tuple[float, float]:
        return (-self.u_max, self.u_max)

    @abstractmethod
    def split(self, u: Array, above: Array, below: Array) -> Array:
        """The functions (.., 3), given which inputs are above and below the thresholds."""

    def known(self, p1: float, p2: float) -> Functions:
        """The basis with known thresholds, for simulations."""
        return Functions(*self.machine, 3, (p1, p2, self.u_max), self.names)


@dataclass(frozen=True)
class DeadZone(Thresholds):
    """A dead zone between p2 < 0 < p1: v = u - p1 above it, u - p2 below, 0 inside; an input block only.

    In terms of coefficients, v = f_1 + p1 f_2 + p2 f_3, where f_1 = u outside the dead zone, f_2 = -1 above it and
    f_3 = -1 below it, 0 elsewhere. A valve ends where it is fully open: u beyond ``limit`` acts as the limit does.

    Parameters
    ----------
    u_max : number
        The largest size of the input, above 0.
    start : number
        Initial size of both thresholds.
    fed : "least-squares" or "average"
        A filter of products has nb estimates of each threshold, the products b_j p1 together with the b_j. They are fed
        back as sum_j b_j (b_j p1) / sum_j b_j^2, or as the mean over j of (b_j p1) / b_j, as in Feng and Hong (2021),
        which fails for a b_j near zero. With minimal parameters (`ExtendedKalman`) p1 and p2 are estimated themselves.
    limit : number or None
        Known size beyond which the input has no further effect, as the 10 V of equation (61) of Feng and Hong (2021).

    Raises
    ------
    ValueError
        For a u_max or a limit that is not above 0, a start below 0, or another ``fed``.
    """

    start: Any = 0.01
    fed: str = "least-squares"
    limit: float | None = None

    code: ClassVar[int] = kernels.DEAD_ZONE
    begins: ClassVar[float] = 0.0
    machine: ClassVar[tuple[Any, Any]] = (kernels.dead_zone, kernels.dead_zone_slopes)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.limit is not None:
            self._set("limit", numbers("DeadZone", "limit", self.limit, ndim=0, low=0.0, strict=True))

    @property
    def own_numbers(self) -> Array:
        return np.append(super().own_numbers, self.reach)

    @property
    def reach(self) -> float:
        """Size beyond which the input has no further effect."""
        return LARGEST if self.limit is None else self.limit

    @property
    def names(self) -> tuple[str, ...]:
        return ("outside", "p1", "p2")

    def split(self, u: Array, above: Array, below: Array) -> Array:
        known, held = np.where(np.isfinite(u), 0.0, np.nan), np.clip(u, -self.reach, self.reach)
        return np.stack([np.where(above | below, held, known), -1.0 * above, -1.0 * below], axis=-1)

    def known(self, p1: float, p2: float) -> Functions:
        return Functions(*self.machine, 3, (p1, p2, *self.own_numbers[2:]), self.names)


@dataclass(frozen=True)
class Saturation(Thresholds):
    """A saturation at p2 < 0 < p1: v = u between them, p1 above, p2 below; an input block only.

    In terms of coefficients, v = f_1 + p1 f_2 + p2 f_3, where f_1 = u inside, f_2 = 1 above p1 and f_3 = 1 below p2, 0
    elsewhere. Parameters as for `DeadZone`; the thresholds begin at half of u_max unless ``start`` is given. A
    threshold that no input reaches converges to about the largest input.
    """

    code: ClassVar[int] = kernels.SATURATION
    begins: ClassVar[float] = 0.5
    machine: ClassVar[tuple[Any, Any]] = (kernels.saturation, kernels.saturation_slopes)

    @property
    def names(self) -> tuple[str, ...]:
        return ("inside", "p1", "p2")

    def split(self, u: Array, above: Array, below: Array) -> Array:
        known = np.where(np.isfinite(u), 0.0, np.nan)
        return np.stack([np.where(above | below, known, u), 1.0 * above, 1.0 * below], axis=-1)


@dataclass(frozen=True)
class Sigmoid(Basis):
    """Sigmoids tanh((x - m_k) / width) + tanh(m_k / width) at increasing ``centres`` m_k: 0 at 0, constant far away.

    A sum of them with positive coefficients increases everywhere and saturates at both ends, as valves and sensors do.
    """

    centres: Any
    width: float

    code: ClassVar[int] = kernels.SIGMOIDS

    @classmethod
    def from_words(cls, words: tuple[Any, ...]) -> Self:
        return cls(words[1:], words[0])

    def __post_init__(self) -> None:
        self._set("centres", knots_of("Sigmoid", self.centres, 1, "centres"))
        self._set("width", numbers("Sigmoid", "width", self.width, ndim=0, low=0.0, strict=True))

    @property
    def n(self) -> int:
        return len(self.centres)

    @property
    def own_numbers(self) -> Array:
        return np.array([*self.centres, self.width])

    @property
    def rise_between(self) -> tuple[float, float]:
        return 0.0, max(self.centres[-1], 0.0) + self.width

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"sigmoid at {m:g}" for m in self.centres)
