"""Simulated Hammerstein-Wiener systems, with the true path of every coefficient.

    v_t = sum_k c_k,t f_k(u_t)
    w_t = -sum_i a_i,t w_{t-i} + sum_j b_j,t v_{t-nk-j+1} + e_t
    sum_k d_k,t g_k(y0_t) = w_t

with c_1 = d_1 = 1, v = w = 0 before the record, and y = y0 + measurement noise. Coefficients follow the laws of
`driftfit.systems.drift`. An unstable linear block has a bounded output only under feedback: pass u as a function of the
past outputs. `example` gives examples 1 to 3 of Feng and Hong (2021), `driftfit.systems.arc_furnace` the fourth.

The output block is inverted by Newton's method within a bracket, for all samples at once. `invert` raises an error if
the block does not increase within the bracket or does not reach a level: it never chooses one of several roots.
Departures from the paper: N(0, 0.002) is a standard deviation, and the laws of b in example 3 are increments
(``literal=True`` takes them as levels, which changes b by 0.04 %).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.models.hammerstein_wiener.basis import Basis, Polynomial
from driftfit.models.hammerstein_wiener.blocks import radius_of
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.systems.drift import Jump, Law, Ramp, RandomWalk, SineIncrement, SineOffset, paths

LIMIT = 1e3
"""Outputs beyond which the inversion gives up."""
GRID = 200
"""Points at which the slope of a block that is not a polynomial is evaluated."""

Laws = Sequence[Law | float | Callable[[Array], Array]]


class Simulated(NamedTuple):
    """A record with its true parameters."""

    model: HammersteinWiener
    y: Array
    """(T,), with measurement noise."""
    u: Array
    """(T,)"""
    y0: Array
    """(T,), without measurement noise."""
    w: Array
    """(T,), output of the linear block."""
    v: Array
    """(T,), output of the input block."""
    a: Array
    """(T, na)"""
    b: Array
    """(T, nb)"""
    c: Array
    """(T, n_in), the first 1."""
    d: Array
    """(T, n_out), the first 1."""
    sigma: float
    """Standard deviation of the measurement noise."""
    unstable: int | None
    """The first sample at which the linear block has a pole on or outside the unit circle."""

    @property
    def xi(self) -> Array:
        """The minimal parameters, (T, n_x)."""
        none = np.zeros(len(self.y)) if self.model.intercept else None
        return self.model.structure.minimal(self.a, self.b, self.c, self.d, none)

    @property
    def theta(self) -> Array:
        """The products of the exact regression, each factor at its own time, (T, n); NaN before the record."""
        model = self.model
        ad = [[self.a[:, i] * _late(self.d[:, k], i + 1) for i in range(model.na)] for k in range(1, model.out.n)]
        bc = [[self.b[:, j] * _late(self.c[:, k], model.nk + j) for j in range(model.nb)]
              for k in range(1, model.into.n)]  # fmt: skip
        columns = [*self.a.T, *self.b.T, *self.d[:, 1:].T, *(x for row in (*bc, *ad) for x in row)]
        return np.stack([*columns, *([np.zeros(len(self.y))] if model.intercept else [])], axis=1)


def _late(path: Array, k: int) -> Array:
    """A path delayed by k samples, NaN before it begins."""
    return np.concatenate([np.full(min(k, len(path)), np.nan), path[: max(len(path) - k, 0)]])


def simulate(
    model: HammersteinWiener,
    a: Laws,
    b: Laws,
    c: Laws = (),
    d: Laws = (),
    *,
    T: int,
    rng: np.random.Generator,
    u: Any = None,
    snr_db: float | None = None,
    equation_noise: float = 0.0,
    limit: float = LIMIT,
) -> Simulated:
    """Simulate T samples.

    Parameters
    ----------
    model : HammersteinWiener
        Orders and bases.
    a, b, c, d : laws, numbers or functions of the sample numbers
        na, nb, n_in - 1 and n_out - 1 of them, because c_1 and d_1 are 1.
    u : (T,), a function (t, y) or None
        The input. A function receives the sample number and the earlier outputs (t,). None draws white noise of
        variance 1.
    snr_db : number or None
        Adds measurement noise of standard deviation std(y0) 10^(-snr_db / 20).
    equation_noise : number
        Standard deviation of white noise added to w.
    limit : number
        Outputs larger than this count as unreachable.

    Raises
    ------
    NotMonotoneError
        If the output block does not increase, or w is out of its range (an unstable linear block).
    """
    counts = {"a": model.na, "b": model.nb, "c": model.into.n - 1, "d": model.out.n - 1}
    for (name, count), given in zip(counts.items(), (a, b, c, d), strict=True):
        if len(given) != count:
            raise ValueError(f"simulate: {name} needs {count} laws, without the leading 1; got {len(given)}.")
    one = np.ones((T, 1))
    ta, tb, tc, td = (paths(laws, T, rng) for laws in (a, b, c, d))
    tc, td = np.concatenate([one, tc], axis=1), np.concatenate([one, td], axis=1)
    unstable = first_unstable(ta)
    error = equation_noise * rng.normal(size=T) if equation_noise else np.zeros(T)
    if callable(u):
        drive, v, w, y0 = _closed(model, u, ta, tb, tc, td, error, limit)
    else:
        drive = rng.normal(size=T) if u is None else np.asarray(u, dtype=float)
        if drive.shape != (T,):
            raise ValueError(f"simulate: u must be ({T},); got shape {drive.shape}.")
        v = input_block(model.into, drive, tc)
        w = _linear(model, ta, tb, v, error)
        try:
            y0 = invert(model.out, td, w, limit)
        except NotMonotoneError as failure:
            more = "" if unstable is None else f" The linear block is unstable from sample {unstable} on."
            raise NotMonotoneError(f"{failure}{more}") from None
    sigma = 0.0 if snr_db is None else float(np.std(y0) * 10.0 ** (-snr_db / 20.0))
    y = y0 + sigma * rng.normal(size=T) if sigma else y0.copy()
    return Simulated(model, y, drive, y0, w, v, ta, tb, tc, td, sigma, unstable)


def input_block(basis: Basis, u: Array, c: Array) -> Array:
    """v (T,) for coefficients c (T, n)."""
    return np.asarray(np.sum(basis.for_coefficients(u, c) * c, axis=1))


def _linear(model: HammersteinWiener, a: Array, b: Array, v: Array, error: Array) -> Array:
    """w (T,) by the recursion, from a zero past."""
    late = [np.nan_to_num(_late(v, model.nk + j)) for j in range(model.nb)]
    drive = np.sum(b * np.stack(late, axis=1), axis=1) + error
    w = [0.0] * model.na
    for row, x in zip(a.tolist(), drive.tolist(), strict=True):
        w.append(x - sum(coefficient * w[-1 - i] for i, coefficient in enumerate(row)))
    return np.array(w[model.na :])


def _closed(
    model: HammersteinWiener, u: Callable[[int, Array], float], a: Array, b: Array, c: Array, d: Array, e: Array,
    limit: float,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """The same sample by sample, for an input that depends on the outputs; needs nk >= 1."""
    if model.nk < 1:
        raise ValueError("simulate: an input that depends on the output needs nk >= 1.")
    T = len(e)
    drive, v, w, y = np.zeros((4, T))
    for t in range(T):
        w[t] = e[t] - sum(a[t, i] * w[t - 1 - i] for i in range(model.na) if t > i)
        w[t] += sum(b[t, j] * v[t - model.nk - j] for j in range(model.nb) if t >= model.nk + j)
        drive[t] = u(t, y[:t])
        v[t] = input_block(model.into, drive[t : t + 1], c[t : t + 1])[0]
        y[t] = invert(model.out, d[t : t + 1], w[t : t + 1], limit, first=t)[0]
    return drive, v, w, y


def first_unstable(a: Array) -> int | None:
    """The first sample at which the linear block has a pole of size 1 or more; a (T, na)."""
    beyond = radius_of(a) >= 1.0
    return int(np.argmax(beyond)) if beyond.any() else None


START = {"a": (-0.6, 0.4), "b": (0.7, -0.36), "c": (0.4, -0.7), "d": (-0.4, 0.6)}
"""Coefficients at the start of examples 1 to 3, without the leading 1 of c and d."""
WALK = 0.002
CUBIC = HammersteinWiener(2, 2, input=Polynomial(3), output=Polynomial(3))


def example(number: int, seed: int = 0, T: int = 5000, snr_db: float | None = None, literal: bool = False) -> Simulated:
    """Example 1, 2 (both: a random walk of every parameter) or 3 (ramps, sines, a random walk of c, a jump of d).

    If the random walk of a seed leaves the region where the linear block is stable and the output block increases, it
    is replaced by seed + 1000, and so on.
    """
    laws: dict[str, Laws] = {name: [RandomWalk(x, WALK) for x in values] for name, values in START.items()}
    if number == 3:
        b: Laws = [SineIncrement(0.7, 3e-4, 0.005), SineIncrement(-0.36, 5e-4, 0.003, -np.pi / 2)]
        if literal:
            b = [SineOffset(0.7, 3e-4, 0.005, np.pi / 2), SineOffset(-0.36, 5e-4, 0.003)]
        laws |= {
            "a": [Ramp(-0.6, 5e-5), Ramp(0.4, -4e-5)], "b": b,
            "d": [Jump(-0.4, 0.1, T // 5), Jump(0.6, -0.1, T // 5)],
        }  # fmt: skip
    while True:
        try:
            groups = (laws[name] for name in "abcd")
            found = simulate(CUBIC, *groups, T=T, rng=np.random.default_rng(seed), snr_db=snr_db)
        except NotMonotoneError:
            seed += 1000
            continue
        if found.unstable is None:
            return found
        seed += 1000


class NotMonotoneError(ValueError):
    """The output block does not increase where it is used, or does not reach a level."""


def invert(basis: Basis, d: Array, w: Any, limit: float = LIMIT, first: int = 0) -> Array:
    """y (T,) with sum_k d_k g_k(y) = w, for d (T, n) and w (T,).

    From [-1, 1], or the range of the basis, each end moves out by the present width until the levels enclose w. Then
    Newton steps follow; a step that leaves the bracket is replaced by bisection.

    Raises
    ------
    NotMonotoneError
        Names the first sample (counted from ``first``) at which the block does not increase within the bracket, or
        does not reach w within ``limit``.
    """
    d, w = np.asarray(d, dtype=float), np.asarray(w, dtype=float)
    low, high = _bracket(basis, d, w, limit, first)
    _check_rising(basis, d, low, high, first)
    y = 0.5 * (low + high)
    for _ in range(200):
        off = np.sum(d * basis.value(y), axis=1) - w
        low, high = np.where(off <= 0.0, y, low), np.where(off >= 0.0, y, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = y - off / np.sum(d * basis.derivative(y), axis=1)
        inside = (step >= low) & (step <= high)
        after = np.where(inside, step, 0.5 * (low + high))
        done = np.abs(after - y) <= 1e-14 * np.maximum(1.0, np.abs(y))
        y = after
        if done.all():
            break
    return y


def _bracket(basis: Basis, d: Array, w: Array, limit: float, first: int) -> tuple[Array, Array]:
    start = basis.expected if np.isfinite(basis.expected).all() else (-1.0, 1.0)
    low, high = (np.full(len(w), end) for end in start)
    bottom, top = np.maximum(basis.limits, -limit)[0], np.minimum(basis.limits, limit)[1]
    while True:
        with np.errstate(invalid="ignore", over="ignore"):
            below = np.sum(d * basis.value(low), axis=1) > w
            above = np.sum(d * basis.value(high), axis=1) < w
        lost = (below & (low <= bottom)) | (above & (high >= top)) | ~np.isfinite(w)
        if lost.any():
            t = int(np.argmax(lost))
            raise NotMonotoneError(
                f"sample {first + t}: the output block does not reach w = {w[t]:g} for any y within "
                f"({bottom:g}, {top:g})."
            )
        if not (below | above).any():
            return low, high
        width = high - low
        low = np.where(below, np.maximum(low - width, bottom), low)
        high = np.where(above, np.minimum(high + width, top), high)


def _check_rising(basis: Basis, d: Array, low: Array, high: Array, first: int) -> None:
    points = _suspects(basis, d, low, high)
    slopes = np.einsum("tgk,tk->tg", basis.derivative(points), d)
    bad = ~(slopes > 0.0)
    if bad.any():
        t = int(np.argmax(bad.any(axis=1)))
        where = points[t, bad[t]]
        raise NotMonotoneError(
            f"sample {first + t}: the output block does not increase between y = {where.min():g} and {where.max():g} "
            f"(d = {np.array2string(d[t], precision=4)}), so y cannot be recovered from w."
        )


def _suspects(basis: Basis, d: Array, low: Array, high: Array) -> Array:
    """Points (T, g) in the brackets; if the slope is 0 or less anywhere, it is so at one of them."""
    middle = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, 3 if isinstance(basis, Polynomial) else GRID)
    if not isinstance(basis, Polynomial) or basis.degree < 2:
        return middle
    k = basis.degree - 1  # the slope of a polynomial changes sign at its roots: test between them, and at the extrema
    roots = [np.roots((np.arange(1, k + 2) * row)[::-1]) for row in d] if k > 2 else _roots(d)
    found = np.full((len(d), 3 * k), np.nan)
    for t, row in enumerate(roots):
        real = np.sort(row.real[np.abs(row.imag) <= 1e-9 * np.maximum(1.0, np.abs(row))])
        ends = np.concatenate([real, 0.5 * (real[1:] + real[:-1])])[: 3 * k]
        found[t, : len(ends)] = ends
    inside = (found >= low[:, None]) & (found <= high[:, None])
    return np.concatenate([middle, np.where(inside, found, middle[:, :1])], axis=1)


def _roots(d: Array) -> Array:
    """Roots (T, 2) of 1 + 2 d_2 y + 3 d_3 y^2."""
    full = np.concatenate([d, np.zeros((len(d), 3 - d.shape[1]))], axis=1).astype(complex)
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.sqrt(full[:, 1] ** 2 - 3.0 * full[:, 2])
        both = np.stack([-full[:, 1] - spread, -full[:, 1] + spread], axis=1) / (3.0 * full[:, 2:3])
        single = -0.5 / full[:, 1:2]
    roots: Array = np.where(full[:, 2:3] == 0.0, single, both)
    return np.where(np.isfinite(roots), roots, 1j)
