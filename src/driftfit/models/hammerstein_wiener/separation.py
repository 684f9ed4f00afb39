"""Stage two: a, b, c, d from the products theta of stage one, for a whole path at once.

    [b, BC] (nb, n_in) = b c'        [a, AD] (na, n_out) = a (1, d_2 ..)'

    "average"    c_k = mean_j BC_jk / b_j,   b_j = (b_j + sum_k BC_jk / c_k) / n_in,   a and d taken from theta
    "svd"        the nearest matrices of rank one: c = v_1, b = sigma_1 u_1; d = w_1 / w_1[0], a = tau_1 t_1 w_1[0]
    "svd-joint"  b, c as "svd"; a, d the nearest array of rank one to [[1, d], [a, AD]] whose corner is 1, by
                 alternating least squares: a = (a0 + AD d) / (1 + d'd), d = (d0 + AD' a) / (1 + a'a)
    "gls"        zeta = argmin (theta - g(zeta))' P^-1 (theta - g(zeta)),     |c| = 1 for each input
                 cov(zeta) = (J' P^-1 J)^-1 over the directions with c'dc = 0,     J = dg/dzeta

The scale of c is that of a singular vector, |c| = 1, with the sign of rising curves, r'c > 0 (`Basis.rise`): no
coefficient needs to be different from zero. If r = 0 it is c_1 = 1. The regression is written with d_1 = 1. All methods
agree on exact products. "average" is cheap and has large spikes whenever a b_j or c_k passes through zero; its divisors
are at least 1e-12, which prevents the division by zero, not the spike.

"gls" takes Levenberg-Marquardt steps from "svd-joint" in zeta = (a, b, c, d_2 .., l). All of c is free, which keeps the
problem well posed for c_1 = 0. Its standard deviations are those of the delta method under the filter's own P, and only
as good as q and r. The eigenvalues of P, scaled to a unit diagonal, are taken to be at least 1e-13: after a prior of
1e8 computed ones are negative in every form that is not a square root.

Source: Feng and Hong (2021), eq. 21 to 27; Bai (1998); Levenberg (1944). Departures: (21) needs a definition of c; the
paper swaps left and right vectors and gives no gauge. Cost per sample: O(nb n_in^2 + na n_out^2); of "gls" O(n^3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.structure import Structure

METHODS = ("average", "svd", "svd-joint", "gls")
SMALLEST_DIVISOR = 1e-12
ALTERNATIONS = 200
"""Largest number of iterations of the alternating least squares."""
STILL = 1e-12
"""The iterations end where nothing changes by more."""
LEVENBERG_STEPS = 30
"""Largest number of steps; three to ten are typical."""
SMALLEST_EIGENVALUE = 1e-13
RIDGE = 1e-15
"""Added to a unit diagonal, so that no matrix is exactly singular."""


class Groups(NamedTuple):
    """a (.., na), b (.., nb), c (.., n_in), d (.., n_out)."""

    a: Array
    b: Array
    c: Array
    d: Array


def split(model: HammersteinWiener, theta: Array, method: str) -> tuple[Array, Array, Array, Array, Array]:
    """a, b, c, d and quality from theta (T, n) by one of the first three methods; gauge "unit" and "d1".

    The quality (T, 2) is sigma_2 / sigma_1 of [b, BC], the largest of all inputs, and of [a, AD]; NaN for "average".
    """
    s, T, b, c = model.structure, len(theta), [], []
    worst = np.zeros(T)
    at_b, (at_d, at_bc, at_ad), rises = s.na, s.starts, s.of_inputs(model.rise, s.n_in)
    for nb, n_in, rise in zip(s.nb, s.n_in, rises, strict=True):
        B = _matrix(theta, at_b, at_bc, nb, n_in)
        left, right, quality = _average(B) if method == "average" else _rank_one(B)
        left, right = _rising(rise, left, right)
        b.append(left)
        c.append(right)
        worst = np.maximum(worst, quality)
        at_b, at_bc = at_b + nb, at_bc + nb * (n_in - 1)
    A = _matrix(theta, 0, at_ad, s.na, s.n_out)
    d = np.concatenate([np.ones((T, 1)), theta[:, at_d : at_d + s.n_out - 1]], axis=1)
    a, other = A[:, :, 0], np.full(T, np.nan) if method == "average" else np.zeros(T)
    if method != "average" and s.na:
        left, right, other = _rank_one(A)
        a, d = _headed(left, right) if method == "svd" else _joint(A, d)
    return a, np.concatenate(b, axis=1), np.concatenate(c, axis=1), d, np.stack([worst, other], axis=1)


def _matrix(theta: Array, first: int, others: int, m: int, p: int) -> Array:
    """[b, BC] or [a, AD], (T, m, p): m entries from ``first`` on, and the products of these from ``others`` on."""
    products = theta[:, others : others + m * (p - 1)].reshape(len(theta), p - 1, m)
    return np.concatenate([theta[:, first : first + m, None], products.transpose(0, 2, 1)], axis=2)


def _guarded(x: Array) -> Array:
    """x, or the nearest number by which one can divide."""
    return np.where(np.abs(x) >= SMALLEST_DIVISOR, x, np.where(x >= 0.0, SMALLEST_DIVISOR, -SMALLEST_DIVISOR))


def _average(M: Array) -> tuple[Array, Array, Array]:
    """The means of the quotients."""
    right = np.mean(M / _guarded(M[:, :, :1]), axis=1)
    right[:, 0] = 1.0
    return np.sum(M / _guarded(right)[:, None], axis=2) / M.shape[2], right, np.full(len(M), np.nan)


def _rank_one(M: Array) -> tuple[Array, Array, Array]:
    """M (T, m, p) nearly left (T, m) times right (T, p) with |right| = 1, and sigma_2 / sigma_1. For numbers that are
    not finite the product is 0.
    """
    known = np.asarray(np.isfinite(M).all(axis=(1, 2)))
    M = np.where(known[:, None, None], M, 0.0)
    _, sizes, rights = np.linalg.svd(M, full_matrices=False)
    top = sizes[:, :1]
    right = np.where(top > 0.0, rights[:, 0], np.eye(1, M.shape[2]))
    ratio = np.divide(sizes, top, out=np.zeros_like(sizes), where=top > 0.0)
    quality = ratio[:, 1] if ratio.shape[1] > 1 else np.zeros(len(M))
    return _times(M, right), right, np.where(known, quality, np.nan)


def _joint(M: Array, d0: Array) -> tuple[Array, Array]:
    """a and d by alternating least squares on [[1, d], [a, AD]]; M = [a, AD], d0 and d have their leading 1."""
    a, d, going = M[:, :, 0].copy(), d0.copy(), np.arange(len(M))
    for _ in range(ALTERNATIONS):
        A, was = M[going], d[going]
        one = _times(A, was) / np.sum(was * was, axis=1, keepdims=True)
        other = (d0[going] + _times(A.transpose(0, 2, 1), one)) / (1.0 + np.sum(one * one, axis=1, keepdims=True))
        other[:, 0] = 1.0
        moved = np.maximum(np.abs(one - a[going]).max(axis=1), np.abs(other - was).max(axis=1))
        a[going], d[going] = one, other
        going = going[moved >= STILL]
        if not going.size:
            break
    return a, d


def _times(M: Array, x: Array) -> Array:
    """M x of every sample."""
    return np.asarray((M @ x[:, :, None])[:, :, 0])


def _headed(left: Array, right: Array) -> tuple[Array, Array]:
    """The same product with right[0] = 1."""
    head = right[:, :1]
    scaled = right / _guarded(head)
    scaled[:, 0] = 1.0
    return left * head, scaled


def _rising(rise: Array, left: Array, right: Array) -> tuple[Array, Array]:
    """The same product with |right| = 1 and rise'right >= 0, or with right[0] = 1 where rise is 0."""
    if not rise.any():
        return _headed(left, right)
    scale = np.sqrt(np.sum(right * right, axis=1)) * np.where(np.sum(rise * right, axis=1) >= 0.0, 1.0, -1.0)
    return left * scale[:, None], right / scale[:, None]


