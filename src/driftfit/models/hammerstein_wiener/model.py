"""Hammerstein-Wiener: a static curve, a linear system, and another static curve, all of which may drift.

    v_t = sum_k c_k f_k(u_t)                                          input block
    w_t = -sum_{i=1..na} a_i w_{t-i} + sum_{j=1..nb} b_j v_{t-nk-j+1}  linear block
    sum_k d_k g_k(y_t) = w_t,  d_1 = 1                                inverse of the output block, increasing

With several inputs each has its own curve v_i and coefficients b_i, and their sum drives the linear block. With several
outputs each has its own linear block and output block: a regression on its own lags and on the inputs, in a separate
lane. Without noise this is not a restriction, since the entries of every row of a transfer matrix have a common
denominator, of at most the order of the whole.

In the measured signals this is a regression on products of the parameters
(`driftfit.models.hammerstein_wiener.structure`):

    z_t = -g_1(y_t) = phi_t' theta_t                                  equation (11) of the source
    phi_t = [g_1(y_{t-i}) .., -f_1(u_{t-nk-j+1}) .., g_2(y_t) .. g_q(y_t), -f_k(u_{t-nk-j+1}) .., g_k(y_{t-i}) .., (1)]

Any tracker estimates theta (stage one); `driftfit.models.hammerstein_wiener.separation` gives a, b, c, d. The
regression is exact only if each product uses every factor at its own time; products at one time leave an error of
second order in the drift.

The prediction of a run is of y, through the inverted output block; innovation, innovation_std and loglik are of the
equation error, with the Jacobian F'(y_t) in the likelihood, since phi_t contains y_t. Nothing is filled in: a missing
output makes the samples t .. t + na unusable, a missing input t + nk .. t + nk + nb - 1.

The a_i are those of the field's polynomial A(z) = 1 + a_1 z^-1 + .., and are named A1, A2, ..; `ARX` has the opposite
signs, and the names a1, a2. Use this model if one or both curves matter; for a linear system use `ARX`. Least squares
is consistent only for data without measurement noise, because phi contains y. ``output_noise`` weights samples by the
effect of noise of that standard deviation on the equation, which lowers the variance but not the bias;
`driftfit.models.hammerstein_wiener.output_error` has neither problem.

Source: Feng and Hong (2021), Int. J. Systems Science 52(16); Bai (1998), Automatica 34(3). Departures: all columns of
the input have a minus sign, without which the regression gives -b. Cost per sample: O(n + 64 n_out).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from driftfit.engine.drivers import LARGEST, ModelSteps
from driftfit.engine.kernel import Array
from driftfit.engine.settings import numbers, output_names, warn, whole
from driftfit.models.base import Implicit, Model
from driftfit.models.hammerstein_wiener.basis import Basis, Polynomial, basis_of
from driftfit.models.hammerstein_wiener.output_curve import play
from driftfit.models.hammerstein_wiener.steps import DIGITS, Input, build, inputs_of, memory
from driftfit.models.hammerstein_wiener.structure import Structure
from driftfit.models.hammerstein_wiener.thresholds import settled
from driftfit.models.inputs import CountedInputs
from driftfit.readings.screen import suspect

IDENTITY = Polynomial(1)
SLOPE_SHARE = 1e-3
"""Smallest slope of the output block that the likelihood accepts, as a share of the slope of its functions."""
VARIANCE_SHARE = 1e-4
"""Smallest variance that measurement noise adds to the equation, as a share of the squared height of the functions."""
UNIT_SIZE = 10.0
"""Root mean square beyond which, or below whose inverse, data are far from unit size for raw powers."""


def several(value: Any) -> bool:
    """Whether a setting has an entry for each input; the words of one basis begin with its name."""
    return isinstance(value, (tuple, list)) and not (len(value) > 0 and isinstance(value[0], str))


def _blocks(value: Any) -> Any:
    """A basis, or one for each input."""
    return tuple(basis_of(each) for each in value) if several(value) else basis_of(value)


def _plain(value: Any) -> Any:
    """A setting as plain data."""
    if isinstance(value, tuple):
        return tuple(_plain(each) for each in value)
    return value.plain() if isinstance(value, Basis) else value


@dataclass(frozen=True)
class HammersteinWiener(CountedInputs, Implicit):
    """Hammerstein-Wiener model.

    Parameters
    ----------
    na : int
        Lags of w in the linear block.
    nb, nk : int, or one per input
        Lags of v in the linear block, at least 1, and the delay of the input in samples (0 uses the present input).
    input : Basis or None, or one per input
        Functions of the input block; None is the identity. Every input has its own curve.
    output : Basis or None
        Functions of the inverse of the output block; None is the identity. ``output=None`` is a Hammerstein and
        ``input=None`` a Wiener model.
    intercept : bool
        Add one constant; those of the two blocks cannot be distinguished.
    output_noise : number, one for each output, or None
        Standard deviation of white noise on y. The noise variance of the equation then is r times
        sigma^2 sum_{i=0..na} a_i^2 F'(y_{t-i})^2, plus 1e-4 of the squared height of the output block's
        functions since the slope of a curve may be 0, from the estimates before each sample; use r = 1.
    inputs : int, names, or None
        How many inputs, or their names, as in `ARX`. None: as many as ``nb``, ``nk`` or ``input`` have entries, else as
        many as u has columns.
    ny : int or names
        Outputs, columns of y. With several, ``output`` and ``output_noise`` may be lists with one entry for each; the
        bases of all outputs are of one kind and size, with separate ranges and knots.

    Raises
    ------
    ValueError
        For orders that are not integers, lists of different lengths, a dead zone or saturation in the output block, or
        output bases of different kinds.
    """

    na: int
    nb: Any
    nk: Any = 1
    input: Any = None
    output: Any = None
    intercept: bool = False
    output_noise: Any = None
    inputs: Any = None
    ny: Any = 1
    per_input = ("nb", "nk", "input")
    fewest = 1
    lowest: ClassVar[Mapping[str, int]] = {"nb": 1}

    def __post_init__(self) -> None:
        self._set("na", whole("HammersteinWiener", "na", self.na, 0))
        self._check_inputs()
        for name in self.per_input:
            if several(value := getattr(self, name)) and len(value) == 1:
                self._set(name, value[0])
        self._check_outputs()

    def _check_per_input(self, name: str) -> int | None:
        if name != "input":
            return super()._check_per_input(name)
        self._set("input", _blocks(self.input))
        return len(self.input) if several(self.input) else None

    def _check_outputs(self) -> None:
        """Outputs, their bases and their noises."""
        lists = {name: len(value) for name in ("output", "output_noise") if several(value := getattr(self, name))}
        self._set("ny", max([1, *lists.values()]) if self.ny == 1 else self.ny)
        if not isinstance(self.ny, int):
            self._set("ny", output_names("HammersteinWiener", self.ny))
        count = len(output_names("HammersteinWiener", self.ny))
        if set(lists.values()) - {count}:
            raise ValueError(f"HammersteinWiener: there are {count} outputs, but one entry for each of {lists}.")
        self._set("output", _blocks(self.output))
        for basis in self.output if several(self.output) else (self.output,):
            if basis is not None and basis.adaptive:
                raise ValueError(
                    f"HammersteinWiener: {type(basis).__name__} is not one-to-one, so it can only be an input block."
                )
        if len({(basis.functions, basis.n, basis.parameters.size) for basis in self.outs}) > 1:
            raise ValueError(
                f"HammersteinWiener: outputs that run together have bases of one kind and size; got {self.output!r}. "
                "Use a separate model for any other output."
            )
        if self.output_noise is not None:
            ndim = 1 if several(self.output_noise) else 0
            sigma = numbers("HammersteinWiener", "output_noise", self.output_noise, ndim=ndim, low=0.0, strict=True)
            self._set("output_noise", sigma)

    def settings(self) -> dict[str, Any]:
        return {name: _plain(value) for name, value in super().settings().items()}

    @property
    def bases(self) -> tuple[Basis, ...]:
        """Functions of the curve of each input."""
        return tuple(IDENTITY if basis is None else basis for basis in self.for_each_input("input"))

    @property
    def delays(self) -> tuple[int, ...]:
        """nk of each input."""
        return self.for_each_input("nk")

    @property
    def into(self) -> Basis:
        """Functions of the input block; ValueError if there are several inputs."""
        if self.m > 1:
            raise ValueError("HammersteinWiener: this method needs a model with one input.")
        return self.bases[0]

    @property
    def outputs(self) -> tuple[str, ...]:
        return output_names("HammersteinWiener", self.ny)

    @property
    def outs(self) -> tuple[Basis, ...]:
        """Functions of the inverse of the output block of each output."""
        given = self.output if several(self.output) else (self.output,) * len(self.outputs)
        return tuple(IDENTITY if basis is None else basis for basis in given)

    @property
    def out(self) -> Basis:
        """Functions of the inverse of the output block, of the first output if there are several."""
        return self.outs[0]

    def alone(self, output: str) -> HammersteinWiener:
        i = self.outputs.index(output)
        one = {name: value[i] for name in ("output", "output_noise") if several(value := getattr(self, name))}
        return replace(self, ny=1, **one)

    @property
    def structure(self) -> Structure:
        """The orders, and the positions of the parameters in theta."""
        nb = self.for_each_input("nb")
        return Structure(self.na, nb, tuple(basis.n for basis in self.bases), self.out.n, self.intercept)

    @property
    def names(self) -> tuple[str, ...]:
        return self.called(self.structure.names)

    def called(self, names: Sequence[str]) -> tuple[str, ...]:
        """Names of coefficients, with those of the inputs for [u1], [u2] .. where they have names."""
        for i, name in enumerate(self.input_names):
            names = [each.replace(f"[u{i + 1}]", f"[{name}]") for each in names]
        return tuple(names)

    @cached_property
    def rise(self) -> Array:
        """r with r'c > 0 for the curves that rise, of each input (sum of n_in,); 0 where c_1 = 1 by definition."""
        return np.concatenate([np.zeros(basis.n) if basis.adaptive else basis.rise for basis in self.bases])

    @property
    def linear(self) -> bool:
        """Whether the output block is the identity."""
        return self.out == IDENTITY

    def memory(self) -> Mapping[str, Any]:
        sigma = self.output_noise[0] if several(self.output_noise) else self.output_noise
        return memory(self.structure, self.delays, self.bases, self.out, sigma or 0.0, self._least_noise)

    @cached_property
    def entering(self) -> tuple[Input, ...]:
        """The inputs, and where their numbers are in the state."""
        return inputs_of(self.structure, self.delays, self.bases)

    @property
    def steps(self) -> ModelSteps:
        return build(self.structure, self.entering, self.out.functions, not self.linear)

    @property
    def reach(self) -> int:
        return max(self.na, *(nb + nk - 1 for nb, nk in zip(self.structure.nb, self.delays, strict=True)))

    def play(self, theta: Array, y: Array, u: Array, noise: Array, span: tuple[Any, Any]) -> Array:
        return play(self, theta, y, u, noise, span)

    def touched(self, t: int, signal: str) -> range:
        """The samples that cannot be used if "y" or "u" is missing at t."""
        if signal == "y":
            return range(t, t + self.na + 1)
        ends = [nb + nk for nb, nk in zip(self.structure.nb, self.delays, strict=True)]
        return range(t + min(self.delays), t + max(ends))

    @property
    def implicit(self) -> Implicit:
        return self

    def expand(self, theta: Array) -> Array | None:
        return self.structure.products(theta) if theta.shape[-1] == self.structure.n_x else None

    @property
    def noise_varies(self) -> bool:
        return self.output_noise is not None

    def output_weights(self, theta: Array) -> Array:
        """d (..., n_out) with d_1 = 1 from theta (..., n), or from the minimal xi (..., n_x)."""
        at = self.structure.starts[0]
        if theta.shape[-1] != self.n:
            at += sum(self.structure.n_in) - self.m
        d = theta[..., at : at + self.out.n - 1]
        return np.concatenate([np.ones((*theta.shape[:-1], 1)), d], axis=-1)

    def slope(self, theta: Array, y: Array) -> Array:
        """F'(y; d), the slope of the inverse of the output block; theta (..., n) or xi (..., n_x), y (...)."""
        return np.asarray(np.sum(self.out.derivative(y) * self.output_weights(theta), axis=-1))

    def noise_response(self, theta: Array, h: int) -> Array:
        """Response of w to one equation error: that of 1 / A(z)."""
        response: Array = np.eye(1, h)[0]
        for t in range(1, h):
            lags = response[max(t - self.na, 0) : t][::-1]
            response[t] = np.clip(-theta[: len(lags)] @ lags, -LARGEST, LARGEST)  # unstable estimates grow for ever
        return response

    def output_slope(self, theta: Array, y: Array) -> Array:
        """F'(y_t; d_t) with the estimate after the sample, at least 1e-3 of the slope of the functions.

        The integral of a function linear in d over the posterior is its value at the posterior mean, so the density of
        y integrates to 1 with the estimate after the sample, and to more with the one before.
        """
        with np.errstate(invalid="ignore"):
            found: Array = np.maximum(self.slope(theta, y), SLOPE_SHARE * self.out.steepness)
        return found

    def noise_factor(self, theta: Array, y: Array) -> float:
        """1, or sigma^2 (1 + sum_i a_i^2) F'(y)^2 + floor under ``output_noise``."""
        if self.output_noise is None:
            return 1.0
        energy = 1.0 + float(np.sum(theta[: self.na] ** 2))
        return float((self.output_noise * self.slope(theta, y)) ** 2 * energy + self._least_noise)

    @property
    def _least_noise(self) -> float:
        """The slope of the identity is 1, so that it needs no floor."""
        return 0.0 if self.linear else VARIANCE_SHARE * self.out.height**2

    def settled(self, phi: Array, y: Array, u: Array, at: Array) -> Array:
        if not any(basis.adaptive for basis in self.bases):
            return phi
        return settled(phi, y, u, at, self.bases, self.delays, self.structure)

    def follows(self, other: Model) -> bool:
        return isinstance(other, HammersteinWiener) and replace(self, inputs=self.m) == replace(other, inputs=other.m)

    def inspect(self, y: Array, u: Array) -> None:
        """Warn of data that the bases do not fit; `driftfit.track` calls it with a whole record, y (T,), u (T, 1)."""
        names = self.input_names or (["u"] if self.m == 1 else [f"u{i + 1}" for i in range(self.m)])
        for what, basis, data in (*zip(names, self.bases, u.T, strict=True), ("y", self.out, y)):
            if basis.n == 1 and not np.isfinite(basis.expected).any():
                continue
            with np.errstate(over="ignore"):
                total = float(np.abs(data).sum())
            values = data if total < LARGEST else data[np.abs(data) < LARGEST]  # usually no value is missing
            low, high = basis.expected
            outside = int(np.sum((values < low) | (values > high))) if low > -np.inf or high < np.inf else 0
            if outside:
                effect = "are missing" if basis.limits == basis.expected else "are beyond what it was made for"
                warn(
                    f"{outside} of {values.size} samples of {what} lie outside the range ({low:g}, {high:g}) of "
                    f"{type(basis).__name__} and {effect}; {what} spans {values.min():g} to {values.max():g}.",
                    UserWarning,
                )
            if not (isinstance(basis, Polynomial) and basis.degree > 1):
                continue
            values = values[~suspect(values)]  # which say nothing of the unit of the others
            size = float(np.sqrt(values @ values / values.size)) if values.size else 0.0
            if size and not 1.0 / UNIT_SIZE <= size <= UNIT_SIZE:
                powers = np.abs(values[:, None] ** [1, basis.degree])
                lost = int(np.sum(powers[:, 1] >= DIGITS * np.maximum(powers[:, 0], 1.0)))
                unusable = f", and {lost} samples, whose powers span more than 13 digits, are missing" if lost else ""
                warn(
                    f"{what} has a root mean square of {size:g}: raw powers of data far from unit size are badly "
                    f"scaled{unusable}; scale it, or use Legendre({basis.degree}, ({values.min():g}, "
                    f"{values.max():g})).",
                    UserWarning,
                )
