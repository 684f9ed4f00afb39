"""The positions of the parameters of a Hammerstein-Wiener model in its regression, and of numbers in its memory.

    theta = [a_1 .. a_na, b_1 .. b_nb, d_2 .. d_q, b_1 c_2 .. b_nb c_2, b_1 c_3 .., a_1 d_2 .. a_na d_2, .., (l)]
    xi    = [a_1 .. a_na, b_1 .. b_nb, c_2 .. c_p, d_2 .. d_q, (l)]
    theta = g(xi),  J = dg/dxi:   d(b_j c_k) = c_k db_j + b_j dc_k,   d(a_i d_k) = d_k da_i + a_i dd_k

with c_1 = d_1 = 1, p = n_in and q = n_out functions in the input and in the output block, and l the intercept. The lag
is the fastest index. With several inputs each has its own nb and n_in, and b, c and the products b c are those of the
first input, then those of the second, and so on. theta has n entries, xi the n_x free ones.

The memory of the compiled steps is one field ``blocks`` (size, L) of numbers and arrays one after the other. Their
routines are given the address of ``blocks`` for one lane, in which element i is stored L numbers after element i - 1.
The positions, `places_of`, are constants of these routines, so that their loops can be unrolled.

    now, next (n)             regressors of this sample except those of its output, and of the next
    f_past  (nb + nk, n_in)   functions of the inputs t, t - 1, .., of a dead zone with the thresholds known then;
                              one array after the other where there are several inputs
    g_past  (1 + na, n_out)   functions of the outputs t, t - 1, ..; their slopes in h_past
    d_now   (n_out)           coefficients (1, d_2 ..) before the sample
    trial, trial_bend         functions and slopes at a trial y; spare, slopes that are not used
    into, out                 the numbers of the bases, those of all inputs first
    curve (n_out, GRID)       functions of the output block on the grid; bend, their slopes
    level (GRID)              an envelope of the levels
    d_checked, reach (n_out)  coefficients for which the grid increases, and the safe distance from them
    us (inputs)               the inputs of this sample
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.models.hammerstein_wiener.basis import Basis, Polynomial


class Spans(NamedTuple):
    """The positions of a, b of each input, c of each input, d and the intercept among coefficients."""

    a: Array
    b: list[Array]
    c: list[Array]
    d: Array
    rest: Array


class Structure(NamedTuple):
    """Orders of a Hammerstein-Wiener model; ``nb`` and ``n_in`` have an entry for each input."""

    na: int
    nb: tuple[int, ...]
    n_in: tuple[int, ...]
    n_out: int
    intercept: bool = False

    @property
    def products_in(self) -> int:
        """The number of products b c."""
        return sum(nb * (n_in - 1) for nb, n_in in zip(self.nb, self.n_in, strict=True))

    @property
    def n(self) -> int:
        """Entries of theta."""
        more = self.n_out - 1
        return self.na + sum(self.nb) + more + self.products_in + self.na * more + self.intercept

    @property
    def n_x(self) -> int:
        """Entries of xi."""
        return self.na + sum(self.nb) + sum(self.n_in) - len(self.n_in) + self.n_out - 1 + self.intercept

    @property
    def starts(self) -> tuple[int, int, int]:
        """The positions of d, the products b c and the products a d in theta."""
        d = self.na + sum(self.nb)
        bc = d + self.n_out - 1
        return d, bc, bc + self.products_in

    @property
    def tags(self) -> tuple[str, ...]:
        """The labels that distinguish the coefficients of several inputs in their names."""
        return tuple(f"[u{i + 1}]" for i in range(len(self.nb))) if len(self.nb) > 1 else ("",)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries of theta."""
        a, b, _, (_, *d) = self.groups_names
        lags = [b[end - nb : end] for nb, end in zip(self.nb, np.cumsum(self.nb).tolist(), strict=True)]
        bc = [
            f"{name}*c{k}"
            for own, n_in in zip(lags, self.n_in, strict=True)
            for k in range(2, n_in + 1)
            for name in own
        ]
        ad = [f"{name}*{last}" for last in d for name in a]
        return (*a, *b, *d, *bc, *ad, *(("intercept",) if self.intercept else ()))

    @property
    def groups_names(self) -> tuple[tuple[str, ...], ...]:
        """Names of a, b, c and d, the leading coefficients of the curves among them."""
        return (
            tuple(f"A{i + 1}" for i in range(self.na)),
            tuple(f"b{j + 1}{tag}" for tag, nb in zip(self.tags, self.nb, strict=True) for j in range(nb)),
            tuple(f"c{k + 1}{tag}" for tag, n_in in zip(self.tags, self.n_in, strict=True) for k in range(n_in)),
            tuple(f"d{k + 1}" for k in range(self.n_out)),
        )

    @property
    def leads(self) -> Array:
        """The position of the first coefficient of each input in c."""
        return np.cumsum([0, *self.n_in[:-1]])

    @property
    def minimal_names(self) -> tuple[str, ...]:
        """Names of the entries of xi."""
        a, b, c, d = self.groups_names
        free = np.delete(np.array(c), self.leads).tolist()
        return (*a, *b, *free, *d[1:], *(("intercept",) if self.intercept else ()))

    def of_inputs(self, group: Array, counts: tuple[int, ...]) -> list[Array]:
        """b, or c, of each input, from all of them (..., sum of counts)."""
        return np.split(group, np.cumsum(counts)[:-1], axis=-1)

    def minimal(self, a: Array, b: Array, c: Array, d: Array, intercept: Array | None = None) -> Array:
        """xi (..., n_x) from the groups, c and d with their first entries 1."""
        free = np.delete(c, self.leads, axis=-1)
        return np.concatenate([a, b, free, d[..., 1:], *([] if intercept is None else [intercept[..., None]])], axis=-1)

    def groups(self, xi: Array) -> tuple[Array, Array, Array, Array]:
        """a, b, c, d from xi (..., n_x), c and d with their first entries 1."""
        more = sum(self.n_in) - len(self.n_in)
        a, b, c, d, _ = np.split(xi, np.cumsum([self.na, sum(self.nb), more, self.n_out - 1]), axis=-1)
        c = np.insert(c, self.leads - np.arange(len(self.n_in)), 1.0, axis=-1)
        return a, b, c, np.insert(d, 0, 1.0, axis=-1)

    def products(self, x: Array) -> Array:
        """theta = g(xi), (..., n), from xi or from zeta, which also has each c_1."""
        (rows, entries), (products, first, second) = positions(self, x.shape[-1] != self.n_x)
        theta = np.empty((*x.shape[:-1], self.n))
        theta[..., rows] = x[..., entries]
        theta[..., products] = x[..., first] * x[..., second]
        return theta

    def jacobian(self, x: Array) -> Array:
        """The derivatives of `products`, (..., n, n_x)."""
        (rows, entries), (products, first, second) = positions(self, x.shape[-1] != self.n_x)
        J = np.zeros((*x.shape[:-1], self.n, x.shape[-1]))
        J[..., rows, entries] = 1.0
        J[..., products, first] = x[..., second]
        J[..., products, second] = x[..., first]
        return J

    def spans(self, free: bool, lead: bool = False) -> Spans:
        """Their positions in xi; in zeta if c_1 is ``free``, and among all coefficients if d_1 is one of them too."""
        m, c = len(self.nb), [n_in - 1 + free for n_in in self.n_in]
        ends = np.cumsum([0, self.na, *self.nb, *c, self.n_out - 1 + lead, self.intercept])
        a, *both, d, rest = (np.arange(first, last) for first, last in pairwise(ends))
        return Spans(a, both[:m], both[m:], d, rest)


