"""The date of a break: the likelihood of every date between its neighbours, with the coefficients integrated out.

    x_t, y_t            rows divided by the level of the noise, which is an autoregression a of order p
    left and right      x_t 1(t < d), x_t 1(t >= d): 2 n columns, whitened together with y, so that the p rows after d
                        contain both
    G                   mean of x_t x_t' over the whitened rows: what one row tells
    log L(d)            -RSS(d) / 2 - log |X'X + G| / 2    coefficients integrated out under a nearly flat prior

Without G, dates would be preferred on one side of which an input rests: there a coefficient that is not determined
has no price, and the logarithm of a determinant that is rounding alone decides. With G the dates are the same in all
units, offsets and orders of the regressors.

For a given size of the change the likelihood is a random walk on either side of the date, whatever the date is, so an
interval with 95 % of sum exp log L contains the date in at least 95 % of records (more if one sample decides). The
determinant accounts for the unknown coefficients. If the change is large this is the interval of Bai (1997); if it is
small, Bai's is too short, because its scale is estimated.

Source: Yao (1987), Bai (1997); Pitman's interval for a location. Cost: O(rows n^3).
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array, Driver, shared
from driftfit.judge.statistics.noise import whitened
from driftfit.judge.statistics.robust import cholesky

SWEEPS = 10


@shared
def whiten(X: Array, y: Array, ar: Array, t: int, breaks: Array, row: Array) -> None:
    """Whiten row t of [x in its segment, 0 in the others, y], row (K n + 1,), for K - 1 breaks."""
    n, k = X.shape[1], breaks.shape[0]
    for i in range(row.shape[0]):
        row[i] = 0.0
    for lag in range(ar.shape[0] + 1):
        a = 1.0 if lag == 0 else -ar[lag - 1]
        while k > 0 and t - lag < breaks[k - 1]:
            k -= 1
        if a != 0.0:
            for i in range(n):
                row[k * n + i] += a * X[t - lag, i]
            row[row.shape[0] - 1] += a * y[t - lag]


@shared
def add(M: Array, row: Array, sign: float) -> None:
    """M + sign row row', lower triangle."""
    for i in range(row.shape[0]):
        if row[i] != 0.0:
            for j in range(i + 1):
                M[i, j] += sign * row[i] * row[j]


def _dates(X: Array, y: Array, ar: Array, dates: Array, loglik: Array, sums: Array, row: Array) -> None:
    """log L of the dates from ``dates`` (2, 1) on, a date and the next; rows of X (N, n) from p on.

    The scratch space is two matrices that are zero, and a row, (2 n + 1,): arrays that are made in compiled code take
    seconds to compile. The third matrix of ``sums`` (3, 2 n + 1, 2 n + 1) is G of both sides.
    """
    N, n, p = X.shape[0], X.shape[1], ar.shape[0]
    M, L, G, here, following = sums[0], sums[1], sums[2], dates[0], dates[1]
    for t in range(p, N):
        whiten(X, y, ar, t, here, row)
        add(M, row, 1.0)
    for place in range(loglik.shape[0]):
        for i in range(2 * n + 1):
            for j in range(i + 1):
                L[i, j] = M[i, j]
        loglik[place] = -0.5 * cholesky(L, 2 * n)
        for i in range(2 * n):
            for j in range(i + 1):
                L[i, j] = M[i, j] + G[i, j]
        cholesky(L, 2 * n)
        for i in range(2 * n):
            if L[i, i] > 0.0:
                loglik[place] -= np.log(L[i, i])
        for t in range(max(here[0], p), min(here[0] + p + 1, N)):
            whiten(X, y, ar, t, here, row)
            add(M, row, -1.0)
            whiten(X, y, ar, t, following, row)
            add(M, row, 1.0)
        here[0], following[0] = following[0], following[0] + 1


_run = Driver(_dates)


def date_loglik(X: Array, y: Array, ar: Array, first: int, last: int) -> Array:
    """log L of the dates first .. last, X (N, n) and y (N,) in units of the white noise."""
    n, rows = X.shape[1], whitened(X, y, ar)[0][len(ar) :]
    loglik, sums = np.empty(last - first + 1), np.zeros((3, 2 * n + 1, 2 * n + 1))
    sums[2, :n, :n] = sums[2, n:-1, n:-1] = rows.T @ rows / max(len(rows), 1)
    X, y, ar = (np.ascontiguousarray(one) for one in (X, y, ar))
    _run(X, y, ar, np.array([[first], [first + 1]]), loglik, sums, np.zeros(2 * n + 1))
    return loglik


def smallest(loglik: Array, level: float) -> tuple[int, int]:
    """First and last position of the smallest set of positions with ``level`` of the likelihood."""
    weight = np.exp(loglik - loglik.max())
    order = np.argsort(-weight, kind="stable")
    count = int(np.searchsorted(np.cumsum(weight[order]), level * weight.sum())) + 1
    held = order[:count]
    return int(held.min()), int(held.max())


def dated(
    X: Array, y: Array, ar: Array, breaks: list[int], least: int, level: float
) -> tuple[list[int], list[tuple[int, int]]]:
    """The most likely dates, each between its neighbours until all are stable, and intervals of ``level``.

    A date is at least ``least`` rows away from its neighbours. Its interval may reach nearer to them, because they are
    uncertain too.
    """
    breaks, spans = list(breaks), [(b, b) for b in breaks]
    for _ in range(SWEEPS):
        before = list(breaks)
        for k in range(len(breaks)):
            a, b = ([0, *breaks][k], [*breaks, len(y)][k + 1])
            low, high = min(max(least // 2, len(ar) + 1), (b - a) // 3), max((b - a) - least // 2, (b - a) * 2 // 3)
            loglik = date_loglik(X[a:b], y[a:b], ar, low, high)
            first, last = (a + low + place for place in smallest(loglik, level))
            nearest = max(least, low)
            breaks[k] = a + nearest + int(np.argmax(loglik[nearest - low : b - a - least - low + 1]))
            spans[k] = min(first, breaks[k]), max(last, breaks[k])
        if breaks == before:
            break
    return breaks, spans
