"""The machine behind `driftfit.models.hammerstein_wiener.trackers.output_error`: one sample on plain arrays, compiled
once for all orders.

S is the covariance of [w, xi], of which the lower triangle is kept; its first n_w = max(na, 1) entries are the last
outputs of the linear block. ``own`` holds the numbers named below. What the model says of the present input and output
stands in its memory (`driftfit.models.hammerstein_wiener.memory`).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array, core, floats, outside, part
from driftfit.models.hammerstein_wiener.memory import (
    CURVE,
    D_NOW,
    F_PAST,
    G_PAST,
    GIVEN,
    GRID,
    HIGHEST,
    IDENTITY,
    LATE,
    LEVEL,
    LOWEST,
    N_IN,
    N_OUT,
    NA,
    NB,
    NK,
    PREDICTED,
    RAW,
    STARTED,
    TRIAL,
    TRIAL_BEND,
    Places,
)
from driftfit.models.hammerstein_wiener.output_curve import inverse_of, level, rises
from driftfit.models.hammerstein_wiener.values import Kind, level_of, output_values

FLATTEST = 0.05
"""Least slope of F that the filter divides by."""
REACH = 3.0
"""Times the largest w of the outputs seen: w is held within that."""
WIDEST = 1e3
"""Largest standard deviation of w as a multiple of that: an unstable estimate must not grow without end in an outage.
The cross-covariances shrink along."""
MEMORY, FIRST, LARGE = 100.0, 10.0, 25.0
"""Samples over which the power of v is remembered; how many are taken as they come, and the multiple of it by which a
later square counts at most: a fault code may not make a scale of its own."""

TIME, R, Q_W, P_W, V_POWER, COUNTED, BEGUN, VALID, SEEN, OK, E, S2, SIZE = range(13)
"""Numbers of the filter: nominal intervals times the drift, variances, power of v and of how many samples, whether w
stands, what comes out."""


@core
def past_levels(m: Array, p: Places, w: Array, S: Array, p_w: float) -> None:
    """w = F(y) at the last outputs, each of variance p_w."""
    na, n_out, d, g = p[NA], p[N_OUT], p[D_NOW], p[G_PAST]
    for i in range(na):
        total = m[g + (i + 1) * n_out, 0]
        for k in range(1, n_out):
            total += m[d + k, 0] * m[g + (i + 1) * n_out + k, 0]
        w[i] = total if total == total else 0.0
        S[i, i] = p_w


@part
def product(S: Array, row: Array, moved: Array, total: float) -> float:
    """moved = S row from the lower triangle; returns row' S row, added to a total."""
    N = len(S)
    for x in range(N):
        value = 0.0
        for z in range(x + 1):
            value += S[x, z] * row[z]
        for z in range(x + 1, N):
            value += S[z, x] * row[z]
        moved[x] = value
        total += row[x] * value
    return total


@core
def advance(
    p: Places, theta: Array, phi: Array, w: Array, S: Array, row: Array, moved: Array, q_w: float, reach: float
) -> None:  # fmt: skip
    """The time update of w, which is held within reach whatever the poles do, and of S."""
    na, nb, n_in, n_out = p[NA], p[NB], p[N_IN], p[N_OUT]
    n_w, N = len(w), len(S)
    at_bc = na + nb + n_out - 1
    x_c = n_w + na + nb
    total = 0.0
    for i in range(N):
        row[i] = 0.0
    for i in range(na):
        row[i] = -theta[i]
        row[n_w + i] = -w[i]
        total -= theta[i] * w[i]
    for j in range(nb):
        v = -phi[na + j]
        for k in range(n_in - 1):
            f = -phi[at_bc + k * nb + j]
            v += theta[na + nb + k] * f
            row[x_c + k] += theta[na + j] * f
        row[n_w + na + j] = v
        total += theta[na + j] * v
    for x in range(x_c + n_in - 1 + n_out - 1, N):
        row[x] = -1.0
        total -= theta[x - n_w]
    own = product(S, row, moved, q_w)
    for i in range(n_w - 1, 0, -1):
        w[i] = w[i - 1]
        for j in range(i, 0, -1):
            S[i, j] = S[i - 1, j - 1]
        for x in range(n_w, N):
            S[x, i] = S[x, i - 1]
    most = WIDEST * WIDEST * reach * reach
    shrink = np.sqrt(most / own) if own > most else 1.0
    for x in range(1, N):
        S[x, 0] = shrink * (moved[x - 1] if x < n_w else moved[x])
    S[0, 0] = min(own, most)
    w[0] = min(max(total, -reach), reach)


@core
def absorb(
    e: float, slope: float, m: Array, p: Places, r: float, ok: bool, theta: Array, w: Array, S: Array, row: Array,
    moved: Array,
) -> float:  # fmt: skip
    """The measurement update; returns the variance of the innovation."""
    n_w, N, n_out, g = len(w), len(S), p[N_OUT], p[TRIAL]
    x_d = n_w + p[NA] + p[NB] + p[N_IN] - 1
    for x in range(N):
        row[x] = 0.0
    row[0] = 1.0 / slope
    for k in range(1, n_out):
        row[x_d + k - 1] = -m[g + k, 0] / slope
    s: float = product(S, row, moved, r)
    if ok:
        for x in range(N):
            k = moved[x] / s
            if x < n_w:
                w[x] += k * e
            else:
                theta[x - n_w] += k * e
            for z in range(x + 1):
                S[x, z] -= k * moved[z]
    return s


