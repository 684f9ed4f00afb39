"""Before the hypothesis tree grows: one leaf, no event, and a filter that decides when the tree can begin."""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import shared
from driftfit.trackers.bank.layout import (
    NEVER,
    READY,
)  # fmt: skip
from driftfit.trackers.bank.leaves.forget import GROWTH, PER_CAP
from driftfit.trackers.bank.leaves.lags import push
from driftfit.trackers.bank.leaves.leaf_matrix import AGE, FIRST, LOG, NU, WEIGHT, S


@shared
def begin(t: Any, nu: float, squares: float) -> None:
    """Set the single leaf from which a bank starts; P, in units of an unknown noise variance, is converted to units of
    theta.
    """
    B, theta, P, history = t.leaves, t.theta, t.cov, t.history
    n, H = len(theta), len(t.initial)
    at, unit = FIRST + n, squares / (nu - 2.0) if nu > 2.0 else 1.0
    t.unit = unit
    for row in range(LOG, FIRST):
        B[row, 0] = 0.0
    B[WEIGHT, 0], B[NU, 0], B[S, 0], B[AGE, 0] = 1.0, nu, squares, NEVER
    for i in range(n):
        B[FIRST + i, 0] = theta[i]
        for j in range(i + 1):
            B[at, 0] = P[i, j]
            P[i, j] *= unit
            at += 1
    for at in range(history.shape[1]):
        history[0, at] = 1.0 if at % (H + 1) == H else 0.0
    t.many_leaves, t.groups, t.expanded, t.settled = 1, 1, 1, 1


@shared
def wait(t: Any) -> None:
    """Before the tree grows there is one leaf and no event; the tracker runs its filter."""
    t.lag_prob[0, 0] = 1.0
    t.expected[1, 0] = t.y_hat if abs(t.y_hat) < np.inf else 0.0
    push(t, t.leaves, 1, 0, 1, t.y, False)
    t.clock += 1
    if t.settled == READY:
        begin(t, t.times, max(t.squares, t.least * t.times))


@shared
def limit_forgetting(t: Any) -> None:
    """The caps of variances, from those of the single filter."""
    for i in range(t.n):
        t.places[PER_CAP, i] = 1.0 / (GROWTH * t.cov[i, i]) if t.cov[i, i] > 0.0 else 0.0