@lru_cache
def positions(s: Structure, free: bool) -> tuple[Array, Array]:
    """(entry of theta, entry of xi) of the parameters that appear in theta alone, (2, k), and (entry of theta, entry of
    xi, entry of xi) of the products b c and a d, (3, k); for zeta in the place of xi if c_1 is ``free``.
    """
    (a, bs, cs, d, rest), (at_d, row, at_ad) = s.spans(free), s.starts
    alone = [(i, i) for i in (a if free else range(at_d))]
    alone += [(at_d + k, x) for k, x in enumerate(d)] + [(s.n - 1, x) for x in rest]
    pairs = [(j, j, c[0]) for b, c in zip(bs, cs, strict=True) for j in (b if free else ())]
    for b, c in zip(bs, cs, strict=True):
        pairs += [(row + k * len(b) + j, x, y) for k, y in enumerate(c[free:]) for j, x in enumerate(b)]
        row += len(b) * len(c[free:])
    pairs += [(at_ad + k * s.na + i, i, x) for k, x in enumerate(d) for i in a]
    return np.array(alone, np.int64).reshape(-1, 2).T, np.array(pairs, np.int64).reshape(-1, 3).T


GRID = 64
"""Points of the grid on which the output block is inverted."""
_Numbers = namedtuple(
    "_Numbers",
    "low step lowest highest bottom top rising predicted started minimal given raw variance moved late cell y dt "
    "believed ok factor floor scale count",
)
NUMBER = _Numbers(*range(24))
"""Numbers in the memory: the grid, the range of accepted outputs, where the output block is defined, whether its levels
increase, the prediction, whether all lags are known, whether theta is xi, the given noise factor, the output as given,
sigma^2 or 0, whether the range changed, whether a level is stored in place of the prediction, its cell of the grid,
what steps and compiled routine exchange, whether the output becomes a lag, whether the sample was used, the noise
factor of the equation, the least variance that sigma adds to it, and the scale of y that the basis gives.
"""
_Places = namedtuple(
    "_Places",
    "na nb n_out n nk identity adaptive d x_d ad now next f_past g_past h_past spare d_now trial trial_bend into out "
    "curve bend level d_checked reach us inputs count",
)
AT = _Places(*range(29))
"""Places: orders (nb of all inputs, nk the smallest), whether the output block is the identity and an input basis
depends on its own coefficients, where d begins in theta and in xi and the products a d in theta, where the arrays
begin, and how many inputs there are.
"""
_Inputs = namedtuple("_Inputs", "nb n_in nk f into end adaptive b c bc count")
INPUT = _Inputs(*range(11))
"""Places of each input, INPUT.count numbers from AT.count on: its orders, where its functions and the numbers of its
basis begin, where those end, whether the basis depends on its own coefficients, and where its b, its c in xi, and its
products begin.
"""

