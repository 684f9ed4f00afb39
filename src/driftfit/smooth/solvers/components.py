"""Components of a mixture: unnormalised Gaussians in square-root form, and what a smoother does to them.

A component is exp(c) exp(-|S theta - d|^2 / 2) with S an upper triangle and A = [S | d]: a density of theta, or the
likelihood of later samples. Only rotations are done to it, so a component without information on some direction, from
collinear regressors or a part of a record in which nothing excites it, is like any other.

Source: Bierman, Factorization Methods for Discrete Sequential Estimation (1977), chapters 5 and 6, for the rotations;
Runnalls (2007), equation 24, for the measure by which components are merged. Cost: O(n^2) to absorb a sample, O(n^3)
for everything else.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, part, shared

LOG, MODE, MOVE, COST, SHARE = range(5)
"""Of a component: c, its mode, its last move, the sum of e^2 / s on its path, and the log of its integral."""
TOTAL, FIRST, MIXED = range(3)
"""Of one that others join: the log of the integral of all, of the first, and whether there are others."""
UNLIKELY = 11.0
"""Log of the ratio to the most probable below which a component, or a pair of them, is dropped."""
MINOR, FAR = 0.03, 600.0
"""Share of a noise below which it counts as the first, and log of the ratio of two densities at most."""
ROOMY = 12
"""Components that are usually enough."""
JOIN, SQUEEZE = 1e-3, 100.0
"""Weighted divergence below which a component joins another, falling with the square of the components that are allowed
beyond `ROOMY`; and the factor of it when there is no room."""


class Filter(NamedTuple):
    """The present K components of a filter."""

    A: Array
    """(K, n, n + 1): [S | d]."""
    facts: Array
    """(K, 5): `LOG` to `SHARE`."""
    many: Array
    """(1,): the number of components."""
    level: Array
    """(1,): log of the factors that were taken out of them."""
    spikes: Array
    """(1,): the expected number of samples that had another noise than the first."""


class Moves(NamedTuple):
    """What may happen between two samples, in the order of the modes that are left, in one direction of time."""

    begin: Array
    """(S + 1,): the first move out of each mode."""
    kind: Array
    """(M, 4): the mode that is entered; the event, 0 for none; its root, after that of a drift if there is one (-1)."""
    log_prob: Array
    """(U, M): U tables of log probabilities."""
    roots: Array
    """(k, n, n): upper triangles G with G G' the covariance."""


class Noises(NamedTuple):
    """The noises of a sample."""

    kind: Array
    """(L, 2): factor of the noise variance, and offset."""
    log_prob: Array
    """(S, L): log probabilities in each mode."""


class Room(NamedTuple):
    """Scratch space: children, their order, factors of kept components, facts of merging, squares, a row, and odds."""

    born: Array
    born_facts: Array
    order: Array
    factors: Array
    merged: Array
    squares: Array
    row: Array
    odds: Array


def room_for(n: int, most: int, children: int) -> Room:
    """Scratch space for so many components, and children of each."""
    C = most * children
    return Room(
        np.empty((C, n, n + 1)), np.empty((C, 5)), np.empty(C, np.int64), np.empty((most + 1, n, n + 1)),
        np.empty((most, 3)), np.zeros((4, n, n + 1)), np.empty(n + 1), np.empty(children + 1),
    )  # fmt: skip


@part
def copy_upper(A: Array, to: Array) -> None:
    """[S | d] without the zeros below the diagonal."""
    for i in range(len(A)):
        for j in range(i, A.shape[1]):
            to[i, j] = A[i, j]


@part
def absorb(A: Array, row: Array) -> float:
    """Rotate the row [phi | y] of noise variance 1 into A = [S | d], and return what is left of y."""
    n = A.shape[0]
    for i in range(n):
        b = row[i]
        if b != 0.0:
            a = A[i, i]
            r = np.sqrt(a * a + b * b)
            c, s = a / r, b / r
            A[i, i] = r
            for j in range(i + 1, n + 1):
                x, z = A[i, j], row[j]
                A[i, j], row[j] = c * x + s * z, c * z - s * x
    return float(row[n])


