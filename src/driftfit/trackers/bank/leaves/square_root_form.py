"""The compiled routine of a bank whose leaves keep factors U D U' of their covariances: ``Bank(form="sqrt")``.

It is the routine of `driftfit.trackers.bank.machine.advance` in which the parts that work on covariances are
substituted; growing, weighing, choosing and histories have one source for both forms. The operations are in
`driftfit.trackers.bank.leaves.factored`; every part here names the one that it replaces. Covariances of changes are
factorised once per sample.

Changes are in `driftfit.trackers.bank.leaves.factored_changes`; merging condenses all columns of the members and their
distances from the mean. Until the tree begins, the single filter keeps a covariance.
"""

from __future__ import annotations

from typing import Any

from driftfit.engine.kernel import Array, shared
from driftfit.engine.simd import WIDTH, fill, higher, load, minus, over, plus, store, sum_of, times
from driftfit.trackers.bank.layout import ENTERS
from driftfit.trackers.bank.leaves import forget, leaf_matrix
from driftfit.trackers.bank.leaves.factored import absorb, along, condense, factorise, raised
from driftfit.trackers.bank.leaves.factored_changes import add_walked, average, blur, develop_eight
from driftfit.trackers.bank.leaves.forget import RAY
from driftfit.trackers.bank.leaves.leaf_matrix import FIRST, NU, WEIGHT, S, regressors, variance_factor
from driftfit.trackers.bank.machine import grow, late_direction, start
from driftfit.trackers.bank.machine.gaps import chain_gap
from driftfit.trackers.bank.reducing import lookahead, merge, refilter

covariance_begin = start.begin


@shared
def ready(t: Any) -> None:
    """`leaf_matrix.ready`: factorised."""
    for i in range(len(t.walks)):
        factorise(t.Q[i], t.n, 0.0)


