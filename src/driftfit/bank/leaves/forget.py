"""Changes that forget: the changes of a leaf N(m, C) other than a random walk.

    exponential   C <- C / lam, which is a random walk with Q = (1/lam - 1) C; no variance grows above its cap
    directional   C <- C + (1/lam - 1) g g' / (z' g),   g = C z, z the regressor of the last sample that was used
    stabilised    C^-1 <- lam C^-1 + (1 - lam) A^-1,   C^-1 m <- lam C^-1 m + (1 - lam) A^-1 theta0
    reset         m <- theta0, C <- Q; of some parameters: these, independent of the others

lam is the forgetting factor of this interval, ``forget`` to the power dt; directional forgetting depends on samples and
not on time. Stabilised forgetting is exponential forgetting followed by a measurement of theta0 with noise
A / (1 - lam): n measurements by the rows w_k of W, W'W = A^-1, each with noise 1 / (1 - lam). C therefore stays below
A / (1 - lam), whatever the regressors are, and unexcited parameters return to theta0.

Source: Kulhavy and Zarrop (1993) for stabilised forgetting; Hagglund (1983), Kulhavy and Karny (1984) for directional.
Cost: O(n^2) per leaf, O(n^3) if it is stabilised.
"""

from __future__ import annotations

from typing import Any

from driftfit.bank.leaves.leaf_matrix import FIRST, spread
from driftfit.engine.kernel import Array, exp, part, shared
from driftfit.engine.simd import WIDTH, fill, load, plus, store, times

KEEP, RESET, KIND, GAIN = range(4)
"""Columns of the table of maps: the factor of C, whether all is reset, the kind; of the settings then log forget, of an
interval 1/lam - 1 (directional), 1 - lam (stabilised), or whether time passes.
"""
WALK, EXPONENTIAL, DIRECTIONAL, STABILISED, PARTIAL = range(5)
MEAN, BEFORE, PER_CAP, ANCHORS = range(4)
"""Rows of the table of places: theta0, the regressor of the last used sample, the reciprocals of the caps of variances
(0: none), and from ANCHORS on n rows for every change: W, or D with zeros for the parameters that are reset.
"""
GROWTH = 1e8
"""Exponential forgetting may let a variance grow to this multiple of its value when the tree begins, or when a sample
first determines it.
"""


@shared
def for_interval(settings: Array, dt: float, maps: Array) -> None:
    """The maps for an interval, of which the settings are those of the nominal one."""
    for i in range(len(settings)):
        kind = int(settings[i, KIND])
        for k in range(4):
            maps[i, k] = settings[i, k]
        if kind == DIRECTIONAL:
            maps[i, GAIN] = settings[i, KEEP] - 1.0
            maps[i, KEEP] = 1.0
        elif dt == 0.0:
            maps[i, KEEP], maps[i, RESET], maps[i, GAIN] = 1.0, 0.0, 0.0
        elif kind == PARTIAL:
            maps[i, GAIN] = 1.0
        elif kind != WALK:
            if dt != 1.0:
                maps[i, KEEP] = exp(-dt * settings[i, GAIN])
            maps[i, GAIN] = 1.0 - 1.0 / maps[i, KEEP]


