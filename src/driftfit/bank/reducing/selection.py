"""Selection of leaves: a group for every leaf, whose members are merged; -1 for leaves that are dropped.

Groups are chosen after a sample and merged before the next sample that can be used, so a sample that is not used does
not change the mixture.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from driftfit.bank.leaves.leaf_matrix import AGE, CHANGES, CODE, LOG, SENSORS, WEIGHT
from driftfit.bank.reducing.lookahead import expected_risk
from driftfit.engine.kernel import Array, kernel, log, shared
from driftfit.engine.simd import WIDTH, fill, load, plus, reaches, sum_of

CUT, MERGE, INTERACT, BEAM, HYBRID, REFILTER, RESAMPLE = range(7)
"""Kinds of reduction."""
KIND, LEAVES, DEPTH, TAU, WAIT, CAP, PRIOR, AHEAD, SEED = range(9)
"""Entries of the vector of settings of a reduction."""
STEP, MIX, MIX_2 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
"""Constants of the random numbers splitmix64 (Steele, Lea and Flood 2014)."""


@kernel
def reached(V: Array, row: int, count: int, value: float) -> float:
    """How many entries of a row are at least ``value``."""
    sums = fill(0.0)
    for l in range(0, count, WIDTH):
        sums = plus(sums, reaches(load(V, row, l), fill(value)))
    return float(sum_of(sums))


@shared
def bound(V: Array, row: int, count: int, M: int) -> float:
    """The M-th largest entry of a row, or any number between it and the next; 0 if no more than M are positive.

    By bisection of the bits, which are in the order of the numbers: a dozen counts, each without branches,
    are faster than a selection that jumps about.
    """
    low, high = np.int64(1), np.int64(0x7FF0000000000000)
    if reached(V, row, count, np.int64(low).view(np.float64)) <= M:
        return 0.0
    while high - low > 1:
        middle = low + (high - low) // 2  # of numbers above 2 the sum of the bits would overflow
        many = reached(V, row, count, np.int64(middle).view(np.float64))
        low = middle if many >= M else low
        high = high if many >= M else middle
        if many == M:
            break
    return float(np.int64(low).view(np.float64))


@shared
def heaviest(V: Array, row: int, count: int, M: int, group: Array, order: Array) -> int:
    """Number the M largest positive values of a row in their order, ties by their order; -1 for the rest. Returns how
    many. The rest of the row, up to the end of a SIMD vector, must be zero.
    """
    value, over, G, least = V[row], 0, 0, bound(V, row, count, M)
    for l in range(count):
        over += 1 if value[l] > least else 0
    ties = M - over if least > 0.0 else 0
    for l in range(count):
        tie = 1 if value[l] == least and ties > 0 else 0
        keep = tie + (1 if value[l] > least else 0)
        ties -= tie
        group[l], order[G] = G if keep > 0 else -1, l
        G += keep
    return G


@kernel
def clear(V: Array, row: int, count: int) -> None:
    """Zeros after the first entries, up to the end of a SIMD vector."""
    for l in range(count, min(count + WIDTH, V.shape[1])):
        V[row, l] = 0.0


@shared
def beam(t: Any, L: int) -> int:
    """The heaviest leaves."""
    return int(heaviest(t.leaves, WEIGHT, L, int(t.reduction[LEAVES]), t.group, t.order))


@kernel
def uniform(seed: float, k: int) -> float:
    """The k-th random number in [0, 1) of splitmix64."""
    x = (np.uint64(seed) << np.uint64(32)) + np.uint64(k) * STEP
    x = (x ^ (x >> np.uint64(30))) * MIX
    x = (x ^ (x >> np.uint64(27))) * MIX_2
    return float((x ^ (x >> np.uint64(31))) >> np.uint64(11)) * 2.0**-53


@shared
def common_weight(w: Array, M: int) -> float:
    """The c with sum min(w / c, 1) = M, from above; 0 if no more than M weights are positive."""
    c, lower, positive = np.inf, 2.0, 0
    while lower < c:
        c, heavy, rest, positive = lower, 0, 0.0, 0
        for l in range(len(w)):
            heavy, rest = (heavy + 1, rest) if w[l] > c else (heavy, rest + w[l])
            positive += 1 if w[l] > 0.0 else 0
        lower = rest / (M - heavy) if positive > M else 0.0
    return c


@shared
def resample(t: Any, L: int) -> int:
    """The leaves of `driftfit.bank.reduction.Resample`, which are in the order of their last changes, as children with
    a change come after those without. New weights are in the logarithms alone: the mixture is still that of the old.
    """
    B, M, G = t.leaves, int(t.reduction[LEAVES]), 0
    c = common_weight(B[WEIGHT, :L], M)
    u = c * uniform(t.reduction[SEED], t.clock)
    for l in range(L):
        heavy = B[WEIGHT, l] > c
        u -= 0.0 if heavy else B[WEIGHT, l]
        kept = (heavy or u < 0.0) and G < M
        if kept and not heavy:
            B[LOG, l] = log(c)
            u += c
        t.group[l], t.order[G] = G if kept else -1, l
        G += 1 if kept else 0
    return G


@shared
def merge(t: Any, L: int) -> int:
    """Merge leaves with the same code; codes are numbered in the order of their appearance."""
    B, group, slots, G = t.leaves, t.group, t.slots, 0
    for l in range(L):
        slots[int(B[CODE, l])] = -1
    for l in range(L):
        group[l] = -1
        if B[WEIGHT, l] > 0.0:
            code = int(B[CODE, l])
            if slots[code] < 0:
                slots[code] = G
                G += 1
            group[l] = slots[code]
    return G


@shared
def hybrid(t: Any, L: int) -> int:
    """Merge leaves equal in recent changes, newest sensor events and age; keep the heaviest of the results."""
    B, group, slots, X, bases = t.leaves, t.group, t.slots, t.scratch, t.bases
    cap, M, size, G = t.reduction[CAP], int(t.reduction[LEAVES]), len(t.slots), 0
    mass, key, renumber = X[0], X[1], X[3]
    for k in range(size):
        slots[k] = -1
    for l in range(L):
        group[l] = -1
        if B[WEIGHT, l] <= 0.0:
            continue
        mine = (B[CHANGES, l] * bases[1] + B[SENSORS, l]) * (cap + 1.0) + min(B[AGE, l], cap)
        place = int(mine) * 2654435761 % size  # a hash table with open addressing
        while slots[place] >= 0 and key[slots[place]] != mine:
            place = (place + 1) % size
        if slots[place] < 0:
            slots[place], key[G], mass[G] = G, mine, 0.0
            G += 1
        group[l] = slots[place]
        mass[slots[place]] += B[WEIGHT, l]
    if G > M:
        for k in range(G):
            slots[k] = 0
        clear(X, 0, G)
        kept = heaviest(X, 0, G, M, slots, t.order)
        for k in range(G):
            renumber[k] = slots[k]
        for l in range(L):
            group[l] = int(renumber[group[l]]) if group[l] >= 0 else -1
        return int(kept)
    return G


@shared
def oldest(t: Any, L: int, top: float, p: Array) -> float:
    """The weights of the oldest events in p, whose digit in the codes counts ``top``; returns their sum."""
    mass = 0.0
    for e in range(len(t.loss)):
        p[e] = 0.0
    for l in range(L):
        if t.group[l] >= 0:
            p[int(t.leaves[CODE, l] // top)] += t.leaves[WEIGHT, l]
            mass += t.leaves[WEIGHT, l]
    return mass


@shared
def least_risk(loss: Array, p: Array, mass: float, risk: Array) -> int:
    """The event of least risk R_k = sum_e L[e, k] p_e among those with p_k > 0, the lowest on ties; p becomes p / mass,
    and risk R.
    """
    best, H = -1, len(loss)
    for k in range(H):
        p[k] /= mass
    for k in range(H):
        risk[k] = 0.0
        for e in range(H):
            risk[k] += loss[e, k] * p[e]
        if p[k] > 0.0 and (best < 0 or risk[k] < risk[best]):
            best = k
    return best


@shared
def settled(t: Any, L: int, held: int, risk: float, top: float, mass: float, phi: Array) -> bool:
    """Whether the oldest event is decided now: at full depth, where its risk is small, or where waiting does not pay,
    R* <= s c + ER_s for every number s of samples that may be waited for.
    """
    reduction, wait = t.reduction, t.reduction[WAIT]
    if held >= reduction[DEPTH]:
        return True
    if reduction[TAU] < 0.0:
        return False
    if risk <= reduction[TAU]:
        return True
    if wait <= 0.0:
        return False
    for samples in range(1, int(min(reduction[AHEAD], reduction[DEPTH] - held)) + 1):
        if risk > samples * wait and risk > samples * wait + expected_risk(t, L, top, mass, phi, samples):
            return False
    return True


@shared
def decide(t: Any, L: int, phi: Array) -> None:
    """Resolve the oldest events while the rule says so.

    A leaf that loses a decision leaves its group. ``decided[k]`` is the event, how many samples ago it was first
    visible, and its probability. ``phi`` is used as the next regressor.
    """
    B, group, stamps, decided, held = t.leaves, t.group, t.stamps, t.decided, t.held
    p, risk, H, count = t.scratch[0], t.scratch[1], len(t.loss), 0
    for l in range(L):
        group[l] = 0 if B[WEIGHT, l] > 0.0 else -1
    while held > 0:
        top = float(H) ** (held - 1)
        mass = oldest(t, L, top, p)
        best = least_risk(t.loss, p, mass, risk)
        if not settled(t, L, held, risk[best], top, mass, phi):
            break
        decided[count, 0], decided[count, 1], decided[count, 2] = best, float(t.clock) - stamps[0], p[best]
        count += 1
        for k in range(held - 1):
            stamps[k] = stamps[k + 1]
        for l in range(L):
            if group[l] >= 0:
                if int(B[CODE, l] // top) == best:
                    B[CODE, l] -= best * top
                else:
                    group[l] = -1
        held -= 1
    t.held = held


@shared
def number(group: Array, L: int, order: Array) -> int:
    """Groups of single leaves in their order."""
    G = 0
    for l in range(L):
        keep = group[l] >= 0
        group[l], order[G] = G if keep else -1, l
        G += 1 if keep else 0
    return G
