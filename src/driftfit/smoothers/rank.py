"""Rank of the regressors of a record: decided on the rows that are used, their columns scaled to unit rms."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.drivers import make_tile
from driftfit.kernel import Array, Driver
from driftfit.trackers import diffuse


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
    """Rank of the scaled regressors up to each sample, (T,), and an orthonormal basis of their span, (rank, n)."""
    tile = basis(len(scale)).copy()
    rank = np.empty(len(phi), np.int64)
    compiled_ranks()(tile, phi, scale, weight, rank)
    return rank, tile["V"][0, : rank[-1], :, 0]


@lru_cache
def basis(n: int) -> Array:
    """A tile that has seen no regressors, to be copied."""
    return make_tile(n, 0, {}, [{"theta": np.zeros(n), **diffuse.knowing_nothing(n)}])


@lru_cache
def compiled_ranks() -> Any:
    outside, tolerance = diffuse.outside, diffuse.TOLERANCE

    @Driver
    def run(tile: Array, phi: Array, scale: Array, weight: Array, rank: Array) -> None:
        s = tile[0]
        n = s.theta.shape[0]
        for t in range(phi.shape[0]):
            if weight[t] > 0.0 and s.rank[0] < n:
                for i in range(n):
                    s.phi[i, 0] = phi[t, i] / scale[i]
                _, square = outside(s.phi[:, 0], s.V[:, :, 0], s.rank[0], s.w[:, 0])
                if square > tolerance * tolerance:
                    for i in range(n):
                        s.V[s.rank[0], i, 0] = s.w[i, 0] / np.sqrt(square)
                    s.rank[0] += 1
            rank[t] = s.rank[0]

    return run
