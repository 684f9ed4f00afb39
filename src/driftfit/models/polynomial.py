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

    d y_hat / d a_i = D/C y_t-i,          d y_hat / d b_i = D/(C F_j) u_j,t-nk-i+1,   d y_hat / d f_i = D/(C F_j) w_j,t-i
    d y_hat / d c_i = 1/C e_t-i,          d y_hat / d d_i = 1/C v_t-i,                d y_hat / d c   = D/C 1

`RLS` is then the recursive maximum likelihood (or prediction error) method, and `Kalman` the extended Kalman filter for
parameters that drift. In contrast to least squares in an `ARX` model they are not biased by coloured noise, and their
covariance is that of the prediction error estimate.

C and F_j filter only while they are stable: if theta has left that region, the last coefficients inside are used in
the linearisation, and theta is free to return. The first 10 n samples are a pseudolinear regression (extended least
squares): psi is the regression vector itself and, with one input, w is y without its autoregressive part, because at
theta = 0 the gradient with respect to F is 0. Their bias fades with the memory of the tracker.

A missing output is replaced by its prediction, for at most na outputs in a row if there are lags of it, and its e is
0. A missing input makes the samples unusable that have it in psi directly; in w its last value is held. A gap in time
breaks the lags as in `ARX`, and e and v are 0 after it.

Source: Ljung and Soderstrom, Theory and Practice of Recursive Identification (1983), section 3.7, and Ljung, System
Identification (1999), eq. 11.51; the general structure is eq. 4.33 there. Departures: signs of a, d, f are those of the
regression, as in `ARX`; the start; filters that pause outside of the stable region, where the source projects theta.
Cost per sample: O(n + K (m + 1)) with K the largest order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST, ModelSteps
from driftfit.engine.kernel import Array, State, Step, kernel
from driftfit.engine.settings import input_names, whole
from driftfit.models.arx import GAP
from driftfit.models.base import Model

SETTLING = 4.0
"""Samples for each parameter, at the start, that are a pseudolinear regression."""

STABLE = 0.9999
"""Largest reflection coefficient of a filter that is used."""

CONTRACTION, CONTRACTIONS = 0.9, 20
"""Factor of the zeros of C or F while it is unstable, and how often it is applied."""

Y, YF, V, VF, E, EF, ONE, OWN = range(8)
"""Rows of the past: the output and D/C of it, v and 1/C v, e and 1/C e, D/C 1; then EACH rows for every input."""
U, HELD, G, UF, W, WF, EACH = range(7)
"""Rows of an input: itself, itself or its last value, D/C and D/(C F) of that, its response w, D/(C F) of w."""


