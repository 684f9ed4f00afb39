"""Covariances of leaves as factors, C = U D U': U an upper triangle with ones on its diagonal, D diagonal and never
negative. So z'C z is a sum of squares, sum_j D_j (U'z)_j^2, and no rounding makes it negative.

    add     C + c v v' with c >= 0, for j = n - 1 .. 0:
                p = v_j,   d = D_j + c p^2,   beta = c p / d,   gamma = D_j / d
                v_i <- v_i - p U_ij,   U_ij <- gamma U_ij + beta v_i (as it was),   c <- gamma c,   D_j <- d
    absorb  a measurement by z with noise a: f = U'z, and for j = 0 .. n - 1:
                v = D_j f_j,   a' = a + f_j v,   p = f_j / a,   D_j <- D_j a / a',   a <- a'
                U_ij <- U_ij - b_i p,   b_i <- b_i + U_ij (as it was) v,   b_j = v
            after which a = z'C z + noise, and the gain is b / a
    condense  sum_k d_k w_k w_k' with d_k >= 0, by weighted Gram-Schmidt on the rows of W

A leaf stores D_j in the place of C_jj, and U_ij in the place of C_ji = C_ij, i < j. Leaves are processed in SIMD
vectors of eight, which are rows of narrow matrices, eight numbers wide, from column 0.

Source: Bierman (1977), chapters 5 and 6 (Agee and Turner 1972; Thornton 1976 for Gram-Schmidt); the order of operations
in `add` after Fletcher and Powell (1974), which keeps digits where c p^2 is much larger than D_j. Cost: O(n^2) for the
first two, O(n^2) per vector for the third.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, kernel, shared
from driftfit.engine.simd import WIDTH, fill, load, minus, over, plus, reaches, store, sum_of, times
from driftfit.trackers.bank.leaves.leaf_matrix import FIRST

LEAST_PIVOT = 4.0 * np.finfo(float).eps
"""A pivot below n times this share of its variance is rounding."""


@kernel
def add(C: Array, n: int, l: int, V: Array, c: Any) -> None:
    """C + c v v' in the columns from l; v are the first n rows of V, which are overwritten; c is a SIMD vector."""
    for j in range(n - 1, -1, -1):
        at = j * (j + 1) // 2
        p, was = load(V, j, 0), load(C, at + j, l)
        pull = times(c, p)
        d = plus(was, times(pull, p))
        none = reaches(fill(0.0), d)  # where both are zero nothing changes
        divisor = plus(d, none)
        beta, gamma = over(pull, divisor), plus(over(was, divisor), none)
        store(C, at + j, l, d)
        for i in range(j):
            u, v = load(C, at + i, l), load(V, i, 0)
            store(V, i, 0, minus(v, times(p, u)))
            store(C, at + i, l, plus(times(gamma, u), times(beta, v)))
        c = times(c, gamma)


@kernel
def raised(C: Array, n: int, l: int, q: Array, share: Any, V: Array) -> None:
    """C + share Q in the columns from l; q is the factor of Q, share a SIMD vector, V has n narrow rows."""
    for k in range(n):
        at = k * (k + 1) // 2
        if q[at + k] > 0.0:
            for i in range(k):
                store(V, i, 0, fill(q[at + i]))
            store(V, k, 0, fill(1.0))
            add(C, k + 1, l, V, times(share, fill(q[at + k])))


@kernel
def along(C: Array, n: int, l: int, Z: Array, zl: int, F: Array, fl: int) -> Any:
    """f = U'z; returns z'C z, a SIMD vector."""
    h, at = fill(0.0), 0
    for j in range(n):
        f = load(Z, j, zl)
        for i in range(j):
            f = plus(f, times(load(C, at + i, l), load(Z, i, zl)))
        store(F, j, fl, f)
        h = plus(h, times(f, times(load(C, at + j, l), f)))
        at += j + 1
    return h


