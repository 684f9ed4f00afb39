"""Basis functions of static curves, f(x) = sum_k c_k f_k(x), for the blocks of a Hammerstein-Wiener model.

    Polynomial(degree)           x, x^2, ..
    Legendre(degree, range)      P_1(s), P_2(s), ..,  s = (x - middle) / half-width
    Chebyshev(degree, range)     T_1(s), T_2(s), ..
    PiecewiseLinear(knots)       x, then for each knot k: max(0, x - k) if k >= 0, min(0, x - k) if k < 0
    BSpline(degree, knots)       B_k(x) - B_k(anchor), k = 2 .. K, clamped at the ends
    Sigmoid(centres, width)      tanh((x - m_k) / width) + tanh(m_k / width)
    Functions(values, slopes, n) two functions that you write and Numba compiles

`driftfit.models.hammerstein_wiener.thresholds` has dead zones and saturations. No basis contains a constant: constants
of the input and of the output block cannot be distinguished, and a model has one ``intercept`` for both. Scaling and
range are settings, never estimated from the data.

Raw powers are suitable up to degree 3 on data of unit size; beyond that their columns are nearly collinear, and you
should use `Legendre` on the range of the data. B-splines are undefined outside their knots: samples there are missing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import lru_cache
from inspect import isabstract
from itertools import pairwise
from typing import Any, ClassVar, Self

import numpy as np

from driftfit.engine.kernel import Array, Driver, kernel
from driftfit.engine.settings import Settings, numbers, place_of, warn, whole
from driftfit.models.hammerstein_wiener import curve_kernels


@lru_cache
def _over(functions: Any) -> Driver:
    """A compiled loop of a kernel over an array."""

    @Driver
    def each(x: Array, p: Array, out: Array, slopes: Array) -> None:
        for i in range(x.shape[0]):
            functions(x[i], p, out[i], slopes[i])

    return each


def values_and_slopes(functions: Any, x: Array, p: Array, n: int) -> Array:
    """The functions of a kernel at x (k,), and their derivatives, (2, k, n); p may be overwritten."""
    found = np.empty((2, len(x), n))
    _over(functions)(np.ascontiguousarray(x), p, *found)
    return found


class Basis(Settings, ABC):
    """A set of functions of one variable, without a constant.

    It has `value(x)` and `derivative(x)`, (..., n) each, and for steps the kernel ``functions``. Its numbers p
    (``parameters``) are stored in the record, so another range needs no new compilation.
    """

    functions: ClassVar[Any]
    """The kernel of `driftfit.models.hammerstein_wiener.curve_kernels` that computes them and their derivatives, as a
    static method: a kernel alone would be bound to the basis."""
    sequence: ClassVar[tuple[int, str] | None] = None
    """How many numbers come before those of a setting that is a sequence, on the command line, and its name."""
    letter: ClassVar[str] = "f"
    """With which the names of the functions begin."""
    adaptive: ClassVar[bool] = False
    """Whether the functions depend on their own coefficients, which are then fed back at every sample."""

    @property
    @abstractmethod
    def n(self) -> int:
        """Number of functions."""

    @property
    def parameters(self) -> Array:
        """Numbers p of the basis, (k,); a zero where it has none."""
        return np.zeros(1)

    @property
    def expected(self) -> tuple[float, float]:
        """The range in which data are expected."""
        return (-np.inf, np.inf)

    @property
    def limits(self) -> tuple[float, float]:
        """The range in which the functions are defined; a sample outside is missing."""
        return (-np.inf, np.inf)

    @property
    def rise_between(self) -> tuple[float, float]:
        """Two inputs: a curve that is higher at the second than at the first counts as rising.

        They are 0, or the point of the range nearest to it, and the upper end; so an even curve has a sign as well.
        """
        low, high = self.expected
        if not (np.isfinite(low) and np.isfinite(high)):
            return 0.0, 1.0
        middle = min(max(0.0, low), high)
        return (middle if middle < high else low), high

    @property
    def rise(self) -> Array:
        """r (n,) with r'c > 0 for the coefficients of curves that rise."""
        low, high = self.value(np.array(self.rise_between))
        return np.asarray(high - low)

    @property
    def height(self) -> float:
        """The largest change of a function between the inputs of `rise_between`.

        1 for raw powers, 1.5 for Legendre polynomials on a range around 0, and of the unit of x for straight pieces; 1
        where it is not a positive number, as for `Functions` that are not defined at 0.
        """
        with np.errstate(invalid="ignore"):
            height = float(np.max(np.abs(self.rise)))
        return height if 0.0 < height < np.inf else 1.0

    @property
    def steepness(self) -> float:
        """The height as a mean slope: thresholds for slopes are shares of it, so that no unit of x matters.

        1 for straight pieces with a single knot, which have no range, and slopes of 1.
        """
        low, high = self.rise_between
        return self.height / (high - low) if high > low else 1.0

    @property
    def scale(self) -> float:
        """The scale of x that range, knots or centres give; 0 if there are none."""
        low, high = self.rise_between
        return high - low

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the functions, in the order of the coefficients."""
        return tuple(f"{self.letter}{k + 1}" for k in range(self.n))

    def value(self, x: Any) -> Array:
        """The functions at x (...), as (..., n)."""
        return np.asarray(self._at(x)[0])

    def derivative(self, x: Any) -> Array:
        """Their derivatives at x (...), as (..., n)."""
        return np.asarray(self._at(x)[1])

    def for_coefficients(self, x: Any, c: Array) -> Array:
        """The functions at x (...) under coefficients c (..., n), on which those of some bases depend, (..., n)."""
        return self.value(x)

    def _at(self, x: Any) -> Array:
        points = np.asarray(x, dtype=float)
        found = values_and_slopes(self.functions, points.ravel(), self.parameters.copy(), self.n)
        return found.reshape(2, *points.shape, self.n)

    @classmethod
    def from_words(cls, words: tuple[Any, ...]) -> Self:
        """The basis from a sequence of numbers, as on the command line."""
        if cls.sequence is not None:
            first, name = cls.sequence
            own = (each.name for each in fields(cls) if each.name != name)  # type: ignore[arg-type]
            return cls(**{name: words[first:]}, **dict(zip(own, words[:first], strict=False)))
        try:
            return cls(*words)
        except TypeError:
            raise ValueError(f"{cls.__name__}: {len(words)} numbers were given, {words!r}; that is too many.") from None

    def plain(self) -> dict[str, Any]:
        """The basis as plain data; see `basis_of`."""
        return {"class": type(self).__name__, "settings": self.settings()}


@dataclass(frozen=True)
class Polynomial(Basis):
    """Raw powers x .. x^degree; from degree 4 on, `Legendre` is the better choice, and a warning is issued."""

    degree: int

    functions: ClassVar[Any] = staticmethod(curve_kernels.powers)

    def __post_init__(self) -> None:
        self._set("degree", whole("Polynomial", "degree", self.degree, 1))
        if self.degree > 3:
            warn(
                f"Polynomial({self.degree}): powers beyond 3 are nearly collinear, and estimates suffer; "
                f"use Legendre({self.degree}, (low, high)) on the range of the data.",
                UserWarning,
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


@dataclass(frozen=True)
class _Orthogonal(Basis):
    """Orthogonal polynomials on a range; they are continued outside it."""

    degree: int
    range: Any

    sequence = (1, "range")

    def __post_init__(self) -> None:
        owner = type(self).__name__
        self._set("degree", whole(owner, "degree", self.degree, 1))
        given = numbers(owner, "range", self.range)
        if not isinstance(given, tuple) or len(given) != 2 or not given[0] < given[1]:
            raise ValueError(f"{owner}: range must be (low, high) with low below high; got {self.range!r}.")
        self._set("range", given)

    @property
    def n(self) -> int:
        return self.degree

    @property
    def expected(self) -> tuple[float, float]:
        low, high = self.range
        return low, high

    @property
    def parameters(self) -> Array:
        low, high = self.range
        return np.array([0.5 * (low + high), 0.5 * (high - low)])


@dataclass(frozen=True)
class Legendre(_Orthogonal):
    """Legendre polynomials P_1 .. P_degree of s = (x - middle) / half-width on ``range`` = (low, high)."""

    functions: ClassVar[Any] = staticmethod(curve_kernels.legendre)
    letter: ClassVar[str] = "P"


@dataclass(frozen=True)
class Chebyshev(_Orthogonal):
    """Chebyshev polynomials T_1 .. T_degree of s = (x - middle) / half-width on ``range`` = (low, high)."""

    functions: ClassVar[Any] = staticmethod(curve_kernels.chebyshev)
    letter: ClassVar[str] = "T"


def _increasing(owner: str, name: str, value: Any, count: int = 1) -> tuple[float, ...]:
    given = numbers(owner, name, value)
    knots = given if isinstance(given, tuple) else (given,)
    if len(knots) < count or any(b <= a for a, b in pairwise(knots)):
        raise ValueError(
            f"{owner}: {name} must be at least {count} strictly increasing numbers (a repeated one would make two "
            f"columns equal); got {value!r}."
        )
    return knots


@dataclass(frozen=True)
class PiecewiseLinear(Basis):
    """A line that bends at increasing ``knots``; its first coefficient is the slope of the piece that contains 0."""

    knots: Any

    functions: ClassVar[Any] = staticmethod(curve_kernels.hinges)
    sequence = (0, "knots")

    def __post_init__(self) -> None:
        self._set("knots", _increasing("PiecewiseLinear", "knots", self.knots))

    @property
    def rise_between(self) -> tuple[float, float]:
        """A point well beyond the last knot, since a curve may be constant between the knots."""
        return 0.0, max(self.knots[-1], 0.0) + max(map(abs, self.knots))

    @property
    def n(self) -> int:
        return 1 + len(self.knots)

    @property
    def parameters(self) -> Array:
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

    functions: ClassVar[Any] = staticmethod(curve_kernels.splines)
    sequence = (1, "knots")

    def __post_init__(self) -> None:
        self._set("degree", whole("BSpline", "degree", self.degree, 1))
        self._set("knots", _increasing("BSpline", "knots", self.knots, 2))
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
    def parameters(self) -> Array:
        ends = np.pad(self.knots, self.degree, mode="edge")
        p = np.concatenate([[self.degree, len(ends)], ends, np.zeros(self.degree + 1 + self.n)])
        p[-self.n :] = values_and_slopes(self.functions, np.array([self.anchor]), p.copy(), self.n)[0][0]
        return p

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"B{k + 2}" for k in range(self.n))


@dataclass(frozen=True)
class Sigmoid(Basis):
    """Sigmoids tanh((x - m_k) / width) + tanh(m_k / width) at increasing ``centres`` m_k: 0 at 0, constant far away.

    A sum of them with positive coefficients increases everywhere and saturates at both ends, as valves and sensors do.
    """

    centres: Any
    width: float

    functions: ClassVar[Any] = staticmethod(curve_kernels.sigmoids)
    sequence = (1, "centres")

    def __post_init__(self) -> None:
        self._set("centres", _increasing("Sigmoid", "centres", self.centres))
        self._set("width", numbers("Sigmoid", "width", self.width, ndim=0, low=0.0, strict=True))

    @property
    def n(self) -> int:
        return len(self.centres)

    @property
    def parameters(self) -> Array:
        return np.array([*self.centres, self.width])

    @property
    def rise_between(self) -> tuple[float, float]:
        return 0.0, max(self.centres[-1], 0.0) + self.width

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"sigmoid at {m:g}" for m in self.centres)


@dataclass(frozen=True)
class Functions(Basis):
    """Functions of your own.

    Parameters
    ----------
    values, slopes : functions (x, p, out) that Numba can compile
        Fill ``out`` (n,) with the functions, or with their derivatives, at the number x. They may use numpy, math,
        numbers and ``driftfit.engine.kernel`` functions. A file keeps their names; hand them in to load it,
        ``Live.load(path, classes=[values, slopes])``.
    n : int
        Number of functions.
    numbers : sequence
        The content of the array p.
    labels : sequence of str or None
        Names of the functions.
    """

    values: Any
    slopes: Any
    n: int = 1
    numbers: Any = (0.0,)
    labels: Any = None

    def __post_init__(self) -> None:
        self._set("n", whole("Functions", "n", self.n, 1))
        given = numbers("Functions", "numbers", self.numbers)
        self._set("numbers", given if isinstance(given, tuple) else (given,))
        for function in (self.values, self.slopes):
            if not callable(function):
                raise ValueError(f"Functions: values and slopes must be functions (x, p, out); got {function!r}.")
        if self.labels is not None:
            self._set("labels", tuple(str(label) for label in self.labels))
            if len(self.labels) != self.n:
                raise ValueError(f"Functions: {len(self.labels)} labels were given for {self.n} functions.")

    @property
    def scale(self) -> float:
        return 0.0

    @property
    def functions(self) -> Any:
        return _together(self.values, self.slopes)

    @property
    def parameters(self) -> Array:
        return np.array(self.numbers)

    @property
    def names(self) -> tuple[str, ...]:
        return self.labels or super().names

    def __repr__(self) -> str:
        """The expression, with the names of the functions."""
        given = {name: place_of(getattr(self, name)).partition(":")[2] for name in ("values", "slopes")}
        given |= {} if self.n == 1 else {"n": repr(self.n)}
        given |= {} if self.numbers == (0.0,) else {"numbers": repr(self.numbers)}
        given |= {} if self.labels is None else {"labels": repr(self.labels)}
        return f"Functions({', '.join(f'{name}={value}' for name, value in given.items())})"

    def settings(self) -> dict[str, Any]:
        return super().settings() | {name: {"function": place_of(getattr(self, name))} for name in ("values", "slopes")}


@lru_cache
def _together(values: Callable[..., Any], slopes: Callable[..., Any]) -> Any:
    """The kernel of a user's two functions."""
    first, second = (kernel(getattr(one, "py_func", one)) for one in (values, slopes))

    @kernel
    def both(x: float, p: Array, out: Array, slopes: Array) -> None:
        first(x, p, out)
        second(x, p, slopes)

    return both


