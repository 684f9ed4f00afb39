"""What leaves remember of their past, for tables of probabilities: marginals of events, and of no change since.

Row l of the table is what leaf l remembers: entry k (H + 1) + e is p(joint event e, k floors back | leaf), entry
k (H + 1) + H is p(no change in the newest k + 1 floors | leaf). A leaf's memory is one piece, so that handing it on is
one copy and a marginal one sum of rows; the last row of the table is for such sums. After growth the table is still
that of the parents; a sample that is not used writes it out for every leaf.
"""

from __future__ import annotations

import numpy as np

from driftfit.eights import WIDTH, fill, load, plus, store, times
from driftfit.hypotheses.leaves import WEIGHT
from driftfit.kernel import Array, core, kernel, part


@kernel
def hand_on(T: Array, of: int, e: int, H: int, Hm: int, T2: Array, to: int) -> None:
    """Row ``to`` of T2: what the child of leaf ``of`` with event e remembers. It may write into the row after it."""
    block, width = H + 1, T.shape[1]
    for k in range(0, width - block, WIDTH):
        store(T2, to, block + k, load(T, of, k))
    for k in range(block):
        T2[to, k] = 0.0
    T2[to, e] = 1.0
    if e < Hm:
        T2[to, H] = 1.0
    else:
        for k in range(block + H, width, block):
            T2[to, k] = 0.0


@core
def write_out(T: Array, L: int, H: int, Hm: int, parent: Array, event: Array, T2: Array) -> None:
    """The table of the children, from that of their parents."""
    for l in range(L):
        hand_on(T, parent[l], event[l], H, Hm, T2, l)


@core
def shift(T: Array, L: int, prior: Array, Hm: int) -> None:
    """One more floor of which nothing was seen: its events are as likely as before."""
    H = len(prior)
    block = H + 1
    for l in range(L):
        for k in range(T.shape[1] - 1, block - 1, -1):
            T[l, k] = T[l, k - block]
        for e in range(H):
            T[l, e] = prior[e, l]
        quiet = 0.0
        for e in range(Hm):
            quiet += prior[e, l]
        T[l, H] = quiet
        for k in range(block + H, T.shape[1], block):
            T[l, k] *= quiet


@part
def pick(
    T: Array, expanded: bool, H: int, Hm: int, parent: Array, event: Array, order: Array, G: int, T2: Array
) -> None:
    """The table of leaves that were kept as they were."""
    for k in range(G):
        l = order[k]
        if expanded:
            for at in range(T.shape[1]):
                T2[k, at] = T[l, at]
        else:
            hand_on(T, parent[l], event[l], H, Hm, T2, k)


@core
def average(T: Array, members: Array, share: Array, T2: Array, to: int) -> None:
    """Row ``to`` of T2: the average over the members."""
    for at in range(T.shape[1]):
        T2[to, at] = 0.0
    for k in range(len(members)):
        for at in range(T.shape[1]):
            T2[to, at] += share[k] * T[members[k], at]


@part
def marginals(
    B: Array, L: int, T: Array, expanded: bool, H: int, Hm: int, event: Array, mass: Array, steady: Array, K: int,
    lags: Array,
) -> float:  # fmt: skip
    """lags[k, e] = p(event e, k floors back); returns the probability of a change among the floors of the table.

    Leaves are blocks of the children of K parents, in their order.
    """
    block, W, sums, w = H + 1, len(lags), len(T) - 1, B[WEIGHT]
    back, quiet, last = 1, 0.0, W * block - 1
    for e in range(H):
        lags[0, e] = 0.0
    if expanded:
        K, back = L, 0
        for l in range(L):
            mass[l] = w[l]
    else:
        for l in range(K):
            mass[l], steady[l] = 0.0, 0.0
        for at in range(0, L, K):
            newest, own = event[at], 0.0
            for l in range(K):
                p, e = w[np.uint64(at + l)], event[np.uint64(at + l)]
                mass[l] += p
                steady[l] += p if e < Hm else 0.0
                if e != newest:
                    lags[0, newest] += own
                    newest, own = e, 0.0
                own += p
            lags[0, newest] += own
        for l in range(K):
            quiet += steady[l] * (T[l, last - block] if W > 1 else 1.0)
    for at in range(0, T.shape[1], WIDTH):
        total = fill(0.0)
        for l in range(K):
            total = plus(total, times(fill(mass[l]), load(T, l, at)))
        store(T, sums, at, total)
    for k in range(back, W):
        for e in range(H):
            lags[k, e] = T[sums, (k - back) * block + e]
    return 1.0 - min(T[sums, last] if expanded else quiet, 1.0)
