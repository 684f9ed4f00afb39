"""Where the parameters of the blocks of a Hammerstein-Wiener model stand in its regression.

    theta = [a_1 .. a_na, b_1 .. b_nb, d_2 .. d_q, b_1 c_2 .. b_nb c_2, b_1 c_3 .., a_1 d_2 .. a_na d_2, .., (l)]
    xi    = [a_1 .. a_na, b_1 .. b_nb, c_2 .. c_p, d_2 .. d_q, (l)]
    theta = g(xi),  J = dg/dxi:   d(b_j c_k) = c_k db_j + b_j dc_k,   d(a_i d_k) = d_k da_i + a_i dd_k

with c_1 = d_1 = 1, p = n_in and q = n_out functions in the input and in the output block, and l the intercept. The lag
runs fastest. theta has n entries, xi the n_x that are free.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.kernel import Array


class Structure(NamedTuple):
    """Orders of a Hammerstein-Wiener model."""

    na: int
    nb: int
    n_in: int
    n_out: int
    intercept: bool = False

    @property
    def n(self) -> int:
        """Entries of theta."""
        na, nb, n_in, n_out, intercept = self
        return na + nb + n_out - 1 + nb * (n_in - 1) + na * (n_out - 1) + intercept

    @property
    def n_x(self) -> int:
        """Entries of xi."""
        na, nb, n_in, n_out, intercept = self
        return na + nb + n_in - 1 + n_out - 1 + intercept

    @property
    def starts(self) -> tuple[int, int, int]:
        """Where d, the products b c and the products a d begin in theta."""
        d = self.na + self.nb
        bc = d + self.n_out - 1
        return d, bc, bc + self.nb * (self.n_in - 1)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries of theta."""
        na, nb, n_in, n_out, intercept = self
        a, b = [f"a{i + 1}" for i in range(na)], [f"b{j + 1}" for j in range(nb)]
        d = [f"d{k}" for k in range(2, n_out + 1)]
        bc = [f"{name}*c{k}" for k in range(2, n_in + 1) for name in b]
        ad = [f"{name}*{last}" for last in d for name in a]
        return (*a, *b, *d, *bc, *ad, *(("intercept",) if intercept else ()))

    @property
    def minimal_names(self) -> tuple[str, ...]:
        """Names of the entries of xi."""
        na, nb, n_in, n_out, intercept = self
        groups = (("a", 1, na), ("b", 1, nb), ("c", 2, n_in), ("d", 2, n_out))
        named = [f"{name}{k}" for name, first, last in groups for k in range(first, last + 1)]
        return (*named, *(("intercept",) if intercept else ()))

    def minimal(self, a: Array, b: Array, c: Array, d: Array, intercept: Array | None = None) -> Array:
        """xi (..., n_x) from the groups, c and d with their first entry 1."""
        parts = [a, b, c[..., 1:], d[..., 1:]] + ([] if intercept is None else [intercept[..., None]])
        return np.concatenate(parts, axis=-1)

    def groups(self, xi: Array) -> tuple[Array, Array, Array, Array]:
        """a, b, c, d from xi (..., n_x), c and d with their first entry 1."""
        at = np.cumsum([self.na, self.nb, self.n_in - 1, self.n_out - 1])
        a, b, c, d, _ = np.split(xi, at, axis=-1)
        one = np.ones((*xi.shape[:-1], 1))
        return a, b, np.concatenate([one, c], axis=-1), np.concatenate([one, d], axis=-1)

    def products(self, xi: Array) -> Array:
        """theta = g(xi), (..., n)."""
        a, b, c, d = self.groups(xi)
        bc = (c[..., 1:, None] * b[..., None, :]).reshape(*xi.shape[:-1], -1)
        ad = (d[..., 1:, None] * a[..., None, :]).reshape(*xi.shape[:-1], -1)
        rest = xi[..., self.n_x - 1 :] if self.intercept else xi[..., :0]
        return np.concatenate([a, b, d[..., 1:], bc, ad, rest], axis=-1)

    def jacobian(self, xi: Array) -> Array:
        """J (..., n, n_x)."""
        na, nb, n_in, n_out, _ = self
        a, b, c, d = self.groups(xi)
        at_d, at_bc, at_ad = self.starts
        x_c, x_d = na + nb, na + nb + n_in - 1
        J = np.zeros((*xi.shape[:-1], self.n, self.n_x))
        for i in range(na + nb):
            J[..., i, i] = 1.0
        for k in range(n_out - 1):
            J[..., at_d + k, x_d + k] = 1.0
            for i in range(na):
                row = at_ad + k * na + i
                J[..., row, i] = d[..., k + 1]
                J[..., row, x_d + k] = a[..., i]
        for k in range(n_in - 1):
            for j in range(nb):
                row = at_bc + k * nb + j
                J[..., row, na + j] = c[..., k + 1]
                J[..., row, x_c + k] = b[..., j]
        if self.intercept:
            J[..., -1, -1] = 1.0
        return J
