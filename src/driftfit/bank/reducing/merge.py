"""Merge the leaves of a group into one with their mean and covariance.

    W = sum w,   m = sum w m_l / W,   C = sum w (C_l + d_l d_l') / W,   d_l = m_l - m

With unknown noise variance the one is the normal-inverse-gamma nearest in Kullback-Leibler divergence: with
g_l = nu_l / S_l and g = sum w g_l,

    m = sum w g_l m_l / g,   C = sum w (C_l + g_l d_l d_l'),
    psi(nu/2) - log(nu/2) = sum w (psi(nu_l/2) - log(S_l/2)) - log g,   S = nu / g

which keeps the expectations of 1/s2, log s2, theta/s2 and theta theta'/s2. A group of one leaf is that leaf.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from driftfit.bank.layout import flip, tables
from driftfit.bank.leaves.leaf_matrix import AGE, CHANGES, CODE, FIRST, LOG, NU, SENSORS, WEIGHT, S, lag_row
from driftfit.bank.machine.ancestry import average
from driftfit.engine.kernel import Array, shared
from driftfit.engine.simd import WIDTH, gathered, store

LEAST_FREEDOM = 2.5
"""Leaves whose noise differs by orders of magnitude would have fewer, and with 2 or fewer no expected variance."""


@shared
def digamma(x: float) -> float:
    total = 0.0
    while x < 8.0:
        total -= 1.0 / x
        x += 1.0
    f = 1.0 / (x * x)
    return (
        total + math.log(x) - 0.5 / x
        - f * (1.0 / 12.0 - f * (1.0 / 120.0 - f * (1.0 / 252.0 - f * (1.0 / 240.0 - f / 132.0))))
    )  # fmt: skip


@shared
def trigamma(x: float) -> float:
    total = 0.0
    while x < 8.0:
        total += 1.0 / (x * x)
        x += 1.0
    f = 1.0 / (x * x)
    return total + (1.0 + 0.5 / x + f * (1.0 / 6.0 - f * (1.0 / 30.0 - f * (1.0 / 42.0 - f / 30.0)))) / x


@shared
def freedom(t: float, start: float) -> float:
    """nu with psi(nu/2) - log(nu/2) = t < 0, by Newton's method in log nu."""
    x = 0.5 * start
    for _ in range(50):
        error = digamma(x) - math.log(x) - t
        step = error / (x * trigamma(x) - 1.0)
        step = min(2.0, max(-2.0, step))
        x *= math.exp(-step)
        if abs(step) < 1e-13:
            break
    return 2.0 * x


@shared
def pool(t: Any, members: Array, share: Array, to: int, mean: int, count: int, at: int) -> None:
    """sum w (C_l + g_l d_l d_l') of parent ``to`` from row ``at`` on, for ``count`` numbers whose means are already
    stored from row ``mean`` on.
    """
    B, A, first, unknown = t.leaves, t.parents, at, t.unknown > 0
    for k in range(len(members)):
        l, at = members[k], first
        pull = B[NU, l] / B[S, l] if unknown else 1.0
        for i in range(count):
            away = pull * (B[mean + i, l] - A[mean + i, to])
            for j in range(i + 1):
                A[at, to] += share[k] * (B[at, l] + away * (B[mean + j, l] - A[mean + j, to]))
                at += 1


@shared
def match(t: Any, members: Array, share: Array, to: int) -> None:
    """Fill parent ``to`` from the members, whose shares sum to 1."""
    B, A, n, na, unknown = t.leaves, t.parents, t.n, t.output_lags, t.unknown > 0
    lags, heaviest, g, s = lag_row(t), 0, 0.0, 0.0
    for k in range(len(members)):
        heaviest = k if share[k] > share[heaviest] else heaviest
    best = members[heaviest]
    for row in range(LOG, FIRST):
        A[row, to] = B[row, best]
    for row in range(FIRST, len(A)):
        A[row, to] = 0.0
    for k in range(len(members)):  # g = sum w g_l
        l = members[k]
        g += share[k] * (B[NU, l] / B[S, l] if unknown else 1.0)
    for k in range(len(members)):  # m = sum w g_l m_l / g
        l = members[k]
        pull = share[k] * (B[NU, l] / B[S, l] if unknown else 1.0) / g
        for i in range(n):
            A[FIRST + i, to] += pull * B[FIRST + i, l]
        for i in range(na):
            A[lags + i, to] += share[k] * B[lags + i, l]
        if unknown:
            s += share[k] * (digamma(0.5 * B[NU, l]) - math.log(0.5 * B[S, l]))
    pool(t, members, share, to, FIRST, n, FIRST + n)
    if lags + na < len(A):
        pool(t, members, share, to, lags, na, lags + na)
    if unknown:
        A[NU, to] = max(freedom(s - math.log(g), B[NU, best]), LEAST_FREEDOM)
        A[S, to] = A[NU, to] / g


