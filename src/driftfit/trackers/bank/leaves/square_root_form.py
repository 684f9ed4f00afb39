"""The compiled routine of a bank whose leaves keep factors U D U' of their covariances: ``Bank(form="sqrt")``.

It is the routine of `driftfit.trackers.bank.machine.advance` in which the parts that work on covariances are
substituted, so that everything else (growing, weighting, planning and remembering) has one source for both forms. The
operations are in `driftfit.trackers.bank.leaves.factored`; every part here names the one that it replaces. Covariances
of changes are factorised once per sample.

Changes are in `driftfit.trackers.bank.leaves.factored_changes`; merging condenses all columns of the members and their
distances from the mean. Until the tree starts, the single filter keeps a covariance.
"""

from __future__ import annotations

from driftfit.engine.kernel import Array, part, shared
from driftfit.engine.simd import WIDTH, fill, higher, load, minus, over, plus, store, sum_of, times
from driftfit.trackers.bank.leaves import forget, leaves
from driftfit.trackers.bank.leaves.factored import absorb, along, condense, factorise, raised
from driftfit.trackers.bank.leaves.factored_changes import average, blur, develop_eight, walked
from driftfit.trackers.bank.leaves.leaves import FIRST, NU, WEIGHT, S, regressors, variance_factor
from driftfit.trackers.bank.machine import grow, lookahead, merge, refilter, start
from driftfit.trackers.bank.machine.gaps import chain_gap

covariance_begin = start.begin


@part
def ready(Q: Array, n: int) -> None:
    """`leaves.ready`: factorised."""
    for i in range(len(Q)):
        factorise(Q[i], n, 0.0)


@shared
def begin(B: Array, T: Array, theta: Array, P: Array, nu: float, squares: float, many: Array, H: int) -> None:
    """`start.begin`, factorised."""
    covariance_begin(B, T, theta, P, nu, squares, many, H)
    n = len(theta)
    factorise(B[FIRST + n : FIRST + n + n * (n + 1) // 2, 0], n, 1.0)


@part
def mixture(n: int, B: Array, L: int, unknown: bool, X: Array, theta: Array, P: Array) -> None:
    """`leaves.mixture`, multiplied out."""
    variance_factor(B, L, unknown, X, n)
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
            P[i, j] = sum_of(sums)


@shared
def spread(C: Array, Z: Array, m: Array, L: int, n: int, na: int, g: Array, expected: Array) -> None:
    """`leaves.spread`, but with f = U'z in g."""
    for l in range(0, L, WIDTH):
        y, k = fill(0.0), l if na > 0 else 0
        for i in range(n):
            y = plus(y, times(load(Z, i, k), load(m, i, l)))
        store(expected, 0, l, along(C, n, l, Z, k, g, l))
        store(expected, 1, l, y)


@part
def correct(
    n: int, B: Array, at: int, columns: int, C: Array, m: Array, g: Array, expected: Array, y: float, noise: float,
    X: Array, row: int,
) -> None:  # fmt: skip
    """`grow.correct`; what the uncertainty of lags adds to z'C z counts as noise."""
    b = X[row + 2 :].reshape(((X.shape[0] - row - 2) * X.shape[1] // WIDTH, WIDTH))
    for l in range(0, columns, WIDTH):
        h = fill(0.0)
        for i in range(n):
            f = load(g, i, l)
            h = plus(h, times(f, times(load(C, i * (i + 3) // 2, l), f)))
        lags, eps = minus(load(expected, 0, l), h), minus(fill(y), load(expected, 1, l))
        a = absorb(C, l, n, g, l, plus(fill(noise), higher(lags, fill(0.0))), b, B, FIRST + n, at + l)
        gain = over(eps, a)
        store(X, row, l, times(eps, gain))
        store(X, row + 1, l, a)
        for i in range(n):
            store(B, FIRST + i, at + l, plus(load(m, i, l), times(gain, load(b, i, 0))))


@part
def ahead(
    n: int, A: Array, K: int, phi: Array, na: int, Q: Array, maps: Array, places: Array, own: bool, Hm: int, C: Array,
    m: Array, Z: Array, g: Array, expected: Array,
) -> int:  # fmt: skip
    """`grow.ahead`. An eight may reach into the columns of the next change, which are written after it."""
    V = g.reshape((g.shape[0] * g.shape[1] // WIDTH, WIDTH))
    columns = K if own else K * len(Q)
    for c in range(len(Q)):
        of, to, count = (c * Hm, c * Hm, Hm) if own else (0, c * K, K)
        for l in range(0, count, WIDTH):
            develop_eight(A, of + l, n, c, Q, maps, places, C, m, to + l, V)
    regressors(phi, A, K, columns // K, n, na, Z)
    spread(C, Z, m, columns, n, na, g, expected)
    return int(columns)


@shared
def foresee(
    B: Array, L: int, n: int, na: int, prior: Array, Hm: int, Q: Array, maps: Array, places: Array, walks: bool,
    used: bool, C: Array, m: Array, Z: Array, g: Array, expected: Array, X: Array,
) -> None:  # fmt: skip
    """`forget.foresee`. Where all changes walk the variance of the forecast needs no factor of what may happen."""
    V = X.reshape((X.shape[0] * X.shape[1] // WIDTH, WIDTH))
    if not walks:
        for l in range(0, L, WIDTH):
            average(B, l, n, prior, Hm, Q, maps, places, C, m, V)
        spread(C, Z, m, L, n, na, g, expected)
        return
    for l in range(0, L, WIDTH):
        for i in range(n):
            store(m, i, l, load(B, FIRST + i, l))
    spread(B[FIRST + n :], Z, m, L, n, na, g, expected)
    for l in range(0, L, WIDTH):
        store(expected, 0, l, plus(load(expected, 0, l), walked(n, Q, prior, Hm, Z, l if na > 0 else 0, l)))
        if not used:
            blur(B, l, n, prior, Hm, Q, C, V)


@shared
def pool(B: Array, members: Array, n: int, unknown: bool, share: Array, A: Array, to: int, X: Array) -> None:
    """`merge.pool`: as many members at once as X has room for, and what they gave with the next ones."""
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
        W[n, count + n] = share[k] * (B[NU, l] / B[S, l] if unknown else 1.0)
        count += n + 1
    condense(W, count, n, A, to)


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
def widen(root: Array, n: int, weight: Array, Q: Array, X: Array) -> None:
    """`refilter.widen`."""
    V = X.reshape((X.shape[0] * X.shape[1] // WIDTH, WIDTH))
    for e in range(len(Q)):
        raised(root[FIRST + n :], n, 0, Q[e], fill(weight[e]), V)


@shared
def widen_leaf(A: Array, n: int, k: int, q: Array, X: Array) -> None:
    """`chain_gap.widen_leaf`; q is factorised."""
    tri, W = n * (n + 1) // 2, X.reshape((X.shape[0] * X.shape[1] // WIDTH, WIDTH))
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
    leaves.ready: ready, leaves.mixture: mixture, start.begin: begin,
    forget.foresee: foresee, grow.ahead: ahead, grow.correct: correct, merge.pool: pool,
    refilter.widen: widen, chain_gap.widen_leaf: widen_leaf, lookahead.width: width,
}  # fmt: skip
"""What takes whose place."""
