"""The blocks of a Hammerstein-Wiener run: paths of a, b, c, d with names, gauge, quality and standard deviations.

    v = sum_k c_k f_k(u),   w_t = -sum_i a_i w_{t-i} + sum_j b_j v_{t-nk-j+1},   F(y) = sum_k d_k g_k(y) = w

Two of the scales are free. The gauge of the model is c_1 = d_1 = 1; `Blocks.gauge` rescales,

    input "c1", "b1"     c_1 = 1, or b_1 = 1: the gain stands in the curve
    output "d1", "slope"  d_1 = 1, or F'(at) = 1: w has the unit of y at the working point

and takes standard deviations along by the delta method. Ratios such as b_j / b_1, and the local gain b_1 / F', depend
on no gauge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from driftfit.blocks.separate import METHODS, separate
from driftfit.kernel import Array
from driftfit.models.base import Model
from driftfit.models.hammerstein_wiener import HammersteinWiener
from driftfit.settings import one_of

if TYPE_CHECKING:
    pass


class Groups(NamedTuple):
    """a (.., na), b (.., nb), c (.., n_in), d (.., n_out)."""

    a: Array
    b: Array
    c: Array
    d: Array


@dataclass(frozen=True)
class Blocks:
    """Paths of the parameters of the blocks.

    Attributes
    ----------
    a, b, c, d : (T, na), (T, nb), (T, n_in), (T, n_out)
        Coefficients after each sample.
    names : Groups of tuples of str
    quality : (T, 2)
        sigma_2 / sigma_1 of [b, BC] and of [a, AD]: 0 for an exact product, near 1 where there is none.
    std : Groups
        Standard deviations; NaN unless the method is "gls" or the tracker followed the minimal parameters.
    cov : (T, n_x, n_x) or None
        Covariance of the minimal parameters in the gauge of the model.
    intercept : (T,) or None
        d_0 (1 + sum a) - c_0 sum b, if the model has one.
    cost : (T,) or None
        Of "gls", (theta - g(xi))' P^-1 (theta - g(xi)).
    """

    model: HammersteinWiener
    method: str
    a: Array
    b: Array
    c: Array
    d: Array
    quality: Array
    std: Groups
    intercept: Array | None = None
    cov: Array | None = None
    cost: Array | None = None
    gauged: tuple[str, str] = ("c1", "d1")

    def __len__(self) -> int:
        return len(self.b)

    def __repr__(self) -> str:
        return f"Blocks of {len(self)} samples by {self.method!r}, gauge {self.gauged}: {self.model!r}"

    @property
    def names(self) -> Groups:
        counts = zip("abcd", (self.a, self.b, self.c, self.d), strict=True)
        return Groups(*(tuple(f"{name}{k + 1}" for k in range(part.shape[1])) for name, part in counts))  # type: ignore[arg-type]

    @property
    def xi(self) -> Array:
        """The minimal parameters, (T, n_x), in the gauge of the model."""
        if self.gauged != ("c1", "d1"):
            raise ValueError("xi: minimal parameters belong to the gauge c_1 = d_1 = 1; take them before `gauge`.")
        return self.model.structure.minimal(self.a, self.b, self.c, self.d, self.intercept)

    @property
    def radius(self) -> Array:
        """The largest size of a pole of the linear block, (T,); 1 and more is unstable."""
        T, na = self.a.shape
        if not na:
            return np.zeros(T)
        companion = np.zeros((T, na, na))
        companion[:, 0] = -self.a
        companion[:, range(1, na), range(na - 1)] = 1.0
        known = np.isfinite(companion).all(axis=(1, 2))
        found = np.full(T, np.nan)
        found[known] = np.abs(np.linalg.eigvals(companion[known])).max(axis=1)
        return found

    def input_curve(self, u: Any, t: int = -1) -> Array:
        """v at inputs u (...), with the coefficients of sample t."""
        return np.asarray(self._basis(t).value(u) @ self.c[t])

    def _basis(self, t: int) -> Any:
        into = self.model.into
        return into.known(self.c[t, 1], self.c[t, 2]) if into.adaptive else into  # type: ignore[attr-defined]

    def output_curve(self, y: Any, t: int = -1) -> Array:
        """w = F(y) at outputs y (...), with the coefficients of sample t: the inverse of the output block."""
        return np.asarray(self.model.out.value(y) @ self.d[t])

    def slope(self, y: Any) -> Array:
        """F'(y_t; d_t), (T,), for y (T,) or one number."""
        return np.asarray(np.sum(self.model.out.derivative(np.broadcast_to(y, len(self))) * self.d, axis=1))

    def gauge(self, input: str = "c1", output: str = "d1", at: float = 0.0) -> Blocks:
        """The same system in another gauge.

        Parameters
        ----------
        input : "c1" or "b1"
            Which coefficient is 1.
        output : "d1" or "slope"
            d_1 = 1, or F'(at) = 1.
        at : number
            Working point of y.

        Raises
        ------
        ValueError
            If these paths are not in the gauge of the model, or a scale passes zero.
        """
        one_of("gauge", "input", input, ("c1", "b1"))
        one_of("gauge", "output", output, ("d1", "slope"))
        if self.gauged != ("c1", "d1"):
            raise ValueError(f"gauge: these paths are in the gauge {self.gauged} already; begin with the original.")
        slopes = self.model.out.derivative(float(at))
        level = self.d @ slopes if output == "slope" else np.ones(len(self))
        gain = self.b[:, 0] / level if input == "b1" else np.ones(len(self))
        if not (level != 0.0).all() or not (gain != 0.0).all():
            raise ValueError("gauge: the coefficient that is to be 1 passes zero; choose another gauge.")
        L, G = level[:, None], gain[:, None]
        std = self._std(L, G, slopes, input, output)
        rest = None if self.intercept is None else self.intercept / level
        return replace(
            self, b=self.b / L / G, c=self.c * G, d=self.d / L, std=std, intercept=rest, gauged=(input, output)
        )

    def _std(self, L: Array, G: Array, slopes: Array, input: str, output: str) -> Groups:
        """Standard deviations after a change of gauge, by the delta method."""
        if self.cov is None or (input, output) == ("c1", "d1"):
            return self.std
        na, nb, n_in, n_out, _ = self.model.structure
        T, n_x = len(self), self.cov.shape[1]
        parts = [np.zeros((T, k, n_x)) for k in (na, nb, n_in, n_out)]
        x_c, x_d = na + nb, na + nb + n_in - 1
        parts[0][:, range(na), range(na)] = 1.0
        parts[1][:, range(nb), range(na, na + nb)] = 1.0
        parts[2][:, range(1, n_in), range(x_c, x_d)] = 1.0
        parts[3][:, range(1, n_out), range(x_d, x_d + n_out - 1)] = 1.0
        d_level, d_gain = np.zeros((T, n_x)), np.zeros((T, n_x))
        if output == "slope":
            d_level[:, x_d : x_d + n_out - 1] = slopes[1:]
        if input == "b1":
            d_gain = (parts[1][:, 0] - G * d_level) / L
        rate_l, rate_g = (d_level / L)[:, None], (d_gain / G)[:, None]
        J = (
            parts[0],
            (parts[1] - self.b[..., None] * (rate_l + rate_g)) / (L * G)[..., None],
            (parts[2] + self.c[..., None] * rate_g) * G[..., None],
            (parts[3] - self.d[..., None] * rate_l) / L[..., None],
        )
        with np.errstate(invalid="ignore"):
            return Groups(*(np.sqrt(np.maximum(np.einsum("tix,txz,tiz->ti", j, self.cov, j), 0.0)) for j in J))