@shared
def guard(t: Any, C: Array, a: int, b: int, c: int, h: Array) -> None:
    """Limit forgetting by the caps: lam <- min(1, max(lam, max_i C_ii / cap_i))."""
    n, keep, per_cap, q = t.n, t.maps[c, KEEP], t.places[PER_CAP], t.Q[c]
    for l in range(a, b):
        h[l] = 0.0
    for i in range(n):
        at = i * (i + 3) // 2
        for l in range(a, b):
            h[l] = max(h[l], abs(C[at, l] - q[at]) * per_cap[i])
    for l in range(a, b):
        h[l] = max(1.0 / h[l], 1.0 / keep) if h[l] > 1.0 else 1.0
    for k in range(n * (n + 1) // 2):
        for l in range(a, b):
            C[k, l] = (C[k, l] - q[k]) * h[l] + q[k] if h[l] != 1.0 else C[k, l]


@shared
def along(C: Array, n: int, a: int, b: int, z: Array, g: Array, h: Array) -> None:
    """g = C z, h = z' C z."""
    for l in range(a, b):
        h[l] = 0.0
    for i in range(n):
        for l in range(a, b):
            g[i, l] = 0.0
        for j in range(n):
            at = i * (i + 1) // 2 + j if j <= i else j * (j + 1) // 2 + i
            for l in range(a, b):
                g[i, l] += C[at, l] * z[j]
        for l in range(a, b):
            h[l] += z[i] * g[i, l]


@shared
def add_square(C: Array, n: int, a: int, b: int, g: Array, h: Array) -> None:
    """C <- C + h g g'."""
    at = 0
    for i in range(n):
        for j in range(i + 1):
            for l in range(a, b):
                C[at, l] += h[l] * g[i, l] * g[j, l]
            at += 1


@shared
def toward(C: Array, n: int, a: int, b: int, z: Array, gain: float, work: Array) -> None:
    """Directional forgetting; nothing where z or C z is zero."""
    g, h = work, work[n]
    along(C, n, a, b, z, g, h)
    for l in range(a, b):
        h[l] = gain / h[l] if h[l] > 0.0 else 0.0
    add_square(C, n, a, b, g, h)


@shared
def measure(C: Array, m: Array, a: int, b: int, w: Array, mean: Array, r: float, work: Array) -> None:
    """Measurement update by w' theta = w' mean with noise variance r."""
    n = len(w)
    g, h = work, work[n]
    along(C, n, a, b, w, g, h)
    for l in range(a, b):
        h[l] = -1.0 / (h[l] + r)
    add_square(C, n, a, b, g, h)
    for l in range(a, b):
        away = 0.0
        for j in range(n):
            away += w[j] * (mean[j] - m[j, l])
        h[l] *= -away
    for i in range(n):
        for l in range(a, b):
            m[i, l] += h[l] * g[i, l]


@shared
def renew(C: Array, m: Array, a: int, b: int, D: Array, mean: Array, q: Array, X: Array) -> None:
    """Reset some parameters: m <- mean + D (m - mean), C <- D (C - Q) D' + Q; X has n n spare rows."""
    n, at = len(D), 0
    for i in range(n):
        for j in range(n):
            to = X[i * n + j]  # (C - Q) D'
            for l in range(a, b):
                to[l] = 0.0
            for k in range(n):
                entry = i * (i + 1) // 2 + k if k <= i else k * (k + 1) // 2 + i
                for l in range(a, b if D[j, k] != 0.0 else a):
                    to[l] += D[j, k] * (C[entry, l] - q[entry])
    for i in range(n):
        for j in range(i + 1):
            for l in range(a, b):
                C[at, l] = q[at]
            for k in range(n):
                for l in range(a, b if D[i, k] != 0.0 else a):
                    C[at, l] += D[i, k] * X[k * n + j, l]
            at += 1
    for i in range(n):
        away = mean[i]
        for k in range(n):
            away -= D[i, k] * mean[k]
        for l in range(a, b):
            X[i, l] = away
        for k in range(n):
            for l in range(a, b if D[i, k] != 0.0 else a):
                X[i, l] += D[i, k] * m[k, l]
    for i in range(n):
        for l in range(a, b):
            m[i, l] = X[i, l]


@shared
def apply(t: Any, C: Array, m: Array, a: int, b: int, c: int, work: Array) -> None:
    """Complete change c in the columns a .. b of C and m, to which KEEP, RESET and Q have been applied.

    ``work`` has n rows, for C z, and one more; where some parameters are reset n n rows.
    """
    maps, places, n = t.maps, t.places, t.n
    kind = int(maps[c, KIND])
    if kind == EXPONENTIAL:
        guard(t, C, a, b, c, work[n])
    elif kind == DIRECTIONAL:
        toward(C, n, a, b, places[BEFORE], maps[c, GAIN], work)
    elif kind == STABILISED and maps[c, GAIN] > 0.0:
        for k in range(n):
            measure(C, m, a, b, places[ANCHORS + c * n + k], places[MEAN], 1.0 / maps[c, GAIN], work)
    elif kind == PARTIAL and maps[c, GAIN] > 0.0:
        renew(C, m, a, b, places[ANCHORS + c * n : ANCHORS + (c + 1) * n], places[MEAN], t.Q[c], t.spare_square)


@part
def predicted(n: int, t: Any, A: Array, K: int, c: int, C: Array, m: Array, to: int) -> None:
    """C- = C / forget + Q and m of K leaves of A under change c, in the columns of C and m from ``to`` on. The rows of
    g and one more are overwritten.
    """
    keep, reset, Q, mean = fill(t.maps[c, KEEP]), t.maps[c, RESET] > 0.0, t.Q[c], t.places[MEAN]
    for l in range(0, K, WIDTH):
        for k in range(n * (n + 1) // 2):
            store(C, k, to + l, plus(times(keep, load(A, FIRST + n + k, l)), fill(Q[k])))
        for i in range(n):
            store(m, i, to + l, fill(mean[i]) if reset else load(A, FIRST + i, l))
    if t.maps[c, KIND] > 0.0:
        apply(t, C, m, to, to + K, c, t.from_g)


@shared
def average(t: Any, L: int, Hd: int, Hm: int) -> None:
    """Mean m and covariance C of every leaf over all changes, without data: the first two moments

        m = sum_c p_c m_c,   C = sum_c p_c (C_c + (m_c - m) (m_c - m)'),

    computed as differences from the leaf's own. Only the first ``Hd`` changes count, under ``Hm`` sensors. Needs
    tri + n + 1 spare rows, unless all changes are walks.
    """
    B, C, m, X, n, Q, maps, tri = t.leaves, t.C, t.m, t.spare, t.n, t.Q, t.maps, t.n * (t.n + 1) // 2
    chance, one, mean = X[0], X[1 : 1 + tri], X[1 + tri : 1 + tri + n]
    for k in range(n + tri):
        to = m[k] if k < n else C[k - n]
        for l in range(L):
            to[l] = 0.0 if k < n else B[FIRST + k, l]
    for c in range(Hd):
        for l in range(L):  # p_c, summed over the sensors
            chance[l] = 0.0
            for j in range(Hm):
                chance[l] += t.prior[c * Hm + j, l]
        if maps[c, KIND] == WALK and maps[c, RESET] == 0.0:
            for k in range(tri):
                for l in range(L if Q[c, k] != 0.0 else 0):
                    C[k, l] += chance[l] * Q[c, k]
            continue
        predicted(n, t, B, L, c, one, mean, 0)
        for i in range(n):
            for l in range(L):
                mean[i, l] -= B[FIRST + i, l]
                m[i, l] += chance[l] * mean[i, l]
        for k in range(tri):
            for l in range(L):
                C[k, l] += chance[l] * (one[k, l] - B[FIRST + n + k, l])
        add_square(C, n, 0, L, mean, chance)
    if t.walks_only == 0:
        for l in range(L):
            chance[l] = -1.0
        add_square(C, n, 0, L, m, chance)
    for i in range(n):
        for l in range(L):
            m[i, l] += B[FIRST + i, l]


@shared
def foresee(t: Any, L: int, Hd: int, Hm: int) -> None:
    """Fill the rows z'C z and z'm of `expected` for every leaf over all changes, and m and C."""
    average(t, L, Hd, Hm)
    spread(t.C, t.z, t.m, L, t.n, t.output_lags, t.g, t.expected)