@part
def convolve(A: Array, G: Array, size: float, row: Array) -> float:
    """theta <- theta + size G w, w ~ N(0, I), in A = [S | d]; returns by how much c falls."""
    n, product = A.shape[0], 1.0
    for q in range(n if size > 0.0 else 0):
        if G[q, q] == 0.0:
            continue
        top = 1.0
        for j in range(n + 1):
            row[j] = 0.0
        for i in range(q, -1, -1):
            z = 0.0
            for j in range(i, q + 1):
                z -= A[i, j] * G[j, q]
            z *= size
            r = np.sqrt(top * top + z * z)
            c, s = top / r, z / r
            top = r
            for j in range(i, n + 1):
                x = row[j]
                row[j], A[i, j] = c * x + s * A[i, j], c * A[i, j] - s * x
        product *= top
    return float(np.log(product))


@part
def log_det(A: Array) -> float:
    """log |S|."""
    product, logs = 1.0, 0.0
    for i in range(A.shape[0]):
        product *= A[i, i]
        if not 1e-200 < product < 1e200:
            logs, product = logs + np.log(product), 1.0
    return float(logs + np.log(product))


@part
def moments(A: Array, R: Array, m: Array) -> None:
    """R = S^-1, an upper triangle with R R' the covariance, and m = R d."""
    n = A.shape[0]
    for j in range(n):
        R[j, j] = 1.0 / A[j, j]
        for i in range(j - 1, -1, -1):
            t = 0.0
            for k in range(i + 1, j + 1):
                t -= A[i, k] * R[k, j]
            R[i, j] = t / A[i, i]
    for i in range(n):
        m[i] = 0.0
        for j in range(i, n):
            m[i] += R[i, j] * A[j, n]


@shared
def grow(K: int, now: Filter, moves: Moves, logp: Array, sizes: Array, room: Room) -> int:
    """All moves of K components; returns the number of the children.

    A move with the drift of the move before it takes what that made of the component.
    """
    X, facts, Y, more, row, drifted = now.A, now.facts, room.born, room.born_facts, room.row, room.squares[0]
    C, best = 0, -np.inf
    for k in range(K):
        best = max(best, facts[k, SHARE])
    for k in range(K):
        mode, drift, lower = int(facts[k, MODE]), -1, 0.0
        for at in range(moves.begin[mode], moves.begin[mode + 1]):
            if facts[k, SHARE] + logp[at] < best - UNLIKELY:
                continue
            kind = moves.kind[at]
            if kind[2] != drift:
                drift = kind[2]
                copy_upper(X[k], drifted)
                lower = convolve(drifted, moves.roots[drift], sizes[drift], row)
            copy_upper(drifted, Y[C])
            c = facts[k, LOG] + logp[at] - lower
            if kind[3] >= 0:
                c -= convolve(Y[C], moves.roots[kind[3]], sizes[kind[3]], row)
            more[C, LOG], more[C, MODE], more[C, MOVE] = c, kind[0], at
            more[C, COST], more[C, SHARE] = facts[k, COST], facts[k, SHARE] + logp[at]
            C += 1
    return C


@shared
def absorb_noise(A: Array, phi: Array, y: float, r: float, noise: Array, row: Array) -> float:
    """Rotate a sample with this noise into A; returns what is left of y."""
    root = 1.0 / np.sqrt(r * noise[0])
    for i in range(len(phi)):
        row[i] = phi[i] * root
    row[len(phi)] = (y - noise[1]) * root
    return float(absorb(A, row))