@core
def inputs_known(m: Array, p: Places) -> bool:
    """Whether all inputs that the linear block needs are there."""
    nb, nk, n_in = p[NB], p[NK], p[N_IN]
    missing = 0
    for k in range(n_in):
        for j in range(nb):
            missing += 0 if abs(m[p[F_PAST] + (nk + j) * n_in + k, 0]) < LARGEST else 1
    return missing == 0


@core
def follow_power(m: Array, p: Places, theta: Array, own: Array) -> None:
    """The usual power of v, which stands for inputs that are missing."""
    na, nb, f = p[NA], p[NB], p[F_PAST]
    v = m[f, 0]
    for k in range(1, p[N_IN]):
        v += theta[na + nb + k - 1] * m[f + k, 0]
    if abs(v) < LARGEST:
        square = min(v * v, LARGE * own[V_POWER]) if own[COUNTED] >= FIRST and own[V_POWER] > 0.0 else v * v
        own[COUNTED] = min(own[COUNTED] + 1.0, MEMORY)
        own[V_POWER] += (square - own[V_POWER]) / own[COUNTED]


@core
def reach_of(m: Array, p: Places) -> float:
    """How large w may be, by the outputs seen."""
    low, high = m[LOWEST, 0], m[HIGHEST, 0]
    if p[IDENTITY] == 0:
        rising, last = rises(m, p), GRID - 1
        low = level(m, p, p[CURVE], 0) if rising else m[p[LEVEL], 0]
        high = level(m, p, p[CURVE], last) if rising else m[p[LEVEL] + last, 0]
    reach = REACH * max(abs(low), abs(high))
    return reach if reach > 0.0 and reach < LARGEST else LARGEST


@lru_cache
def _work(out: Kind) -> Any:
    """One sample, for the functions of an output basis."""
    fill_trial, invert = output_values(out), inverse_of(level_of(out))

    def output_error_work(
        m: Array, p: Places, own: Array, theta: Array, phi: Array, q: Array, w: Array, S: Array, P: Array, row: Array,
        moved: Array,
    ) -> None:  # fmt: skip
        na, nb, n_in, n_out, d = p[NA], p[NB], p[N_IN], p[N_OUT], p[D_NOW]
        n_w, n_x = len(w), len(theta)
        for i in range(n_x):
            for j in range(i + 1):
                S[n_w + i, n_w + j] += q[i, j] * own[TIME]
        for k in range(n_out - 1):
            m[d + k + 1, 0] = theta[na + nb + n_in - 1 + k]
        if own[BEGUN] == 0.0 and m[STARTED, 0] > 0.0:
            past_levels(m, p, w, S, own[P_W])
            own[BEGUN] = 1.0
        known, power = inputs_known(m, p), 0.0
        for j in range(nb):
            power += theta[na + j] * theta[na + j]
        q_w = own[Q_W] + (0.0 if known else power * own[V_POWER])
        advance(p, theta, phi, w, S, row, moved, q_w, reach_of(m, p))
        y_hat, y = (w[0] if p[IDENTITY] > 0 else invert(m, p, w[0])), m[RAW, 0]
        able = abs(y_hat) < np.inf
        fill_trial(m, p, y_hat if able else 0.0, p[TRIAL], p[TRIAL_BEND])
        slope = 0.0
        for k in range(n_out):
            slope += m[d + k, 0] * m[p[TRIAL_BEND] + k, 0]
        valid, seen = known and able and own[BEGUN] > 0.0, abs(y) < np.inf
        used = valid and seen and m[GIVEN, 0] < np.inf
        own[VALID], own[SEEN], own[OK] = 1.0 if valid else 0.0, 1.0 if seen else 0.0, 1.0 if used else 0.0
        own[E] = y - y_hat if used else 0.0
        r = own[R] * m[GIVEN, 0] if used else own[R]
        own[S2] = absorb(own[E], max(slope, FLATTEST), m, p, r, used, theta, w, S, row, moved)
        m[PREDICTED, 0], m[LATE, 0] = y_hat, 0.0
        follow_power(m, p, theta, own)
        for i in range(n_x):
            for j in range(i + 1):
                P[i, j] = S[n_w + i, n_w + j]

    return core(output_error_work)


@lru_cache
def output_error(out: Kind, p: tuple[int, ...]) -> Any:
    """The machine for the functions of an output basis and the places of a model."""
    work, orders = _work(out), np.array(p)

    def machine_output_error(
        blocks: int, theta: int, phi: int, q: int, w: int, S: int, scratch: int, own: int, P: int, n_x: int, n: int,
    ) -> None:  # fmt: skip
        n_w = max(orders[NA], 1)
        N = n_w + n_x
        work(
            floats(blocks, 1, 1), orders, floats(own, 1, SIZE)[0], floats(theta, 1, n_x)[0], floats(phi, 1, n)[0],
            floats(q, n_x, n_x), floats(w, 1, n_w)[0], floats(S, N, N), floats(P, n_x, n_x), floats(scratch, 2, N)[0],
            floats(scratch, 2, N)[1],
        )  # fmt: skip

    return outside(machine_output_error)
