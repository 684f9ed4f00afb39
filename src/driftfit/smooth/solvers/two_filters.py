"""Two square-root information filters that meet at every sample: the safe method of the exact smoother.

    forwards    (S-, d-)_t   information on theta_t from the prior and the samples before t
    backwards   (S+, d+)_t   information on theta_t from the samples after t
    T_t         = (S-, d-) with the rows of (S+, d+) rotated in: theta_t without sample t
    theta_t, C_t              from T_t with the row of sample t rotated in: theta_t = T^-1 d, C_t = T^-1 T^-T

The last rotation yields rho and the product c of the cosines, which give without cancellation

    leverage h_t            1 - h_t = c^2
    residual                y_t - phi_t' theta_t = rho c / sqrt(weight_t)
    with t left out         y_t - phi_t' theta_t(without t) = rho / (c sqrt(weight_t))

It handles every ratio of drift to noise, any prior, zero and singular q, a separate drift for every parameter and
sample (rows of G scaled by ``drift_root``), slopes (a shear of S by ``trend``), collinear and badly scaled regressors.
Both filters run in one loop as two lanes, the meeting as `WIDTH` lanes. Cost: O(T n^3), and 8 (n + 1) (n + 2) bytes
per sample.

Sources: Fraser and Potter (1969) for the two filters; Bierman (1977) for the rotations
(`driftfit.trackers.forms.information`). Departure: leverage and leave-one-out residuals from the cosines.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple, Self

import numpy as np

from driftfit.engine.kernel import Array, Driver
from driftfit.engine.tiles import WIDTH, make_tile
from driftfit.smooth.solvers.walk import Path, Walk
from driftfit.trackers.forms.information import absorb, invert, shear, solve, spread

KNOWN_EXACTLY = 1e8
"""Information on directions that the prior fixes, relative to that of all samples; its square exceeds the precision."""
STANDS_STILL = 1e-60
"""The drift of a direction that does not move, in scaled units; its weight is the square of the inverse."""


class Start(NamedTuple):
    """The information before the first sample, ``rows theta_1 = values``, and which parameters stay undetermined."""

    rows: Array
    values: Array
    hidden: Array
    """(n,) or (T, n) bool"""

    @classmethod
    def fixing(cls, natural: Array, scale: Array, scaled: Array, hidden: Array) -> Self:
        """The start that fixes these directions of theta, in rows, at the first point, ``scaled`` as its columns."""
        rows = natural / scale
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        return cls(rows, rows[:, : len(scaled)] @ scaled, hidden)


def smooth(walk: Walk, scale: Array, G: Array, begin: Start, keep: str = "std") -> Path:
    """Solve the problem with columns divided by ``scale``; G is the square root of q in these units."""
    cross, hidden = np.outer(scale, scale), begin.hidden
    scaled = walk._replace(phi=walk.phi / scale)
    found, blocks = meeting(scaled, G, begin.rows, begin.values, keep)
    used = walk.weight > 0.0
    found.rho[~used] = np.nan
    lag_cov = gains(scaled, G, blocks) @ found.cov[1:] if keep == "cov" else found.cov
    c = found.c[used]
    return found._replace(
        theta=found.theta / scale, var=np.where(hidden, np.inf, found.var / scale**2),
        measurement_cost=float(np.sum((found.rho[used] * c) ** 2)),
        spread=float(np.sum((1.0 - c**2) / walk.weight[used])), cov=found.cov / cross, lag_cov=lag_cov / cross,
    )  # fmt: skip


def meeting(walk: Walk, G: Array, rows: Array, values: Array, keep: str = "std") -> tuple[Path, Array]:
    """Run both filters from ``rows theta_1 = values`` with G G' = q, and combine them; also return their blocks.

    Of the path, only the part of the cost that is measured, and the spread, are left open.
    """
    T, n = walk.phi.shape
    blocks = np.zeros(-(-T // WIDTH), block_type(n))
    pair = workspace(n, 2).copy()
    pair["G"] = G[:, :, None]
    cost = filter_both(pair, walk, rows, values, blocks)
    theta, var, rho, c = np.empty((T, n)), np.empty((T, n)), np.empty(T), np.empty(T)
    R = np.empty((T if keep == "cov" else 0, n, n))
    meet(workspace(n, WIDTH).copy(), _weighted(walk), blocks, theta, var, rho, c, R)
    cov = R @ R.swapaxes(1, 2)
    return Path(theta, var, rho, c, cost, np.nan, np.nan, cov, cov, "safe"), blocks


def filter_both(pair: Array, walk: Walk, rows: Array, values: Array, blocks: Array) -> float:
    """Run both filters in the scratch space ``pair`` from ``rows theta_1 = values``; fills ``blocks``.

    Returns the sum of rho^2 of the filter that goes forwards.
    """
    drift = np.sqrt(np.append(walk.drift, 0.0))
    start = np.column_stack([rows, values])
    return float(filters(pair, _weighted(walk), drift, *_changes(walk), start, blocks))


def _weighted(walk: Walk) -> Array:
    """sqrt(w) phi and sqrt(w) y, (T, n + 1)."""
    return np.asarray(np.sqrt(walk.weight)[:, None] * np.column_stack([walk.phi, walk.y]))


def _changes(walk: Walk) -> tuple[Array, Array]:
    """``drift_root`` and ``trend`` with an entry after the last sample, where nothing changes."""
    drift_root, trend = walk.drift_root, walk.trend.ravel()
    drift_root = np.vstack([drift_root, np.ones((1, drift_root.shape[1]))]) if len(drift_root) else drift_root
    return drift_root, np.append(trend, 0.0) if len(trend) else trend


def start(walk: Walk, scale: Array, unseen: Array) -> Start:
    """The start of a problem whose regressors, divided by ``scale``, are orthogonal to the vectors ``unseen`` (n, k).

    A proper prior gives one row for each of its axes. Without one, a row that fixes the first point is needed in every
    direction that the regressors never span; it costs nothing there, so its weight does not matter.
    """
    theta0 = walk.theta0 * scale
    if walk.p0 is not None:
        variance, axes = np.linalg.eigh(walk.p0 * np.outer(scale, scale))
        sure = KNOWN_EXACTLY * np.sqrt(1.0 + walk.weight.sum() * len(scale))
        rows = axes.T / np.sqrt(np.maximum(variance, sure**-2.0))[:, None]
        return Start(rows, rows @ theta0, np.zeros(len(scale), bool))
    natural = unspanned(unseen, scale)
    return Start.fixing(natural, scale, theta0, undetermined(natural))


def unspanned(unseen: Array, scale: Array) -> Array:
    """Orthonormal basis, in rows, of the directions of theta without information, from those of scaled regressors."""
    return np.asarray(np.linalg.qr(unseen / scale[:, None])[0].T)


def undetermined(hidden: Array) -> Array:
    """Which parameters have a component in undetermined directions."""
    return np.asarray(np.linalg.norm(hidden, axis=0) > 1e-8)


def gains(walk: Walk, G: Array, blocks: Array) -> Array:
    """Smoothing gains (T - 1, n, n): the part of theta_t that depends on theta_{t+1}.

    With M the root of the information of the samples up to t on F theta_t = x, g = E G sqrt(drift_{t+1}) = V s W' and F
    moving theta along its slope (F = 1 without slopes), x minimises

        |M x|^2 + |s^-1 V' (x - theta_{t+1})|^2

    The solution uses Householder reflections with the rows sorted by size. M'M would lose the information of the past
    if the drift is far above the noise, and computing the gain as 1 minus another matrix would cancel.
    """
    T, n = walk.phi.shape
    M = np.zeros((T, n + 1, n))
    rows, columns = np.triu_indices(n)
    M[:, rows, columns] = np.moveaxis(blocks["S"][:, 0], 1, 2).reshape(-1, len(rows))[:T]
    M[:, n] = np.sqrt(walk.weight)[:, None] * walk.phi
    g = G * np.sqrt(walk.drift[1:, None, None])
    if len(walk.drift_root):
        g = walk.drift_root[1:, :, None] * g
    back = np.broadcast_to(np.eye(n), (T - 1, n, n))
    if len(walk.trend):
        back = back - np.eye(n, k=n // 2) * walk.trend[1:, None, None]
    V, s, _ = np.linalg.svd(g)
    held = (V / np.maximum(s, STANDS_STILL)[:, None, :]).swapaxes(1, 2)
    A = np.concatenate([M[:-1] @ back, held], axis=1)
    b = np.concatenate([np.zeros((T - 1, n + 1, n)), held], axis=1)
    order = np.argsort(-np.abs(A).max(axis=2), axis=1)[:, :, None]
    A, b = np.take_along_axis(A, order, axis=1), np.take_along_axis(b, order, axis=1)
    pivots = np.argsort(-np.abs(A[:, 0]), axis=1)
    Q, R = np.linalg.qr(np.take_along_axis(A, pivots[:, None, :], axis=2))
    found, gain = np.linalg.solve(R, Q.swapaxes(1, 2) @ b), np.empty((T - 1, n, n))
    np.put_along_axis(gain, pivots[:, :, None], found, axis=1)
    return np.asarray(back @ gain)


def block_type(n: int) -> np.dtype[Any]:
    """The information of the two filters before `WIDTH` samples: packed S and d, lanes 0 and 1."""
    packed = n * (n + 1) // 2
    return np.dtype([("S", np.float64, (2, packed, WIDTH)), ("d", np.float64, (2, n, WIDTH))])


@lru_cache
def workspace(n: int, L: int) -> Array:
    """Scratch space of L lanes, to be copied."""
    square, vector = np.zeros((n, n)), np.zeros(n)
    names = {"S": square, "R": square, "G": square, "H": square, "d": vector, "x": vector, "row": vector}
    names |= {"pivot": vector}
    return make_tile(n, 0, {}, [{"theta": vector, "rho": 0.0, "c": 0.0, **names}] * L)


@Driver
def filters(
    work: Array, samples: Array, drift: Array, drift_root: Array, trend: Array, rows: Array, blocks: Array
) -> float:
    """Lane 0 goes forwards, lane 1 backwards; returns the sum of rho^2 of lane 0.

    ``samples`` (T, n + 1) are sqrt(w) phi and sqrt(w) y, ``rows`` (k, n + 1) the start: rows of theta and values.
    """
    s = work[0]
    T, n = samples.shape[0], s.d.shape[0]
    # information before the first sample, for the forward filter only
    s.H[:] = s.G
    for k in range(rows.shape[0]):
        for i in range(n):
            s.row[i, 0] = rows[k, i]
        absorb(s.S, s.d, s.row, rows[k, n], 0)
    cost = 0.0
    for t in range(T):
        # time update: the increment before the sample in this filter's direction of time
        if drift_root.shape[0] > 0:
            for l in range(2):
                for i in range(n):
                    for j in range(i, n):
                        s.H[i, j, l] = drift_root[t if l == 0 else T - t, i] * s.G[i, j, l]
        if trend.shape[0] > 0:
            shear(s.S, -trend[t], 0)
        for l in range(2):
            spread(s.S, s.d, s.H, drift[t if l == 0 else T - t], s.pivot, l)
        if trend.shape[0] > 0:
            shear(s.S, trend[T - t], 1)
        # store the information without the sample, then rotate the sample in
        for l in range(2):
            at = t if l == 0 else T - 1 - t
            block, lane = blocks[at // WIDTH], at % WIDTH
            k = 0
            for i in range(n):
                block.d[l, i, lane] = s.d[i, l]
                for j in range(i, n):
                    block.S[l, k, lane] = s.S[i, j, l]
                    k += 1
            for i in range(n):
                s.row[i, l] = samples[at, i]
            s.y[l] = samples[at, n]
        for l in range(2):
            s.rho[l], s.c[l] = absorb(s.S, s.d, s.row, s.y[l], l)
        cost += s.rho[0] * s.rho[0]
    return cost


@Driver
def meet(
    work: Array, samples: Array, blocks: Array, theta: Array, var: Array, rho: Array, c: Array, inverse: Array
) -> None:
    """Combine the two filters, `WIDTH` samples at a time."""
    s = work[0]
    T, n = samples.shape[0], s.d.shape[0]
    for b in range(blocks.shape[0]):
        block, first = blocks[b], b * WIDTH
        count = min(WIDTH, T - first)
        # information from the samples before: (S-, d-)
        k = 0
        for i in range(n):
            for l in range(WIDTH):
                s.d[i, l] = block.d[0, i, l]
                for j in range(i, n):
                    s.S[i, j, l] = block.S[0, k + j - i, l]
            k += n - i
        # rotate in the rows of (S+, d+), the information from the samples after
        k = 0
        for i in range(n):
            for l in range(WIDTH):
                for j in range(n):
                    s.row[j, l] = block.S[1, k + j - i, l] if j >= i else 0.0
                absorb(s.S, s.d, s.row, block.d[1, i, l], l)
            k += n - i
        # rotate in the sample itself: rho and the cosine c give residual and leverage
        for l in range(count):
            for i in range(n):
                s.row[i, l] = samples[first + l, i]
            s.y[l] = samples[first + l, n]
        for l in range(WIDTH):
            s.rho[l], s.c[l] = absorb(s.S, s.d, s.row, s.y[l], l)
        # theta = S^-1 d, and its variances from R = S^-1
        for l in range(WIDTH):
            solve(s.S, s.d, s.x, l)
            invert(s.S, s.R, l)
            for i in range(n):
                total = 0.0
                for j in range(i, n):
                    total += s.R[i, j, l] * s.R[i, j, l]
                s.var[i, l] = total
        for l in range(count):
            rho[first + l], c[first + l] = s.rho[l], s.c[l]
            for i in range(n):
                theta[first + l, i] = s.x[i, l]
                var[first + l, i] = s.var[i, l]
        if inverse.shape[0] > 0:
            for l in range(count):
                for i in range(n):
                    for j in range(n):
                        inverse[first + l, i, j] = s.R[i, j, l]