@shared
def observe(C: int, room: Room, phi: Array, y: float, r: float, noises: Noises, now: Filter) -> int:
    """Update C children by a sample; returns the number of children that come of it.

    Each is updated by every noise that has at least `MINOR` of its probability; the others count as the first. The
    probability of others than the first is added to ``now.spikes``.
    """
    Y, more, kind, p, copy = room.born, room.born_facts, noises.kind, room.odds, room.squares[0]
    count, L, others, everything, best = C, len(kind), 0.0, 0.0, -np.inf
    unit = np.log(r * kind[0, 0])
    for k in range(C):
        if L > 1:
            copy_upper(Y[k], copy)
        earlier, share = more[k, LOG] - more[k, SHARE], more[k, SHARE]
        e = absorb_noise(Y[k], phi, y, r, kind[0], room.row)
        size = log_det(Y[k])
        logs = unit + 2.0 * (size - earlier)  # of the variance of y
        first = noises.log_prob[int(more[k, MODE]), 0] - 0.5 * (e * e + logs)
        more[k, COST] += e * e
        if L > 1:
            s, cost, total = np.exp(logs), more[k, COST] - e * e, 0.0
            f = e * np.sqrt(s) + kind[0, 1]
            for l in range(L):
                v = s + r * (kind[l, 0] - kind[0, 0])
                p[l] = noises.log_prob[int(more[k, MODE]), l] - 0.5 * ((f - kind[l, 1]) ** 2 / v + np.log(v)) - first
                p[l] = np.exp(min(p[l], FAR))
                total += p[l]
            w = share + first + np.log(total)
            scale = np.exp(min(best - w, 0.0))
            best = max(best, w)
            others, everything = (
                others * scale + np.exp(w - best) * (1.0 - p[0] / total),
                everything * scale + np.exp(w - best),
            )
            for l in range(1, L):
                if p[l] < MINOR * total:
                    p[0] += p[l]
                    continue
                copy_upper(copy, Y[count])
                own = absorb_noise(Y[count], phi, y, r, kind[l], room.row)
                more[count, MODE], more[count, MOVE] = more[k, MODE], more[k, MOVE]
                more[count, COST], more[count, SHARE] = cost + own * own, share + first + np.log(p[l])
                more[count, LOG] = more[count, SHARE] + log_det(Y[count])
                count += 1
            first += np.log(p[0])
        more[k, SHARE] = share + first
        more[k, LOG] = more[k, SHARE] + size
    if L > 1:
        now.spikes[0] += others / everything
    return count


@shared
def pool(R: Array, m: Array, share: float, other: Array, mean: Array, row: Array) -> None:
    """Merge N(mean, other other') with this share into N(m, R R'), by their first two moments."""
    n = len(m)
    for i in range(n):
        for j in range(i, n):
            R[i, j] *= np.sqrt(1.0 - share)
    for q in range(n + 1):
        for i in range(n):
            if q < n:
                row[i] = np.sqrt(share) * other[i, q] if i <= q else 0.0
            else:
                row[i] = np.sqrt(share * (1.0 - share)) * (mean[i] - m[i])
        for i in range(min(q, n - 1), -1, -1):
            b = row[i]
            if b != 0.0:
                a = R[i, i]
                r = np.sqrt(a * a + b * b)
                c, s = a / r, b / r
                R[i, i] = r
                for k in range(i):
                    x, z = R[k, i], row[k]
                    R[k, i], row[k] = c * x + s * z, c * z - s * x
    for i in range(n):
        m[i] += share * (mean[i] - m[i])


@part
def divergence(A: Array, m: Array, ahead: float, other: Array, limit: float) -> float:
    """KL of a Gaussian from the component A with mean m; inf beyond the limit. ``other`` are [S^-1 | mean] of the
    Gaussian, ``ahead`` is its log |S| less that of A.

    The means, the diagonal with ``ahead``, and what is above it have a share each, none of them negative.
    """
    n, squares = len(m), 0.0
    for i in range(n):
        squares += (A[i, i] * other[i, i]) ** 2 - 1.0
    apart = 0.5 * squares + ahead
    if apart > limit:
        return np.inf
    squares = 0.0
    for i in range(n):
        t = 0.0
        for j in range(i, n):
            t += A[i, j] * (other[j, n] - m[j])
        squares += t * t
    if apart + 0.5 * squares > limit:
        return np.inf
    for i in range(n):
        for j in range(i + 1, n):
            t = 0.0
            for k in range(i, j + 1):
                t += A[i, k] * other[k, j]
            squares += t * t
    return apart + 0.5 * squares


