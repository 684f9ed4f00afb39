"""The date of a break: the likelihood of every date between its neighbours, with the coefficients integrated out.

    x_t, y_t            rows divided by the level of the noise, which is an autoregression a of order p
    left and right      x_t 1(t < d), x_t 1(t >= d): 2 n columns, whitened together with y, so that the p rows after d
                        contain both
    log L(d)            -RSS(d) / 2 - log |X'X| / 2        coefficients integrated out under a flat prior

For a given size of the change the likelihood is a random walk on either side of the date, whatever the date is, so an
interval with 95 % of sum exp log L contains the date in at least 95 % of records (more if one sample decides). The
determinant accounts for the unknown coefficients. If the change is large this is the interval of Bai (1997); if it is
small, Bai's is too short, because its scale is estimated.

Source: Yao (1987), Bai (1997); Pitman's interval for a location. Cost: O(rows n^3).
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array, Driver, shared
from driftfit.judge.statistics.robust import cholesky


@shared
def _row(X: Array, y: Array, ar: Array, t: int, d: int, row: Array) -> None:
    """Whiten row t of [left, right, y] for a break at d; rows before the first are not used."""
    n = X.shape[1]
    for i in range(2 * n + 1):
        row[i] = 0.0
    for k in range(ar.shape[0] + 1):
        a = 1.0 if k == 0 else -ar[k - 1]
        side = 0 if t - k < d else n
        for i in range(n):
            row[side + i] += a * X[t - k, i]
        row[2 * n] += a * y[t - k]


@shared
def _add(M: Array, row: Array, sign: float) -> None:
    for i in range(row.shape[0]):
        if row[i] != 0.0:
            for j in range(i + 1):
                M[i, j] += sign * row[i] * row[j]


def _dates(X: Array, y: Array, ar: Array, first: int, loglik: Array, M: Array, L: Array, row: Array) -> None:
    """log L of the dates first .. first + len(loglik) - 1, rows of X (N, n) from p on; room for two matrices, M zero,
    and a row of 2 n + 1.
    """
    N, n, p = X.shape[0], X.shape[1], ar.shape[0]
    for t in range(p, N):
        _row(X, y, ar, t, first, row)
        _add(M, row, 1.0)
    for place in range(loglik.shape[0]):
        d = first + place
        for i in range(2 * n + 1):
            for j in range(i + 1):
                L[i, j] = M[i, j]
        rss = cholesky(L, 2 * n)
        loglik[place] = -0.5 * rss
        for i in range(2 * n):
            if L[i, i] > 0.0:
                loglik[place] -= np.log(L[i, i])
        for t in range(d, min(d + p + 1, N)):
            _row(X, y, ar, t, d, row)
            _add(M, row, -1.0)
            _row(X, y, ar, t, d + 1, row)
            _add(M, row, 1.0)


_run = Driver(_dates)


def date_loglik(X: Array, y: Array, ar: Array, first: int, last: int) -> Array:
    """log L of the dates first .. last, X (N, n) and y (N,) in units of the white noise."""
    loglik, k = np.empty(last - first + 1), 2 * X.shape[1] + 1
    room = np.zeros((k, k)), np.zeros((k, k)), np.zeros(k)
    _run(np.ascontiguousarray(X), np.ascontiguousarray(y), np.ascontiguousarray(ar), int(first), loglik, *room)
    return loglik


def smallest(loglik: Array, level: float) -> tuple[int, int]:
    """First and last position of the smallest set of positions with ``level`` of the likelihood."""
    weight = np.exp(loglik - loglik.max())
    order = np.argsort(-weight, kind="stable")
    count = int(np.searchsorted(np.cumsum(weight[order]), level * weight.sum())) + 1
    held = order[:count]
    return int(held.min()), int(held.max())