class LeastSquares:
    """theta = g(zeta) with all of c free, zeta = (a, b, c, d_2 .., l), and its generalised least squares fit."""

    def __init__(self, s: Structure) -> None:
        self.s, self.spans = s, s.spans(free=True)
        self.b, self.c, self.n_z = self.spans.b, self.spans.c, s.n_x + len(s.nb)

    def refine(self, theta: Array, P: Array, zeta: Array) -> tuple[Array, Array, Array]:
        """zeta (T, n_z), its covariance (T, n_z, n_z) and the cost (T,), from a zeta with |c| = 1.

        Where P (T, n, n) is not a finite covariance, zeta stays and the others are NaN.
        """
        zeta, (T, n_z) = zeta.copy(), zeta.shape
        cov, cost = np.full((T, n_z, n_z), np.nan), np.full(T, np.nan)
        usable = np.isfinite(P).all(axis=(1, 2)) & (np.einsum("tii->ti", P) > 0.0).all(axis=1)
        at = np.flatnonzero(usable & np.isfinite(theta).all(axis=1) & np.isfinite(zeta).all(axis=1))
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            W = _whitening(P[at])
            zeta[at], cost[at] = self._minimum(theta[at], W, zeta[at])
            cov[at] = self._projected(zeta[at], _inverse(self._normal(W, zeta[at])[0]))
        return zeta, cov, cost

    def _normal(self, W: Array, zeta: Array) -> tuple[Array, Array]:
        """J' P^-1 J, with the scales held, and J' W': adding c c' changes no product, and c'dc = 0 follows."""
        J = W @ self.s.jacobian(zeta)
        N = J.transpose(0, 2, 1) @ J
        for c in self.c:
            weight = np.einsum("tii->ti", N)[:, c].sum(axis=1)
            held = np.where(weight > 0.0, weight, 1.0)[:, None, None] * zeta[:, c, None] * zeta[:, None, c]
            N[:, c[0] : c[-1] + 1, c[0] : c[-1] + 1] += held
        return N, J.transpose(0, 2, 1)

    def _minimum(self, theta: Array, W: Array, zeta: Array) -> tuple[Array, Array]:
        """zeta and the cost at the minimum."""
        rho = _times(W, theta - self.s.products(zeta))
        best, damping, going = np.sum(rho * rho, axis=1), np.zeros(len(zeta)), np.arange(len(zeta))
        for _ in range(LEVENBERG_STEPS):
            # Gauss-Newton: N step = J' rho, with more damping until the cost does not rise
            N, J = self._normal(W[going], zeta[going])
            right, gain, trying = _times(J, rho[going]), np.full(len(going), np.nan), np.arange(len(going))
            for _ in range(10):
                t = going[trying]
                moved = zeta[t] + _solved(N[trying], damping[t], right[trying])
                off = _times(W[t], theta[t] - self.s.products(moved))
                value = np.sum(off * off, axis=1)
                good = value <= best[t]
                gain[trying[good]] = (best[t] - value)[good]
                best[t[good]], zeta[t[good]], rho[t[good]] = value[good], self._unit(moved[good]), off[good]
                damping[t[~good]] = np.maximum(10.0 * damping[t[~good]], 1e-3)
                damping[t[good]] = np.where(damping[t[good]] < 1e-3, 0.0, 0.1 * damping[t[good]])
                trying = trying[~good]
                if not trying.size:
                    break
            going = going[gain > 1e-12 * best[going]]
            if not going.size:
                break
        return zeta, best

    def _unit(self, zeta: Array) -> Array:
        """The same products with |c| = 1 for each input."""
        zeta = zeta.copy()
        for b, c in zip(self.b, self.c, strict=True):
            size = np.sqrt(np.sum(zeta[:, c] ** 2, axis=1))[:, None]
            zeta[:, b] *= size
            zeta[:, c] /= size
        return zeta

    def _projected(self, zeta: Array, cov: Array) -> Array:
        """(I - v g') cov (I - v g')' with g = (0, c) and v = (-b, c), after which c'dc = 0 for each input."""
        for b, c in zip(self.b, self.c, strict=True):
            g, v = np.zeros_like(zeta), np.zeros_like(zeta)
            g[:, c] = v[:, c] = zeta[:, c]
            v[:, b] = -zeta[:, b]
            A = np.eye(self.n_z) - v[:, :, None] * g[:, None, :]
            cov = A @ cov @ A.transpose(0, 2, 1)
        return 0.5 * (cov + cov.transpose(0, 2, 1))