Places = Array
"""Whole numbers (28 + 10 per input,), a constant for the compiler."""


def room(p: Places | tuple[int, ...]) -> int:
    """Length of the memory of these places: the inputs are its last numbers."""
    return int(p[AT.us] + p[AT.inputs])


def _arrays(s: Structure, delays: Sequence[int], bases: Sequence[Basis], out: Basis) -> list[Array]:
    """The arrays before the first sample, in the order of AT."""
    lags = sum(width * (count + delay) for width, count, delay in zip(s.n_in, s.nb, delays, strict=True))
    outputs, grid, none = np.full((1 + max(s.na, 1)) * s.n_out, np.nan), np.zeros(GRID * s.n_out), np.zeros(s.n_out)
    return [
        np.full(s.n, np.nan), np.full(s.n, np.nan), np.full(lags, np.nan), outputs, outputs, np.zeros(max(s.n_in)),
        np.eye(1, s.n_out)[0], none, none, np.concatenate([basis.parameters for basis in bases]), out.parameters,
        grid, grid, np.zeros(GRID), none, np.full(s.n_out, np.inf), np.zeros(len(bases)),
    ]  # fmt: skip


def places_of(s: Structure, delays: Sequence[int], bases: Sequence[Basis], out: Basis) -> tuple[int, ...]:
    """The places of a model with these orders, delays, and functions of its inputs and of its output."""
    begins = np.cumsum([NUMBER.count, *(array.size for array in _arrays(s, delays, bases, out))])[:-1].tolist()
    adaptive = [int(basis.adaptive) for basis in bases]
    d, bc, ad = s.starts
    head = (s.na, sum(s.nb), s.n_out, s.n, min(delays), int(out == Polynomial(1)), max(adaptive))
    places = [*head, d, d + sum(s.n_in) - len(s.n_in), ad, *begins, len(bases)]
    f, into, b, c = places[AT.f_past], places[AT.into], s.na, d
    for i, basis in enumerate(bases):
        end = into + basis.parameters.size
        places += [s.nb[i], s.n_in[i], delays[i], f, into, end, adaptive[i], b, c, bc]
        f, into, b, c = f + s.n_in[i] * (s.nb[i] + delays[i]), end, b + s.nb[i], c + s.n_in[i] - 1
        bc += s.nb[i] * (s.n_in[i] - 1)
    return tuple(places)


def memory(
    s: Structure, delays: Sequence[int], bases: Sequence[Basis], out: Basis, sigma: float, floor: float
) -> Array:
    """``blocks`` before the first sample, for measurement noise of standard deviation sigma."""
    head = np.zeros(NUMBER.count)
    head[[NUMBER.lowest, NUMBER.highest, NUMBER.bottom, NUMBER.top]] = np.inf, -np.inf, *out.limits
    head[[NUMBER.rising, NUMBER.predicted]] = 1.0, np.nan
    head[[NUMBER.variance, NUMBER.floor, NUMBER.scale]] = sigma * sigma, floor, out.scale
    return np.concatenate([head, *_arrays(s, delays, bases, out)])
