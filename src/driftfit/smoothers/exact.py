"""The exact fixed-interval smoother: off-line flexible least squares, the mean and covariance of every theta_t.

It minimises, and gives the posterior of,

    J = sum_t weight_t (y_t - phi_t' theta_t)^2 + sum_t |G^-1 (theta_t - theta_{t-1})|^2 / drift_t + prior,   G G' = q

on one of two paths. The fast one (`driftfit.smoothers.elimination`) serves a diagonal q and a diffuse start and tests
its own result by a step of refinement; where the test fails, and for everything else, the safe one
(`driftfit.smoothers.two_filters`) works on square roots of information. ``Path.method`` says which one it was.

Where the regressors never span all directions, a constant shift in the complement costs nothing; the first point then
takes theta0 there, the limit of a vanishing prior, and std is inf for parameters that are not determined. Rank is
decided on regressors with columns scaled to unit rms.

Use it on a complete record. Bands hold under the random-walk model and its q. Cost: O(T n^3).

Source: Kalaba and Tesfatsion (1989) for flexible least squares; Rauch, Tung and Striebel (1965) for the smoother.
Departure: the rule for undetermined directions.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit

from driftfit.drivers import make_tile
from driftfit.kernel import Array, Driver
from driftfit.smoothers import elimination, two_filters
from driftfit.smoothers.walk import Path, Walk
from driftfit.trackers import diffuse


def smooth(walk: Walk, keep: str = "std") -> Path:
    """Solve the problem; keep="cov" adds the covariances of every sample and of neighbours."""
    n = walk.phi.shape[1]
    scale = column_scale(walk.phi, walk.weight)
    rank, spanned = ranks(walk, scale)
    simple = keep == "std" and walk.p0 is None and rank[-1] == n and np.array_equal(walk.q, np.diag(np.diag(walk.q)))
    found = elimination.smooth(walk) if simple else None
    if found is None:
        found = two_filters.smooth(walk, scale, spanned, keep)
    return found._replace(rank=rank)


@njit(error_model="numpy", nogil=True, cache=True)
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


def ranks(walk: Walk, scale: Array) -> tuple[Array, Array]:
    """Rank of the scaled regressors up to each sample, (T,), and an orthonormal basis of their span, (rank, n)."""
    tile = basis(len(scale)).copy()
    rank = np.empty(len(walk.phi), np.int64)
    compiled_ranks()(tile, walk.phi, scale, walk.weight, rank)
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