@dataclass(frozen=True)
class Polynomial(Model):
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

    Raises
    ------
    ValueError
        If an order is negative, the numbers of inputs disagree, or there is nothing to estimate.
    """

    na: int = 0
    nb: int | tuple[int, ...] = 1
    nc: int = 0
    nd: int = 0
    nf: int | tuple[int, ...] = 0
    nk: int | tuple[int, ...] = 1
    inputs: int | tuple[str, ...] | None = None
    offset: bool = False

    def __post_init__(self) -> None:
        kind, counts = type(self).__name__, set()
        for name in ("na", "nc", "nd"):
            self._set(name, whole(kind, name, getattr(self, name), 0))
        for name in ("nb", "nf", "nk"):
            value = getattr(self, name)
            if isinstance(value, Sequence | np.ndarray):
                self._set(name, tuple(whole(kind, name, one, 0) for one in value))
                counts.add(len(value))
            else:
                self._set(name, whole(kind, name, value, 0))
        if isinstance(self.inputs, str):
            self._set("inputs", (self.inputs,))
        elif isinstance(self.inputs, int | np.integer):
            self._set("inputs", whole(kind, "inputs", self.inputs, 0))
        elif self.inputs is not None:
            self._set("inputs", input_names(kind, "inputs", self.inputs))
        elif len(counts) == 1:
            self._set("inputs", next(iter(counts)))
        elif self.nb == 0 and not counts:
            self._set("inputs", 0)
        given = self.inputs if isinstance(self.inputs, int) or self.inputs is None else len(self.inputs)
        if len(counts | ({given} if given is not None else set())) > 1:
            raise ValueError(
                f"{kind}: nb={self.nb!r}, nf={self.nf!r}, nk={self.nk!r} and inputs={self.inputs!r} imply different "
                "numbers of inputs."
            )
        if self.inputs is not None and self.n == 0:
            raise ValueError(f"{kind}: there is nothing to estimate; give an order of at least 1.")

    def bind(self, inputs: int | Sequence[str]) -> Polynomial:
        count = inputs if isinstance(inputs, int) else len(inputs)
        if self.inputs is None:
            if count == 0:
                raise ValueError(f"{type(self).__name__}: nb={self.nb!r} needs an input, but there is no u; give nb=0.")
        elif count != self.m:
            raise ValueError(
                f"{type(self).__name__}: the model has {self.m} inputs (nb={self.nb!r}, inputs={self.inputs!r}), "
                f"but u has {count} columns."
            )
        elif isinstance(inputs, int) or not isinstance(self.inputs, int):
            return self
        return replace(self, inputs=inputs if isinstance(inputs, int) else tuple(inputs))

    @property
    def m(self) -> int:
        return 1 if self.inputs is None else self.inputs if isinstance(self.inputs, int) else len(self.inputs)

    @property
    def input_names(self) -> tuple[str, ...]:
        return self.inputs if isinstance(self.inputs, tuple) else ()

    @property
    def orders(self) -> tuple[tuple[int, int, int], ...]:
        """(nb, nf, nk) of every input."""
        each = (one if isinstance(one, tuple) else (one,) * self.m for one in (self.nb, self.nf, self.nk))
        return tuple(zip(*each, strict=True))

    @property
    def names(self) -> tuple[str, ...]:
        inputs = self.input_names or tuple(f"u{j + 1}" if self.m > 1 else "" for j in range(self.m))
        names = [f"a{i + 1}" for i in range(self.na)]
        names += [_named("b", i, u) for u, (nb, _, _) in zip(inputs, self.orders, strict=True) for i in range(nb)]
        names += [f"c{i + 1}" for i in range(self.nc)] + [f"d{i + 1}" for i in range(self.nd)]
        names += [_named("f", i, u) for u, (_, nf, _) in zip(inputs, self.orders, strict=True) for i in range(nf)]
        return (*names, "offset") if self.offset else tuple(names)

    @property
    def dimensions(self) -> tuple[tuple[int, int | None], ...]:
        gains = [(1, j) for j, (nb, _, _) in enumerate(self.orders) for _ in range(nb)]
        rest = self.nc + self.nd + sum(nf for _, nf, _ in self.orders)
        return (*((0, None),) * self.na, *gains, *((0, None),) * rest, *([(1, None)] if self.offset else []))

    @property
    def recursive(self) -> bool:
        return True

    @property
    def reach(self) -> int:
        return self._depth - 1

    @property
    def _depth(self) -> int:
        """Samples of the past that are kept, the present one included."""
        inputs = (max(nb + nk - 1, nf) for nb, nf, nk in self.orders)
        return 1 + max(self.na, self.nc, self.nd, *inputs, 1)

    def memory(self) -> Mapping[str, Any]:
        past = np.zeros((OWN + EACH * self.m, self._depth))
        past[[Y, *(OWN + EACH * j + U for j in range(self.m))]] = np.nan
        return {
            "past": past,
            "filter": np.zeros(self.n),
            "damped": np.zeros(self.n),
            "spare": np.zeros((2, self._depth)),
            "held": np.zeros(max(self.m, 1)),
            "shift": 0.0,
            "measured": np.nan,
            "filled": 0.0,
            "started": 0.0,
            "learned": 0.0,
        }

    @property
    def steps(self) -> ModelSteps:
        return _steps(self.na, self.nc, self.nd, self.orders, self.offset)[0]

    @property
    def apply(self) -> Step | None:
        late = all(nk > 0 for _, _, nk in self.orders)
        return _steps(self.na, self.nc, self.nd, self.orders, self.offset)[1] if late else None

    def noise_response(self, theta: Array, h: int) -> Array:
        """Response of C / (A D) to an impulse, (h,)."""
        from scipy import signal  # this import takes a third of a second, and only forecasts need it

        parts = self.parts(theta)
        response: Array = signal.lfilter(parts["C"], np.convolve(parts["A"], parts["D"]), np.eye(1, h)[0])
        return response

    def parts(self, theta: Array) -> dict[str, Any]:
        """The polynomials of one theta (n,) in powers of z^-1: A, C, D, and lists B and F with an entry per input.

        They have the signs of the equation, so that A = [1, -a_1, ..]; B begins with nk zeros.
        """
        theta = np.asarray(theta, dtype=float)
        sizes = [self.na, *(nb for nb, _, _ in self.orders), self.nc, self.nd, *(nf for _, nf, _ in self.orders)]
        cut = np.split(theta[: sum(sizes)], np.cumsum(sizes)[:-1])
        b, (c, d), f = cut[1 : 1 + self.m], cut[1 + self.m : 3 + self.m], cut[3 + self.m :]
        return {
            "A": np.append(1.0, -cut[0]),
            "B": [np.append(np.zeros(nk), one) for one, (_, _, nk) in zip(b, self.orders, strict=True)],
            "C": np.append(1.0, c),
            "D": np.append(1.0, -d),
            "F": [np.append(1.0, -one) for one in f],
        }


def _named(letter: str, i: int, u: str) -> str:
    return f"{letter}{i + 1}[{u}]" if u else f"{letter}{i + 1}"


@dataclass(frozen=True, repr=False)
class ARMAX(Polynomial):
    """A(z) y = B(z) u + C(z) e: as `ARX`, in noise that is a moving average after A. See `Polynomial`."""

    nd: int = field(default=0, init=False)
    nf: int = field(default=0, init=False)
    na: int = 1
    nc: int = 1


@dataclass(frozen=True, repr=False)
class OE(Polynomial):
    """y = B(z) / F(z) u + e, output error: a plant, and white noise of measurement. See `Polynomial`."""

    na: int = field(default=0, init=False)
    nc: int = field(default=0, init=False)
    nd: int = field(default=0, init=False)
    nf: int | tuple[int, ...] = 1


@dataclass(frozen=True, repr=False)
class BoxJenkins(Polynomial):
    """y = B(z) / F(z) u + C(z) / D(z) e: plant and noise have models of their own. See `Polynomial`."""

    na: int = field(default=0, init=False)
    nc: int = 1
    nd: int = 1
    nf: int | tuple[int, ...] = 1


@kernel
def stable(s: State, first: int, order: int, sign: float, l: int) -> bool:
    """Whether 1 + sum_i sign x_i z^-i is, x from s.filter[first]: all reflection coefficients are inside (-1, 1)."""
    inside = True
    for i in range(order):
        s.spare[0, i, l] = sign * s.filter[first + i, l]
    for k in range(order - 1, -1, -1):
        r = s.spare[0, k, l]
        inside = inside & (abs(r) < STABLE)
        scale = 1.0 / (1.0 - r * r) if inside else 0.0
        for i in range(k):
            s.spare[1, i, l] = (s.spare[0, i, l] - r * s.spare[0, k - 1 - i, l]) * scale
        for i in range(k):
            s.spare[0, i, l] = s.spare[1, i, l]
    return inside


@kernel
def contract(s: State, first: int, order: int, sign: float, l: int) -> None:
    """s.filter is theta in the coefficients of a polynomial, its zeros drawn towards 0 until it is stable."""
    for i in range(order):
        s.filter[first + i, l] = s.theta[first + i, l]
    for _ in range(CONTRACTIONS):
        if not stable(s, first, order, sign, l):
            scale = CONTRACTION
            for i in range(order):
                s.filter[first + i, l] *= scale
                scale *= CONTRACTION
    if not stable(s, first, order, sign, l):
        for i in range(order):
            s.filter[first + i, l] = 0.0


@lru_cache
def _steps(
    na: int, nc: int, nd: int, orders: tuple[tuple[int, int, int], ...], offset: bool
) -> tuple[ModelSteps, Step]:
    """The steps for one set of orders, which are constants, so that every loop is unrolled; and that of a late input."""
    m, alone = len(orders), len(orders) == 1
    nb, nf, nk = (tuple(one[i] for one in orders) or (0,) for i in range(3))
    at_b = tuple(int(na + sum(nb[:j])) for j in range(max(m, 1)))
    at_c = na + sum(nb)
    at_d = at_c + nc
    at_f = tuple(int(at_d + nd + sum(nf[:j])) for j in range(max(m, 1)))
    last = at_d + nd + sum(nf)

    rows = OWN + EACH * m

    @kernel
    def colour(s: State, raw: int, filtered: int, l: int) -> float:
        """D/C of a row for the present sample."""
        x = s.past[raw, 0, l]
        for i in range(nd):
            x -= s.filter[at_d + i, l] * s.past[raw, i + 1, l]
        for i in range(nc):
            x -= s.damped[at_c + i, l] * s.past[filtered, i + 1, l]
        return x  # type: ignore[no-any-return]

    @kernel
    def whiten(s: State, raw: int, filtered: int, l: int) -> None:
        """1/C of a row for the present sample."""
        x = s.past[raw, 0, l]
        for i in range(nc):
            x -= s.damped[at_c + i, l] * s.past[filtered, i + 1, l]
        s.past[filtered, 0, l] = x

    @kernel
    def respond(s: State, j: int, l: int) -> float:
        """w_j of the present sample, and D/(C F) of it."""
        w, wf, own = 0.0, 0.0, OWN + EACH * j
        for i in range(nb[j]):
            b = s.filter[at_b[j] + i, l]
            w += b * s.past[own + HELD, nk[j] + i, l]
            wf += b * s.past[own + UF, nk[j] + i, l]
        for i in range(nf[j]):
            w += s.filter[at_f[j] + i, l] * s.past[own + W, i + 1, l]
            wf += s.damped[at_f[j] + i, l] * s.past[own + WF, i + 1, l]
        s.past[own + W, 0, l], s.past[own + WF, 0, l] = w, wf
        return w

    @kernel
    def take_inputs(s: State, l: int) -> None:
        """The inputs of the present sample, and what is filtered of them alone."""
        for j in range(m):
            own, u = OWN + EACH * j, s.u[j, l]
            known = abs(u) < LARGEST
            s.past[own + U, 0, l] = u if known else np.nan
            s.held[j, l] = u if known else s.held[j, l]
            s.past[own + HELD, 0, l] = s.held[j, l]
            s.past[own + G, 0, l] = colour(s, own + HELD, own + G, l)
            x = s.past[own + G, 0, l]
            for i in range(nf[j]):
                x += s.damped[at_f[j] + i, l] * s.past[own + UF, i + 1, l]
            s.past[own + UF, 0, l] = x

    @kernel
    def linearise(s: State, l: int) -> None:
        """The point theta' of the linearisation: theta, where C and F are stable."""
        for i in range(s.theta.shape[0]):
            if (i < at_c) | ((i >= at_d) & (i < at_f[0])) | (i >= last):
                s.filter[i, l] = s.theta[i, l]
        if nc > 0:
            contract(s, at_c, nc, 1.0, l)
        for j in range(m):
            if nf[j] > 0:
                contract(s, at_f[j], nf[j], -1.0, l)
        share = s.learned[l] / (SETTLING * s.theta.shape[0])
        inner = 1.0 - 1.0 / max(share, 1.0)
        scale = inner
        for i in range(nc):
            s.damped[at_c + i, l] = scale * s.filter[at_c + i, l]
            scale *= inner
        for j in range(m):
            scale = inner
            for i in range(nf[j]):
                s.damped[at_f[j] + i, l] = scale * s.filter[at_f[j] + i, l]
                scale *= inner

    @kernel
    def gradient(s: State, l: int) -> float:
        """s.phi is the gradient, or at the start the regression vector; returns y_hat at theta'."""
        settled = s.learned[l] >= SETTLING * s.theta.shape[0]
        y_hat = 0.0
        for i in range(na):
            y_hat += s.filter[i, l] * s.past[Y, i + 1, l]
            lag = s.past[YF, i + 1, l] if settled else s.past[Y, i + 1, l]
            s.phi[i, l] = lag if abs(s.past[Y, i + 1, l]) < LARGEST else np.nan
        for j in range(m):
            own = OWN + EACH * j
            y_hat += respond(s, j, l)
            for i in range(nb[j]):
                lag = s.past[own + (UF if settled else U), nk[j] + i, l]
                s.phi[at_b[j] + i, l] = lag if abs(s.past[own + U, nk[j] + i, l]) < LARGEST else np.nan
            for i in range(nf[j]):
                s.phi[at_f[j] + i, l] = s.past[own + (WF if settled else W), i + 1, l]
        for i in range(nc):
            y_hat += s.filter[at_c + i, l] * s.past[E, i + 1, l]
            s.phi[at_c + i, l] = s.past[EF if settled else E, i + 1, l]
        for i in range(nd):
            y_hat += s.filter[at_d + i, l] * s.past[V, i + 1, l]
            s.phi[at_d + i, l] = s.past[VF if settled else V, i + 1, l]
        if offset:
            y_hat += s.filter[last, l]
            one = s.past[ONE, 0, l]
            s.phi[last, l] = one if settled else 1.0
        return y_hat

    @kernel
    def regress(s: State, l: int) -> None:
        broken = s.dt[l] > GAP
        for r in range(rows):
            for i in range(s.past.shape[1] - 1, 0, -1):
                s.past[r, i, l] = s.past[r, i - 1, l]
        for i in range(1, s.past.shape[1]):
            s.past[Y, i, l] = np.nan if broken else s.past[Y, i, l]
            for j in range(m):
                own = OWN + EACH * j
                s.past[own + U, i, l] = np.nan if broken else s.past[own + U, i, l]
            for r in (V, VF, E, EF):
                s.past[r, i, l] = 0.0 if broken else s.past[r, i, l]
        linearise(s, l)
        take_inputs(s, l)
        one = 1.0
        for i in range(nd):
            one -= s.filter[at_d + i, l]
        for i in range(nc):
            one -= s.damped[at_c + i, l] * s.past[ONE, i + 1, l]
        s.past[ONE, 0, l] = one
        y_hat, along, complete = gradient(s, l), 0.0, 1.0
        for i in range(s.theta.shape[0]):
            complete = complete if abs(s.phi[i, l]) < LARGEST else 0.0
            along += s.phi[i, l] * s.filter[i, l]
        settled = s.learned[l] >= SETTLING * s.theta.shape[0]
        s.shift[l] = y_hat - along if settled & (abs(y_hat - along) < LARGEST) else 0.0
        s.measured[l] = s.y[l]
        s.y[l] -= s.shift[l]
        s.started[l] = 1.0 if complete > 0.0 else s.started[l]
        s.dt[l] = s.dt[l] if s.started[l] > 0.0 else 0.0

    @kernel
    def posterior(s: State, l: int) -> float:
        """y_hat of the present sample at the theta after it; w of the sample becomes that of this theta."""
        linearise(s, l)
        y_hat = s.filter[last, l] if offset else 0.0
        for i in range(na):
            lag = s.past[Y, i + 1, l]
            y_hat += s.filter[i, l] * (lag if abs(lag) < LARGEST else 0.0)
        for j in range(m):
            w, own = 0.0, OWN + EACH * j
            for i in range(nb[j]):
                w += s.filter[at_b[j] + i, l] * s.past[own + HELD, nk[j] + i, l]
            for i in range(nf[j]):
                w += s.filter[at_f[j] + i, l] * s.past[own + W, i + 1, l]
            y_hat += w
            s.past[own + W, 0, l] = w
        for i in range(nc):
            y_hat += s.filter[at_c + i, l] * s.past[E, i + 1, l]
        for i in range(nd):
            y_hat += s.filter[at_d + i, l] * s.past[V, i + 1, l]
        return y_hat

    @kernel
    def push(s: State, l: int) -> None:
        seen, valid = s.seen[l] > 0.0, s.valid[l] > 0.0
        informed = valid & ((s.s[l] != np.inf) | (s.noise[l] == np.inf))
        fitted, coloured = posterior(s, l), 0.0
        e = s.measured[l] - fitted if seen & informed else 0.0
        # what is left of an interpolated sample is rounding, and no regressor
        e = e if abs(e) > 1e-10 * (abs(s.measured[l]) + abs(fitted)) else 0.0
        s.y_hat[l] += s.shift[l]
        y = s.measured[l] if seen else (s.y_hat[l] if abs(s.y_hat[l]) < LARGEST else 0.0)
        known = seen | (informed & ((na == 0) | (s.filled[l] < na)))
        s.filled[l] = 0.0 if seen else s.filled[l] + 1.0
        for i in range(nd):
            coloured += s.filter[at_d + i, l] * s.past[V, i + 1, l]
        for i in range(nc):
            coloured += s.filter[at_c + i, l] * s.past[E, i + 1, l]
        share = s.learned[l] / (SETTLING * s.theta.shape[0])
        v = e + coloured
        if share < 0.5:
            v, e = 0.0, 0.0
        s.past[V, 0, l], s.past[E, 0, l] = v, e
        s.past[Y, 0, l] = y
        whiten(s, E, EF, l)
        whiten(s, V, VF, l)
        s.learned[l] += s.ok[l]
        filtered = colour(s, Y, YF, l)
        s.past[YF, 0, l] = filtered if abs(filtered) < LARGEST else y
        s.past[Y, 0, l] = y if known else np.nan
        if alone & (nf[0] > 0) & (s.learned[l] < SETTLING * s.theta.shape[0]):
            w = y
            for i in range(na):
                w -= s.theta[i, l] * s.past[Y, i + 1, l]
            w -= s.theta[last, l] if offset else 0.0
            s.past[OWN + W, 0, l] = w if abs(w) < LARGEST else s.past[OWN + W, 0, l]

    return ModelSteps(regress, push), take_inputs
