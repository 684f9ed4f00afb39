"""The blocks of a Hammerstein-Wiener run: paths of a, b, c, d with names, gauge, quality and standard deviations.

    v = sum_k c_k f_k(u),   w_t = -sum_i a_i w_{t-i} + sum_j b_j v_{t-nk-j+1},   F(y) = sum_k d_k g_k(y) = w

The scales of v (of each input) and of w are free. A gauge fixes them,

    input "unit", "c1", "b1"       |c| = 1 and the curve rises; c_1 = 1; or b_1 = 1: the gain is in the curve
    output "d1", "unit", "slope"   d_1 = 1; |d| = 1; or F'(at) = 1: w has the unit of y at the working point

and `Blocks.gauge` converts between them, including standard deviations by the delta method. "unit" cannot degenerate;
c_1 = 1, the gauge of Feng and Hong (2021), makes the other coefficients infinite where c_1 passes through zero, as in a
valve with a dead zone around 0. A curve counts as rising if it is higher at the upper end of its range than at 0, or at
the point of the range nearest to 0. Ratios such as b_j / b_1, and the local gain b_1 / F', do not depend on the gauge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.engine.settings import one_of
from driftfit.models.base import Model
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.separation import METHODS, Groups, split
from driftfit.models.hammerstein_wiener.structure import Spans

INPUTS, OUTPUTS = ("unit", "c1", "b1"), ("d1", "unit", "slope")


@dataclass(frozen=True)
class Blocks:
    """Paths of the parameters of the blocks.

    Attributes
    ----------
    a, b, c, d : (T, na), (T, nb), (T, n_in), (T, n_out)
        Coefficients after each sample; those of several inputs are concatenated in b and c, see `of_input`.
    names : Groups of tuples of str
    quality : (T, 2)
        sigma_2 / sigma_1 of [b, BC] and of [a, AD]: 0 for an exact product, near 1 if there is none.
    std : Groups
        Standard deviations; NaN unless the method is "gls" or the tracker followed the minimal parameters.
    cov : (T, k, k) or None
        Covariance of a, b, c, d and the intercept in this gauge, in which it is singular.
    intercept : (T,) or None
        d_0 (1 + sum a) - c_0 sum b, if the model has one.
    cost : (T,) or None
        Of "gls", (theta - g(zeta))' P^-1 (theta - g(zeta)).
    gauged : (str, str)
        The gauge.
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
    gauged: tuple[str, str] = ("unit", "d1")

    def __len__(self) -> int:
        return len(self.b)

    def __repr__(self) -> str:
        return f"Blocks of {len(self)} samples by {self.method!r}, gauge {self.gauged}: {self.model!r}"

    @property
    def names(self) -> Groups:
        return Groups(*(self.model.called(group) for group in self.model.structure.groups_names))  # type: ignore[arg-type]

    @property
    def xi(self) -> Array:
        """The minimal parameters, (T, n_x), which have c_1 = d_1 = 1; ValueError if c_1 is 0."""
        found = self.gauge("c1", "d1")
        return self.model.structure.minimal(found.a, found.b, found.c, found.d, found.intercept)

    @property
    def xi_cov(self) -> Array | None:
        """Covariance of the minimal parameters, (T, n_x, n_x), if that of the blocks is known."""
        cov = self.gauge("c1", "d1").cov
        if cov is None:
            return None
        structure = self.model.structure
        c = structure.na + sum(structure.nb)
        fixed = [*(c + structure.leads), c + sum(structure.n_in)]
        return np.delete(np.delete(cov, fixed, axis=1), fixed, axis=2)

    @property
    def radius(self) -> Array:
        """The largest size of a pole of the linear block, (T,); 1 and more is unstable."""
        return radius_of(self.a)

    def of_input(self, i: int = 0) -> tuple[Array, Array]:
        """b (T, nb) and c (T, n_in) of input i, an index from 0 on."""
        structure = self.model.structure
        return structure.of_inputs(self.b, structure.nb)[i], structure.of_inputs(self.c, structure.n_in)[i]

    def input_curve(self, u: Any, t: int = -1, i: int = 0) -> Array:
        """v of input i at inputs u (...), with the coefficients of sample t."""
        c = self.of_input(i)[1][t]
        return np.asarray(self.model.bases[i].for_coefficients(u, c) @ c)

    def output_curve(self, y: Any, t: int = -1) -> Array:
        """w = F(y) at outputs y (...), with the coefficients of sample t: the inverse of the output block."""
        return np.asarray(self.model.out.value(y) @ self.d[t])

    def slope(self, y: Any) -> Array:
        """F'(y_t; d_t), (T,), for y (T,) or one number."""
        return np.asarray(np.sum(self.model.out.derivative(np.broadcast_to(y, len(self))) * self.d, axis=1))

    def gauge(self, input: str = "unit", output: str = "d1", at: float = 0.0) -> Blocks:
        """The same system in another gauge.

        Parameters
        ----------
        input : "unit", "c1" or "b1"
            The coefficient that is set to 1: |c|, with the sign of a rising curve, c_1 or b_1.
        output : "d1", "unit" or "slope"
            d_1 = 1, |d| = 1 with d_1 > 0, or F'(at) = 1.
        at : number
            Working point of y.

        Raises
        ------
        ValueError
            If the coefficient to be set to 1 is 0 at some sample.
        """
        one_of("gauge", "input", input, INPUTS)
        one_of("gauge", "output", output, OUTPUTS)
        if (input, output) == self.gauged and output != "slope":
            return self
        x, spans = self._together()
        level, rate = _output_scale(self, output, at, x, spans)
        scale, rates = np.ones(x.shape), np.zeros((self.model.m, *x.shape))
        for own in spans.d, spans.rest:
            scale[:, own] /= level[:, None]
        for i, (b, c) in enumerate(zip(spans.b, spans.c, strict=True)):
            gain, rates[i] = _input_scale(self, input, i, (level, rate), x, spans)
            scale[:, b] *= (gain / level)[:, None]
            scale[:, c] /= gain[:, None]
        if not np.isfinite(scale).all() and np.isfinite(x).all():
            raise ValueError(
                'gauge: the coefficient to be set to 1 passes through zero; choose input="unit", output="d1".'
            )
        cov = None if self.cov is None else _carried(self.cov, x * scale, scale, rate, rates, spans)
        return self._apart(x * scale, cov, (input, output), spans)

    def _together(self) -> tuple[Array, Spans]:
        """a, b, c, d and the intercept concatenated, (T, k), and their positions."""
        rest = [] if self.intercept is None else [self.intercept[:, None]]
        return np.concatenate([self.a, self.b, self.c, self.d, *rest], axis=1), self.model.structure.spans(True, True)

    def _apart(self, x: Array, cov: Array | None, gauged: tuple[str, str], spans: Spans) -> Blocks:
        """The blocks with other coefficients."""
        if gauged[0] == "b1":
            x[:, [b[0] for b in spans.b]] = 1.0
        _, b, c, d, rest = np.split(x, [spans.b[0][0], spans.c[0][0], spans.d[0], spans.d[-1] + 1], axis=1)
        intercept = rest[:, 0] if rest.size else None
        std = Groups(self.std.a, *(np.full(part.shape, np.nan) for part in (b, c, d)))
        if cov is not None:
            std = deviations(self.model, np.einsum("tii->ti", cov))
        return replace(self, b=b, c=c, d=d, std=std, intercept=intercept, cov=cov, gauged=gauged)


