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

from driftfit.engine.kernel import Array, kernel, shared
from driftfit.trackers.bank.leaves.leaf_matrix import FIRST, NU, S

PLAUSIBLE, VAGUE = 1e4, 1e12
"""Limits beyond which a prediction is no possible output: its square in mean squares of the outputs, and its variance
in variances of the noise. Without them the lags of an unstable leaf would diverge.
"""


@kernel
def plausible(expected: Array, l: int, most: float, r: float) -> bool:
    """Whether the prediction of leaf l is a possible output."""
    return expected[1, l] * expected[1, l] <= most and expected[0, l] <= VAGUE * r  # type: ignore[no-any-return]


@shared
def covariance_row(n: int, na: int) -> int:
    """The first row of V, whose lower triangle is stored last in a leaf."""
    return FIRST + n + n * (n + 1) // 2 + na


@shared
def push(t: Any, L: int, observed: bool, y_hat: Array, most: float) -> None:
    """Store output lags of leaves without a measurement update: y if it was observed, otherwise each prediction, within
    limits.
    """
    B, n, na, y, limit = t.leaves, t.n, t.output_lags, t.y, math.sqrt(most)
    at = FIRST + n + n * (n + 1) // 2
    for i in range(na - 1, 0, -1):
        for l in range(L):
            B[at + i, l] = B[at + i - 1, l]
    if na > 0:
        for l in range(L):
            B[at, l] = y if observed else min(max(y_hat[l], -limit), limit)


@shared
def write_coefficients(t: Any, columns: int) -> None:
    """The coefficients of the output lags, where leaves are in coordinates of the start."""
    m, rows, a = t.m, t.lag_rows, t.lag_coefficients
    for i in range(t.output_lags if t.in_coordinates > 0 else 0):
        for l in range(columns):
            a[i, l] = 0.0
            for k in range(t.n):
                a[i, l] += rows[i, k] * m[k, l]


@shared
def widen_by_lags(t: Any, B: Array, K: int, columns: int) -> None:
    """h <- h + a' V a for columns c K + l, whose lags are those of leaf l of B."""
    na, h = t.output_lags, t.expected[0]
    at = covariance_row(t.n, na)
    if at >= len(B):
        return
    write_coefficients(t, columns)
    a = t.lag_coefficients if t.in_coordinates > 0 else t.m
    for i in range(na):
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
    B, na, expected, X = t.leaves, t.output_lags, t.expected, t.spare_lags
    r, most, block = t.r, t.most, slice(at, at + columns)
    first = covariance_row(t.n, na)
    if first >= len(B):
        return
    write_coefficients(t, columns)
    a = t.lag_coefficients if t.in_coordinates > 0 else t.m
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
            to[l] = X[i - 1, l] if own and plausible(expected, l, most, r) else 0.0
    to = B[first, block]
    for l in range(len(to)):
        to[l] = expected[0, l] + r if own and plausible(expected, l, most, r) else 0.0


@shared
def merge_covariance(t: Any, members: Array, share: Array, to: int) -> None:
    """A parent, column ``to``: the average of V plus the spread of the lags, whose mean is already stored there."""
    B, A, n, na, unknown = t.leaves, t.parents, t.n, t.output_lags, t.unknown > 0
    first, lags = covariance_row(n, na), FIRST + n + n * (n + 1) // 2
    if first >= len(B):
        return
    for k in range(len(members)):
        l, at = members[k], first
        pull = B[NU, l] / B[S, l] if unknown else 1.0
        for i in range(na):
            away = pull * (B[lags + i, l] - A[lags + i, to])
            for j in range(i + 1):
                A[at, to] += share[k] * (B[at, l] + away * (B[lags + j, l] - A[lags + j, to]))
                at += 1
