"""The positions of the parameters of a Hammerstein-Wiener model in its regression.

    theta = [a_1 .. a_na, b_1 .. b_nb, d_2 .. d_q, b_1 c_2 .. b_nb c_2, b_1 c_3 .., a_1 d_2 .. a_na d_2, .., (l)]
    xi    = [a_1 .. a_na, b_1 .. b_nb, c_2 .. c_p, d_2 .. d_q, (l)]
    theta = g(xi),  J = dg/dxi:   d(b_j c_k) = c_k db_j + b_j dc_k,   d(a_i d_k) = d_k da_i + a_i dd_k

with c_1 = d_1 = 1, p = n_in and q = n_out functions in the input and in the output block, and l the intercept. The lag
is the fastest index. With several inputs each has its own nb and n_in, and b, c and the products b c are those of the
first input, then those of the second, and so on. theta has n entries, xi the n_x free ones.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array


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