def _output_scale(found: Blocks, output: str, at: float, x: Array, spans: Spans) -> tuple[Array, Array]:
    """L (T,), the divisor of d, and d log L / dx (T, k)."""
    rate = np.zeros(x.shape)
    if output == "unit":
        level = np.copysign(np.linalg.norm(found.d, axis=1), found.d[:, 0])
        with np.errstate(divide="ignore", invalid="ignore"):
            rate[:, spans.d] = found.d / level[:, None] ** 2
        return level, rate
    weights = np.eye(1, found.d.shape[1])[0] if output == "d1" else found.model.out.derivative(float(at))
    level = found.d @ weights
    with np.errstate(divide="ignore", invalid="ignore"):
        rate[:, spans.d] = weights / level[:, None]
    return level, rate


def _input_scale(
    found: Blocks, input: str, i: int, output: tuple[Array, Array], x: Array, spans: Spans
) -> tuple[Array, Array]:
    """S (T,), by which c of input i is divided, and d log S / dx (T, k)."""
    rate = np.zeros(x.shape)
    own, lead = x[:, spans.c[i]], spans.c[i][0]
    rise = found.model.structure.of_inputs(found.model.rise, found.model.structure.n_in)[i]
    with np.errstate(divide="ignore", invalid="ignore"):
        if input == "unit" and rise.any():
            gain = np.where(own @ rise >= 0.0, 1.0, -1.0) * np.linalg.norm(own, axis=1)
            rate[:, spans.c[i]] = own / gain[:, None] ** 2
        elif input == "b1":
            first = spans.b[i][0]
            gain = output[0] / x[:, first]
            rate += output[1]
            rate[:, first] -= 1.0 / x[:, first]
        else:
            gain = x[:, lead].copy()
            rate[:, lead] = 1.0 / gain
    return gain, rate


