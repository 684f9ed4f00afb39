"""Transfer functions in coloured noise: ARMAX, output error, Box-Jenkins and all between, by prediction errors.

    A(z) y_t = sum_j B_j(z) / F_j(z) u_j,t + (c) + C(z) / D(z) e_t

    A = 1 - a_1 z^-1 ..,  B_j = b_1 z^-nk + ..,  F_j = 1 - f_1 z^-1 ..,  C = 1 + c_1 z^-1 ..,  D = 1 - d_1 z^-1 ..

The prediction is linear in past outputs and inputs, and in three signals that depend on theta themselves:

    w_j,t = sum_i f_i w_j,t-i + sum_i b_i u_j,t-nk-i+1               the response to an input, without noise
    v_t   = y_t - sum_i a_i y_t-i - sum_j w_j,t - c                  the noise
    e_t   = v_t - sum_i d_i v_t-i - sum_i c_i e_t-i                  the innovation

    y_hat = sum_i a_i y_t-i + sum_j w_j,t + c + sum_i d_i v_t-i + sum_i c_i e_t-i

Every tracker of linear regressions follows theta by the linearisation of y_hat at its own last estimate theta',

    psi_t = d y_hat / d theta,     y_t - y_hat(theta') + psi_t' theta' = psi_t' theta_t + e_t

    d y_hat / d a_i = D/C y_t-i       d y_hat / d b_i = D/(C F_j) u_j,t-nk-i+1    d y_hat / d f_i = D/(C F_j) w_j,t-i
    d y_hat / d c_i = 1/C e_t-i       d y_hat / d d_i = 1/C v_t-i                 d y_hat / d c   = D/C 1

`RLS` is then the recursive maximum likelihood (or prediction error) method, and `Kalman` the extended Kalman filter for
parameters that drift. In contrast to least squares in an `ARX` model they are not biased by coloured noise, and their
covariance is that of the prediction error estimate.

theta' is theta with the zeros of C, D and F_j drawn towards 0 while one of them is unstable. Signals that are absurd
beside the readings (`driftfit.models.polynomials.steps.BEYOND`), which a theta that one wrong reading changed computes,
are not used: e and v are bounded, and w starts again, from y if there is one input. The start needs care, because
the gradient with respect to F is 0 at theta = 0, and e means nothing before A and B are known: the first 4 n usable
samples are a pseudolinear regression (psi is the regression vector itself; for one input, w is y without its
autoregressive part; C and D enter after 2 n samples), and after N samples the filters of psi have zeros and poles at
1 - 4 n / N of their distance from 0. The bias of the start fades with the memory of the tracker; `RLS`, also with
lambda = 1, has a short one during the first 80 n samples, without C and D 40 n (`Linearised.settling`).

A missing output is replaced by its prediction, for at most na outputs in a row if there are lags of it, and its e is
0. A missing input makes the samples unusable that have it in psi directly; in w its last value is held. A gap in time
breaks the lags as in `ARX`, and e and v are 0 after it.

Source: Ljung and Soderstrom, Theory and Practice of Recursive Identification (1983), section 3.7, and Ljung, System
Identification (1999), eq. 11.51; the general structure is eq. 4.33 there. Departures: signs of a, d, f are those of the
regression, as in `ARX`; the start; filters that stay stable, where the source projects theta itself; w and e of a
sample are computed from the theta that has learned from it. Cost per sample: O(n + K (m + 1)) with K the largest order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST, ModelSteps, TrackerSteps
from driftfit.engine.kernel import Array, State, kernel
from driftfit.engine.settings import whole
from driftfit.models.inputs import LinearisedTransfer
from driftfit.models.linearised import MEMORY
from driftfit.models.polynomials.instruments import MORE, instrumental_steps
from driftfit.models.polynomials.steps import (
    EACH,
    HELD,
    OWN,
    SETTLING,
    WF,
    Places,
    U,
    W,
    Y,
    credible,
    places,
    steps,
    taking_inputs,
)

FORGOTTEN = 80.0
"""Samples for each parameter that a tracker without drift should forget again: twenty times the start."""


@kernel
def hold_before(s: State, signal: int, age: int, l: int) -> None:
    """The input before is held, also in the filters since then, as if this one had been missing."""
    own, oldest = OWN + EACH * signal, s.signals.shape[1] - 1
    s.signals[own + U, age, l] = np.nan
    for r in range(HELD, W):
        before = s.signals[own + r, age + 1, l] if age < oldest else s.left[signal, r - HELD, l]
        for i in range(age + 1):
            taken = (r > HELD) | (not abs(s.signals[own + U, i, l]) < LARGEST)
            s.signals[own + r, i, l] = before if taken else s.signals[own + r, i, l]
    s.last_input[signal, l] = s.signals[own + HELD, 0, l]


@lru_cache
def taking_late(take_inputs: Any) -> Any:
    """`ModelSteps.apply`: where a record takes the inputs in, their sample has not been counted yet."""

    @kernel
    def take_late(s: State, l: int) -> None:
        counted = s.ok[l] * s.moved_on[l]
        s.usable[l] -= counted
        take_inputs(s, l)
        s.usable[l] += counted

    return take_late


@lru_cache
def _refusing(p: Places) -> Any:
    """`ModelSteps.refuse`: the input before is held, and w since then is without the response to the difference."""
    n, m, nb, nf, nk, at_b, at_f = p.n, p.m, p.nb, p.nf, p.nk, p.at_b, p.at_f

    @kernel
    def subtract_response(s: State, j: int, age: int, l: int) -> None:
        own, first = OWN + EACH * j, age - nk[j]
        for i in range(first, -1, -1):
            w = 0.0
            for k in range(min(nb[j], first - i + 1)):
                at = i + nk[j] + k
                w += s.point[at_b[j] + k, l] * (s.recursion[0, at, l] - s.signals[own + HELD, at, l])
            for k in range(min(nf[j], first - i)):
                w += s.point[at_f[j] + k, l] * s.recursion[1, i + 1 + k, l]
            s.recursion[1, i, l] = w if credible(s, w, 0, l) else 0.0
            s.signals[own + W, i, l] -= s.recursion[1, i, l]
            s.signals[own + WF, i, l] = s.signals[own + WF, first + 1, l]

    @kernel
    def refuse(s: State, signal: int, age: int, l: int) -> None:
        for i in range(age + 1):
            s.recursion[0, i, l] = s.signals[OWN + EACH * signal + HELD, i, l]
        hold_before(s, signal, age, l)
        for j in range(m):  # the orders of an input are constants
            if (j == signal) & (s.usable[l] >= SETTLING * n):  # w of the first samples is what outputs say
                subtract_response(s, j, age, l)

    return refuse


@lru_cache
def _steps(p: Places, held: bool, instruments: bool = False) -> ModelSteps:
    made = instrumental_steps(p, held) if instruments else steps(p, held)
    late, ages = all(p.nk[: p.m]), max((nb + nk - 1 for nb, nk in zip(p.nb[: p.m], p.nk, strict=False)), default=0)
    return made._replace(apply=taking_late(taking_inputs(p)) if late else None, ages=ages, refuse=_refusing(p))


@dataclass(frozen=True)
class PolynomialModel(LinearisedTransfer):
    """A(z) y = sum_j B_j(z) / F_j(z) u_j + C(z) / D(z) e, the general transfer function with one output.

    `ARMAX`, `OE` and `BoxJenkins` are its best-known cases.

    Parameters
    ----------
    na, nc, nd : int
        Orders of A, C and D.
    nb, nf, nk : int, or one per input
        Lags of each input, order of its F, and its delay in samples (0 uses the present input).
    inputs : int, names, or None
        How many inputs, or their names. None: as many as ``nb``, ``nf`` or ``nk`` have entries, else as many as u has
        columns.
    offset : bool
        Add the constant c as the last parameter.
    point : (n,) or None
        Hold the linearisation at this theta, as one iteration of `Track.refine` does; None: it is at the last estimate.

    Raises
    ------
    ValueError
        If an order is negative, the numbers of inputs disagree, the point has another length than theta, or there is
        nothing to estimate.
    """

    na: int = 0
    nb: int | tuple[int, ...] = 1
    nc: int = 0
    nd: int = 0
    nf: int | tuple[int, ...] = 0
    nk: int | tuple[int, ...] = 1
    inputs: int | tuple[str, ...] | None = None
    offset: bool = False
    point: tuple[float, ...] | None = None
    per_input = ("nb", "nf", "nk")

    def __post_init__(self) -> None:
        for name in ("na", "nc", "nd"):
            self._set(name, whole(type(self).__name__, name, getattr(self, name), 0))
        self._check_inputs()
        if self.inputs is not None and self.n == 0:
            raise ValueError(f"{type(self).__name__}: there is nothing to estimate; give an order of at least 1.")
        self._check_point()

    @property
    def orders(self) -> tuple[tuple[int, int, int], ...]:
        """(nb, nf, nk) of every input."""
        return tuple(zip(*(self.for_each_input(name) for name in ("nb", "nf", "nk")), strict=True))

    @property
    def names(self) -> tuple[str, ...]:
        names = [f"a{i + 1}" for i in range(self.na)]
        names += [f"b{i + 1}{u}" for u, (nb, _, _) in zip(self.suffixes, self.orders, strict=True) for i in range(nb)]
        names += [f"c{i + 1}" for i in range(self.nc)] + [f"d{i + 1}" for i in range(self.nd)]
        names += [f"f{i + 1}{u}" for u, (_, nf, _) in zip(self.suffixes, self.orders, strict=True) for i in range(nf)]
        return (*names, "offset") if self.offset else tuple(names)

    @property
    def dimensions(self) -> tuple[tuple[int, int | None], ...]:
        gains = [(1, j) for j, (nb, _, _) in enumerate(self.orders) for _ in range(nb)]
        rest = self.nc + self.nd + sum(nf for _, nf, _ in self.orders)
        return (*((0, None),) * self.na, *gains, *((0, None),) * rest, *([(1, None)] if self.offset else []))

    @property
    def settling(self) -> float:
        if self.point is not None:
            return 0.0
        if self.nc or self.nd:
            return FORGOTTEN * self.n
        return 0.5 * FORGOTTEN * self.n if any(nf for _, nf, _ in self.orders) else 0.0

    @property
    def settling_memory(self) -> float:
        return SETTLING * self.n

    @property
    def unequal_start(self) -> bool:
        return bool(self.nc or self.nd)

    @property
    def reach(self) -> int:
        return self._depth - 1

    @property
    def _places(self) -> Places:
        return places(self.na, self.nc, self.nd, self.orders, self.offset)

    @property
    def _depth(self) -> int:
        """Samples of the past that are kept, the present one included."""
        inputs = (max(nb + nk - 1, nf) for nb, nf, nk in self.orders)
        return 1 + max(self.na, self.nc, self.nd, *inputs, 1)

    def memory(self) -> Mapping[str, Any]:
        past = np.zeros((OWN + EACH * self.m, self._depth))
        past[[Y, *(OWN + EACH * j + U for j in range(self.m))]] = np.nan
        return {
            "signals": past,
            "point": np.zeros(self.n) if self.point is None else np.array(self.point),
            "damped": np.zeros(self.n),
            "recursion": np.zeros((2, self._depth)),
            "last_input": np.zeros(max(self.m, 1)),
            "left": np.zeros((max(self.m, 1), 3)),
            "extent": np.zeros(1 + self.m),
            "reference": np.zeros(1 + self.m),
            **MEMORY,
            "usable": 0.0 if self.point is None else LARGEST,
        }

    @property
    def steps(self) -> ModelSteps:
        return _steps(self._places, self.point is not None)

    @property
    def instruments(self) -> bool:
        return self.na == 0 and any(nf for _, nf, _ in self.orders)

    @property
    def simulated(self) -> tuple[bool, ...]:
        return tuple(nf > 0 for _, nf, _ in self.orders)

    def fitted_to(self, tracker: TrackerSteps) -> tuple[Mapping[str, Any], ModelSteps]:
        memory = self.memory()
        if not (tracker.instruments and self.instruments):
            return memory, self.steps
        rows = np.concatenate([memory["signals"], np.zeros((MORE * self.m, self._depth))])
        memory = {**memory, "signals": rows, "followed": memory["point"]}
        return memory, _steps(self._places, self.point is not None, True)

    def noise_response(self, theta: Array, h: int) -> Array:
        """Response of C / (A D) to an impulse, (h,)."""
        from scipy import signal  # this import takes a third of a second, and only forecasts need it

        parts = self.parts(theta)
        return np.asarray(signal.lfilter(parts["C"], np.convolve(parts["A"], parts["D"]), np.eye(1, h)[0]))

    def transfers(self, theta: Array) -> tuple[Array, list[tuple[Array, Array]]]:
        parts = self.parts(theta)
        A = whole = parts["A"]
        found = []
        for B, F in zip(parts["B"], parts["F"], strict=True):
            whole = _product(whole, F)
            found.append((B, _product(A, F)))
        return whole, found

    def parts(self, theta: Array) -> dict[str, Any]:
        """The polynomials of theta (.., n) in powers of z^-1: A, C, D, and lists B and F with an entry per input.

        They have the signs of the equation, so that A = [1, -a_1, ..]; B begins with nk zeros.
        """
        theta = np.asarray(theta, dtype=float)
        sizes = [self.na, *(nb for nb, _, _ in self.orders), self.nc, self.nd, *(nf for _, nf, _ in self.orders)]
        a, *cut = np.split(theta[..., : sum(sizes)], np.cumsum(sizes)[:-1], axis=-1)
        b, (c, d), f = cut[: self.m], cut[self.m : 2 + self.m], cut[2 + self.m :]
        zeros = [np.zeros((*theta.shape[:-1], nk)) for _, _, nk in self.orders]
        return {
            "A": _monic(-a),
            "B": [np.concatenate([late, one], axis=-1) for late, one in zip(zeros, b, strict=True)],
            "C": _monic(c),
            "D": _monic(-d),
            "F": [_monic(-one) for one in f],
        }


def _monic(rest: Array) -> Array:
    """The polynomial 1 + rest_1 z^-1 + .., coefficients on the last axis."""
    return np.concatenate([np.ones((*rest.shape[:-1], 1)), rest], axis=-1)


def _product(one: Array, other: Array) -> Array:
    """The products of polynomials, whose coefficients are on the last axis."""
    found = np.zeros((*one.shape[:-1], one.shape[-1] + other.shape[-1] - 1))
    for i in range(one.shape[-1]):
        found[..., i : i + other.shape[-1]] += one[..., i : i + 1] * other
    return found


@dataclass(frozen=True, repr=False)
class ARMAX(PolynomialModel):
    """A(z) y = B(z) u + C(z) e: as `ARX`, in noise that is a moving average after A. See `PolynomialModel`."""

    nd: int = field(default=0, init=False)
    nf: int = field(default=0, init=False)
    na: int = 1
    nc: int = 1


@dataclass(frozen=True, repr=False)
class OE(PolynomialModel):
    """y = B(z) / F(z) u + e, output error: a plant, and white noise of measurement. See `PolynomialModel`."""

    na: int = field(default=0, init=False)
    nc: int = field(default=0, init=False)
    nd: int = field(default=0, init=False)
    nf: int | tuple[int, ...] = 1


@dataclass(frozen=True, repr=False)
class BoxJenkins(PolynomialModel):
    """y = B(z) / F(z) u + C(z) / D(z) e: plant and noise have models of their own. See `PolynomialModel`."""

    na: int = field(default=0, init=False)
    nc: int = 1
    nd: int = 1
    nf: int | tuple[int, ...] = 1
