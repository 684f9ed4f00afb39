"""A sample that makes its regressor a coordinate z_j: in one mean and one covariance.

    y = sum_{i<j} x_i z_i + z_j + v,     where z_j was sum_{k>=j} x_k z_k / x_j before, or unknown

With the gain K = C x / s of the coordinates as they were, s = x'C x + r, the errors after the sample are those of

    w_i - K_i (x'w + v)  for i != j,        rho = (1 - x'K) x'w - x'K v,  1 - x'K = r / s,  for x'z

and so, with the covariance C of the former, z_j = x'z - sum_{i<j} x_i z_i has

    C_jb = cov(rho, b) - sum_{i<j} x_i C_ib,      C_jj = var(rho) - sum_{i<j} x_i (cov(rho, i) + C_ji)

No difference of large numbers is left in them, however large x_j^2 C_jj is compared with r. If nothing was known of
z_j, s is infinite: K is 0 for the other coordinates, x'K is 1, and x_i z_i with i > j, which leaves with output lags
of their own have, is no part of z_j.

Source: ours; the limit is that of Durbin and Koopman, Time Series Analysis by State Space Methods (2012), section 5.2.
Cost: O(n^2).
"""

from __future__ import annotations

from driftfit.engine.kernel import Array, shared
from driftfit.trackers.parts.covariance import LEFT
from driftfit.trackers.parts.diffuse import ENTERING, OK, SIZE, STD, Y

K, G = SIZE, STD
"""Rows of ``work`` here: the gain, and a covariance times the regressor."""


@shared
def product(M: Array, at: int, step: int, x: Array, work: Array, row: int) -> float:
    """C x in ``work[row]`` for the C whose lower triangle begins at ``at`` with stride ``step``; returns x'C x."""
    h = 0.0
    for a in range(len(x)):
        work[row, a] = 0.0
        for b in range(len(x)):
            k = a * (a + 1) // 2 + b if b <= a else b * (b + 1) // 2 + a
            work[row, a] += M[at + k * step] * x[b]
        h += x[a] * work[row, a]
    return h


@shared
def gain_of(M: Array, at: int, step: int, x: Array, noise: float, known: int, work: Array) -> float:
    """K = C x / s in ``work[K]`` for the C whose lower triangle begins at ``at`` with stride ``step``; returns
    1 - x'K = noise / s. Both are 0 if s is infinite (``known`` is 0) or only rounding.
    """
    h = product(M, at, step, x, work, K)
    share = 1.0 / (h + noise) if known > 0 and h > 0.0 else 0.0
    for a in range(len(x)):
        work[K, a] *= share
    return noise * share


@shared
def enter_packed(M: Array, at: int, step: int, x: Array, now: Array, noise: float, left: float, work: Array) -> None:
    """The covariance of (I - K x') w - K v, for w with a covariance whose lower triangle begins at ``at`` with stride
    ``step`` and v with variance ``noise``; x'K = 1 - left. z_j becomes sum_{k>=j} x_k z_k: its error is that of x'z
    without those of z_i, i < j.
    """
    n, j, sign = len(x), int(now[ENTERING]), now[OK]
    others = j if left > 0.0 else n
    h = product(M, at, step, x, work, G)
    k = at
    for a in range(n):
        for b in range(a + 1):
            change = work[K, a] * work[K, b] * (h + noise) - work[K, a] * work[G, b] - work[G, a] * work[K, b]
            M[k] = max(M[k] + change, LEFT * M[k]) if a == b else M[k] + change
            k += step
    own = left * left * h + (1.0 - left) ** 2 * noise
    for b in range(n):
        if b != j:
            shared_error = left * (work[G, b] - work[K, b] * h) + (1.0 - left) * noise * work[K, b]
            row = shared_error
            for i in range(others):
                row -= x[i] * M[at + (i * (i + 1) // 2 + b if b <= i else b * (b + 1) // 2 + i) * step]
            if b < others:
                own -= x[b] * (row + shared_error)
            M[at + (j * (j + 1) // 2 + b if b <= j else b * (b + 1) // 2 + j) * step] = sign * row
    M[at + (j * (j + 1) // 2 + j) * step] = own


@shared
def enter_mean(m: Array, at: int, step: int, x: Array, now: Array, left: float, work: Array) -> None:
    """The mean of the same: m + K e, and m_j from the part of the reading that neither z_i, i < j, nor v explains."""
    j, e = int(now[ENTERING]), now[Y]
    for i in range(len(x)):
        e -= x[i] * m[at + i * step]
    rest = now[Y] - left * e
    for i in range(len(x)):
        m[at + i * step] += work[K, i] * e
    for i in range(j if left > 0.0 else len(x)):
        rest -= x[i] * m[at + i * step]
    m[at + j * step] = now[OK] * rest
