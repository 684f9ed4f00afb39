"""Output lags that leaves keep separately, and their uncertainty.

A leaf with the hypothesis of a sensor fault puts its own prediction into its lags. If a wrong prediction is treated as
certain, it is worse than a wrong output: while a sensor is frozen, predictions are fed back, and the first good sample
is trusted because of its huge regressor. Leaves therefore carry the covariance V of their lags too. If a are the leaf's
coefficients of the output lags,

    s = z' C z + a' V a + r,          V+ = [[s, (V a)'], [V a, V]]  without its last row and column

after a prediction was stored, and a zero row for an output that was measured. This is a plug-in approximation: joint
errors of a and the lags are neglected, and so is the information of later outputs about earlier ones. Merged leaves add
the spread of their lags to V. Like C, V is in units of the noise variance where that is unknown. A prediction that
cannot be an output (`PLAUSIBLE`) is not stored; y is stored instead or, without y, the largest possible output.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from driftfit.bank.leaves.leaf_matrix import lag_row
from driftfit.engine.kernel import Array, kernel, shared

PLAUSIBLE, VAGUE = 1e4, 1e12
"""Limits beyond which a prediction is no possible output: its square in mean squares of the outputs, and its variance
in variances of the noise. Without them the lags of an unstable leaf would diverge.
"""


@kernel
def plausible(h: float, y_hat: float, most: float, r: float) -> bool:
    """Whether a prediction is a possible output."""
    return y_hat * y_hat <= most and h <= VAGUE * r


@kernel
def covariance_row(t: Any) -> int:
    """The first row of V, whose lower triangle is stored last in a leaf, if it is."""
    return lag_row(t) + t.output_lags  # type: ignore[no-any-return]


@shared
def push(t: Any, A: Array, K: int, at: int, columns: int, y: float, own: bool) -> None:
    """Output lags of the leaves from column ``at`` on, whose parents are K columns of A: moved by one, then y or, under
    a hypothesis with lags of its ``own`` and where y is missing, the prediction. A may be the leaves themselves.
    """
    B, h, y_hat, lags, most, r, limit = (
        t.leaves, t.expected[0], t.expected[1], lag_row(t), t.most, t.r, math.sqrt(t.most),
    )  # fmt: skip
    missing = t.observed == 0.0
    for i in range(t.output_lags - 1, 0, -1):
        for c in range(at, at + columns, K):
            for l in range(K):
                B[lags + i, np.uint64(c + l)] = A[lags + i - 1, l]
    for l in range(columns if t.output_lags > 0 else 0):
        believed = missing or (own and plausible(h[l], y_hat[l], most, r))
        B[lags, np.uint64(at + l)] = min(max(y_hat[l], -limit), limit) if believed else y


@shared
def write_coefficients(t: Any, columns: int) -> None:
    """The coefficients of the output lags."""
    m, rows, a = t.m, t.lag_rows, t.lag_coefficients
    for i in range(t.output_lags):
        for l in range(columns):
            a[i, l] = 0.0
        for k in range(t.n):
            of = rows[i, k]
            for l in range(columns if of != 0.0 else 0):
                a[i, l] += of * m[k, l]


@shared
def widen_by_lags(t: Any, B: Array, K: int, columns: int) -> None:
    """h <- h + a' V a for columns c K + l, whose lags are those of leaf l of B."""
    a, h, at = t.lag_coefficients, t.expected[0], covariance_row(t)
    write_coefficients(t, columns)
    for i in range(t.output_lags if at < len(B) else 0):
        for j in range(i + 1):
            twice = 1.0 if i == j else 2.0
            for start in range(0, columns, K):
                for l in range(K):
                    h[start + l] += twice * a[i, start + l] * a[j, start + l] * B[at, l]
            at += 1


@shared
def shift_covariance(t: Any, A: Array, K: int, at: int, columns: int, own: bool) -> None:
    """V of the leaves from column ``at`` on, whose parents are K columns of A: moved by one lag, with the variance of
    the new entry, which is zero if it was measured or replaced. A may be the leaves themselves.
    """
    B, na, X, a, first = t.leaves, t.output_lags, t.spare_lags, t.lag_coefficients, covariance_row(t)
    h, y_hat, r, most, block = t.expected[0], t.expected[1], t.r, t.most, slice(at, at + columns)
    if first >= len(B):
        return
    write_coefficients(t, columns)
    for i in range(na - 1):  # V a, but for its last entry
        for l in range(columns):
            X[i, l] = 0.0
        for j in range(na):
            entry = A[first + (i * (i + 1) // 2 + j if j <= i else j * (j + 1) // 2 + i)]
            for start in range(0, columns, K):
                for l in range(K):
                    X[i, start + l] += entry[l] * a[j, start + l]
    for i in range(na - 1, 0, -1):  # V moves down by a row and a column
        for j in range(i, 0, -1):
            to, was = B[first + i * (i + 1) // 2 + j, block], A[first + (i - 1) * i // 2 + j - 1]
            for start in range(0, columns, K):
                for l in range(K):
                    to[start + l] = was[l]
    for i in range(na - 1, 0, -1):
        to = B[first + i * (i + 1) // 2, block]
        for l in range(len(to)):
            to[l] = X[i - 1, l] if own and plausible(h[l], y_hat[l], most, r) else 0.0
    to = B[first, block]
    for l in range(len(to)):
        to[l] = h[l] + r if own and plausible(h[l], y_hat[l], most, r) else 0.0
