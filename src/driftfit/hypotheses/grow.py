"""One floor of the tree: every leaf with every change, then the sample under every sensor.

    C- = C / forget + Q_i,     s = factor_j r + z'C- z,     eps = y - b_j - z'm,     K = C- z / s
    m+ = m + K eps,            C+ = C- - K (C- z)'
    log w+ = log w + log p(event | leaf) + log N(eps; 0, s)

With unknown noise variance (nu, S; C in its units, s above with r = 1):

    log p = lgamma((nu+1)/2) - lgamma(nu/2) - 1/2 log(pi S s) - (nu+1)/2 log(1 + eps^2 / (S s)),   nu <- nu + 1,
    S <- S + eps^2 / s

after nu and S were multiplied by the forgetting factor of the variance. The children of K leaves stand in the order
sensor, change, leaf: child (j H_d + i) K + l.
"""

from __future__ import annotations

import math

import numpy as np

from driftfit.hypotheses.forecast import CLEANS, FACTOR, FROZEN, VALUE, WIDTH
from driftfit.hypotheses.forget import apply
from driftfit.hypotheses.lags import shift_covariance, widen_by_lags
from driftfit.hypotheses.leaves import AGE, CHANGES, CODE, FIRST, LOG, NU, SENSORS, S, regressors, spread
from driftfit.kernel import Array, core, log

LOG_2PI, LOG_PI = math.log(2.0 * math.pi), math.log(math.pi)
FLOOR = 1e-12
"""S never falls below this share of nu times the mean square of y: the data's own rounding."""


@core
def develop(
    A: Array, K: int, n: int, Q: Array, maps: Array, places: Array, own: bool, Hm: int, C: Array, m: Array, g: Array,
    h: Array,
) -> int:  # fmt: skip
    """Every leaf under every change: C and m of the columns c K + l. With ``own`` leaf l stands for the joint event l
    alone. Returns the number of columns.
    """
    first = FIRST + n
    if own:
        for l in range(K):
            c = l // Hm
            for k in range(Q.shape[1]):
                C[k, l] = maps[c, 0] * A[first + k, l] + Q[c, k]
            for i in range(n):
                m[i, l] = places[0, i] if maps[c, 1] > 0.0 else A[FIRST + i, l]
        for c in range(len(Q)):
            apply(C, m, c * Hm, (c + 1) * Hm, c, maps, places, Q, g, h)
        return K
    for c in range(len(Q)):
        keep, block = maps[c, 0], slice(c * K, (c + 1) * K)
        for k in range(Q.shape[1]):
            q, to = Q[c, k], C[k, block]
            for l in range(K):
                to[l] = keep * A[first + k, l] + q
        for i in range(n):
            to = m[i, block]
            for l in range(K):
                to[l] = A[FIRST + i, l]
            if maps[c, 1] > 0.0:
                to[:] = places[0, i]
        apply(C, m, c * K, (c + 1) * K, c, maps, places, Q, g, h)
    return K * len(Q)


@core
def correct(
    B: Array, block: slice, n: int, C: Array, m: Array, g: Array, h: Array, y_hat: Array, y: float, noise: float,
    X: Array,
) -> None:  # fmt: skip
    """The data in a block of columns; innovations and their variances go to the first two rows of X."""
    eps, s, gain, k = X[0], X[1], X[2], X[3]
    columns, row, at = block.stop - block.start, FIRST + n, 0
    for l in range(columns):
        s[l] = h[l] + noise
        eps[l] = y - y_hat[l]
        gain[l] = 1.0 / s[l]
    for i in range(n):
        mean = B[FIRST + i, block]
        for l in range(columns):
            k[l] = gain[l] * g[i, l]
            mean[l] = m[i, l] + k[l] * eps[l]
        for j in range(i + 1):
            to = B[row + at, block]
            for l in range(columns):
                to[l] = C[at, l] - k[l] * g[j, l]
            at += 1


@core
def leave(B: Array, block: slice, n: int, C: Array, m: Array) -> None:
    """A sensor that says nothing of theta."""
    for i in range(n):
        to = B[FIRST + i, block]
        for l in range(len(to)):
            to[l] = m[i, l]
    for k in range(len(C)):
        to = B[FIRST + n + k, block]
        for l in range(len(to)):
            to[l] = C[k, l]


@core
def gaussian(eps: Array, s: Array, columns: int, out: Array) -> None:
    """log N(eps; 0, s)."""
    for l in range(columns):
        out[l] = -0.5 * (LOG_2PI + log(s[l]) + eps[l] * eps[l] / s[l])


@core
def student(nus: Array, scales: Array, eps: Array, s: Array, fade: float, least: float, out: Array) -> None:
    """Log density with unknown variance; nu and S take the sample in."""
    before, ratio = np.nan, 0.0
    for l in range(len(nus)):
        nu = fade * nus[l]
        if nu != before:
            before, ratio = nu, math.lgamma(0.5 * (nu + 1.0)) - math.lgamma(0.5 * nu)
        out[l] = ratio
    for l in range(len(nus)):
        nu, scale = fade * nus[l], fade * scales[l]
        far = eps[l] * eps[l] / s[l]
        out[l] -= 0.5 * (LOG_PI + log(scale) + log(s[l])) + 0.5 * (nu + 1.0) * log(1.0 + far / scale)
        nus[l] = nu + 1.0
        scales[l] = max(scale + far, least * (nu + 1.0))


