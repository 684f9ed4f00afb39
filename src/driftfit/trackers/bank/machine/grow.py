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

from driftfit.engine.kernel import Array, log, part, shared
from driftfit.engine.simd import WIDTH, fill, higher, load, log_of, minus, over, plus, store, times
from driftfit.trackers.bank.leaves.forecast import CLEANS, FACTOR, FROZEN, OWN, STUCK, VALUE
from driftfit.trackers.bank.leaves.forget import KIND, apply
from driftfit.trackers.bank.leaves.lags import plausible, shift_covariance, widen_by_lags
from driftfit.trackers.bank.leaves.leaves import AGE, CHANGES, CODE, FIRST, LOG, NU, SENSORS, S, regressors, spread
from driftfit.trackers.bank.leaves.own_sensor import clean_all, judge_all, weigh_all
from driftfit.trackers.parts.diffuse import LEFT

LOG_2PI, LOG_PI = math.log(2.0 * math.pi), math.log(math.pi)
FLOOR = 1e-12
"""S never falls below this share of nu times the mean square of y: the data's own rounding."""


@part
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
            for k in range(n * (n + 1) // 2):
                C[k, l] = maps[c, 0] * A[first + k, l] + Q[c, k]
            for i in range(n):
                m[i, l] = places[0, i] if maps[c, 1] > 0.0 else A[FIRST + i, l]
        for c in range(len(Q)):
            if maps[c, KIND] > 0.0:
                apply(C, m, c * Hm, (c + 1) * Hm, c, maps, places, Q, g, h)
        return K
    for c in range(len(Q)):
        keep, reset = fill(maps[c, 0]), maps[c, 1] > 0.0
        for l in range(0, K, WIDTH):
            for k in range(n * (n + 1) // 2):
                store(C, k, c * K + l, plus(times(keep, load(A, first + k, l)), fill(Q[c, k])))
            for i in range(n):
                store(m, i, c * K + l, fill(places[0, i]) if reset else load(A, FIRST + i, l))
        if maps[c, KIND] > 0.0:
            apply(C, m, c * K, (c + 1) * K, c, maps, places, Q, g, h)
    return K * len(Q)


@part(sizes=(2, 3, 4))
def ahead(
    n: int, A: Array, K: int, phi: Array, na: int, Q: Array, maps: Array, places: Array, own: bool, Hm: int, C: Array,
    m: Array, Z: Array, g: Array, expected: Array,
) -> int:  # fmt: skip
    """What the leaves and all that may happen to them expect of the sample; returns the number of columns."""
    columns = develop(A, K, n, Q, maps, places, own, Hm, C, m, g, expected[0])
    regressors(phi, A, K, columns // K, n, na, Z)
    spread(C, Z, m, columns, n, na, g, expected)
    return int(columns)


@part(sizes=(2, 3, 4))
def correct(
    n: int, B: Array, at: int, columns: int, C: Array, m: Array, g: Array, expected: Array, y: float, noise: float,
    X: Array, row: int,
) -> None:  # fmt: skip
    """The data in the columns from ``at``; eps^2 / s and s of every leaf go to two rows of X."""
    for l in range(0, columns, WIDTH):
        s = plus(load(expected, 0, l), fill(noise))
        eps, gain, entry = minus(fill(y), load(expected, 1, l)), over(fill(1.0), s), 0
        store(X, row, l, times(eps, times(gain, eps)))
        store(X, row + 1, l, s)
        for i in range(n):
            k = times(gain, load(g, i, l))
            store(B, FIRST + i, at + l, plus(load(m, i, l), times(k, eps)))
            for j in range(i):
                store(B, FIRST + n + entry, at + l, minus(load(C, entry, l), times(k, load(g, j, l))))
                entry += 1
            was = load(C, entry, l)
            left = minus(was, times(k, load(g, i, l)))
            store(B, FIRST + n + entry, at + l, higher(left, times(fill(LEFT), was)))
            entry += 1


@shared
def leave(B: Array, at: int, columns: int, n: int, C: Array, m: Array) -> None:
    """A sensor that says nothing of theta."""
    for l in range(0, columns, WIDTH):
        for i in range(n):
            store(B, FIRST + i, at + l, load(m, i, l))
        for k in range(n * (n + 1) // 2):
            store(B, FIRST + n + k, at + l, load(C, k, l))


@part
def gaussian(X: Array, out: int, columns: int) -> None:
    """Row ``out`` of X: log N(eps; 0, s), where eps^2 / s and s are in the two rows after it."""
    for l in range(0, columns, WIDTH):
        far = plus(plus(fill(LOG_2PI), log_of(load(X, out + 2, l))), load(X, out + 1, l))
        store(X, out, l, times(fill(-0.5), far))


@part
def student(B: Array, at: int, X: Array, out: int, columns: int, fade: float, least: float) -> None:
    """The same with unknown variance; nu and S of the columns of B from ``at`` on take the sample in."""
    before, ratio = np.nan, 0.0
    for l in range(columns):
        nu = fade * B[NU, at + l]
        if nu != before:
            before, ratio = nu, math.lgamma(0.5 * (nu + 1.0)) - math.lgamma(0.5 * nu)
        X[out, l] = ratio
    for l in range(0, columns, WIDTH):
        nu, scale, far = (
            times(fill(fade), load(B, NU, at + l)),
            times(fill(fade), load(B, S, at + l)),
            load(X, out + 1, l),
        )
        more = plus(nu, fill(1.0))
        wide = plus(plus(fill(LOG_PI), log_of(scale)), log_of(load(X, out + 2, l)))
        wide = plus(wide, times(more, log_of(plus(fill(1.0), over(far, scale)))))
        store(X, out, l, minus(load(X, out, l), times(fill(0.5), wide)))
        store(B, NU, at + l, more)
        store(B, S, at + l, higher(plus(scale, far), times(fill(least), more)))


@shared
def frozen(
    B: Array, at: int, columns: int, y: float, last: float, width: float, r: float, unknown: bool, out: Array
) -> None:
    """Log density of the last output again."""
    for l in range(columns):
        wide = width
        if width <= 0.0:
            wide = -width * (B[S, at + l] / (B[NU, at + l] - 2.0) if unknown else r)
        far = y - last
        out[l] = -0.5 * (LOG_2PI + log(wide) + far * far / wide) if abs(last) < np.inf else -np.inf


@shared
def grow(
    A: Array, K: int, B: Array, phi: Array, y: float, last: float, noise: float, r: float, unknown: bool, fade: float,
    least: float, most: float, na: int, Q: Array, maps: Array, places: Array, sensors: Array, prior: Array, own: bool,
    alike: bool, bases: Array, parent: Array, event: Array, judges: int, X: Array,
) -> int:  # fmt: skip
    """The children of K leaves, with their weights not normalised; returns how many there are. ``alike`` says that the
    prior is the same for all leaves; ``judges`` is where likelihoods of the user's own are.
    """
    n, Hd, Hm = len(phi), len(Q), len(sensors)
    tri = n * (n + 1) // 2
    C, m, Z, g = X[:tri], X[tri : tri + n], X[tri + n : tri + 2 * n], X[tri + 2 * n : tri + 3 * n]
    expected, likely = X[tri + 3 * n : tri + 3 * n + 2], tri + 3 * n + 2
    columns = ahead(n, A, K, phi, na, Q, maps, places, own, Hm, C, m, Z, X[tri + 2 * n :], expected)
    if na > 0:
        widen_by_lags(A, K, columns, n, na, m, expected[0])
    for j in range(Hm):
        at = j * columns
        if unknown:
            inherit(A, K, B, NU, at, columns)
            inherit(A, K, B, S, at, columns)
        if sensors[j, FROZEN] > 0.0:
            leave(B, at, columns, n, C, m)
            frozen(B, at, columns, y, last, sensors[j, STUCK], r, unknown, X[likely])
        elif sensors[j, OWN] > 0.0:
            which, said, noisy = sensors[j, OWN], X[len(X) - 1], r * noise
            judge_all(judges, which, B, at, columns, expected, y, noisy, unknown, last, X, likely, said)
            correct(n, B, at, columns, C, m, g, expected, y, 0.0, X, likely + 1)
            weigh_all(judges, which, B, at, columns, expected, y, noisy, unknown, last, X, likely, said)
        else:
            noise_j = sensors[j, FACTOR] * r * noise
            correct(n, B, at, columns, C, m, g, expected, y - sensors[j, VALUE], noise_j, X, likely + 1)
            if unknown:
                student(B, at, X, likely, columns, fade, least)
            else:
                gaussian(X, likely, columns)
        if na > 0:
            own_lags = sensors[j, CLEANS] > 0.0
            remember(A, K, B, at, columns, n, na, y - sensors[j, VALUE], expected, own_lags, most, r)
            if own_lags and sensors[j, OWN] > 0.0:
                which, said, noisy = sensors[j, OWN], X[len(X) - 1], r * noise
                clean_all(judges, which, B, at, columns, n, expected, y, noisy, unknown, last, said)
            block, spare = slice(at, at + columns), X[len(X) - na :]
            shift_covariance(A, K, B, block, n, na, own_lags, m, expected, r, most, spare)
        weigh(A, K, B, at, columns, j, Hm, own, alike, prior, X, likely, parent, event)
        encode(A, K, B, at, columns, j, Hd, Hm, bases, event)
    return int(columns * Hm)


@shared
def inherit(A: Array, K: int, B: Array, row: int, at: int, columns: int) -> None:
    """A row of children as their parents have it."""
    for c in range(at, at + columns, K):
        for l in range(K):
            B[row, np.uint64(c + l)] = A[row, l]


@shared
def remember(
    A: Array, K: int, B: Array, at: int, columns: int, n: int, na: int, y: float, expected: Array, own: bool,
    most: float, r: float,
) -> None:  # fmt: skip
    """Output lags of the children: the parent's, one later, and y or what the leaf expected."""
    first = FIRST + n + n * (n + 1) // 2
    for i in range(na - 1, 0, -1):
        for c in range(at, at + columns, K):
            for l in range(K):
                B[first + i, np.uint64(c + l)] = A[first + i - 1, l]
    for l in range(columns):
        believed = own and plausible(expected, l, most, r)
        B[first, np.uint64(at + l)] = expected[1, l] if believed else y


@part
def weigh(
    A: Array, K: int, B: Array, at: int, columns: int, j: int, Hm: int, own: bool, alike: bool, prior: Array,
    X: Array, row: int, parents: Array, events: Array,
) -> None:  # fmt: skip
    """Weights and ages of the children under sensor j, whose children they are, and by which event; their log
    densities are a row of X.
    """
    likely = X[row]
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
                store(B, LOG, to + l, plus(load(A, LOG, l), plus(fill(toll), load(X, row, c * K + l))))
        else:
            for l in range(K):
                toll = log(chances[l]) if chances[l] > 0.0 else -np.inf
                B[LOG, np.uint64(to + l)] = A[LOG, l] + (toll + likely[np.uint64(c * K + l)])
        for l in range(0, K, WIDTH):
            store(B, AGE, to + l, fill(0.0) if c > 0 else plus(load(A, AGE, l), fill(1.0)))
        for l in range(K):
            parents[np.uint64(to + l)], events[np.uint64(to + l)] = l, e


@shared
def encode(
    A: Array, K: int, B: Array, at: int, columns: int, j: int, Hd: int, Hm: int, bases: Array, events: Array
) -> None:
    """The codes of the children; ``bases`` limits the three codes, and 1 keeps none."""
    for k in range(3):
        row, base = (CODE, SENSORS, CHANGES)[k], bases[k]
        if base > 1.0:
            for l in range(columns):
                e = events[at + l]
                digits, digit = ((Hd * Hm, e), (Hm, j), (Hd, e // Hm))[k]
                B[row, at + l] = (A[row, l % K] * digits + digit) % base
