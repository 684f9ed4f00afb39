"""Stage two: a, b, c, d from the products theta of stage one, for a whole path at once.

    [b, BC] (nb, n_in) = b c'        [a, AD] (na, n_out) = a (1, d_2 ..)'

    "average"    c_k = mean_j BC_jk / b_j,   b_j = (b_j + sum_k BC_jk / c_k) / n_in,   a and d taken from theta
    "svd"        the nearest matrices of rank one: c = v_1, b = sigma_1 u_1; d = w_1 / w_1[0], a = tau_1 t_1 w_1[0]
    "svd-joint"  b, c as "svd"; a, d the nearest array of rank one to [[1, d], [a, AD]] whose corner is 1, by
                 alternating least squares: a = (a0 + AD d) / (1 + d'd), d = (d0 + AD' a) / (1 + a'a)

The scale of c is that of a singular vector, |c| = 1, with the sign of rising curves, r'c > 0 (`Basis.rise`): no
coefficient needs to be different from zero. If r = 0 it is c_1 = 1. The regression is written with d_1 = 1.

Divisors below 1e-12 are replaced by 1e-12. "average" is cheap and has large spikes whenever a b_j or c_k passes through
zero; the guard prevents the division by zero, not the spike. All methods agree on exact products.

Singular vectors come from one-sided Jacobi rotations on the smaller side: they have high relative accuracy without the
squares of a Gram matrix, and need no library. Source: Feng and Hong (2021), eq. 21 to 27; Bai (1998); Hestenes (1958).
Departures: (21) needs a definition of c; the paper swaps left and right vectors and gives no gauge. Cost per sample:
O(nb n_in^2 + na n_out^2).
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array, Driver, shared

METHODS = ("average", "svd", "svd-joint", "gls")
LEAST = 1e-12
ROUNDS = 200
"""Largest number of iterations of the alternating least squares."""
SWEEPS = 30


@shared
def guard(x: float) -> float:
    """x, or the nearest number by which one can divide."""
    if abs(x) >= LEAST:
        return x
    return LEAST if x >= 0.0 else -LEAST


@shared
def orthogonal(W: Array) -> None:
    """Rotate pairs of rows until all are orthogonal; their lengths are then the singular values."""
    k, length = W.shape
    for _ in range(SWEEPS):
        turned = False
        for i in range(k - 1):
            for j in range(i + 1, k):
                first, second, mixed = 0.0, 0.0, 0.0
                for x in range(length):
                    first += W[i, x] * W[i, x]
                    second += W[j, x] * W[j, x]
                    mixed += W[i, x] * W[j, x]
                if abs(mixed) > 1e-15 * np.sqrt(first * second):
                    turned = True
                    zeta = (second - first) / (2.0 * mixed)
                    t = 1.0 / (abs(zeta) + np.sqrt(1.0 + zeta * zeta))
                    t = t if zeta >= 0.0 else -t
                    cosine = 1.0 / np.sqrt(1.0 + t * t)
                    sine = cosine * t
                    for x in range(length):
                        one, other = W[i, x], W[j, x]
                        W[i, x] = cosine * one - sine * other
                        W[j, x] = sine * one + cosine * other
        if not turned:
            break


@shared
def rank_one(M: Array, W: Array, left: Array, right: Array) -> float:
    """M (m, p) nearly left (m,) times right (p,) with |right| = 1; W is scratch. Returns sigma_2 / sigma_1."""
    m, p = M.shape
    by_rows = m <= p
    k, length = (m, p) if by_rows else (p, m)
    # one-sided Jacobi on the shorter side: rows become orthogonal, their lengths the singular values
    for i in range(k):
        for x in range(length):
            W[i, x] = M[i, x] if by_rows else M[x, i]
    orthogonal(W[:k, :length])
    # the two largest singular values
    best, top, second = 0, -1.0, 0.0
    for i in range(k):
        square = 0.0
        for x in range(length):
            square += W[i, x] * W[i, x]
        if square > top:
            best, top, second = i, square, max(top, 0.0)
        else:
            second = max(second, square)
    if not top > 0.0:
        right[:] = 0.0
        right[0] = 1.0
        left[:] = 0.0
        return 0.0 if top == 0.0 else np.nan
    sigma = np.sqrt(top)
    # the right singular vector of unit length, and left = M right
    for i in range(p):
        total = 0.0
        if by_rows:
            total = W[best, i]
        else:
            for x in range(m):
                total += M[x, i] * W[best, x] / sigma
        right[i] = total / sigma
    for x in range(m):
        total = 0.0
        for i in range(p):
            total += M[x, i] * right[i]
        left[x] = total
    return float(np.sqrt(second / top))


@shared
def headed(left: Array, right: Array) -> None:
    """The same product with right[0] = 1."""
    head = right[0]
    for x in range(left.shape[0]):
        left[x] = left[x] * head
    for i in range(right.shape[0]):
        right[i] = right[i] / guard(head)
    right[0] = 1.0


@shared
def normed(rise: Array, left: Array, right: Array) -> None:
    """The same product with |right| = 1 and rise'right >= 0, or with right[0] = 1 where rise is 0."""
    size, up, some = 0.0, 0.0, False
    for i in range(right.shape[0]):
        size += right[i] * right[i]
        up += rise[i] * right[i]
        some = some or rise[i] != 0.0
    if not some:
        headed(left, right)
        return
    scale = np.sqrt(size) if up >= 0.0 else -np.sqrt(size)
    for x in range(left.shape[0]):
        left[x] = left[x] * scale
    for i in range(right.shape[0]):
        right[i] = right[i] / scale


