"""Rank of the regressors of a record, decided on the used rows with columns scaled to unit rms."""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, Driver
from driftfit.smooth.solvers.walk import WEIGHT
from driftfit.trackers.forms.diffuse import ROW, WORK, outside, refresh, turn_in


def column_sizes(phi: Array, total: Any = np.mean) -> Array:
    """Root mean square (n,) of each column of phi (N, n), N > 0; 1 for columns of zeros, whose parameters are then 0.

    In units of their size the columns are equally long, so that rank is not lost where units are far apart. With
    ``total=np.sum`` it is their length, which they have without rows too.
    """
    size = np.sqrt(total(phi * phi, axis=0))
    return np.where(size > 0.0, size, 1.0)


@Driver
def column_scale(phi: Array, signals: Array) -> Array:
    """Root mean square of each column of phi over the samples that are used; 1 for columns of zeros.

    ``signals`` are those of a `driftfit.smooth.solvers.walk.Walk`.
    """
    T, n = phi.shape
    top, squares, scale, count = np.zeros(n), np.zeros(n), np.ones(n), 0
    for t in range(T):  # row by row, because a column takes a cache line for each number
        if signals[t, WEIGHT] > 0.0:
            count += 1
            for i in range(n):
                top[i] = max(top[i], abs(phi[t, i]))
    for i in range(n):  # a unit in which the largest is about 1: squares neither overflow nor vanish
        if top[i] > 0.0:
            scale[i] = 2.0 ** -max(-1000.0, min(1000.0, np.floor(np.log2(top[i]))))  # exact in the products
    for t in range(T):
        if signals[t, WEIGHT] > 0.0:
            for i in range(n):
                squares[i] += (phi[t, i] * scale[i]) ** 2
    for i in range(n):
        scale[i] = np.sqrt(squares[i] / count) / scale[i] if top[i] > 0.0 else 1.0
    return scale


def ranks(phi: Array, signals: Array, scale: Array) -> tuple[Array, Array]:
    """Rank of the scaled regressors up to each sample, (T,), and a basis of their null space, (n, n - rank)."""
    n = len(scale)
    rank = np.full(len(phi), n, np.int16)
    S, R = np.zeros((n, n)), np.eye(n)
    run_ranks(S, R, np.zeros((WORK, n)), phi, scale, signals, rank)
    return rank, R[:, np.diag(S) == 0.0]


@Driver
def run_ranks(S: Array, R: Array, work: Array, phi: Array, scale: Array, signals: Array, rank: Array) -> None:
    n, known = len(scale), 0
    scaled, values = np.empty(n), np.zeros(n)
    for t in range(phi.shape[0]):
        if known == n:
            break
        if signals[t, WEIGHT] > 0.0:
            for i in range(n):
                scaled[i] = phi[t, i] / scale[i]
            entering, _, _ = outside(scaled, S, work)
            for i in range(n):
                work[ROW, i] = scaled[i]
            turn_in(S, values, work[ROW], 0.0, entering)
            refresh(S, R, work)
            known += 1 if entering >= 0 else 0
        rank[t] = known
