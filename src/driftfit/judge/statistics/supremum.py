"""Tests for a date, or an interval, at which a score path changed too much: suprema of Wald-type statistics.

    Q(a, b) = (S_b - S_a)' Var(S_b - S_a)^-1 (S_b - S_a)          chi-square with n degrees of freedom for constants
    one break      c = max over b of Q(0, b)                      the path is tied at both ends: before b against after
    an interval    c = max over a < b of Q(a, b)                  within against outside

    P(max Q > c) = P(chi2_n > c) sum kappa_b,  or  sum kappa_a kappa_b,      kappa = x nu(sqrt(2 x)),  x = c (1 - rho)

rho is the correlation of Q's Gaussian vector with that of the next position, from the covariance of the path, so the
null distribution is that of the record. nu corrects for the distance between positions: kappa is 1 if neighbours are
independent, which is Bonferroni's bound, and less if they are correlated. The mean square of a path (Nyblom and Hansen)
averages a short change away; the supremum does not, and grows with the square of its size.

Source: Andrews (1993) for the supremum; Siegmund (1985), Yao (1993) for its tail on a grid. Departures: covariances
of the record instead of those of a stationary one. Cost: O(m^2 n^3) for m positions.
"""

from __future__ import annotations

import math

import numpy as np
import scipy

from driftfit.engine.kernel import Array, Driver
from driftfit.judge.statistics.robust import cholesky

TIED = 1e-9
"""A variance below this share of the largest of the path is rounding."""


def _scan(S: Array, cov: Array, Q: Array, left: Array, right: Array) -> None:
    """Q, and 1 - rho if a or b moves by one position; S (m + 1, n) from 0 on, cov (m + 1, n, m + 1, n).

    A component whose change has no variance (a regressor of the fit ties the path to zero there) does not count: the
    quotient would be that of two rounding errors.
    """
    m, n = S.shape[0] - 1, S.shape[1]
    M, z, size = np.zeros((n + 1, n + 1)), np.zeros(n), np.zeros(n)
    for i in range(n):
        for b in range(m + 1):
            size[i] = max(size[i], cov[b, i, b, i])
    for a in range(m):
        for b in range(a + 1, m + 1):
            for i in range(n):
                for j in range(i + 1):
                    M[i, j] = cov[b, i, b, j] + cov[a, i, a, j] - cov[a, i, b, j] - cov[b, i, a, j]
                M[n, i] = S[b, i] - S[a, i]
            for i in range(n):
                if not M[i, i] > TIED * size[i]:
                    M[n, i] = 0.0
                    for j in range(n):
                        M[max(i, j), min(i, j)] = 0.0
            M[n, n] = 0.0
            cholesky(M, n)
            total = 0.0
            for i in range(n):
                total += M[n, i] * M[n, i]
            Q[a, b] = total
            for side in range(2):
                x = a if side == 0 else b - 1
                y = x + 1
                share = 0.0
                for j in range(n):
                    # column j of the factor's inverse times the variance of the position that is added or removed
                    for i in range(n):
                        z[i] = cov[y, i, y, j] + cov[x, i, x, j] - cov[x, i, y, j] - cov[y, i, x, j]
                    for i in range(n):
                        for k in range(i):
                            z[i] -= M[i, k] * z[k]
                        z[i] = z[i] / M[i, i] if M[i, i] > 0.0 else 0.0
                    for i in range(n - 1, j - 1, -1):
                        for k in range(i + 1, n):
                            z[i] -= M[k, i] * z[k]
                        z[i] = z[i] / M[i, i] if M[i, i] > 0.0 else 0.0
                    share += z[j]
                if side == 0:
                    left[a, b] = 0.5 * share / n
                else:
                    right[a, b] = 0.5 * share / n


_run = Driver(_scan)


def scanned(S: Array, cov: Array) -> tuple[Array, Array, Array]:
    """Q, and 1 - rho if a or b moves by one position, (m + 1, m + 1) each, of a path S (m, n)."""
    m, n = S.shape
    path, full = np.zeros((m + 1, n)), np.zeros((m + 1, n, m + 1, n))
    path[1:], full[1:, :, 1:] = S, cov
    Q, left, right = np.zeros((3, m + 1, m + 1))
    _run(path, full, Q, left, right)
    return Q, left, right


def suprema(S: Array, cov: Array, rows: Array, least: int, apart: bool) -> tuple[float, float]:
    """p-values of one break, and of an interval, for the path S (m, n) with covariance (m, n, m, n).

    ``rows`` (m,): rows up to each position, the last being all rows; ``least``: rows on each side, and in an interval
    and outside it. ``apart``: the covariance belongs to other residuals than those of the path. Then Q of an interval
    of k rows is Hotelling's T^2, which is far from chi-square for small k, and (k - (n + 3) / 2) log(1 + Q / k) is used
    (Bartlett, 1938). For the same residuals Q is at most k.
    """
    m, n = S.shape
    Q, left, right = scanned(S, cov)
    at = np.concatenate([[0], rows])
    length = at[None, :] - at[:, None]
    allowed = (length >= least) & (length <= rows[-1] - least)
    if apart:
        k = np.maximum(np.minimum(length, rows[-1] - length), least)
        Q = (k - 0.5 * (n + 3)) * np.log1p(Q / k)
    single, double = allowed.copy(), allowed
    single[1:] = False
    double[0] = double[:, m] = False
    single[:, m] = False
    return _tail(Q[single], n, right[single]), _tail(Q[double], n, left[double], right[double])


def _tail(Q: Array, n: int, *moved: Array) -> float:
    """P(max Q > its largest) for chi-squares with 1 - rho = moved between neighbours."""
    if not Q.size:
        return float("nan")
    c = float(Q.max())
    places = np.ones(len(Q))
    for one in moved:
        places *= _kappa(c * np.minimum(one, 1.0))
    return float(min(1.0, scipy.special.gammaincc(0.5 * n, 0.5 * c) * max(1.0, places.sum())))


def _kappa(x: Array) -> Array:
    """x nu(sqrt(2 x))."""
    half = np.sqrt(np.maximum(x, 1e-12) / 2.0)
    density = np.exp(-0.5 * half * half) / np.sqrt(2.0 * np.pi)
    above = scipy.special.ndtr(half)
    nu = (above - 0.5) / half / (half * above + density)
    kappa: Array = np.minimum(1.0, np.maximum(x, 0.0) * nu)
    return kappa


def together(mean: float, *suprema: float) -> float:
    """Combine tests of one record into one p-value, however they depend on each other: Liu and Xie (2020).

    The mean square has half of the weight, and the suprema share the rest. p-values above one half count as one half:
    those of suprema are bounds without meaning there.
    """
    weights = (0.5, *[0.5 / len(suprema)] * len(suprema))
    known = [(w, min(max(p, 1e-12), 0.5)) for w, p in zip(weights, (mean, *suprema), strict=True) if math.isfinite(p)]
    if not known:
        return float("nan")
    # tan loses the small p-values
    total = sum(w * (1.0 / (p * math.pi) if p < 1e-6 else math.tan((0.5 - p) * math.pi)) for w, p in known)
    total /= sum(w for w, _ in known)
    return 1.0 / (total * math.pi) if total > 1e6 else 0.5 - math.atan(total) / math.pi