@shared
def begin(t: Any, nu: float, squares: float) -> None:
    """`start.begin`, factorised."""
    covariance_begin(t, nu, squares)
    n = t.n
    factorise(t.leaves[FIRST + n : FIRST + n + n * (n + 1) // 2, 0], n, 1.0)


@shared
def mixture(n: int, t: Any, L: int) -> None:
    """`leaf_matrix.mixture`, multiplied out."""
    B, X, theta = t.leaves, t.scratch, t.theta
    variance_factor(t, X, n, L)
    for i in range(n):
        sums = fill(0.0)
        for l in range(0, L, WIDTH):
            sums = plus(sums, times(load(B, WEIGHT, l), load(B, FIRST + i, l)))
        theta[i] = sum_of(sums)
        for l in range(0, L, WIDTH):
            store(X, i, l, minus(load(B, FIRST + i, l), fill(theta[i])))
    C = B[FIRST + n :]
    for i in range(n):
        for j in range(i + 1):
            sums = fill(0.0)
            for l in range(0, L, WIDTH):
                at = i * (i + 1) // 2
                inner = load(C, at + i, l)
                inner = times(inner, load(C, at + j, l)) if j < i else inner
                for k in range(i + 1, n):
                    at = k * (k + 1) // 2
                    inner = plus(inner, times(load(C, at + k, l), times(load(C, at + i, l), load(C, at + j, l))))
                entry = plus(times(inner, load(X, n, l)), times(load(X, i, l), load(X, j, l)))
                sums = plus(sums, times(load(B, WEIGHT, l), entry))
            t.cov[i, j] = sum_of(sums)


@shared
def spread(C: Array, Z: Array, m: Array, L: int, n: int, na: int, g: Array, expected: Array) -> None:
    """`leaf_matrix.spread`, but with f = U'z in g."""
    for l in range(0, L, WIDTH):
        y, k = fill(0.0), l if na > 0 else 0
        for i in range(n):
            y = plus(y, times(load(Z, i, k), load(m, i, l)))
        store(expected, 0, l, along(C, n, l, Z, k, g, l))
        store(expected, 1, l, y)


@shared
def correct(n: int, t: Any, at: int, columns: int, y: float, noise: float) -> None:
    """`grow.correct`; what the uncertainty of lags adds to z'C z counts as noise."""
    B, C, m, g, expected, scores, b = t.leaves, t.C, t.m, t.g, t.expected, t.scores, t.narrow
    for l in range(0, columns, WIDTH):
        h = fill(0.0)
        for i in range(n):
            f = load(g, i, l)
            store(b, i, 0, f)
            h = plus(h, times(f, times(load(C, i * (i + 3) // 2, l), f)))
        lags, eps = minus(load(expected, 0, l), h), minus(fill(y), load(expected, 1, l))
        a = absorb(C, l, n, b, plus(fill(noise), higher(lags, fill(0.0))), B[FIRST + n :], at + l)
        gain = over(eps, a)
        store(scores, 1, l, times(eps, gain))
        store(scores, 2, l, a)
        for i in range(n):
            store(B, FIRST + i, at + l, plus(load(m, i, l), times(gain, load(b, i, 0))))


@shared
def ahead(n: int, t: Any, K: int, own: bool, phi: Array) -> int:
    """`grow.ahead`. A SIMD vector may extend into the columns of the next change, which are written later."""
    A, V, Hd, Hm = t.parents, t.narrow, len(t.walks), len(t.sensors)
    columns = K if own else K * Hd
    for c in range(Hd):
        of, to, count = (c * Hm, c * Hm, Hm) if own else (0, c * K, K)
        for l in range(0, count, WIDTH):
            develop_eight(t, A, of + l, c, t.C, t.m, to + l, V)
    regressors(n, t, A, K, columns // K, phi)
    spread(t.C, t.z, t.m, columns, n, t.output_lags, t.g, t.expected)
    return int(columns)


@shared
def foresee(t: Any, L: int, Hd: int, Hm: int, used: bool) -> None:
    """`forget.foresee`. If all changes are random walks, the variance of the forecast needs no factor."""
    B, m, n, V = t.leaves, t.m, t.n, t.narrow
    if t.walks_only == 0:
        for l in range(0, L, WIDTH):
            average(t, l, Hd, Hm, V)
        spread(t.C, t.z, m, L, n, t.output_lags, t.g, t.expected)
        return
    for l in range(0, L, WIDTH):
        for i in range(n):
            store(m, i, l, load(B, FIRST + i, l))
    spread(B[FIRST + n :], t.z, m, L, n, t.output_lags, t.g, t.expected)
    for l in range(0, L, WIDTH):
        add_walked(t, l, Hd, Hm)
        if not used:
            blur(t, l, Hd, Hm, V)


@shared
def spill(B: Array, l: int, n: int, share: float, W: Array, to: int) -> None:
    """The columns of a leaf's factor as columns of W, their D times ``share`` below them."""
    at = FIRST + n
    for j in range(n):
        for i in range(j):
            W[i, to + j] = B[at + i, l]
        W[j, to + j] = 1.0
        for i in range(j + 1, n):
            W[i, to + j] = 0.0
        W[n, to + j] = share * B[at + j, l]
        at += j + 1


@shared
def pool(t: Any, members: Array, share: Array, to: int, X: Array) -> None:
    """`merge.pool`: as many members at once as X has room for; the result is pooled with the next ones."""
    A, B, n = t.parents, t.leaves, t.n
    room = X.shape[0] * X.shape[1] // ((n + 2) * WIDTH) * WIDTH
    W, count = X.reshape(X.shape[0] * X.shape[1])[: (n + 2) * room].reshape((n + 2, room)), 0
    for k in range(len(members)):
        l = members[k]
        if count + n + 1 > room:
            condense(W, count, n, A, to)
            spill(A, to, n, 1.0, W, 0)
            count = n
        spill(B, l, n, share[k], W, count)
        for i in range(n):
            W[i, count + n] = B[FIRST + i, l] - A[FIRST + i, to]
        W[n, count + n] = share[k] * (B[NU, l] / B[S, l] if t.unknown > 0 else 1.0)
        count += n + 1
    condense(W, count, n, A, to)


@shared
def widen(t: Any, weight: Array, X: Array) -> None:
    """`refilter.widen`."""
    for e in range(len(t.walks)):
        raised(t.root[FIRST + t.n :], t.n, 0, t.Q[e], fill(weight[e]), t.narrow)


@shared
def spread_along(t: Any, B: Array, L: int, v: float) -> None:
    """`late_direction.spread_along`: G applied to the columns of the factor, and one more."""
    n, z, r, u = t.n, t.z, t.places[RAY], t.sample[ENTERS]
    room = -(-(n + 1) // WIDTH) * WIDTH
    W = t.narrow.reshape(t.narrow.shape[0] * WIDTH)[: (n + 2) * room].reshape((n + 2, room))
    for l in range(L):
        spill(B, l, n, 1.0, W, 0)
        for k in range(n):
            f = 0.0
            for i in range(n):
                f += z[i, l if t.output_lags > 0 else 0] * W[i, k]
            for i in range(n):
                W[i, k] -= r[i] * f / u
        for i in range(n):
            W[i, n] = r[i]
        W[n, n] = v / (u * u)
        condense(W, n + 1, n, B, l)


@shared
def widen_leaf(t: Any, k: int, q: Array) -> None:
    """`chain_gap.widen_leaf`; q is factorised."""
    A, W, n = t.parents, t.narrow, t.n
    tri = n * (n + 1) // 2
    factorise(q, n, 0.0)
    for i in range(tri):
        store(W, i, 0, fill(A[FIRST + n + i, k]))
    raised(W, n, 0, q, fill(1.0), W[tri:])
    for i in range(tri):
        A[FIRST + n + i, k] = W[i, 0]


@shared
def width(B: Array, l: int, n: int, na: int, phi: Array, keep: float, q: Array) -> float:
    """`lookahead.width`."""
    lags, wide, at = FIRST + n + n * (n + 1) // 2, 0.0, 0
    for j in range(n):
        f = B[lags + j, l] if j < na else phi[j]
        own = f
        for i in range(j):
            z = B[lags + i, l] if i < na else phi[i]
            f += B[FIRST + n + at + i, l] * z
            own += q[at + i] * z
        wide += keep * B[FIRST + n + at + j, l] * f * f + q[at + j] * own * own
        at += j + 1
    return wide


PARTS = {
    leaf_matrix.ready: ready, leaf_matrix.mixture: mixture, start.begin: begin,
    forget.foresee: foresee, grow.ahead: ahead, grow.correct: correct, merge.pool: pool,
    late_direction.spread_along: spread_along, refilter.widen: widen, chain_gap.widen_leaf: widen_leaf,
    lookahead.width: width,
}  # fmt: skip
"""Each part with the one that replaces it."""