@shared
def sort(group: Array, L: int, G: int, start: Array, order: Array) -> int:
    """Members of group k are order[start[k] : start[k + 1]]; returns how many leaves are in some group."""
    for k in range(G + 1):
        start[k] = 0
    for l in range(L):
        if group[l] >= 0:
            start[group[l] + 1] += 1
    for k in range(G):
        start[k + 1] += start[k]
    for l in range(L):
        if group[l] >= 0:
            order[start[group[l]]] = l
            start[group[l]] += 1
    for k in range(G, 0, -1):
        start[k] = start[k - 1]
    start[0] = 0
    return int(start[G])


@shared
def combine(t: Any, L: int, G: int) -> float:
    """Make a parent and its history for every group that `sort` ordered; returns the remaining mass."""
    A, B, start, order = t.parents, t.leaves, t.start, t.order
    now, after = tables(t)
    kept, share = 0.0, t.scratch[0]
    for k in range(G):
        members, part = order[start[k] : start[k + 1]], share[start[k] : start[k + 1]]
        mass = 0.0
        for l in members:
            mass += B[WEIGHT, l]
        kept += mass
        for at in range(len(members)):
            part[at] = B[WEIGHT, members[at]] / mass
        if len(members) == 1:
            for row in range(len(A)):
                A[row, k] = B[row, members[0]]
        else:
            match(t, members, part, k)
            A[LOG, k] = math.log(mass)
        average(now, members, part, after, k)
    flip(t)
    return kept


@shared
def take(t: Any, G: int) -> float:
    """Copy the leaves that are kept, in `order`, only the rows in use; returns their mass."""
    A, B, order, bases, unknown = t.parents, t.leaves, t.order, t.bases, t.unknown > 0
    for k in range(0, G, WIDTH):
        for row in range(LOG, CODE):
            if unknown or row < NU:
                store(A, row, k, gathered(B, row, order, k))
        store(A, AGE, k, gathered(B, AGE, order, k))
        for i in range(3):
            if bases[i] > 1.0:
                row = (CODE, SENSORS, CHANGES)[i]
                store(A, row, k, gathered(B, row, order, k))
        for row in range(FIRST, len(A)):
            store(A, row, k, gathered(B, row, order, k))
    kept = 0.0
    for k in range(G):
        kept += A[WEIGHT, k]
    return kept


@shared
def mix(t: Any, L: int) -> int:
    """Interaction (IMM): parent e is mixed from all leaves that may lead to event e, with the weights
    W_le = w_l p(e | l) / sum_l w_l p(e | l). Returns the number of events.
    """
    A, B, prior, order = t.parents, t.leaves, t.prior, t.order
    now, after = tables(t)
    H, share = len(prior), t.scratch[0]
    for e in range(H):
        mass, count = 0.0, 0
        for l in range(L):
            heavy = B[WEIGHT, l] * prior[e, l]
            if heavy > 0.0:
                order[count], share[count] = l, heavy
                mass += heavy
                count += 1
        possible = mass
        if count == 0:  # no leaf leads here
            order[0], share[0], mass, count = 0, 1.0, 1.0, 1
        for k in range(count):
            share[k] /= mass
        match(t, order[:count], share[:count], e)
        average(now, order[:count], share[:count], after, e)
        A[LOG, e] = math.log(possible) if possible > 0.0 else -np.inf
    flip(t)
    return H