def _kinds(kind: type[Basis] = Basis) -> dict[str, type[Basis]]:
    """All bases that are defined, by class name."""
    own = {} if isabstract(kind) else {kind.__name__: kind}
    return own | {name: one for sub in kind.__subclasses__() for name, one in _kinds(sub).items()}


def basis_of(value: Any) -> Basis | None:
    """A basis from its description by `Basis.plain`, or from words ("legendre", 4, -2, 2); None is the identity."""
    if value is None or isinstance(value, Basis):
        return value
    kinds = _kinds()
    if isinstance(value, Mapping) and value.get("class") in kinds:
        return kinds[value["class"]].from_settings(dict(value["settings"]))
    words = tuple(value) if isinstance(value, (tuple, list)) else (value,)
    kind = {name.lower(): kind for name, kind in kinds.items()}.get(str(words[0]).replace("-", "").lower())
    if kind is None or kind is Functions or len(words) < 2:
        raise ValueError(
            f"a block takes one of {', '.join(one for one in kinds if one[0] != '_')}, or None for the identity; on "
            "the command line polynomial/DEGREE, legendre/DEGREE/LOW/HIGH, chebyshev/DEGREE/LOW/HIGH, "
            "piecewise-linear/KNOT/.., bspline/DEGREE/KNOT/.., sigmoid/WIDTH/CENTRE/.., saturation/U_MAX or "
            f"dead-zone/U_MAX; got {value!r}."
        )
    return kind.from_words(words[1:])
