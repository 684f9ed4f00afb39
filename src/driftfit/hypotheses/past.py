"""What leaves remember of their past, for tables of probabilities: marginals of events, and of no change since.

Row k (H + 1) + e of the table is p(joint event e, k floors back | leaf), row k (H + 1) + H is p(no change in the newest
k + 1 floors | leaf). After growth the table is still that of the parents; a sample that is not used writes it out for
every leaf.
"""

from __future__ import annotations

from driftfit.hypotheses.leaves import WEIGHT
from driftfit.kernel import Array, core, kernel


@core
def write_out(T: Array, L: int, H: int, Hm: int, parent: Array, event: Array, T2: Array) -> None:
    """The table of the children, from that of their parents."""
    block = H + 1
    for e in range(H):
        for l in range(L):
            T2[e, l] = 1.0 if event[l] == e else 0.0
    for l in range(L):
        T2[H, l] = 1.0 if event[l] < Hm else 0.0
    for row in range(block, len(T)):
        for l in range(L):
            T2[row, l] = T[row - block, parent[l]]
    for row in range(2 * block - 1, len(T), block):
        for l in range(L):
            T2[row, l] *= T2[H, l]


@core
def shift(T: Array, L: int, prior: Array, Hm: int) -> None:
    """One more floor of which nothing was seen: its events are as likely as before."""
    H = len(prior)
    block = H + 1
    for row in range(len(T) - 1, block - 1, -1):
        for l in range(L):
            T[row, l] = T[row - block, l]
    for e in range(H):
        for l in range(L):
            T[e, l] = prior[e, l]
    for l in range(L):
        quiet = 0.0
        for e in range(Hm):
            quiet += prior[e, l]
        T[H, l] = quiet
        for row in range(2 * block - 1, len(T), block):
            T[row, l] *= quiet


@core
def pick(
    T: Array, expanded: bool, H: int, Hm: int, parent: Array, event: Array, order: Array, G: int, T2: Array
) -> None:
    """The table of leaves that were kept as they were."""
    block = H + 1
    if expanded:
        for row in range(len(T)):
            for k in range(G):
                T2[row, k] = T[row, order[k]]
    else:
        for e in range(block):
            for k in range(G):
                T2[e, k] = 0.0
        for k in range(G):
            e = event[order[k]]
            T2[e, k] = 1.0
            T2[H, k] = 1.0 if e < Hm else 0.0
        for row in range(block, len(T)):
            for k in range(G):
                T2[row, k] = T[row - block, parent[order[k]]]
        for row in range(2 * block - 1, len(T), block):
            for k in range(G):
                T2[row, k] *= T2[H, k]


@core
def average(T: Array, members: Array, share: Array, T2: Array, to: int) -> None:
    """Column ``to`` of T2: the average over the members."""
    for row in range(len(T)):
        T2[row, to] = 0.0
    for k in range(len(members)):
        for row in range(len(T)):
            T2[row, to] += share[k] * T[row, members[k]]


@kernel
def dot(a: Array, b: Array, count: int) -> float:
    """Sum of products, in two interleaved chains."""
    one, two = 0.0, 0.0
    for l in range(0, count - 1, 2):
        one += a[l] * b[l]
        two += a[l + 1] * b[l + 1]
    if count % 2 > 0:
        one += a[count - 1] * b[count - 1]
    return one + two


@core
def marginals(
    B: Array, L: int, T: Array, expanded: bool, H: int, Hm: int, parent: Array, event: Array, mass: Array, K: int,
    lags: Array,
) -> float:  # fmt: skip
    """lags[k, e] = p(event e, k floors back); returns the probability of a change among the floors of the table."""
    w, block, W = B[WEIGHT], H + 1, len(lags)
    quiet, last = 0.0, len(T) - 1
    for k in range(W):
        for e in range(H):
            lags[k, e] = 0.0
    if expanded:
        for k in range(W):
            for e in range(H):
                lags[k, e] = dot(w, T[k * block + e], L)
        for l in range(L):
            quiet += w[l] * T[last, l]
        return 1.0 - min(quiet, 1.0)
    for l in range(K):
        mass[l] = 0.0
    for l in range(L):
        lags[0, event[l]] += w[l]
        mass[parent[l]] += w[l]
    for k in range(1, W):
        for e in range(H):
            lags[k, e] = dot(mass, T[(k - 1) * block + e], K)
    for l in range(K):
        mass[l] = 0.0
    for l in range(L):
        if event[l] < Hm:
            mass[parent[l]] += w[l]
    for l in range(K):
        quiet += mass[l] * (T[last - block, l] if W > 1 else 1.0)
    return 1.0 - min(quiet, 1.0)
