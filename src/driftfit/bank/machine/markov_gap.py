"""Gaps under a Markov chain of changes: each leaf is continued twice, with the mode that probably lasted and with all
others.

During a gap the chain continues. For a leaf whose last event is s,

    reach[s, e]    p(last event of the gap is e)
    stay[s, e]     the part of it in which the change was that of e at every sample of the gap
    held[c]        sum Q_c over the gap, mean[s] = E sum Q over the gap

When a sample can be used after k others that could not, each leaf, of weight w, is split into two:

    one mode c       w kappa,         C + held[c],                                    stay[s, .] / kappa
    all else         w (1 - kappa),   C + (mean[s] - kappa held[c]) / (1 - kappa),   the rest of reach

(c the mode of largest kappa, the sum of stay[s, e] over its events e) and both grow a level as usual, with the chain
from the events in which they end. That is exact in the probabilities of both courses and of what they end in, and in
the first two moments of the parameters given either; the information of the sample about courses within the second is
lost. An interval of dt nominal samples is a gap of dt - 1 and a level.

`Decide` and `GPB` number leaves by their last events and have room for twice as many as there are numbers. So at most
two leaves have one number: a leaf whose twin from an earlier gap is still there continues as one, with the moments of
both courses. Without that rule leaves in one branch were split at every gap, and outgrew their table.

Only random walks, and not under `IMM`, which mixes its leaves at every sample, nor under `FirstFloor`, which grows the
tree again from samples alone; both widen by the mean. Cost: O(H^3 + H n^2) for each sample that is not used, and twice
the leaves for the one that ends the gap.
"""

from __future__ import annotations

import math
from typing import Any

from driftfit.bank.layout import tables
from driftfit.bank.leaves.leaf_matrix import CODE, FIRST, LOG, WEIGHT, standstill, variance_factor
from driftfit.bank.machine.ancestry import settle
from driftfit.engine.kernel import Array, kernel, shared

SURE = 1e-12
"""Courses of events less likely than this are left out."""
MOST_STEPS = 1000
"""Largest number of steps of a chain of events in one interval."""


@kernel
def further(dt: float) -> int:
    """Number of steps of the chain before the last one of an interval."""
    return int(min(dt, MOST_STEPS) - 0.5) if dt > 1.0 else 0


@shared
def step(t: Any, e: int, to: int) -> float:
    """p(next event is ``to`` | e); one row serves all events where the rows are equal."""
    return t.row[to] if t.alike > 0 else t.chain[e, to]  # type: ignore[no-any-return]


@shared
def lengthen(t: Any, share: float) -> None:
    """Add a sample without an observation, in which change c adds ``share`` of Q[c]. The rows of `path` are reach (H),
    stay (H), held (H_d), mean (H), and a spare one.
    """
    path, Q, X, H, Hd, Hm = t.path, t.Q, t.scratch, len(t.row), len(t.walks), len(t.sensors)
    for s in range(H):
        for e in range(H):
            total, same = 0.0, 0.0
            for last in range(H):
                p = step(t, last, e)
                total += path[s, last] * p
                same += path[H + s, last] * p if last // Hm == e // Hm or path[2 * H, path.shape[1] - 1] == 0.0 else 0.0
            X[0, e], X[1, e] = total, same
        for e in range(H):
            path[s, e], path[H + s, e] = X[0, e], X[1, e]
        for c in range(Hd):
            chance = 0.0
            for e in range(c * Hm, (c + 1) * Hm):
                chance += path[s, e]
            for k in range(Q.shape[1]):
                path[2 * H + Hd + s, k] += chance * share * Q[c, k]
    for c in range(Hd):
        for k in range(Q.shape[1]):
            path[2 * H + c, k] += share * Q[c, k]
    path[2 * H, path.shape[1] - 1] = 1.0  # at the first sample any event may lead into a mode


@shared
def go_on(t: Any, dt: float, used: bool) -> None:
    """The interval up to this sample, or to the level that ends the gap; Q becomes that of this level, if there is one.

    A sample that is refused later is processed here twice.
    """
    Q = t.Q
    if t.open == 0 and t.taken == 0:
        for row in range(len(t.path) - 1):
            for k in range(t.path.shape[1]):
                t.path[row, k] = 1.0 if row < 2 * len(t.row) and k == row % len(t.row) else 0.0
    steps = further(dt) + 1 if dt > 0.0 else 0
    share = 1.0 / max(steps, 1)
    for _ in range(steps - t.taken - (1 if used and steps > 0 else 0)):
        lengthen(t, share)
    t.taken = steps - 1 if used and steps > 0 else 0
    for c in range(len(t.walks)):
        for k in range(Q.shape[1]):
            Q[c, k] *= share if used else 0.0


@shared
def add_variance(t: Any, L: int) -> None:
    """h <- h + z' mean[s] z, for leaves whose last events are s."""
    h, z, path, first = t.expected[0], t.z, t.path, 2 * len(t.row) + len(t.walks)
    for l in range(L):
        k, at, row = l if t.output_lags > 0 else 0, 0, first + t.event[l]
        for i in range(t.n):
            for j in range(i + 1):
                h[l] += (1.0 if i == j else 2.0) * z[i, k] * z[j, k] * path[row, at]
                at += 1


