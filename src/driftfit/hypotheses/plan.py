"""Which leaves go on, and which of them become one: a group for every leaf, -1 for those that are dropped.

The plan is made when a sample has been taken in and carried out before the next one that can be used: a sample that is
not used leaves the mixture as it is.
"""

from __future__ import annotations

from driftfit.hypotheses.leaves import AGE, CHANGES, CODE, SENSORS, WEIGHT
from driftfit.hypotheses.lookahead import expected_risk
from driftfit.kernel import Array, core

CUT, MERGE, INTERACT, BEAM, HYBRID, REFILTER = range(6)
"""Kinds of reduction."""
KIND, LEAVES, DEPTH, TAU, WAIT, LIFE, BEST, CAP, PRIOR = range(9)
"""Entries of the vector of settings of a reduction."""


@core
def kth_largest(x: Array, count: int, k: int) -> float:
    """The k-th largest of the first entries (k from 1), which are put out of order; linear on average."""
    low, high = 0, count - 1
    while low < high:
        pivot = x[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while x[i] > pivot:
                i += 1
            while x[j] < pivot:
                j -= 1
            if i <= j:
                x[i], x[j] = x[j], x[i]
                i += 1
                j -= 1
        if k - 1 <= j:
            high = j
        elif k - 1 >= i:
            low = i
        else:
            break
    return float(x[k - 1])


@core
def heaviest(value: Array, count: int, M: int, group: Array, scratch: Array) -> int:
    """Number the M largest positive values in their order, ties by their order; -1 for the rest. Returns how many."""
    positive = 0
    for l in range(count):
        scratch[l] = value[l]
        positive += 1 if value[l] > 0.0 else 0
    bound = 0.0
    if positive > M:
        bound = kth_largest(scratch, count, M)
    above = 0
    for l in range(count):
        above += 1 if value[l] > bound else 0
    ties = M - above if positive > M else 0
    G = 0
    for l in range(count):
        tie = value[l] == bound and ties > 0 and value[l] > 0.0
        ties -= 1 if tie else 0
        if value[l] > bound or tie:
            group[l] = G
            G += 1
        else:
            group[l] = -1
    return G


@core
def beam(B: Array, L: int, knobs: Array, parent: Array, event: Array, Hm: int, group: Array, X: Array) -> int:
    """The heaviest leaves; the young are protected, and jumps of all but the best parent may be left out."""
    w, value, mass = B[WEIGHT], X[0], X[1]
    top = 0
    for l in range(L):
        value[l] = w[l]
        top = l if w[l] > w[top] else top
    if knobs[LIFE] > 0.0:
        for l in range(L):
            value[l] += 2.0 if w[l] > 0.0 and B[AGE, l] < knobs[LIFE] else 0.0
    if knobs[BEST] > 0.0:
        for l in range(L):
            mass[l] = 0.0
        best = 0
        for l in range(L):
            mass[parent[l]] += w[l]
        for l in range(L):
            best = l if mass[l] > mass[best] else best
        for l in range(L):
            value[l] = 0.0 if event[l] >= Hm and parent[l] != best else value[l]
    value[top] = 4.0
    return int(heaviest(value, L, int(knobs[LEAVES]), group, X[2]))


@core
def merge(B: Array, L: int, group: Array, slots: Array) -> int:
    """Leaves of one code become one; codes are numbered as they come."""
    G = 0
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


@core
def hybrid(B: Array, L: int, knobs: Array, bases: Array, group: Array, slots: Array, X: Array) -> int:
    """Merge leaves equal in recent changes, newest sensor events and age; keep the heaviest of what comes of it."""
    cap, size = knobs[CAP], len(slots)
    mass, key, renumber = X[0], X[1], X[3]
    for k in range(size):
        slots[k] = -1
    G = 0
    for l in range(L):
        group[l] = -1
        if B[WEIGHT, l] <= 0.0:
            continue
        mine = (B[CHANGES, l] * bases[1] + B[SENSORS, l]) * (cap + 1.0) + min(B[AGE, l], cap)
        place = int(mine) * 2654435761 % size
        while slots[place] >= 0 and key[slots[place]] != mine:
            place = (place + 1) % size
        if slots[place] < 0:
            slots[place], key[G], mass[G] = G, mine, 0.0
            G += 1
        group[l] = slots[place]
        mass[slots[place]] += B[WEIGHT, l]
    M = int(knobs[LEAVES])
    if G > M:
        for k in range(G):
            slots[k] = 0
        G2 = heaviest(mass, G, M, slots, X[2])
        for k in range(G):
            renumber[k] = slots[k]
        for l in range(L):
            group[l] = int(renumber[group[l]]) if group[l] >= 0 else -1
        return int(G2)
    return G


@core
def decide(
    B: Array, L: int, held: int, knobs: Array, loss: Array, P: Array, row: Array, same: bool, Q: Array, maps: Array,
    theta0: Array, sensors: Array, phi: Array, last: float, r: float, unknown: bool, na: int, event: Array,
    stamps: Array, now: float, decided: Array, parts: Array, group: Array, X: Array,
) -> int:  # fmt: skip
    """Resolve the oldest events while the rule says so; returns how many floors are still held.

    A leaf that loses a decision has its weight set to 0. ``decided[k]`` is the event, how many samples ago it was first
    visible, and its probability.
    """
    H = len(loss)
    p, risk = X[0], X[1]
    count = 0
    for l in range(L):
        group[l] = 0 if B[WEIGHT, l] > 0.0 else -1
    while held > 0:
        top = float(H) ** (held - 1)
        mass = 0.0
        for e in range(H):
            p[e] = 0.0
        for l in range(L):
            if group[l] >= 0:
                p[int(B[CODE, l] // top)] += B[WEIGHT, l]
                mass += B[WEIGHT, l]
        best = -1
        for k in range(H):
            p[k] /= mass
        for k in range(H):
            risk[k] = 0.0
            for e in range(H):
                risk[k] += loss[e, k] * p[e]
            if p[k] > 0.0 and (best < 0 or risk[k] < risk[best]):
                best = k
        stop = held >= knobs[DEPTH]
        if not stop and knobs[TAU] >= 0.0:
            stop = risk[best] <= knobs[TAU]
            if not stop and knobs[WAIT] > 0.0:
                stop = risk[best] <= knobs[WAIT]
                if not stop:
                    later = expected_risk(
                        B, L, top, loss, P, row, same, Q, maps, theta0, sensors, phi, last, r, unknown, na, event,
                        group, mass, parts, X[2:],
                    )  # fmt: skip
                    stop = risk[best] <= knobs[WAIT] + later
        if not stop:
            break
        decided[count, 0], decided[count, 1], decided[count, 2] = best, now - stamps[0], p[best]
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
    return held


@core
def number(group: Array, L: int) -> int:
    """Groups of single leaves in their order."""
    G = 0
    for l in range(L):
        if group[l] >= 0:
            group[l] = G
            G += 1
    return G
