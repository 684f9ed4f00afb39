"""The histories of leaves, from which probabilities of past events are computed.

Row l of the table is the history of leaf l: entry k (H + 1) + e is p(joint event e, k levels back | leaf), entry
k (H + 1) + H is p(no change in the newest k + 1 levels | leaf). A history is contiguous, so inheriting it is one copy
and a marginal one sum of rows; the last row of the table is for such sums. Row e of `new_events` is what event e adds;
two rows of factors for the older entries follow: for no change, and for a change. After growth the table still holds
the parents; a sample that is not used writes it out for every leaf.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.bank.layout import flip, tables
from driftfit.bank.leaves.leaf_matrix import WEIGHT
from driftfit.engine.kernel import Array, kernel, shared
from driftfit.engine.simd import WIDTH, below, equal, fill, load, plus, store, sum_of, times


@shared
def chained(given: Array, P: Array, Hm: int, moving: Array) -> None:
    """The chain of joint events for another chain of the changes; sensors are as after the first change."""
    H = len(P)
    Hd = H // Hm
    for j in range(Hm):
        for to in range(Hm):
            share = 0.0
            for i in range(Hd):
                share += P[j, i * Hm + to]
            for i in range(Hd):
                for k in range(Hd):
                    moving[i * Hm + j, k * Hm + to] = given[i * Hd + k] * share


def news_of(H: int, Hm: int, width: int) -> Array:
    """What each of H joint events adds to a history (the first Hm change nothing), and the factors. The last row is
    padding for SIMD vectors.
    """
    news = np.zeros((H + 3, width))
    news[range(H), range(H)] = 1.0
    news[:Hm, H] = 1.0
    news[H:] = 1.0
    news[H + 1, H :: H + 1] = 0.0
    return news


@kernel
def hand_on(T: Array, of: int, e: int, H: int, Hm: int, news: Array, T2: Array, to: int) -> None:
    """Row ``to`` of T2: the history of the child of leaf ``of`` with event e, without a branch. It may write into the
    next row.
    """
    block, width = H + 1, T.shape[1]
    quiet = H if e < Hm else H + 1
    for k in range(0, block, WIDTH):
        store(T2, to, k, load(news, e, k))
    for k in range(0, width - block, WIDTH):
        store(T2, to, block + k, times(load(T, of, k), load(news, quiet, block + k)))


@shared
def descend(t: Any, L: int, chosen: bool) -> None:
    """The histories of the leaves, from those of their parents; or only of the ``chosen`` ones, in `order`."""
    H, Hm = len(t.initial), len(t.sensors)
    now, after = tables(t)
    for k in range(L):
        l = t.order[k] if chosen else k
        if t.expanded > 0:
            for at in range(now.shape[1]):
                after[k, at] = now[l, at]
        else:
            hand_on(now, t.parent[l], t.event[l], H, Hm, t.new_events, after, k)
    flip(t)
    t.expanded = 1


@shared
def shift(t: Any, L: int) -> None:
    """Add a level without an observation: its events keep their prior probabilities."""
    T, prior, H = tables(t)[0], t.prior, len(t.initial)
    block = H + 1
    for l in range(L):
        for k in range(T.shape[1] - 1, block - 1, -1):
            T[l, k] = T[l, k - block]
        quiet = 0.0
        for e in range(H):
            T[l, e] = prior[e, l]
            quiet += prior[e, l] if e < len(t.sensors) else 0.0
        T[l, H] = quiet
        for k in range(block + H, T.shape[1], block):
            T[l, k] *= quiet


@shared
def settle(T: Array, l: int, levels: int, H: int, Hm: int, best: int) -> None:
    """Row l: one change, ``best``, at each of the newest ``levels``, with the probabilities of sensors as they were."""
    block = H + 1
    known = min(levels, T.shape[1] // block)
    quiet = T[l, (known - 1) * block + H] if known > 0 else 1.0
    for at in range(0, T.shape[1] - block + 1, block):
        if at < known * block:
            for j in range(Hm):
                share = 0.0
                for e in range(j, H, Hm):
                    share += T[l, at + e]
                    T[l, at + e] = 0.0
                T[l, at + best * Hm + j] = share
            T[l, at + H] = 1.0 if best == 0 else 0.0
        elif best > 0:
            T[l, at + H] = 0.0
        elif known > 0:
            T[l, at + H] = T[l, at + H] / quiet if quiet > 0.0 else 0.0


@shared
def average(T: Array, members: Array, share: Array, T2: Array, to: int) -> None:
    """Row ``to`` of T2: the average over the members."""
    for at in range(0, T.shape[1], WIDTH):
        total = fill(0.0)
        for k in range(len(members)):
            total = plus(total, times(fill(share[k]), load(T, members[k], at)))
        store(T2, to, at, total)


@shared
def marginals(t: Any, L: int) -> float:
    """lag_prob[k, e] = p(event e, k levels back); returns the probability of a change among the levels
    of the histories.

    Leaves are ordered in blocks of the children of K parents. Two spare rows are overwritten.
    """
    B, X, event, lags = t.leaves, t.spare, t.event, t.lag_prob
    T = tables(t)[0]
    H, Hm, K, expanded = len(t.initial), len(t.sensors), t.many_parents, t.expanded > 0
    block, W, sums, mass, steady = H + 1, len(lags), len(T) - 1, X[0], X[1]
    back, quiet, last = 1, 0.0, W * block - 1
    if expanded:
        K, back = L, 0
    for l in range(0, K, WIDTH):  # the weight of all children of a parent, and of the children without a change
        own, still = fill(0.0), fill(0.0)
        for at in range(l, L, K):
            p = load(B, WEIGHT, at)
            own, still = plus(own, p), plus(still, times(p, below(event, at, Hm)))
        store(X, 0, l, own)
        store(X, 1, l, still)
    if not expanded:
        for e in range(H):
            own = fill(0.0)
            for l in range(0, L, WIDTH):
                own = plus(own, times(load(B, WEIGHT, l), equal(event, l, e)))
            lags[0, e] = sum_of(own)
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