@shared
def restore(A: Array, R: Array, m: Array) -> None:
    """A = [S | d] from R = S^-1 and m = R d."""
    n = len(m)
    for i in range(n):
        A[i, i] = 1.0 / R[i, i]
    for q in range(n):
        for i in range(q - 1, -1, -1):
            t = 0.0
            for k in range(i + 1, q + 1):
                t -= R[i, k] * A[k, q]
            A[i, q] = t / R[i, i]
    for i in range(n):
        A[i, n] = 0.0
        for q in range(i, n):
            A[i, n] += A[i, q] * m[q]


@shared
def ranked(C: int, shares: Array, order: Array) -> int:
    """Put the children that are not `UNLIKELY` in order, the largest first; returns their number."""
    count, best = 0, -np.inf
    for k in range(C):
        best = max(best, shares[k])
    for k in range(C):
        if shares[k] >= best - UNLIKELY:
            at = count
            while at > 0 and shares[order[at - 1]] < shares[k]:
                order[at] = order[at - 1]
                at -= 1
            order[at] = k
            count += 1
    return count


@shared
def nearest(N: int, now: Filter, room: Room, k: int, limit: float) -> int:
    """The component of the same mode from which child k has the least divergence below the limit, or -1."""
    more, merged, n, most = room.born_facts, room.merged, now.A.shape[1], len(now.A)
    to, least, logs = -1, limit, more[k, LOG] - more[k, SHARE]
    for j in range(N):
        if now.facts[j, MODE] == more[k, MODE]:
            ahead = logs - now.facts[j, LOG] + merged[j, FIRST]
            apart = divergence(now.A[j], room.factors[j, :, n], ahead, room.factors[most], least)
            if apart < least:
                to, least = j, apart
    return to


@shared
def reduce(C: int, room: Room, keep: int, now: Filter) -> int:
    """C children, the largest first, to at most ``keep`` components; returns their number."""
    Y, more, order, merged, scratch = room.born, room.born_facts, room.order, room.merged, room.factors
    X, facts, n, N = now.A, now.facts, now.A.shape[1], 0
    join = JOIN * (ROOMY / max(keep, ROOMY)) ** 2
    count = ranked(C, more[:, SHARE], order)
    best, total = more[order[0], SHARE], 0.0
    root, mean = scratch[len(X), :, :n], scratch[len(X), :, n]
    for o in range(count):
        k = order[o]
        w = np.exp(more[k, SHARE] - best)
        total += w
        if count > 1:
            moments(Y[k], root, mean)
        j = nearest(N, now, room, k, (join if keep > N else SQUEEZE * join) * total / w)
        if j >= 0:
            both = w + np.exp(merged[j, TOTAL] - best)
            pool(scratch[j, :, :n], scratch[j, :, n], w / both, root, mean, room.row)
            facts[j, COST] += w / both * (more[k, COST] - facts[j, COST])
            merged[j, TOTAL], merged[j, MIXED] = np.log(both) + best, 1.0
        elif keep > N:
            copy_upper(Y[k], X[N])
            copy_upper(scratch[len(X)], scratch[N])
            for i in range(facts.shape[1]):
                facts[N, i] = more[k, i]
            merged[N, TOTAL], merged[N, FIRST], merged[N, MIXED] = more[k, SHARE], more[k, SHARE], 0.0
            N += 1
    for j in range(N):
        if merged[j, MIXED] > 0.0:
            restore(X[j], scratch[j, :, :n], scratch[j, :, n])
            facts[j, SHARE] = merged[j, TOTAL]
            facts[j, LOG] = merged[j, TOTAL] + log_det(X[j])
    return N


@shared
def lowered(K: int, facts: Array) -> float:
    """Make the largest share 1; returns the log of what it was."""
    best = -np.inf
    for k in range(K):
        best = max(best, facts[k, SHARE])
    for k in range(K):
        facts[k, SHARE] -= best
        facts[k, LOG] -= best
    return best
