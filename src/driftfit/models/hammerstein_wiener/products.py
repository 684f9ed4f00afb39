"""The positions of the block parameters of a Hammerstein-Wiener model in its regression.

    theta = [a_1 .. a_na, b_1 .. b_nb, d_2 .. d_q, b_1 c_2 .. b_nb c_2, b_1 c_3 .., a_1 d_2 .. a_na d_2, .., (l)]
    xi    = [a_1 .. a_na, b_1 .. b_nb, c_2 .. c_p, d_2 .. d_q, (l)]
    theta = g(xi),  J = dg/dxi:   d(b_j c_k) = c_k db_j + b_j dc_k,   d(a_i d_k) = d_k da_i + a_i dd_k

with c_1 = d_1 = 1, p = n_in and q = n_out functions in the input and in the output block, and l the intercept. The lag
is the fastest index. With several inputs each has its own nb and n_in, and b, c and the products b c are those of the
first input, then those of the second, and so on. theta has n entries, xi the n_x free ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array


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
    def sizes(self) -> Array:
        """nb and n_in of each input, (2, inputs), for compiled functions."""
        return np.array([self.nb, self.n_in], dtype=np.int64)

    @property
    def tags(self) -> tuple[str, ...]:
        """The labels that distinguish the coefficients of several inputs in their names."""
        return tuple(f"[u{i + 1}]" for i in range(len(self.nb))) if len(self.nb) > 1 else ("",)

    def lags(self, tag: int) -> list[str]:
        """Names of the b of an input."""
        return [f"b{j + 1}{self.tags[tag]}" for j in range(self.nb[tag])]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries of theta."""
        a = [f"A{i + 1}" for i in range(self.na)]
        b = [name for i in range(len(self.nb)) for name in self.lags(i)]
        d = [f"d{k}" for k in range(2, self.n_out + 1)]
        bc = [f"{name}*c{k}" for i, n_in in enumerate(self.n_in) for k in range(2, n_in + 1) for name in self.lags(i)]
        ad = [f"{name}*{last}" for last in d for name in a]
        return (*a, *b, *d, *bc, *ad, *(("intercept",) if self.intercept else ()))

    @property
    def groups_names(self) -> tuple[tuple[str, ...], ...]:
        """Names of a, b, c and d, the leading coefficients of the curves among them."""
        return (
            tuple(f"A{i + 1}" for i in range(self.na)),
            tuple(name for i in range(len(self.nb)) for name in self.lags(i)),
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

    @property
    def alone(self) -> Array:
        """(entry of theta, entry of xi) of the parameters that appear in theta alone, (k, 2)."""
        at_d, at_l = self.starts[0], self.n - 1
        x_d = self.n_x - self.intercept - self.n_out + 1
        d = [(at_d + k, x_d + k) for k in range(self.n_out - 1)]
        return np.array([*((i, i) for i in range(at_d)), *d, *([(at_l, self.n_x - 1)] if self.intercept else [])])

    @property
    def pairs(self) -> Array:
        """(entry of theta, entry of xi, entry of xi) of the products b c and a d, (k, 3)."""
        at_d, row, _ = self.starts
        at_b, x_c, found = self.na, at_d, []
        for nb, n_in in zip(self.nb, self.n_in, strict=True):
            found += [(row + k * nb + j, at_b + j, x_c + k) for k in range(n_in - 1) for j in range(nb)]
            at_b, x_c, row = at_b + nb, x_c + n_in - 1, row + nb * (n_in - 1)
        found += [(row + k * self.na + i, i, x_c + k) for k in range(self.n_out - 1) for i in range(self.na)]
        return np.array(found, dtype=np.int64).reshape(-1, 3)

    def products(self, xi: Array) -> Array:
        """theta = g(xi), (..., n)."""
        theta = np.empty((*xi.shape[:-1], self.n))
        (rows, entries), (products, first, second) = self.alone.T, self.pairs.T
        theta[..., rows] = xi[..., entries]
        theta[..., products] = xi[..., first] * xi[..., second]
        return theta

    def jacobian(self, xi: Array) -> Array:
        """J (..., n, n_x)."""
        J = np.zeros((*xi.shape[:-1], self.n, self.n_x))
        (rows, entries), (products, first, second) = self.alone.T, self.pairs.T
        J[..., rows, entries] = 1.0
        J[..., products, first] = xi[..., second]
        J[..., products, second] = xi[..., first]
        return J