@core
def frozen(nus: Array, scales: Array, y: float, last: float, width: float, r: float, unknown: bool, out: Array) -> None:
    """Log density of the last output again."""
    for l in range(len(nus)):
        wide = width
        if width <= 0.0:
            wide = -width * (scales[l] / (nus[l] - 2.0) if unknown else r)
        far = y - last
        out[l] = -0.5 * (LOG_2PI + log(wide) + far * far / wide) if abs(last) < np.inf else -np.inf


@core
def grow(
    A: Array, K: int, B: Array, phi: Array, y: float, last: float, noise: float, r: float, unknown: bool, fade: float,
    least: float, na: int, Q: Array, maps: Array, places: Array, sensors: Array, prior: Array, own: bool, bases: Array,
    parent: Array, event: Array, X: Array,
) -> int:  # fmt: skip
    """The children of K leaves, with their weights not normalised; returns how many there are."""
    n, Hd, Hm = len(phi), len(Q), len(sensors)
    tri = n * (n + 1) // 2
    C, m, Z, g = X[:tri], X[tri : tri + n], X[tri + n : tri + 2 * n], X[tri + 2 * n : tri + 3 * n]
    h, y_hat, likely = X[tri + 3 * n], X[tri + 3 * n + 1], X[tri + 3 * n + 2]
    scratch = X[tri + 3 * n + 3 :]
    columns = develop(A, K, n, Q, maps, places, own, Hm, C, m, g, h)
    regressors(phi, A, K, n, na, Z)
    for i in range(n):
        for c in range(1, columns // K):
            to = Z[i, c * K : (c + 1) * K]
            for l in range(K):
                to[l] = Z[i, l]
    spread(C, Z, m, columns, g, h, y_hat)
    widen_by_lags(A, K, columns, n, na, m, h)
    for j in range(Hm):
        block = slice(j * columns, (j + 1) * columns)
        inherit(A, K, B, block, unknown, bases)
        if sensors[j, FROZEN] > 0.0:
            leave(B, block, n, C, m)
            frozen(B[NU, block], B[S, block], y, last, sensors[j, WIDTH], r, unknown, likely)
        else:
            correct(B, block, n, C, m, g, h, y_hat, y - sensors[j, VALUE], sensors[j, FACTOR] * r * noise, scratch)
            if unknown:
                student(B[NU, block], B[S, block], scratch[0], scratch[1], fade, least, likely)
            else:
                gaussian(scratch[0], scratch[1], columns, likely)
        if na > 0:
            own_lags = sensors[j, CLEANS] > 0.0
            remember(A, K, B, block, n, na, y - sensors[j, VALUE], y_hat, own_lags)
            shift_covariance(A, K, B, block, n, na, own_lags, m, h, r, X[len(X) - na :])
        name(B, block, K, j, Hd, Hm, own, prior, likely, bases, parent, event)
    return int(columns * Hm)


@core
def inherit(A: Array, K: int, B: Array, block: slice, unknown: bool, bases: Array) -> None:
    """What children have of their parents: log w, age, nu and S, and the codes that are kept."""
    for row in range(LOG, FIRST):
        needed = row in (LOG, AGE) or (unknown and row in (NU, S))
        coded = (row == CODE and bases[0] > 1.0) or (row == SENSORS and bases[1] > 1.0)
        if needed or coded or (row == CHANGES and bases[2] > 1.0):
            for at in range(block.start, block.stop, K):
                to = B[row, at : at + K]
                for l in range(K):
                    to[l] = A[row, l]


@core
def remember(A: Array, K: int, B: Array, block: slice, n: int, na: int, y: float, y_hat: Array, own: bool) -> None:
    """Output lags of the children: the parent's, one later, and y or what the leaf expected."""
    first = FIRST + n + n * (n + 1) // 2
    for i in range(na - 1, 0, -1):
        for at in range(block.start, block.stop, K):
            to = B[first + i, at : at + K]
            for l in range(K):
                to[l] = A[first + i - 1, l]
    to = B[first, block]
    for l in range(len(to)):
        to[l] = y_hat[l] if own else y


@core
def name(
    B: Array, block: slice, K: int, j: int, Hd: int, Hm: int, own: bool, prior: Array, likely: Array, bases: Array,
    parents: Array, events: Array,
) -> None:  # fmt: skip
    """Weights, codes and ages of the children under sensor j. ``bases`` limits the three codes; 1 keeps none."""
    weight, age = B[LOG, block], B[AGE, block]
    parent, event = parents[block], events[block]
    for c in range(len(weight) // K):
        here = slice(c * K, (c + 1) * K)
        w, far, old, of, to = weight[here], likely[here], age[here], parent[here], event[here]
        if own:
            for l in range(K):
                to[l] = l // Hm * Hm + j
                w[l] += far[l] if l % Hm == j else -np.inf
                old[l] = 0.0 if l >= Hm else old[l] + 1.0
        else:
            e = c * Hm + j
            for l in range(K):
                chance = prior[e, l]
                w[l] += log(chance) + far[l] if chance > 0.0 else -np.inf
                to[l] = e
            for l in range(K):
                old[l] = 0.0 if c > 0 else old[l] + 1.0
        for l in range(K):
            of[l] = l
    for l in range(len(weight)):
        at = block.start + l
        if bases[0] > 1.0:
            B[CODE, at] = (B[CODE, at] * (Hd * Hm) + event[l]) % bases[0]
        if bases[1] > 1.0:
            B[SENSORS, at] = (B[SENSORS, at] * Hm + j) % bases[1]
        if bases[2] > 1.0:
            B[CHANGES, at] = (B[CHANGES, at] * Hd + event[l] // Hm) % bases[2]
