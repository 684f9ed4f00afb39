"""The compiled routine of `driftfit.models.hammerstein_wiener.trackers.output_error`: one sample on plain arrays,
compiled once for all orders.

S is the covariance of [w, xi], of which the lower triangle is kept; its first n_w = max(na, 1) entries are the last
outputs of the linear block. ``own`` holds the numbers named below. The model's values for the present input and output
are in its memory (`driftfit.models.hammerstein_wiener.step_memory`).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import Array, floats, machine, part, shared, wholes
from driftfit.models.hammerstein_wiener.evaluate_bases import Kind, level_of, output_values
from driftfit.models.hammerstein_wiener.output_curve import inverse_of, level, rises
from driftfit.models.hammerstein_wiener.step_memory import (
    CURVE,
    D_NOW,
    EACH,
    G_PAST,
    GIVEN,
    GRID,
    HIGHEST,
    IDENTITY,
    INPUTS,
    LATE,
    LEVEL,
    LOWEST,
    N_OUT,
    NA,
    NB,
    OWN,
    OWN_F,
    OWN_N_IN,
    OWN_NB,
    OWN_NK,
    PREDICTED,
    RAW,
    STARTED,
    TRIAL,
    TRIAL_BEND,
    Places,
    room,
)
from driftfit.trackers.parts.covariance import LEFT

FLATTEST = 0.05
"""Least slope of F that the filter divides by, as a share of the slope of its functions."""
REACH = 3.0
"""w is limited to this many times the largest w of the observed outputs."""
TINY = 1e-300
"""Smallest variance of a missing input, so that a sample without an input is marked even if b is 0."""
WIDEST = 1e3
"""Largest standard deviation of w as a multiple of that: an unstable estimate must not grow without bound in an outage.
The cross-covariances shrink along."""
SHARE, LARGE = 0.01, 25.0
"""The weight of a sample in the usual power of v, and the largest multiple of that power that its square counts as, so
that a fault code cannot become the scale.
"""

TIME, Q_W, P_W, BEGUN, VALID, OBSERVED, OK, E, H, S2, LEAST_SLOPE, V_POWER = range(12)
"""Numbers of the filter: nominal intervals times the drift, variances, whether w has begun, what the sample has, the
innovation, its variance without and with the noise, and the least slope of F; from V_POWER on the usual power of v of
each input.
"""

AT_BLOCKS, AT_THETA, AT_PHI, AT_Q, AT_W, AT_S, AT_SCRATCH, AT_OWN, AT_P, ADDRESSES = range(10)
"""Addresses that are passed to the routine."""


@part
def at_d(p: Places) -> int:
    """Where d begins in xi."""
    found: int = p[NA] + p[NB]
    for i in range(p[INPUTS]):
        found += p[OWN + EACH * i + OWN_N_IN] - 1
    return found


@shared
def past_levels(m: Array, p: Places, w: Array, S: Array, p_w: float) -> None:
    """w = F(y) at the last outputs, each of variance p_w and independent of xi."""
    na, n_out, d, g = p[NA], p[N_OUT], p[D_NOW], p[G_PAST]
    for i in range(na):
        total = m[g + (i + 1) * n_out, 0]
        for k in range(1, n_out):
            total += m[d + k, 0] * m[g + (i + 1) * n_out + k, 0]
        w[i] = total if total == total else 0.0
        for x in range(i, len(S)):
            S[x, i] = 0.0
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


@part
def transition(p: Places, theta: Array, phi: Array, w: Array, row: Array) -> tuple[float, int]:
    """The row of the transition for the present w but for the intercept; returns w, and where d begins in the state."""
    na, n_w = p[NA], len(w)
    for x in range(len(row)):
        row[x] = 0.0
    total = 0.0
    for i in range(na):
        row[i] = -theta[i]
        row[n_w + i] = -w[i]
        total -= theta[i] * w[i]
    b, c, at = na, na + p[NB], na + p[NB] + p[N_OUT] - 1
    for i in range(p[INPUTS]):
        nb, more_in = p[OWN + EACH * i + OWN_NB], p[OWN + EACH * i + OWN_N_IN] - 1
        for j in range(nb):
            v = -phi[b + j]
            for k in range(more_in):
                f = -phi[at + k * nb + j]
                v += theta[c + k] * f
                row[n_w + c + k] += theta[b + j] * f
            row[n_w + b + j] = v
            total += theta[b + j] * v
        b, c, at = b + nb, c + more_in, at + nb * more_in
    return total, n_w + c


@shared
def advance(p: Places, theta: Array, phi: Array, w: Array, S: Array, scratch: Array, q_w: float, reach: float) -> None:
    """The time update of w, which is held within reach whatever the poles do, and of S."""
    n_w, N, row, moved = len(w), len(S), scratch[0], scratch[1]
    total, x_d = transition(p, theta, phi, w, row)
    for x in range(x_d + p[N_OUT] - 1, N):
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


@shared
def absorb(p: Places, own: Array, theta: Array, w: Array, S: Array, moved: Array) -> None:
    """The measurement update, with ``moved`` = S h of the forecast."""
    n_w = len(w)
    if own[OK] > 0.0:
        for x in range(len(S)):
            k = moved[x] / own[S2]
            if x < n_w:
                w[x] += k * own[E]
            else:
                theta[x - n_w] += k * own[E]
            for z in range(x):
                S[x, z] -= k * moved[z]
            S[x, x] = max(S[x, x] - k * moved[x], LEFT * S[x, x])


@shared
def unknown_power(m: Array, p: Places, theta: Array, own: Array) -> float:
    """The variance that missing inputs leave in w, sum b_j^2 times the usual power of v; 0 where all are there."""
    b, total = p[NA], 0.0
    for i in range(p[INPUTS]):
        at = OWN + EACH * i
        nb, n_in, f = p[at + OWN_NB], p[at + OWN_N_IN], p[at + OWN_F] + p[at + OWN_NK] * p[at + OWN_N_IN]
        for j in range(nb):
            missing = 0
            for k in range(n_in):
                missing += 0 if abs(m[f + j * n_in + k, 0]) < LARGEST else 1
            total += max(theta[b + j] * theta[b + j] * own[V_POWER + i], TINY) if missing > 0 else 0.0
        b += nb
    return total


@shared
def follow_power(m: Array, p: Places, theta: Array, own: Array) -> None:
    """Update the usual power of v, which is used for missing inputs."""
    c = p[NA] + p[NB]
    for i in range(p[INPUTS]):
        f, more_in = p[OWN + EACH * i + OWN_F], p[OWN + EACH * i + OWN_N_IN] - 1
        v = m[f, 0]
        for k in range(more_in):
            v += theta[c + k] * m[f + 1 + k, 0]
        if abs(v) < LARGEST:
            power = own[V_POWER + i]
            own[V_POWER + i] += SHARE * (min(v * v, LARGE * power) - power) if power > 0.0 else v * v
        c += more_in


@shared
def reach_of(m: Array, p: Places) -> float:
    """The largest |w| that the outputs observed so far allow."""
    low, high = m[LOWEST, 0], m[HIGHEST, 0]
    if p[IDENTITY] == 0:
        rising, last = rises(m, p), GRID - 1
        low = level(m, p, p[CURVE], 0) if rising else m[p[LEVEL], 0]
        high = level(m, p, p[CURVE], last) if rising else m[p[LEVEL] + last, 0]
    reach = REACH * max(abs(low), abs(high))
    return reach if reach > 0.0 and reach < LARGEST else LARGEST


@shared
def drift_theta(S: Array, q: Array, n_w: int, time: float) -> None:
    """The time update of the covariance of xi."""
    for i in range(len(q)):
        for j in range(i + 1):
            S[n_w + i, n_w + j] += q[i, j] * time


@shared
def covariance_of_theta(S: Array, n_w: int, P: Array) -> None:
    """P, the lower triangle of the block of xi."""
    for i in range(len(P)):
        for j in range(i + 1):
            P[i, j] = S[n_w + i, n_w + j]


@lru_cache
def _work(out: Kind) -> Any:
    """The time update and the forecast, for the functions of an output basis."""
    fill_trial, invert = output_values(out), inverse_of(level_of(out))

    def output_error_work(
        m: Array, p: Places, own: Array, theta: Array, phi: Array, w: Array, S: Array, scratch: Array
    ) -> None:
        n_out, d, free = p[N_OUT], p[D_NOW], at_d(p)
        for k in range(n_out - 1):
            m[d + k + 1, 0] = theta[free + k]
        if own[BEGUN] == 0.0 and m[STARTED, 0] > 0.0:
            past_levels(m, p, w, S, own[P_W])
            own[BEGUN] = 1.0
        power = unknown_power(m, p, theta, own)
        known = power == 0.0
        advance(p, theta, phi, w, S, scratch, own[Q_W] + power, reach_of(m, p))
        y_hat, y = (w[0] if p[IDENTITY] > 0 else invert(m, p, w[0])), m[RAW, 0]
        able = abs(y_hat) < np.inf
        fill_trial(m, p, y_hat if able else 0.0, p[TRIAL], p[TRIAL_BEND])
        slope = 0.0
        for k in range(n_out):
            slope += m[d + k, 0] * m[p[TRIAL_BEND] + k, 0]
        valid, observed = known and able and own[BEGUN] > 0.0, abs(y) < np.inf
        used = valid and observed and m[GIVEN, 0] < np.inf
        own[VALID], own[OBSERVED], own[OK] = 1.0 if valid else 0.0, 1.0 if observed else 0.0, 1.0 if used else 0.0
        own[E] = y - y_hat if used else 0.0
        row, slope = scratch[0], max(slope, own[LEAST_SLOPE])
        for x in range(len(S)):
            row[x] = 0.0
        row[0] = 1.0 / slope
        for k in range(1, n_out):
            row[len(w) + free + k - 1] = -m[p[TRIAL] + k, 0] / slope
        own[H] = product(S, row, scratch[1], 0.0)
        m[PREDICTED, 0], m[LATE, 0] = y_hat, 0.0

    return shared(output_error_work)


@lru_cache
def output_error(out: Kind, p: tuple[int, ...]) -> Any:
    """The compiled routine, for the functions of an output basis and the places of a model: time update and forecast,
    or the correction.
    """
    work, orders, rows = _work(out), np.array(p), room(p)

    def machine_output_error(fields: int, n_x: int, n: int, correcting: int) -> None:
        at, n_w, size = wholes(fields, 1, ADDRESSES), max(orders[NA], 1), V_POWER + orders[INPUTS]
        N, own = n_w + n_x, floats(at[0, AT_OWN], 1, size)[0]
        q, S, P = floats(at[0, AT_Q], n_x, n_x), floats(at[0, AT_S], N, N), floats(at[0, AT_P], n_x, n_x)
        theta, phi, w = (
            floats(at[0, AT_THETA], 1, n_x)[0],
            floats(at[0, AT_PHI], 1, n)[0],
            floats(at[0, AT_W], 1, n_w)[0],
        )
        scratch, m = floats(at[0, AT_SCRATCH], 2, N), floats(at[0, AT_BLOCKS], rows, 1)
        if correcting > 0:
            absorb(orders, own, theta, w, S, scratch[1])
            follow_power(m, orders, theta, own)
            covariance_of_theta(S, n_w, P)
        else:
            drift_theta(S, q, n_w, own[TIME])
            work(m, orders, own, theta, phi, w, S, scratch)

    return machine(machine_output_error)
