"""Rank of the regressors of a record, decided on the used rows with columns scaled to unit rms."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, Driver
from driftfit.trackers.parts import diffuse


@Driver
def column_scale(phi: Array, weight: Array) -> Array:
    """Root mean square of each column of phi over the samples that are used; 1 for columns of zeros."""
    T, n = phi.shape
    scale = np.empty(n)
    for i in range(n):
        top, count, squares = 0.0, 0, 0.0
        for t in range(T):
            if weight[t] > 0.0:
                top = max(top, abs(phi[t, i]))
                count += 1
        for t in range(T):
            if weight[t] > 0.0 and top > 0.0:
                squares += (phi[t, i] / top) ** 2
        scale[i] = top * np.sqrt(squares / count) if top > 0.0 else 1.0
    return scale


def ranks(phi: Array, weight: Array, scale: Array) -> tuple[Array, Array]:
    """Rank of the scaled regressors up to each sample, (T,), and a basis of their null space, (n, n - rank)."""
    n = len(scale)
    rank = np.empty(len(phi), np.int64)
    S, R = np.zeros((n, n)), np.eye(n)
    compiled_ranks()(S, R, np.zeros((diffuse.WORK, n)), phi, scale, weight, rank)
    return rank, R[:, np.diag(S) == 0.0]


@lru_cache
def compiled_ranks() -> Any:
    refresh, outside, turn_in, row = diffuse.refresh, diffuse.outside, diffuse.turn_in, diffuse.ROW

    @Driver
    def run(S: Array, R: Array, work: Array, phi: Array, scale: Array, weight: Array, rank: Array) -> None:
        n, known = len(scale), 0
        scaled, values = np.empty(n), np.zeros(n)
        for t in range(phi.shape[0]):
            if weight[t] > 0.0 and known < n:
                for i in range(n):
                    scaled[i] = phi[t, i] / scale[i]
                entering, _, _ = outside(scaled, S, work)
                for i in range(n):
                    work[row, i] = scaled[i]
                turn_in(S, values, work[row], 0.0, entering)
                refresh(S, R, work)
                known += 1 if entering >= 0 else 0
            rank[t] = known

    return run
