"""Before the tree of hypotheses grows: one leaf, no event, and a filter that says when the tree can begin."""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array, shared
from driftfit.trackers.bank.leaves.lags import push
from driftfit.trackers.bank.leaves.leaves import AGE, FIRST, LOG, NU, WEIGHT, S
from driftfit.trackers.bank.machine.layout import (
    CLOCK,
    EXPANDED,
    GROUPS,
    IN_SEEN,
    IN_Y,
    LAST,
    LEAST,
    LEAVES,
    NEVER,
    READY,
    SETTLED,
    SQUARES,
    TIMES,
    Y_HAT,
)  # fmt: skip

GROWTH = 1e8
"""Exponential forgetting lets the trace of a covariance grow to this multiple of what it is when the tree begins."""


@shared
def wait(B: Array, T: Array, many: Array, now: Array, theta: Array, P: Array, lag_prob: Array, na: int) -> None:
    """Before the tree grows there is one leaf and no event; the tracker runs its filter."""
    n, H = len(theta), lag_prob.shape[1]
    lag_prob[0, 0] = 1.0
    y_hat = B[WEIGHT, :1]
    y_hat[0] = now[Y_HAT] if abs(now[Y_HAT]) < np.inf else 0.0
    push(B, 1, n, na, now[IN_Y], now[IN_SEEN] > 0.0, y_hat, np.inf)
    now[LAST] = now[IN_Y] if now[IN_SEEN] > 0.0 else now[LAST]
    many[CLOCK] += 1
    if many[SETTLED] == READY:
        begin(B, T, theta, P, now[TIMES], max(now[SQUARES], now[LEAST] * now[TIMES]), many, H)


@shared
def begin(B: Array, T: Array, theta: Array, P: Array, nu: float, squares: float, many: Array, H: int) -> None:
    """The one leaf that a bank starts from; P, in units of an unknown noise variance, takes those of theta."""
    n = len(theta)
    at, unit = FIRST + n, squares / (nu - 2.0) if nu > 2.0 else 1.0
    for row in range(LOG, FIRST):
        B[row, 0] = 0.0
    B[WEIGHT, 0], B[NU, 0], B[S, 0], B[AGE, 0] = 1.0, nu, squares, NEVER
    for i in range(n):
        B[FIRST + i, 0] = theta[i]
        for j in range(i + 1):
            B[at, 0] = P[i, j]
            P[i, j] *= unit
            at += 1
    for at in range(T.shape[1]):
        T[0, at] = 1.0 if at % (H + 1) == H else 0.0
    many[LEAVES], many[GROUPS], many[EXPANDED], many[SETTLED] = 1, 1, 1, 1


@shared
def trace(P: Array) -> float:
    total = 0.0
    for i in range(len(P)):
        total += P[i, i]
    return total
