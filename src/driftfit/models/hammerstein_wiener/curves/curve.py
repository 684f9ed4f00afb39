"""Static curves f(x) = sum_k c_k f_k(x): the interface of every basis, and functions of your own.

A basis has `value(x)` and `derivative(x)`, (..., n) each, and for steps the compiled routine ``evaluate``.
Its numbers p (``parameters``) are stored in the record, so another range needs no new compilation.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, Self

import numpy as np

from driftfit.engine.kernel import Array, Driver, kernel
from driftfit.engine.settings import Settings, numbers, place_of, whole
from driftfit.models.hammerstein_wiener.curves import kernels


@lru_cache
def _over(evaluate: Any) -> Driver:
    """A compiled loop of ``evaluate`` over an array."""

    @Driver
    def each(x: Array, p: Array, out: Array, slopes: Array) -> None:
        n = out.shape[1]
        for i in range(x.shape[0]):
            evaluate(x[i], p.ctypes.data, p.shape[0], out[i].ctypes.data, slopes[i].ctypes.data, n, 1)

    return each


def values_and_slopes(evaluate: Any, x: Array, p: Array, n: int) -> tuple[Array, Array]:
    """The functions of a compiled routine at x (k,), and their derivatives, (k, n) each; p may be overwritten."""
    evaluate.load()
    out, slopes = np.empty((2, len(x), n))
    _over(evaluate)(np.ascontiguousarray(x), p, out, slopes)
    return out, slopes


class Basis(Settings, ABC):
    """A set of functions of one variable, without a constant."""

    code: ClassVar[int] = -1
    """The kind, as a code of `driftfit.models.hammerstein_wiener.curves.kernels`."""
    adaptive: ClassVar[bool] = False
    """Whether the functions depend on their own coefficients, which are then fed back at every sample."""

    @property
    @abstractmethod
    def n(self) -> int:
        """Number of functions."""

    @property
    def evaluate(self) -> Any:
        """The compiled routine that evaluates the functions and their derivatives; see `curve_kernels`."""
        return kernels.evaluate

    @property
    def kind(self) -> tuple[Any, int]:
        """The compiled routine and the code, from which steps are made."""
        return self.evaluate, self.code

    @property
    def own_numbers(self) -> Array:
        """Numbers of the basis, (k,)."""
        return np.zeros(0)

    @property
    def parameters(self) -> Array:
        """The array p of the compiled functions: the code of the kind, and the numbers of the basis."""
        return np.concatenate([[float(self.code)], self.own_numbers])

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
        return tuple(f"f{k + 1}" for k in range(self.n))

    def value(self, x: Any) -> Array:
        """The functions at x (...), as (..., n)."""
        return self._at(x)[0]

    def derivative(self, x: Any) -> Array:
        """Their derivatives at x (...), as (..., n)."""
        return self._at(x)[1]

    def _at(self, x: Any) -> tuple[Array, Array]:
        points = np.asarray(x, dtype=float)
        out, slopes = values_and_slopes(self.evaluate, points.ravel(), self.parameters.copy(), self.n)
        shape = (*points.shape, self.n)
        return out.reshape(shape), slopes.reshape(shape)

    @classmethod
    def from_words(cls, words: tuple[Any, ...]) -> Self:
        """The basis from a sequence of numbers, as on the command line."""
        try:
            return cls(*words)
        except TypeError:
            raise ValueError(f"{cls.__name__}: {len(words)} numbers were given, {words!r}; that is too many.") from None

    def plain(self) -> dict[str, Any]:
        """The basis as plain data; see `basis_of`."""
        return {"class": type(self).__name__, "settings": self.settings()}


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
        for name in ("values", "slopes"):
            self._set(name, _function(getattr(self, name)))
        if self.labels is not None:
            self._set("labels", tuple(str(label) for label in self.labels))
            if len(self.labels) != self.n:
                raise ValueError(f"Functions: {len(self.labels)} labels were given for {self.n} functions.")

    @property
    def scale(self) -> float:
        return 0.0

    @property
    def evaluate(self) -> Any:
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
def _compiled(function: Callable[..., Any]) -> Any:
    """A user's function as a kernel."""
    return function if hasattr(function, "identity") else kernel(getattr(function, "py_func", function))


@lru_cache
def _together(values: Any, slopes: Any) -> Any:
    """The compiled routine of a user's two functions."""
    first, second = _compiled(values), _compiled(slopes)

    @kernel
    def both(x: float, p: Array, out: Array, slopes: Array) -> None:
        first(x, p, out)
        second(x, p, slopes)

    return kernels.machine_of(both)


def _function(given: Any) -> Any:
    if not callable(given):
        raise ValueError(f"Functions: values and slopes must be functions (x, p, out); got {given!r}.")
    return given
