"""One level of the tree: every leaf with every change, then the sample under every sensor.

    C- = C / forget + Q_i,     s = factor_j r + z'C- z,     eps = y - b_j - z'm,     K = C- z / s
    m+ = m + K eps,            C+ = C- - K (C- z)'
    log w+ = log w + log p(event | leaf) + log N(eps; 0, s)

With unknown noise variance (nu, S; C in its units, s above with r = 1):

    log p = lgamma((nu+1)/2) - lgamma(nu/2) - 1/2 log(pi S s) - (nu+1)/2 log(1 + eps^2 / (S s)),   nu <- nu + 1,
    S <- S + eps^2 / s

after nu and S were multiplied by the forgetting factor of the variance. The children of K leaves are in the order
sensor, change, leaf: child (j H_d + i) K + l.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from driftfit.bank.leaves.forecast import CLEANS, FACTOR, FROZEN, OWN, STUCK, VALUE
from driftfit.bank.leaves.forget import KEEP, KIND, MEAN, RESET, apply, predicted
from driftfit.bank.leaves.lags import push, shift_covariance, widen_by_lags
from driftfit.bank.leaves.leaf_matrix import AGE, CHANGES, CODE, FIRST, LOG, NU, SENSORS, S, lag_row, regressors, spread
from driftfit.bank.leaves.own_sensor import judge_all
from driftfit.engine.kernel import Array, log, part, shared, sized
from driftfit.engine.simd import WIDTH, fill, higher, load, log_of, minus, over, plus, store, times
from driftfit.trackers.forms.covariance import LEFT

LOG_2PI, LOG_PI = math.log(2.0 * math.pi), math.log(math.pi)


@shared
def develop_own(t: Any, K: int) -> int:
    """The same, where parent l takes only joint event l."""
    A, C, m, Q, maps, places, n, Hm = t.parents, t.C, t.m, t.Q, t.maps, t.places, t.n, len(t.sensors)
    for l in range(-(-K // WIDTH) * WIDTH):  # numbers up to the end of a SIMD vector are finite
        c = min(l // Hm, len(t.walks) - 1)
        for k in range(n * (n + 1) // 2):
            C[k, l] = maps[c, KEEP] * A[FIRST + n + k, l] + Q[c, k]
        for i in range(n):
            m[i, l] = places[MEAN, i] if maps[c, RESET] > 0.0 else A[FIRST + i, l]
    for c in range(len(t.walks)):
        if maps[c, KIND] > 0.0:
            apply(t, C, m, c * Hm, (c + 1) * Hm, c, t.from_g)
    return K


@part
def develop(n: int, t: Any, K: int, own: bool) -> int:
    """C- = C / forget + Q_i and m of every parent under every change: columns c K + l. With ``own``, parent l takes
    only joint event l. Returns the number of columns.
    """
    if own:
        return int(develop_own(t, K))
    for c in range(len(t.walks)):
        predicted(n, t, t.parents, K, c, t.C, t.m, c * K)
    return K * len(t.walks)


@sized
def ahead(n: int, t: Any, K: int, own: bool, phi: Array) -> int:
    """Forecasts of the sample by the parents under all events; returns the number of columns."""
    columns = develop(n, t, K, own)
    regressors(n, t, t.parents, K, columns // K, phi)
    spread(t.C, t.z, t.m, columns, n, t.output_lags, t.g, t.expected)
    return int(columns)


@sized
def correct(n: int, t: Any, at: int, columns: int, y: float) -> None:
    """Measurement update of the leaves from column ``at`` on; the last two rows of `scores`, whose last one holds the
    noise variances r_j, receive eps^2 / s and s.

    A variance keeps at least the share `LEFT` of its value, so that rounding cannot make it negative.
    """
    B, C, m, g, expected, scores = t.leaves, t.C, t.m, t.g, t.expected, t.scores
    for l in range(0, columns, WIDTH):
        s = plus(load(expected, 0, l), load(scores, 2, l))  # s = r_j + z'C- z
        eps, gain, entry = minus(fill(y), load(expected, 1, l)), over(fill(1.0), s), 0
        store(scores, 1, l, times(eps, times(gain, eps)))
        store(scores, 2, l, s)
        for i in range(n):
            k = times(gain, load(g, i, l))  # K = C- z / s
            store(B, FIRST + i, at + l, plus(load(m, i, l), times(k, eps)))
            for j in range(i):  # C+ = C- - K (C- z)'
                store(B, FIRST + n + entry, at + l, minus(load(C, entry, l), times(k, load(g, j, l))))
                entry += 1
            was = load(C, entry, l)
            left = minus(was, times(k, load(g, i, l)))
            store(B, FIRST + n + entry, at + l, higher(left, times(fill(LEFT), was)))
            entry += 1


@shared
def leave(t: Any, at: int, columns: int) -> None:
    """Leave the leaves from column ``at`` on unchanged, under a sensor that carries no information about theta."""
    B, C, m, n = t.leaves, t.C, t.m, t.n
    for l in range(0, columns, WIDTH):
        for i in range(n):
            store(B, FIRST + i, at + l, load(m, i, l))
        for k in range(n * (n + 1) // 2):
            store(B, FIRST + n + k, at + l, load(C, k, l))


@shared
def gaussian(X: Array, columns: int) -> None:
    """Row 0 of X: log N(eps; 0, s), where eps^2 / s and s are in the two rows after it."""
    for l in range(0, columns, WIDTH):
        far = plus(plus(fill(LOG_2PI), log_of(load(X, 2, l))), load(X, 1, l))
        store(X, 0, l, times(fill(-0.5), far))


@shared
def student(t: Any, at: int, columns: int) -> None:
    """The same in `scores` with unknown variance; nu and S of the leaves from column ``at`` on are
    updated.
    """
    B, X, fade, least = t.leaves, t.scores, t.fade, t.least
    before, ratio = np.nan, 0.0
    for l in range(columns):  # lgamma is expensive, and nu has few different values
        nu = fade * B[NU, at + l]
        if nu != before:
            before, ratio = nu, math.lgamma(0.5 * (nu + 1.0)) - math.lgamma(0.5 * nu)
        X[0, l] = ratio
    for l in range(0, columns, WIDTH):
        nu, scale, far = (
            times(fill(fade), load(B, NU, at + l)),
            times(fill(fade), load(B, S, at + l)),
            load(X, 1, l),
        )
        more = plus(nu, fill(1.0))
        wide = plus(plus(fill(LOG_PI), log_of(scale)), log_of(load(X, 2, l)))
        wide = plus(wide, times(more, log_of(plus(fill(1.0), over(far, scale)))))
        store(X, 0, l, minus(load(X, 0, l), times(fill(0.5), wide)))
        store(B, NU, at + l, more)
        store(B, S, at + l, higher(plus(scale, far), times(fill(least), more)))


@shared
def frozen(t: Any, at: int, columns: int, y: float, last: float, width: float) -> None:
    """Log density of the last output again, N(y; last, width), in the first row of `scores`; a width below zero is in
    variances of the noise.
    """
    B, unknown, out = t.leaves, t.unknown > 0, t.scores[0]
    for l in range(columns):
        wide = width
        if width <= 0.0:
            wide = -width * (B[S, at + l] / (B[NU, at + l] - 2.0) if unknown else t.r)
        far = y - last
        out[l] = -0.5 * (LOG_2PI + log(wide) + far * far / wide) if abs(last) < np.inf else -np.inf


@shared
def inherit(t: Any, K: int, row: int, at: int, columns: int) -> None:
    """Copy a row from parents to children."""
    A, B = t.parents, t.leaves
    for c in range(at, at + columns, K):
        for l in range(K):
            B[row, np.uint64(c + l)] = A[row, l]


@shared
def weigh(t: Any, K: int, at: int, columns: int, j: int, own: bool) -> None:
    """log w+ = log w + log p(event | leaf) + log N of the children under sensor j; their ages, parents
    and events.
    """
    A, B, X, prior, parents, events = t.parents, t.leaves, t.scores, t.prior, t.parent, t.event
    alike, Hm, likely = t.alike > 0, len(t.sensors), t.scores[0]
    if own:
        for l in range(K):
            B[LOG, at + l] = A[LOG, l] + (likely[l] if l % Hm == j else -np.inf)
            B[AGE, at + l] = 0.0 if l >= Hm else A[AGE, l] + 1.0
            parents[at + l], events[at + l] = l, l // Hm * Hm + j
        return
    for c in range(columns // K):
        to, e = at + c * K, c * Hm + j
        chances = prior[e]
        if alike:
            toll = log(chances[0]) if chances[0] > 0.0 else -np.inf
            for l in range(0, K, WIDTH):
                store(B, LOG, to + l, plus(load(A, LOG, l), plus(fill(toll), load(X, 0, c * K + l))))
        else:
            for l in range(K):
                toll = log(chances[l]) if chances[l] > 0.0 else -np.inf
                B[LOG, np.uint64(to + l)] = A[LOG, l] + (toll + likely[np.uint64(c * K + l)])
        for l in range(0, K, WIDTH):
            store(B, AGE, to + l, fill(0.0) if c > 0 else plus(load(A, AGE, l), fill(1.0)))
        for l in range(K):
            parents[np.uint64(to + l)], events[np.uint64(to + l)] = l, e


@shared
def encode(t: Any, K: int, at: int, columns: int, j: int) -> None:
    """The codes of the children; `bases` limits the three codes, and 1 keeps none."""
    A, B, events, bases, Hd, Hm = t.parents, t.leaves, t.event, t.bases, len(t.walks), len(t.sensors)
    for k in range(3):
        row, base = (CODE, SENSORS, CHANGES)[k], bases[k]
        if base > 1.0:
            for l in range(columns):
                e = events[at + l]
                digits, digit = ((Hd * Hm, e), (Hm, j), (Hd, e // Hm))[k]
                B[row, at + l] = (A[row, l % K] * digits + digit) % base


@shared
def grow(t: Any, K: int, own: bool, phi: Array, y: float, last: float, noise: float) -> int:
    """Grow the children of K parents by one sample, with weights that are not normalised; returns their number.

    With ``own``, parent l takes only joint event l; ``last`` is the value that a frozen sensor repeats.
    """
    sensors = t.sensors
    # every parent under every change: C-, g = C- z, h = z'C- z, z'm
    columns = int(ahead(t.n, t, K, own, phi))
    if t.output_lags > 0:
        widen_by_lags(t, t.parents, K, columns)
    for j in range(len(sensors)):
        at = j * columns
        if t.unknown > 0:
            inherit(t, K, NU, at, columns)
            inherit(t, K, S, at, columns)
        # measurement update and log density under sensor j
        if sensors[j, FROZEN] > 0.0:
            leave(t, at, columns)
            frozen(t, at, columns, y, last, sensors[j, STUCK])
        elif sensors[j, OWN] > 0.0:
            judge_all(t, sensors[j, OWN], at, columns, y, t.r * noise)
            correct(t.n, t, at, columns, y)
        else:
            for l in range(0, columns, WIDTH):
                store(t.scores, 2, l, fill(sensors[j, FACTOR] * t.r * noise))
            correct(t.n, t, at, columns, y - sensors[j, VALUE])
            if t.unknown > 0:
                student(t, at, columns)
            else:
                gaussian(t.scores, columns)
        if t.output_lags > 0:
            # output lags of the children, and the covariance of lags that are predictions
            own_lags = sensors[j, CLEANS] > 0.0
            push(t, t.parents, K, at, columns, y - sensors[j, VALUE], own_lags)
            shift_covariance(t, t.parents, K, at, columns, own_lags)
        if sensors[j, OWN] > 0.0 and sensors[j, CLEANS] > 0.0 and t.output_lags > 0:
            for l in range(columns):  # the output that the function returned is the newest lag
                t.leaves[lag_row(t), at + l] = t.answers[0, l]
        # prior probability of the event, ancestry, and codes for the reduction
        weigh(t, K, at, columns, j, own)
        encode(t, K, at, columns, j)
    return columns * len(sensors)
