"""Changes of eight leaves whose covariances are factors U D U'.

A random walk is an `add` for every column of its factor, exponential forgetting scales D, directional forgetting is an
`add`, stabilised forgetting n of `absorb`, and a reset of some parameters adds up the remaining parts of the columns.
The formulas are those of `driftfit.trackers.bank.leaves.forget`, the operations those of
`driftfit.trackers.bank.leaves.factored`. Every function works on eight columns from ``l``; V are narrow rows that may
be overwritten.
"""

from __future__ import annotations

from typing import Any

from driftfit.engine.kernel import Array, kernel, shared
from driftfit.engine.simd import fill, higher, load, minus, over, plus, reaches, store, times
from driftfit.trackers.bank.leaves.factored import absorb, add, along, raised
from driftfit.trackers.bank.leaves.forget import (
    ANCHORS,
    BEFORE,
    DIRECTIONAL,
    EXPONENTIAL,
    GAIN,
    KEEP,
    KIND,
    MEAN,
    PARTIAL,
    PER_CAP,
    RESET,
    STABILISED,
)
from driftfit.trackers.bank.leaves.leaf_matrix import FIRST


@kernel
def guard(C: Array, n: int, l: int, keep: float, per_cap: Array) -> None:
    """`forget.guard` on what was divided by the factor, before its walk."""
    most = fill(1.0)
    for i in range(n):
        variance = load(C, i * (i + 3) // 2, l)
        for j in range(i + 1, n):
            at = j * (j + 1) // 2
            u = load(C, at + i, l)
            variance = plus(variance, times(load(C, at + j, l), times(u, u)))
        most = higher(most, times(variance, fill(per_cap[i])))
    less = higher(over(fill(1.0), most), fill(1.0 / keep))
    for j in range(n):
        at = j * (j + 3) // 2
        store(C, at, l, times(load(C, at, l), less))


@kernel
def renew(C: Array, m: Array, n: int, l: int, which: Array, mean: Array, V: Array) -> None:
    """`forget.renew`: the rest of the columns; the new covariance is added as a walk."""
    tri = n * (n + 1) // 2
    for k in range(tri):
        store(V, n + k, 0, load(C, k, l))
        store(C, k, l, fill(0.0))
    for i in range(n):
        if which[i] > 0.0:
            store(m, i, l, fill(mean[i]))
    for k in range(n):
        at = k * (k + 1) // 2
        for i in range(k):
            store(V, i, 0, fill(0.0) if which[i] > 0.0 else load(V, n + at + i, 0))
        store(V, k, 0, fill(0.0 if which[k] > 0.0 else 1.0))
        add(C, k + 1, l, V, load(V, n + at + k, 0))


@kernel
def toward(C: Array, n: int, l: int, z: Array, gain: float, V: Array) -> None:
    """`forget.toward`."""
    for i in range(n):
        store(V, 2 * n + i, 0, fill(z[i]))
    h, at = along(C, n, l, V[2 * n :], 0, V[n:], 0), 0
    for j in range(n):
        v = times(load(C, at + j, l), load(V, n + j, 0))
        store(V, j, 0, v)
        for i in range(j):
            store(V, i, 0, plus(load(V, i, 0), times(load(C, at + i, l), v)))
        at += j + 1
    none = reaches(fill(0.0), h)
    add(C, n, l, V, over(times(fill(gain), minus(fill(1.0), none)), plus(h, none)))


@kernel
def measure(C: Array, m: Array, n: int, l: int, w: Array, mean: Array, r: float, V: Array) -> None:
    """`forget.measure`."""
    away = fill(0.0)
    for i in range(n):
        store(V, 2 * n + i, 0, fill(w[i]))
        away = plus(away, times(fill(w[i]), minus(fill(mean[i]), load(m, i, l))))
    along(C, n, l, V[2 * n :], 0, V, 0)
    gain = over(away, absorb(C, l, n, V, fill(r), C, l))
    for i in range(n):
        store(m, i, l, plus(load(m, i, l), times(gain, load(V, i, 0))))


@shared
def develop_eight(t: Any, A: Array, of: int, c: int, C: Array, m: Array, to: int, V: Array) -> None:
    """Eight leaves of A with change c, to the columns from ``to``; V has n + max(tri, 2 n) narrow rows."""
    n, maps, places = t.n, t.maps, t.places
    keep, kind = maps[c, KEEP], int(maps[c, KIND])
    for k in range(n * (n + 1) // 2):
        store(C, k, to, load(A, FIRST + n + k, of))
    for j in range(n):
        at = j * (j + 3) // 2
        store(C, at, to, times(load(C, at, to), fill(keep)))
        store(m, j, to, fill(places[MEAN, j]) if maps[c, RESET] > 0.0 else load(A, FIRST + j, of))
    if kind == EXPONENTIAL:
        guard(C, n, to, keep, places[PER_CAP])
    elif kind == PARTIAL and maps[c, GAIN] > 0.0:
        renew(C, m, n, to, places[ANCHORS + c * n], places[MEAN], V)
    raised(C, n, to, t.Q[c], fill(1.0), V)
    if kind == DIRECTIONAL:
        toward(C, n, to, places[BEFORE], maps[c, GAIN], V)
    elif kind == STABILISED and maps[c, GAIN] > 0.0:
        for k in range(n):
            measure(C, m, n, to, places[ANCHORS + c * n + k], places[MEAN], 1.0 / maps[c, GAIN], V)


@kernel
def chance_of(prior: Array, c: int, Hm: int, l: int) -> Any:
    """The probability of a change under any sensor."""
    chance = load(prior, c * Hm, l)
    for j in range(1, Hm):
        chance = plus(chance, load(prior, c * Hm + j, l))
    return chance


@shared
def blur(t: Any, l: int, Hd: int, Hm: int, V: Array) -> None:
    """`leaves.blur` of eight leaves."""
    for k in range(t.n * (t.n + 1) // 2):
        store(t.C, k, l, load(t.leaves, FIRST + t.n + k, l))
    for c in range(Hd):
        raised(t.C, t.n, l, t.Q[c], chance_of(t.prior, c, Hm, l), V)


@shared
def average(t: Any, l: int, Hd: int, Hm: int, V: Array) -> None:
    """`forget.average` of eight leaves. Changes are merged one after the other; p is the total probability so far, p_c
    that of the present one:

        C <- C + p_c C_c + p p_c / (p + p_c) d d',   m <- m + p_c / (p + p_c) d,   d = m_c - m

    which subtracts nothing.
    """
    n, C, m = t.n, t.C, t.m
    tri = n * (n + 1) // 2
    one, mean, V, so_far = V[:tri], V[tri : tri + n], V[tri + n :], fill(0.0)
    for k in range(tri):
        store(C, k, l, fill(0.0))
    for i in range(n):
        store(m, i, l, load(t.leaves, FIRST + i, l))
    for c in range(Hd):
        chance = chance_of(t.prior, c, Hm, l)
        develop_eight(t, t.leaves, l, c, one, mean, 0, V)
        for k in range(n):
            at = k * (k + 1) // 2
            for i in range(k):
                store(V, i, 0, load(one, at + i, 0))
            store(V, k, 0, fill(1.0))
            add(C, k + 1, l, V, times(chance, load(one, at + k, 0)))
        both = plus(so_far, chance)
        share = over(chance, plus(both, reaches(fill(0.0), both)))
        for i in range(n):
            away = minus(load(mean, i, 0), load(m, i, l))
            store(V, i, 0, away)
            store(m, i, l, plus(load(m, i, l), times(share, away)))
        add(C, n, l, V, times(so_far, share))
        so_far = both


@shared
def add_walked(t: Any, l: int, Hd: int, Hm: int) -> None:
    """h <- h + sum_c p_c z'Q_c z of eight leaves."""
    n, Q, Z, zl, total = t.n, t.Q, t.z, l if t.output_lags > 0 else 0, fill(0.0)
    for c in range(Hd):
        wide = fill(0.0)
        for k in range(n):
            at = k * (k + 1) // 2
            if Q[c, at + k] > 0.0:
                f = load(Z, k, zl)
                for i in range(k):
                    f = plus(f, times(fill(Q[c, at + i]), load(Z, i, zl)))
                wide = plus(wide, times(fill(Q[c, at + k]), times(f, f)))
        total = plus(total, times(chance_of(t.prior, c, Hm, l), wide))
    store(t.expected, 0, l, plus(load(t.expected, 0, l), total))
