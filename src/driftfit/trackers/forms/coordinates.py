"""Coordinates in which several filters run in parallel, and in which the information of the start is white.

    z = M theta,    x = M^-T phi,    phi' theta = x' z

M is the square root of information S of the diffuse start (`driftfit.trackers.forms.diffuse`) at the time when the
filters started, with a 1 on the diagonal of each column that was free. z therefore starts with the covariance r I,
however different the units and however large the offsets next to an intercept. A covariance of theta would have the
square of such an offset as its condition number, and lose as many digits; x has only the rounding of the readings
themselves. A random walk of theta with covariance diag(q) is one of z with covariance M diag(q) M'.

A free column has x_j = 0: directions that no sample has determined take no part. A regressor that leaves the span of
the earlier ones does so by its first free column j with a component rho_j that is not 0. Then row j of M becomes rho,
the rest of phi,

    rho = phi - sum_{i<j} x_i M_i.,    z_j = rho' theta,    y = sum_{i<j} x_i z_i + z_j + v

and every filter estimates z_j from the rest of the innovation: m_j = e, C_jj = h + var v, C_ij = -g_i. This is the
limit of any prior of z_j whose variance grows without bound, also for a rho_j close to rounding: nothing is divided by
it.

The same change of coordinates is made if a sample carries so much more information on z_j than all earlier ones that a
covariance would keep no digits of the rest (`outgrown`). The prior of z_j is finite then, and correlated with the
others: they take the sample as always, C_ib - g_i g_b / s, and row j follows from them and from their correlation
-g r / s with v (`driftfit.bank.machine.framed` derives both). It is exact at any ratio.

Source: the square-root form is Bierman's (1977); filters in fixed coordinates of it are ours. Cost per sample: O(n^2)
for x; O(n^3) where a column enters.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array, State, exp, kernel, shared
from driftfit.trackers.forms.diffuse import ENTERING, ROW, SQUARE, VOLUME, estimate, outside, refresh, unseen

OUTGROWN = 1e12
"""Smallest information that one sample adds to a coordinate, as a multiple of the earlier information, at which the
regressor becomes a coordinate: a covariance in the old ones would keep four of sixteen digits of the rest.
"""

LEAST_VARIANCE = 1e-15
"""A variance below this share of the sum of its squares is rounding."""


@shared
def place(phi: Array, S: Array, work: Array, now: Array) -> None:
    """x in ``work[ROW]``, up to the column by which phi leaves the span, if it does."""
    entering, u, _ = outside(phi, S, work)
    now[ENTERING], now[SQUARE] = entering, u * u
    for i in range(entering if entering >= 0 else len(S), len(S)):
        work[ROW, i] = 0.0


@kernel
def whiten_within(s: State, phi: Array, l: int) -> int:
    """x of a regressor if columns are free; returns the column along which it leaves the span of earlier regressors, or
    -1."""
    place(phi, s.S[:, :, l], s.work[:, :, l], s.at_start[:, l])
    for i in range(s.d.shape[0]):
        s.x[i, l] = s.work[ROW, i, l]
    return int(s.at_start[ENTERING, l])


@kernel
def frame(s: State, l: int) -> None:
    """After a change of M: its inverse R, and s.H, a basis of what is not determined."""
    refresh(s.S[:, :, l], s.R[:, :, l], s.work[:, :, l])
    s.at_start[VOLUME, l] = unseen(s.S[:, :, l], s.R[:, :, l], s.H[:, :, l], 0.0)
    s.root[l] = 1 if s.rank[l] < s.d.shape[0] else 0


@kernel
def new_row(s: State, phi: Array, j: int, l: int) -> float:
    """Make the rest of phi row j of M; returns the sign by which that row was multiplied."""
    n = s.theta.shape[0]
    rest = phi[j, l]
    for i in range(j):
        rest -= s.x[i, l] * s.S[i, j, l]
    sign = 1.0 if rest > 0.0 else -1.0
    fresh = s.S[j, j, l] == 0.0
    s.S[j, j, l] = abs(rest)
    for k in range(j + 1, n):
        rest = phi[k, l]
        for i in range(j):
            rest -= s.x[i, l] * s.S[i, k, l]
        s.S[j, k, l] = sign * rest
    frame(s, l)
    if fresh:
        s.F[s.rank[l], l] = s.at_start[SQUARE, l] * exp(s.at_start[VOLUME, l] - s.volume[l])
        s.rank[l] += 1
        s.volume[l] = s.at_start[VOLUME, l]
        s.root[l] = 1 if s.rank[l] < n else 0
    return sign


@kernel
def located_within(s: State, l: int) -> None:
    """theta = M^-1 d where columns are free: it does not change in the directions without information."""
    estimate(s.S[:, :, l], s.d[:, l], s.H[:, :, l], s.theta[:, l], s.work[ROW, :, l], 0.0)


@kernel
def in_units_of_theta(s: State, l: int) -> None:
    """The lower triangle of P = R P R', its diagonal at least as large as its rounding errors."""
    n = s.theta.shape[0]
    for i in range(n):
        for b in range(n):
            total = 0.0
            for a in range(i, n):
                total += s.R[i, a, l] * (s.P[a, b, l] if b <= a else s.P[b, a, l])
            s.W[i, b, l] = total
    for i in range(n):
        squares = 0.0
        for a in range(i, n):
            squares += s.R[i, a, l] * s.R[i, a, l] * s.P[a, a, l]
        for j in range(i + 1):
            total = 0.0
            for b in range(j, n):
                total += s.W[i, b, l] * s.R[j, b, l]
            s.P[i, j, l] = total
        s.P[i, i, l] = max(s.P[i, i, l], LEAST_VARIANCE * squares)


@kernel
def unseen_variance(s: State, l: int) -> None:
    """An infinite variance for what no sample has determined yet."""
    n = s.theta.shape[0]
    for i in range(n):
        for j in range(i, n):
            if s.S[j, j, l] == 0.0 and s.R[i, j, l] != 0.0:
                s.var[i, l] = np.inf