@shared
def add_covariance(t: Any, L: int) -> None:
    """Add to the covariance of the mixture what the gap adds on average."""
    P, B, X, path, H, Hd = t.cov, t.leaves, t.from_C, t.path, len(t.row), len(t.walks)
    variance_factor(t, X, 0, L)
    for s in range(H):
        weight, at = 0.0, 0
        for l in range(L):
            weight += B[WEIGHT, l] * X[0, l] if t.event[l] == s else 0.0
        if weight > 0.0:
            for i in range(len(P)):
                for j in range(i + 1):
                    P[i, j] += weight * path[2 * H + Hd + s, at]
                    at += 1


@shared
def origins(t: Any, L: int, K: int) -> None:
    """prior[s, k]: share of the weight of group k that had s as its last event before the gap."""
    group, event, origin = t.group, t.event, t.prior
    for s in range(len(origin)):
        for k in range(K):
            origin[s, k] = 0.0
    for l in range(L):
        if group[l] >= 0:
            origin[event[l], group[l]] += t.leaves[WEIGHT, l]
    for k in range(K):
        total = 0.0
        for s in range(len(origin)):
            total += origin[s, k]
        for s in range(len(origin)):
            origin[s, k] /= total


@shared
def next_event(t: Any, p: Array, k: int) -> None:
    """The prior of the level to come of a leaf whose last event has the probabilities p."""
    prior, H = t.prior, len(t.row)
    for e in range(H):
        prior[e, k] = 0.0
        for last in range(H):
            prior[e, k] += p[last] * step(t, last, e)
    if t.dt == 0.0:
        standstill(prior, k, k + 1, len(t.sensors))


@shared
def exclude(T: Array, k: int, levels: int, H: int, Hm: int, best: int, kappa: float) -> None:
    """Row k: the mean over all courses of the newest ``levels`` without that of one mode, of probability kappa."""
    block = H + 1
    for at in range(0, T.shape[1] - block + 1, block):
        if at < levels * block:
            for j in range(Hm):
                share = 0.0
                for e in range(j, H, Hm):
                    share += T[k, at + e]
                e = best * Hm + j
                T[k, at + e] = max(T[k, at + e] - kappa * share, 0.0)
            total = 0.0
            for e in range(H):
                total += T[k, at + e]
            for e in range(H):
                T[k, at + e] /= total
        if best == 0 and at >= (levels - 1) * block:
            T[k, at + H] = 0.0  # something changed


@shared
def courses(t: Any, k: int) -> tuple[int, float]:
    """The mode that most likely lasted for parent k, and kappa; reach and stay of this leaf in two rows of scratch."""
    prior, path, reach, stay, H, Hm = t.prior, t.path, t.scratch[0], t.scratch[1], len(t.row), len(t.sensors)
    for e in range(H):
        reach[e], stay[e] = 0.0, 0.0
        for s in range(H):
            reach[e] += prior[s, k] * path[s, e]
            stay[e] += prior[s, k] * path[H + s, e]
    best, kappa = 0, -1.0
    for c in range(len(t.walks)):
        mass = 0.0
        for e in range(c * Hm, (c + 1) * Hm):
            mass += stay[e]
        best, kappa = (c, mass) if mass > kappa else (best, kappa)
    return best, kappa


@shared
def follow(t: Any, k: int, to: int, mode: int, kappa: float, alone: bool) -> None:
    """Continue parent ``to``, a copy of k, in the course of one mode of probability kappa ``alone``, or in all others
    (kappa = 0: in all).
    """
    path, reach, stay, p, H, Hm = t.path, t.scratch[0], t.scratch[1], t.scratch[2], len(t.row), len(t.sensors)
    for i in range(t.n * (t.n + 1) // 2):
        add, mean = path[2 * H + mode, i], 0.0
        if not alone:
            for s in range(H):
                mean += t.prior[s, k] * path[2 * H + len(t.walks) + s, i]
            add = (mean - kappa * add) / (1.0 - kappa)
        t.parents[FIRST + t.n + i, to] += add
    for e in range(H):
        held = stay[e] if e // Hm == mode and kappa > 0.0 else 0.0
        p[e] = held / kappa if alone else max(reach[e] - held, 0.0) / (1.0 - kappa)
    next_event(t, p, to)


@shared
def split(t: Any, K: int) -> int:
    """Split the parents in two; returns their new number.

    `prior` has for every leaf the shares of the events before the gap, and takes those of the level to come.
    """
    A, T, slots, coded = t.parents, tables(t)[0], t.slots, t.bases[0] > 1.0
    H, Hm, levels, count = len(t.row), len(t.sensors), t.open, K
    for k in range(K if coded else 0):  # how many parents have each code
        slots[int(A[CODE, k])] = 0
    for k in range(K if coded else 0):
        slots[int(A[CODE, k])] += 1
    for k in range(K):
        mode, kappa = courses(t, k)
        parts = SURE < kappa < 1.0 - SURE and (not coded or slots[int(A[CODE, k])] == 1)
        if parts:
            for i in range(len(A)):
                A[i, count] = A[i, k]
            for i in range(T.shape[1]):
                T[count, i] = T[k, i]
            A[LOG, count] += math.log(1.0 - kappa)
            A[LOG, k] += math.log(kappa)
            exclude(T, count, levels, H, Hm, mode, kappa)
            settle(T, k, levels, H, Hm, mode)
            follow(t, k, count, mode, kappa, False)
            count += 1
        alone = parts or kappa >= 1.0 - SURE
        follow(t, k, k, mode, kappa if alone else 0.0, alone)
    return count
