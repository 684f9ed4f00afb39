"""The risk that the next s samples are expected to leave, for deciding whether to wait for them.

    ER_s = int min_k sum_e L[e, k] f_e(y) dy,   f_e(y) = sum over leaves with oldest event e, and next events e',
           w_l P[e_l, e'] N(y; z'm_l + b_e', r_e' / s + z'(C_l + Q_e') z)

A minimum of averages is at most the average of minima, so ER_s <= R*: waiting never costs information, only time. For
several samples y is their mean, which contains less information than all of them: the risk is at most ER_s if they have
one regressor and nothing happens between them. One sample alone may decide nothing where ten decide all.

The integral is the mean, over the components of the density of y, of min_k sum_e L[e, k] p(e | y), by the trapezoidal
rule at mean +- 6 standard deviations of each. The next regressors are not known; the last one before the open events is
used, because the leaves agree about regressors to which they have already been fitted. Cost: components^2 x nodes x s;
used only while a decision is open.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from driftfit.bank.leaves.forecast import FACTOR, FROZEN, STUCK, VALUE
from driftfit.bank.leaves.forget import KEEP, MEAN, RESET
from driftfit.bank.leaves.leaf_matrix import CODE, FIRST, NU, WEIGHT, S, lag_row
from driftfit.engine.kernel import Array, exp, shared

NODES = 65
"""Nodes for every component."""


@shared
def regressor(t: Any, l: int, phi: Array) -> None:
    """The regressor of one leaf, in the first column of z."""
    z, rows, lags = t.z, t.lag_rows, lag_row(t)
    for i in range(t.n):
        z[i, 0] = phi[i]
        for k in range(t.output_lags):
            z[i, 0] += rows[k, i] * (t.leaves[lags + k, l] - rows[k, t.n])


@shared
def width(t: Any, l: int, keep: float, q: Array) -> float:
    """z' (keep C + Q) z of a leaf."""
    B, z, at, wide = t.leaves, t.z, 0, 0.0
    for i in range(t.n):
        for j in range(i + 1):
            wide += z[i, 0] * z[j, 0] * (keep * B[FIRST + t.n + at, l] + q[at]) * (1.0 if i == j else 2.0)
            at += 1
    return wide


@shared
def density_parts(t: Any, L: int, top: float, mass: float, phi: Array, samples: int) -> int:
    """Components of the density of the mean of so many samples as columns: oldest event, weight, mean, standard
    deviation.
    """
    B, Q, maps, theta0, sensors, out = t.leaves, t.Q, t.maps, t.places[MEAN], t.sensors, t.components
    n, z, Hm, count, last, r = t.n, t.z, len(t.sensors), 0, t.last, t.r
    P, same = t.chain, t.independent > 0 and t.chained == 0
    for l in range(L):
        if t.group[l] < 0:
            continue
        unit = B[S, l] / (B[NU, l] - 2.0) if t.unknown > 0 else 1.0
        regressor(t, l, phi)
        # forecast of the output under every change c
        for c in range(len(t.walks)):
            mean, wide = 0.0, width(t, l, maps[c, KEEP], Q[c])
            for i in range(n):
                mean += z[i, 0] * (theta0[i] if maps[c, RESET] > 0.0 else B[FIRST + i, l])
            # and every sensor j: weight, mean and standard deviation of one component
            for j in range(Hm):
                e = c * Hm + j
                chance = (P[0, e] if same else P[t.event[l], e]) * B[WEIGHT, l] / mass
                frozen = sensors[j, FROZEN] > 0.0
                if chance <= 0.0 or count >= out.shape[1] or (frozen and not abs(last) < np.inf):
                    continue
                out[0, count], out[1, count] = B[CODE, l] // top, chance
                if frozen:
                    stuck = sensors[j, STUCK]
                    out[2, count] = last
                    out[3, count] = math.sqrt(stuck if stuck > 0.0 else -stuck * r * unit)
                else:
                    out[2, count] = mean + sensors[j, VALUE]
                    out[3, count] = math.sqrt((wide + sensors[j, FACTOR] * r / samples) * unit)
                count += 1
    return count


@shared
def integrate(parts: Array, count: int, loss: Array, f: Array) -> float:
    """int min_k sum_e L[e, k] f_e(y) dy over all components."""
    H, total, step = len(loss), 0.0, 12.0 / (NODES - 1)
    for node in range(count * NODES):
        of, x = node // NODES, step * (node % NODES) - 6.0
        y, mass, least = parts[2, of] + parts[3, of] * x, 0.0, np.inf
        for e in range(H):
            f[e] = 0.0
        for a in range(count):
            far = (y - parts[2, a]) / parts[3, a]
            share = parts[1, a] / parts[3, a] * exp(-0.5 * far * far)
            f[int(parts[0, a])] += share
            mass += share
        for d in range(H):
            risk = 0.0
            for e in range(H):
                risk += loss[e, d] * f[e]
            least = min(least, risk)
        total += parts[1, of] * exp(-0.5 * x * x) * step / math.sqrt(2.0 * math.pi) * least / mass
    return total


@shared
def expected_risk(t: Any, L: int, top: float, mass: float, phi: Array, samples: int) -> float:
    """ER_s for the oldest event held, whose digit in the codes counts ``top``, of leaves of that mass in all."""
    return float(integrate(t.components, density_parts(t, L, top, mass, phi, samples), t.loss, t.scratch[2]))