@kernel
def absorb(C: Array, l: int, n: int, b: Array, a: Any, B: Array, to: int) -> Any:
    """Measurement update from C, column l, to B, column ``to``; the n narrow rows of b hold f = U'z and receive the
    gain times a. Returns a, a SIMD vector; B may be C.
    """
    at = 0
    for j in range(n):
        f, d = load(b, j, 0), load(C, at + j, l)
        v, p = times(d, f), over(f, a)
        more = plus(a, times(f, v))
        for i in range(j):
            u, gain = load(C, at + i, l), load(b, i, 0)
            store(B, at + i, to, minus(u, times(gain, p)))
            store(b, i, 0, plus(gain, times(u, v)))
        store(b, j, 0, v)
        store(B, at + j, to, times(d, over(a, more)))
        a = more
        at += j + 1
    return a


@shared
def condense(W: Array, count: int, n: int, A: Array, to: int) -> None:
    """The factor of sum_k d_k w_k w_k' into column ``to`` of A: the w_k are columns of the first n rows of W, the d_k
    its row n; row n + 1 is spare, and there is room up to the end of a SIMD vector.
    """
    for row in range(n + 1):
        for k in range(count, -(-count // WIDTH) * WIDTH):
            W[row, k] = 0.0
    for j in range(n - 1, -1, -1):
        at, squares = FIRST + n + j * (j + 1) // 2, fill(0.0)
        for k in range(0, count, WIDTH):
            weighed = times(load(W, n, k), load(W, j, k))
            store(W, n + 1, k, weighed)
            squares = plus(squares, times(weighed, load(W, j, k)))
        d = sum_of(squares)
        A[at + j, to] = d
        for i in range(j):
            sums = fill(0.0)
            for k in range(0, count, WIDTH):
                sums = plus(sums, times(load(W, n + 1, k), load(W, i, k)))
            u = sum_of(sums) / d if d > 0.0 else 0.0
            A[at + i, to] = u
            for k in range(0, count, WIDTH):
                store(W, i, k, minus(load(W, i, k), times(fill(u), load(W, j, k))))


@shared
def factorise(C: Array, n: int, least: float) -> None:
    """A positive semi-definite lower triangle (tri,) becomes its factor, in place.

    A pivot that is only rounding becomes ``least`` times the size of rounding: 0 states that nothing is uncertain
    there, 1 that it is unknown.
    """
    for j in range(n - 1, -1, -1):
        at = j * (j + 1) // 2
        whole = C[at + j]
        for k in range(j + 1, n):
            later = k * (k + 1) // 2
            whole += C[later + k] * C[later + j] * C[later + j]
        rounding = LEAST_PIVOT * n * whole
        sound = C[at + j] > rounding
        if not sound:
            C[at + j] = max(least * rounding, 0.0)
        for i in range(j):
            u = C[at + i] / C[at + j] if sound else 0.0
            for k in range(i + 1):
                C[i * (i + 1) // 2 + k] -= u * C[at + k]
        for i in range(j):
            C[at + i] = C[at + i] / C[at + j] if sound else 0.0


def product(factor: Array, n: int) -> Array:
    """Covariances (L, n, n) of factors (tri, L)."""
    U = np.zeros((factor.shape[1], n, n))
    column, row = np.tril_indices(n)
    U[:, row, column] = factor.T
    D = np.einsum("lii->li", U).copy()
    np.einsum("lii->li", U)[:] = 1.0
    return np.asarray((U * D[:, None, :]) @ U.transpose(0, 2, 1))


def widened(factor: Array, p: Array) -> None:
    """Add variances p (n, L) to the covariances of factors (tri, L), in place: `add` for unit vectors."""
    n = len(p)
    for k in range(n):
        v, c = np.zeros_like(p), p[k]
        v[k] = 1.0
        for j in range(k, -1, -1):
            at = j * (j + 1) // 2
            was, one = factor[at + j].copy(), v[j].copy()
            d = was + c * one * one
            divisor = np.where(d > 0.0, d, 1.0)
            beta, gamma = c * one / divisor, np.where(d > 0.0, was / divisor, 1.0)
            U = factor[at : at + j].copy()
            factor[at : at + j] = gamma * U + beta * v[:j]
            v[:j] -= one * U
            factor[at + j], c = d, gamma * c