def empty(model: HammersteinWiener, T: int) -> tuple[Array, Array, Array, Array, Array]:
    """a, b, c, d and quality to be filled."""
    na, nb, n_in, n_out, _ = model.structure
    return np.empty((T, na)), np.empty((T, nb)), np.empty((T, n_in)), np.empty((T, n_out)), np.empty((T, 2))


def split(model: HammersteinWiener, theta: Array, method: str) -> tuple[Array, Array, Array, Array, Array]:
    """a, b, c, d and quality from theta (T, n) by one of the first three methods."""
    parts = empty(model, len(theta))
    separate(np.ascontiguousarray(theta, dtype=float), tuple(model.structure[:4]), METHODS.index(method), *parts)
    return parts


class Separator:
    """Separates one theta after another, for streams: the arrays are made once."""

    def __init__(self, model: Model) -> None:
        if not isinstance(model, HammersteinWiener):
            raise ValueError(f"blocks: {type(model).__name__} has none; they belong to HammersteinWiener.")
        self.model = model
        self._n, self._orders = model.n, tuple(model.structure[:4])
        self._theta, self._parts = np.empty((1, model.n)), empty(model, 1)

    def __call__(self, theta: Array, method: str) -> Groups:
        """a, b, c, d from one theta (n,), or from minimal parameters."""
        if len(theta) != self._n:
            return Groups(*self.model.structure.groups(theta))
        if method not in METHODS[:3]:
            one_of("blocks", "method", method, METHODS[:3])
        a, b, c, d, _ = self._parts
        self._theta[0] = theta
        separate(self._theta, self._orders, METHODS.index(method), *self._parts)
        return Groups(a[0].copy(), b[0].copy(), c[0].copy(), d[0].copy())