def _whitening(P: Array) -> Array:
    """W (T, n, n) with W'W = P^-1."""
    C, scale = _unit_diagonal(P)
    values, vectors = np.linalg.eigh(C)
    root = np.sqrt(np.maximum(values, SMALLEST_EIGENVALUE))
    return np.asarray(vectors.transpose(0, 2, 1) / root[:, :, None] / scale[:, None, :])


def _solved(N: Array, damping: Array, right: Array) -> Array:
    """(N + damping diag N)^-1 right, in units in which the diagonal of N is 1."""
    C, scale = _unit_diagonal(N)
    damped = C + (RIDGE + damping[:, None, None]) * np.eye(C.shape[1])
    return np.asarray(np.linalg.solve(damped, (right / scale)[:, :, None])[:, :, 0] / scale)


def _inverse(N: Array) -> Array:
    """N^-1 of symmetric matrices."""
    C, scale = _unit_diagonal(N)
    return np.asarray(np.linalg.inv(C + RIDGE * np.eye(C.shape[1])) / scale[:, :, None] / scale[:, None, :])


def _unit_diagonal(N: Array) -> tuple[Array, Array]:
    """N scaled to a unit diagonal, and the scales."""
    scale = np.sqrt(np.einsum("tii->ti", N))
    scale = np.where(scale > 0.0, scale, 1.0)
    return N / scale[:, :, None] / scale[:, None, :], scale