def _carried(cov: Array, x: Array, scale: Array, level: Array, gains: Array, spans: Spans) -> Array:
    """J cov J' of a change of gauge, x (T, k) the coefficients after it: J = diag(scale) + x r'."""
    J = np.zeros(cov.shape)
    J[:, range(x.shape[1]), range(x.shape[1])] = scale
    for own in spans.d, spans.rest:
        J[:, own] -= x[:, own, None] * level[:, None]
    for b, c, gain in zip(spans.b, spans.c, gains, strict=True):
        J[:, b] += x[:, b, None] * (gain - level)[:, None]
        J[:, c] -= x[:, c, None] * gain[:, None]
    with np.errstate(invalid="ignore"):
        return np.asarray(J @ cov @ J.transpose(0, 2, 1))


def deviations(model: HammersteinWiener, var: Array) -> Groups:
    """Standard deviations of the groups, from the variances of all coefficients (T, k)."""
    na, nb, n_in, n_out, _ = model.structure
    with np.errstate(invalid="ignore"):
        std = np.sqrt(np.maximum(var, 0.0))
    return Groups(*np.split(std, np.cumsum([na, sum(nb), sum(n_in), n_out]), axis=1)[:4])


def radius_of(a: Array) -> Array:
    """The largest size (T,) of a root of z^na + a_1 z^(na-1) + .., for a (T, na); NaN where a is not finite."""
    T, na = a.shape
    companion = np.zeros((T, na, na))
    companion[:, :1] = -a[:, None]
    companion[:, range(1, na), range(na - 1)] = 1.0
    found, known = np.full(T, np.nan), np.isfinite(a).all(axis=1)
    found[known] = np.abs(np.linalg.eigvals(companion[known])).max(axis=1, initial=0.0)
    return found


def separated(model: Model, names: tuple[str, ...], theta: Array, method: str) -> Groups:
    """a, b, c, d from one theta (n,) of these names: those of the model, or of its minimal parameters."""
    if not isinstance(model, HammersteinWiener):
        raise ValueError(f"blocks: {type(model).__name__} has no blocks; use a HammersteinWiener model.")
    if names != model.names:
        return Groups(*model.structure.groups(theta))
    one_of("blocks", "method", method, METHODS[:3])
    return Groups(*(group[0] for group in split(model, theta[None], method)[:4]))
