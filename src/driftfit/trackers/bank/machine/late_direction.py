"""Regressors that are the first along a direction of theta, after the tree has begun.

While the regressors do not span all of theta, a leaf N(m, C) is N(m, C + kappa N N') with kappa to infinity: the
columns of N are orthogonal to all regressors so far, and nothing in their span depends on kappa. A regressor z with
u = z'r not zero, for a column r of N, changes every leaf in the limit to

    m <- m + (y - z'm) r / u,    C <- G C G' + v r r' / u^2,    G = I - r z' / u

and no weight, because all leaves have the same kappa: a change that resets theta resets what has been determined. The
covariances that are kept for a gap (`driftfit.trackers.bank.machine.gaps`) become G A G'. The uncertainty of separate
output lags is neglected at this sample; N has no part in output lags, or else the tree waits for full rank.

Source: Durbin and Koopman, Time Series Analysis by State Space Methods (2012), section 5.2. Cost: O(n^2) per leaf.
"""

from __future__ import annotations

from typing import Any

from driftfit.engine.kernel import Array, State, floats, kernel, shared
from driftfit.trackers.bank.layout import ENTERS, IN_NOISE, IN_Y, MEMORY_AT, ROW, R, memory_at
from driftfit.trackers.bank.leaves.forget import GROWTH, PER_CAP, RAY
from driftfit.trackers.bank.leaves.leaf_matrix import FIRST, spread
from driftfit.trackers.bank.reducing.selection import KIND, REFILTER
from driftfit.trackers.parts.coordinates import frame
from driftfit.trackers.parts.diffuse import SIZE

PLACES, OUTPUT_LAGS = ROW["places"], ROW["output_lags"]


@shared
def across(t: Any, A: Array) -> None:
    """A <- G A G', a lower triangle."""
    r, phi, g, u, n = t.places[RAY], t.phi, t.g, t.sample[ENTERS], t.n
    h = 0.0
    for i in range(n):
        g[i, 0] = 0.0
        for j in range(n):
            g[i, 0] += A[i * (i + 1) // 2 + j if j <= i else j * (j + 1) // 2 + i] * phi[j]
        h += phi[i] * g[i, 0]
    at = 0
    for i in range(n):
        for j in range(i + 1):
            A[at] += (r[i] * r[j] * h / u - r[i] * g[j, 0] - r[j] * g[i, 0]) / u
            at += 1


@shared
def spread_along(t: Any, B: Array, L: int, v: float) -> None:
    """The covariances of leaves, with noise variance v."""
    r, g, u, first = t.places[RAY], t.g, t.sample[ENTERS], FIRST + t.n
    spread(B[first:], t.z, B[FIRST:], L, t.n, t.output_lags, g, t.expected)
    at = first
    for i in range(t.n):
        for j in range(i + 1):
            for l in range(L):
                far = r[i] * r[j] * (t.expected[0, l] + v) / u
                B[at, l] += (far - r[i] * g[j, l] - r[j] * g[i, l]) / u
            at += 1


@shared
def move_along(t: Any, B: Array, L: int) -> None:
    """The means of leaves."""
    r, z, u = t.places[RAY], t.z, t.sample[ENTERS]
    for l in range(L):
        e, k = t.sample[IN_Y], l if t.output_lags > 0 else 0
        for i in range(t.n):
            e -= z[i, k] * B[FIRST + i, l]
        for i in range(t.n):
            B[FIRST + i, l] += r[i] * e / u


@shared
def determine(t: Any, L: int) -> None:
    """Make all leaves take in a sample along a new direction. Their time update is made, and z is of this sample."""
    r, u, H = t.places[RAY], t.sample[ENTERS], len(t.row)
    v = t.sample[R] * t.sample[IN_NOISE]
    move_along(t, t.leaves, L)
    spread_along(t, t.leaves, L, v)
    if int(t.reduction[KIND]) == REFILTER:
        move_along(t, t.root, 1)
        spread_along(t, t.root, 1, v)
    for i in range(1, len(t.gap)):
        across(t, t.gap[i])
    for i in range(2 * H, len(t.path) - 1):
        across(t, t.path[i])
    for i in range(t.n):
        if r[i] != 0.0:
            t.places[PER_CAP, i] = u * u / (GROWTH * v * r[i] * r[i])


@kernel
def nearest(s: State, l: int) -> None:
    """P without the directions that are not determined, so that a change moves theta no further than the data
    require.
    """
    n = s.theta.shape[0]
    for k in range(n):
        h = 0.0
        for i in range(n if s.S[k, k, l] == 0.0 else 0):
            s.g[i, l] = 0.0
            for j in range(n):
                s.g[i, l] += (s.P[i, j, l] if j <= i else s.P[j, i, l]) * s.H[j, k, l]
            h += s.g[i, l] * s.H[i, k, l]
        for i in range(n if s.S[k, k, l] == 0.0 else 0):
            for j in range(i + 1):
                a, b = s.H[i, k, l], s.H[j, k, l]
                s.P[i, j, l] += h * a * b - a * s.g[j, l] - b * s.g[i, l]


@kernel
def begin_within(s: State, l: int) -> bool:
    """Whether the tree can begin in the span of the regressors so far: what they have determined is determined well
    enough for a covariance, and the rest has no part in separate output lags.
    """
    n, na = s.theta.shape[0], s.table[OUTPUT_LAGS, 0, l]
    good = s.rank[l] < n
    for j in range(n):
        if s.S[j, j, l] > 0.0:
            good = good and s.P[j, j, l] * s.work[SIZE, j, l] ** 2 <= s.worst[l]
        else:
            for i in range(na):
                good = good and s.R[i, j, l] == 0.0
    if good:
        frame(s, l)
        nearest(s, l)
    return good  # type: ignore[no-any-return]


@kernel
def point_along(s: State, column: int, l: int) -> float:
    """Write the direction of a free column for the compiled routine; returns its product with the regressor."""
    n, u = s.theta.shape[0], 0.0
    memory = floats(memory_at(s), s.table[MEMORY_AT, 2, 0], s.theta.shape[1])
    start = s.table[PLACES, 0, l] // 8 + RAY * n
    for i in range(n):
        memory[start + i, l] = s.R[i, column, l]
        u += s.R[i, column, l] * s.phi[i, l]
    return u