@shared
def average(M: Array, left: Array, right: Array) -> None:
    """The means of the quotients."""
    m, p = M.shape
    right[0] = 1.0
    for k in range(1, p):
        total = 0.0
        for j in range(m):
            total += M[j, k] / guard(M[j, 0])
        right[k] = total / m
    for j in range(m):
        total = M[j, 0]
        for k in range(1, p):
            total += M[j, k] / guard(right[k])
        left[j] = total / p


@shared
def joint(M: Array, d0: Array, a: Array, d: Array) -> None:
    """Alternating least squares on [[1, d], [a, AD]] from a; M = [a, AD], d0 and d have their leading 1."""
    r, q = M.shape
    for k in range(q):
        d[k] = d0[k]
    for _ in range(ROUNDS):
        moved = 0.0
        size = 0.0
        for k in range(q):
            size += d[k] * d[k]
        for i in range(r):
            total = 0.0
            for k in range(q):
                total += M[i, k] * d[k]
            moved = max(moved, abs(total / size - a[i]))
            a[i] = total / size
        size = 1.0
        for i in range(r):
            size += a[i] * a[i]
        for k in range(1, q):
            total = d0[k]
            for i in range(r):
                total += M[i, k] * a[i]
            moved = max(moved, abs(total / size - d[k]))
            d[k] = total / size
        if moved < LEAST:
            break


@shared
def copy(source: Array, to: Array) -> None:
    """The numbers of one vector into another."""
    for i in range(to.shape[0]):
        to[i] = source[i]


@shared
def separate_input(
    theta: Array, starts: tuple[int, int], method: int, rise: Array, b: Array, c: Array, worst: Array, work: Array
) -> None:
    """b (T, nb) and c (T, n_in) of an input, whose b and products begin at ``starts``; ``worst`` takes the quality."""
    at_b, at_bc = starts
    nb, n_in = b.shape[1], c.shape[1]
    B, W = work[0, :nb, :n_in], work[1]
    for t in range(theta.shape[0]):
        row = theta[t]
        for j in range(nb):
            B[j, 0] = row[at_b + j]
            for k in range(1, n_in):
                B[j, k] = row[at_bc + (k - 1) * nb + j]
        quality = np.nan
        if method == 0:
            average(B, b[t], c[t])
        else:
            quality = rank_one(B, W, b[t], c[t])
        normed(rise, b[t], c[t])
        if not quality <= worst[t]:
            worst[t] = quality


@shared
def separate_output(
    theta: Array, starts: tuple[int, int], method: int, a: Array, d: Array, quality: Array, work: Array
) -> None:
    """a (T, na) and d (T, n_out), the free of which, and whose products, begin at ``starts``; and the quality (T,)."""
    at_d, at_ad = starts
    na, n_out = a.shape[1], d.shape[1]
    A, W, d0, read = work[0, :na, :n_out], work[1], work[2, 0, :n_out], work[3, 0, :n_out]
    d0[0] = 1.0
    for t in range(theta.shape[0]):
        row = theta[t]
        for i in range(na):
            A[i, 0] = row[i]
            for k in range(1, n_out):
                A[i, k] = row[at_ad + (k - 1) * na + i]
        for k in range(1, n_out):
            d0[k] = row[at_d + k - 1]
        quality[t] = 0.0
        copy(d0, d[t])
        if method == 0:
            copy(A[:, 0], a[t])
            quality[t] = np.nan
        elif na > 0:
            quality[t] = rank_one(A, W, a[t], read)
            headed(a[t], read)
            if method == 1:
                copy(read, d[t])
            else:
                joint(A, d0, a[t], d[t])


@Driver
def separate(
    theta: Array, orders: tuple[int, int, int], sizes: Array, rise: Array, groups: Array, quality: Array
) -> None:
    """Fill ``groups``, a, b, c and d side by side, (T, na + sum nb + sum n_in + n_out), and quality (T, 2).

    theta is (T, n), ``orders`` are na, n_out and the place of the method in METHODS, ``sizes`` (2, inputs) nb and n_in
    of the inputs; quality is sigma_2 / sigma_1 of [b, BC], the largest of all inputs, and of [a, AD]; NaN for
    "average".
    """
    na, n_out, method = orders
    at_d, most = na, max(na, n_out)
    for i in range(sizes.shape[1]):
        at_d, most = at_d + sizes[0, i], max(most, sizes[0, i], sizes[1, i])
    a, b = groups[:, :na], groups[:, na:at_d]
    c, d = groups[:, at_d : groups.shape[1] - n_out], groups[:, groups.shape[1] - n_out :]
    at_b, at_c, at_bc = 0, 0, at_d + n_out - 1
    quality[:, 0] = 0.0
    work = np.empty((4, most, most))
    for i in range(sizes.shape[1]):
        nb, n_in = sizes[0, i], sizes[1, i]
        own_b, own_c = b[:, at_b : at_b + nb], c[:, at_c : at_c + n_in]
        separate_input(theta, (na + at_b, at_bc), method, rise[at_c : at_c + n_in], own_b, own_c, quality[:, 0], work)
        at_b, at_c, at_bc = at_b + nb, at_c + n_in, at_bc + nb * (n_in - 1)
    separate_output(theta, (at_d, at_bc), method, a, d, quality[:, 1], work)
