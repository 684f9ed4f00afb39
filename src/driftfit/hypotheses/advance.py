"""One sample of a bank: forecast, reduce, grow, weigh, plan, report.

What a sample that is not used does is what time does: every leaf takes in what may have happened, no weight moves, and
no leaf is dropped. The reduction that was planned waits for the next sample that can be used.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from driftfit.hypotheses.forecast import expect, expect_together
from driftfit.hypotheses.forget import BEFORE, CAP, for_interval, foresee
from driftfit.hypotheses.grow import grow
from driftfit.hypotheses.lags import shift_covariance, widen_by_lags
from driftfit.hypotheses.leaves import (
    AGE,
    FIRST,
    LOG,
    NU,
    WEIGHT,
    S,
    increments,
    mixture,
    normalise,
    priors,
    regressors,
    standstill,
    variance_factor,
)
from driftfit.hypotheses.merge import combine, mix, sort, take
from driftfit.hypotheses.past import marginals, pick, shift, write_out
from driftfit.hypotheses.plan import (
    BEAM,
    CUT,
    DEPTH,
    HYBRID,
    INTERACT,
    KIND,
    MERGE,
    PRIOR,
    REFILTER,
    WAIT,
    beam,
    decide,
    hybrid,
    merge,
    number,
)
from driftfit.hypotheses.refilter import NOISE, TIME, Y, histories, refilter
from driftfit.kernel import Array, core, floats, kernel, outside, part, wholes

LEAVES, PARENTS, GROUPS, FLOORS, HELD, EXPANDED, CLOCK, IMPOSSIBLE, STORED, SETTLED, REPORTED_TO, FLIPPED, COUNT = (
    range(13)
)
"""Counters of a bank; COUNT is how many there are. SETTLED is 1 once the tree grows, WAITING before, READY where
it begins with the next sample.
"""
WAITING, READY = 0, -1
(
    IN_Y, IN_NOISE, IN_DT, IN_TIME, IN_OK, IN_SEEN, IN_VALID, R, FADE, LEAST, LAST, Y_HAT, S2, EVIDENCE, WINDOW, KEPT,
    SQUARES, TIMES, SIZE,
) = range(19)  # fmt: skip
"""Numbers of the present sample: what comes in, and what goes out."""
GROWTH = 1e8
"""Exponential forgetting lets the trace of a covariance grow to this multiple of what it is when the tree begins."""
NEVER = 1e9
"""Floors since the last change of a leaf that has none, or more."""
HEAD = 4
"""Entries of the report before its arrays: evidence, probability of a change in the window, mass kept, leaves."""


@part
def reduce(
    A: Array, B: Array, T: Array, T2: Array, many: Array, now: Array, prior: Array, row: Array, knobs: Array,
    bases: Array, links: Array, group: Array, n: int, na: int, Hm: int, unknown: bool, Q: Array, sizes: Array, c: Array,
    factors: Array, maps: Array, theta0: Array, sensors: Array, root: Array, samples: Array, Qt: Array, news: Array,
    X: Array,
) -> int:  # fmt: skip
    """Carry out what was planned: the parents of the next floor, in A."""
    H, L, kind = len(row), many[LEAVES], int(knobs[KIND])
    expanded = many[EXPANDED] > 0
    parent, event, start, order = links[0], links[1], links[2], links[3]
    now[KEPT] = 1.0
    full = kind == REFILTER and many[STORED] >= int(knobs[DEPTH])
    alone = kind in (CUT, BEAM)  # the plan has put them in order
    if kind == REFILTER and not full:
        for l in range(L):
            order[l] = l
        many[GROUPS], alone = L, True
    elif kind in (MERGE, HYBRID):
        alone = sort(group, L, many[GROUPS], start, order) == many[GROUPS]
    if not alone and not expanded:
        write_out(T, L, H, Hm, parent, event, news, T2)
        flip(many)
        T, T2 = T2, T
    if full:
        many[STORED] -= 1
        L = refilter(
            root, samples, int(knobs[DEPTH]), B, L, A, knobs[PRIOR] > 0.0, Q, sizes, c, now[R], unknown, now[FADE],
            now[LEAST], factors, maps, theta0, sensors, row, bases, parent, event, prior, na, kind == INTERACT, Qt, X,
        )  # fmt: skip
        histories(A, L, int(knobs[DEPTH]), H, Hm, T)
        return int(L)
    flip(many)
    if kind == INTERACT:
        return int(mix(B, L, prior, n, na, unknown, A, order, X, T, T2))
    G = many[GROUPS]
    if alone:
        pick(T, expanded, H, Hm, parent, event, order, G, news, T2)
        kept = take(B, order, G, len(A), unknown, bases, A)
    else:
        kept = combine(B, group, L, G, n, na, unknown, A, start, order, X, T, T2)
    now[KEPT] = min(kept, 1.0)
    return int(G)


@part
def flip(many: Array) -> None:
    """The two tables of the past change places."""
    many[FLIPPED] = 1 - many[FLIPPED]


@part
def plan(
    B: Array, many: Array, now: Array, knobs: Array, bases: Array, links: Array, group: Array, slots: Array,
    loss: Array, P: Array, row: Array, same: bool, Q: Array, maps: Array, theta0: Array, sensors: Array, phi: Array,
    unknown: bool, na: int, stamps: Array, decided: Array, parts: Array, samples: Array, X: Array,
) -> None:  # fmt: skip
    """Which leaves go on."""
    L, kind, Hm = many[LEAVES], int(knobs[KIND]), len(sensors)
    if kind == CUT:
        if knobs[WAIT] > 0.0:  # the regressor to come is like the last one that no event held has been seen with
            phi = samples[max(many[STORED] - 1 - many[HELD], 0) % len(samples), TIME + 1 :]
        many[HELD] = decide(
            B, L, many[HELD], knobs, loss, P, row, same, Q, maps, theta0, sensors, phi, now[LAST], now[R], unknown, na,
            links[1], stamps, float(many[CLOCK]), decided, parts, group, X,
        )  # fmt: skip
        many[GROUPS] = number(group, L, links[3])
    elif kind == MERGE:
        many[GROUPS] = merge(B, L, group, slots)
    elif kind == BEAM:
        many[GROUPS] = beam(B, L, knobs, links, Hm, group, X)
    elif kind == HYBRID:
        many[GROUPS] = hybrid(B, L, knobs, bases, group, slots, links[3], X)


@core
def push(B: Array, L: int, n: int, na: int, y: float, seen: bool, y_hat: Array) -> None:
    """Output lags of leaves that took no sample in: y where it was seen, else what each expected."""
    at = FIRST + n + n * (n + 1) // 2
    for i in range(na - 1, 0, -1):
        for l in range(L):
            B[at + i, l] = B[at + i - 1, l]
    if na > 0:
        for l in range(L):
            B[at, l] = y if seen else y_hat[l]


@part
def advance(
    A: Array, B: Array, T: Array, T2: Array, X: Array, links: Array, group: Array, slots: Array, many: Array,
    now: Array, prior: Array, phi: Array, Q: Array, sizes: Array, c: Array, factors: Array, maps: Array, theta0: Array,
    sensors: Array, P: Array, initial: Array, given: Array, loss: Array, knobs: Array, bases: Array, stamps: Array,
    decided: Array, parts: Array, root: Array, samples: Array, Qt: Array, news: Array, lag_prob: Array, theta: Array,
    cov: Array, na: int, unknown: bool, same: bool, plain: bool, walks: bool,
) -> None:  # fmt: skip
    """One sample. P[0] is the prior row where events are independent (``same``); ``given`` replaces it where finite.
    The first row of ``theta0`` is the mean before all samples; its others, and ``maps``, are those of `forget`.
    """
    n, H, Hm, L = len(phi), len(initial), len(sensors), many[LEAVES]
    tri = n * (n + 1) // 2
    kind, parent, event = int(knobs[KIND]), links[0], links[1]
    first_table, second_table = T, T2
    T, T2 = (T2, T) if many[FLIPPED] > 0 else (T, T2)
    noise, still = now[IN_NOISE], now[IN_DT] == 0.0
    told, first = given[0] == given[0], many[FLOORS] == 0
    row = given if told else initial if first else P[0]
    alike = same or told or first
    now[EVIDENCE] = 0.0
    for k in range(len(decided)):
        decided[k, 0] = -1.0
    increments(Q, sizes, c, now[R], unknown, now[IN_TIME], factors, Qt)
    settings, maps = maps[: len(Q)], maps[len(Q) :]
    with_mean, Qt = Qt, Qt[: len(Q)]
    if not walks:
        for_interval(settings, now[IN_DT], maps)

    # forecast: every leaf with all that may happen to it
    C, m, Z, g = X[:tri], X[tri : tri + n], X[tri + n : tri + 2 * n], X[tri + 2 * n : tri + 3 * n]
    expected, factor = X[tri + 3 * n : tri + 3 * n + 2], tri + 3 * n + 2
    h, y_hat = expected[0], expected[1]
    scratch = X[tri + 3 * n + 3 :]
    expanded = many[EXPANDED] > 0
    asked = 1 if plain and alike and kind != INTERACT and now[IN_OK] > 0.0 else L  # one stands for all
    priors(T, event, expanded, first, alike, asked, P, row, prior)
    if still:
        standstill(prior, asked, Hm)
    variance_factor(B, L, unknown, X, factor)
    if plain:
        now[Y_HAT], now[S2] = expect_together(
            B, L, X, factor, prior, alike, phi, theta, cov, with_mean, sensors, now[R] * noise
        )
    if not plain or now[IN_OK] == 0.0:
        regressors(phi, B, L, min(L, 1), n, na, Z)
        foresee(
            B, L, n, na, prior, Hm, Qt, maps, theta0, walks, now[IN_OK] > 0.0, C, m, Z, g, expected, scratch
        )  # fmt: skip
        widen_by_lags(B, L, L, n, na, m, h)
    if not plain:
        now[Y_HAT], now[S2] = expect(
            B[WEIGHT], L, y_hat, h, X[factor], prior, sensors, now[R], noise, now[LAST], scratch
        )

    if now[IN_OK] > 0.0:
        K = reduce(
            A, B, T, T2, many, now, prior, row, knobs, bases, links, group, n, na, Hm, unknown, Q, sizes, c, factors,
            maps, theta0, sensors, root, samples, Qt, news, X,
        )  # fmt: skip
        if kind == REFILTER:
            increments(Q, sizes, c, now[R], unknown, now[IN_TIME], factors, Qt)
        if kind == REFILTER or knobs[WAIT] > 0.0:
            store(samples[many[STORED] % len(samples)], now, phi)
            many[STORED] += 1
        T, T2 = (second_table, first_table) if many[FLIPPED] > 0 else (first_table, second_table)
        many[EXPANDED] = 0
        own = kind == INTERACT
        if own:
            for e in range(H):
                for l in range(K):
                    prior[e, l] = 1.0 if e == l else 0.0
        else:
            if not alike or kind == REFILTER:
                priors(T, event, many[EXPANDED] == 0, first, alike, K, P, row, prior)
                if still:
                    standstill(prior, K, Hm)
        L = grow(
            A, K, B, phi, now[IN_Y], now[LAST], noise, now[R], unknown, now[FADE], now[LEAST], na, Qt, maps, theta0,
            sensors, prior, own, alike, bases, parent, event, X,
        )  # fmt: skip
        gone = normalise(B, L)
        many[PARENTS], many[LEAVES] = K, L
        if gone == gone:
            now[EVIDENCE] = gone - math.log(now[KEPT])
            for i in range(n):
                theta0[BEFORE, i] = phi[i]
            if many[HELD] < len(stamps):
                stamps[many[HELD]] = float(many[CLOCK])
            many[HELD] += 1
        else:  # no leaf allows what was seen: go on as if it had not been
            many[IMPOSSIBLE] += 1
            L = recover(A, K, B, len(A))
            many[LEAVES], many[EXPANDED] = L, 1
            shift_covariance(B, L, B, slice(0, L), n, na, False, m, h, now[R], X[len(X) - na :])
            push(B, L, n, na, now[IN_Y], True, y_hat)
            if own or asked < L:
                priors(T, event, many[EXPANDED] > 0, first, alike, L, P, row, prior)
                if still:
                    standstill(prior, L, Hm)
            shift(T, L, prior, Hm)
        many[FLOORS] += 1
        plan(
            B, many, now, knobs, bases, links, group, slots, loss, P, P[0], same, Qt, maps, theta0[0], sensors, phi,
            unknown, na, stamps, decided, parts, samples, X,
        )  # fmt: skip
    else:
        seen = now[IN_SEEN] > 0.0
        shift_covariance(B, L, B, slice(0, L), n, na, not seen, m, h, now[R], X[len(X) - na :])
        push(B, L, n, na, now[IN_Y], seen, y_hat)
        if not still:
            for k in range(n):
                theta0[BEFORE, k] = 0.0
                for l in range(L):
                    B[FIRST + k, l] = m[k, l]
            for k in range(tri):
                for l in range(L):
                    B[FIRST + n + k, l] = C[k, l]
            if not expanded:
                write_out(T, L, H, Hm, parent, event, news, T2)
                flip(many)
                T, T2 = T2, T
                many[EXPANDED] = 1
            shift(T, L, prior, Hm)
            many[FLOORS] += 1
    many[CLOCK] += 1
    mixture(n, B, L, unknown, X, theta, cov)
    now[WINDOW] = marginals(B, L, T, many[EXPANDED] > 0, H, Hm, event, scratch, many[PARENTS], lag_prob)
    if now[IN_SEEN] > 0.0:
        now[LAST] = now[IN_Y]


@part
def store(sample: Array, now: Array, phi: Array) -> None:
    sample[Y], sample[NOISE], sample[TIME] = now[IN_Y], now[IN_NOISE], now[IN_TIME]
    for i in range(len(phi)):
        sample[TIME + 1 + i] = phi[i]


@core
def recover(A: Array, K: int, B: Array, rows: int) -> int:
    """The parents again, as if the sample had not come."""
    for row in range(rows):
        for l in range(K):
            B[row, l] = A[row, l]
    normalise(B, K)
    return K


@core
def wait(B: Array, T: Array, many: Array, now: Array, theta: Array, P: Array, lag_prob: Array, na: int) -> None:
    """Before the tree grows there is one leaf and no event; the tracker runs its filter."""
    n, H = len(theta), lag_prob.shape[1]
    lag_prob[0, 0] = 1.0
    y_hat = B[WEIGHT, :1]
    y_hat[0] = now[Y_HAT] if abs(now[Y_HAT]) < np.inf else 0.0
    push(B, 1, n, na, now[IN_Y], now[IN_SEEN] > 0.0, y_hat)
    now[LAST] = now[IN_Y] if now[IN_SEEN] > 0.0 else now[LAST]
    many[CLOCK] += 1
    if many[SETTLED] == READY:
        begin(B, T, theta, P, now[TIMES], max(now[SQUARES], now[LEAST] * now[TIMES]), many, H)


@core
def begin(B: Array, T: Array, theta: Array, P: Array, nu: float, squares: float, many: Array, H: int) -> None:
    """The one leaf that a bank starts from; P, in units of an unknown noise variance, takes those of theta."""
    n = len(theta)
    at, unit = FIRST + n, squares / (nu - 2.0) if nu > 2.0 else 1.0
    for row in range(LOG, FIRST):
        B[row, 0] = 0.0
    B[WEIGHT, 0], B[NU, 0], B[S, 0], B[AGE, 0] = 1.0, nu, squares, NEVER
    for i in range(n):
        B[FIRST + i, 0] = theta[i]
        for j in range(i + 1):
            B[at, 0] = P[i, j]
            P[i, j] *= unit
            at += 1
    for at in range(T.shape[1]):
        T[0, at] = 1.0 if at % (H + 1) == H else 0.0
    many[LEAVES], many[GROUPS], many[EXPANDED], many[SETTLED] = 1, 1, 1, 1


@core
def trace(P: Array) -> float:
    total = 0.0
    for i in range(len(P)):
        total += P[i, i]
    return total


@part
def note(ring: Array, clock: int, window: float, lag_prob: Array) -> None:
    """Remember the probability of a change in the window, and what is known at last of the event W - 1 floors back."""
    row = (clock - 1) % len(ring)
    ring[row, 0] = window
    for e in range(lag_prob.shape[1]):
        ring[row, 1 + e] = lag_prob[len(lag_prob) - 1, e]


PACKED = (
    "A", "B", "T", "T2", "X", "links", "group", "slots", "prior", "Q", "sizes", "factors", "maps", "theta0", "sensors",
    "chain", "initial", "given", "loss", "knobs", "bases", "stamps", "parts", "root", "samples", "Qt", "ring",
    "news", "lag_prob", "decided",
)  # fmt: skip
"""Arrays of a bank that lie one after the other in the field `memory`, the last two in `report`, so that banks of many
shapes have one type of record and one driver. Row k of the table says where, in bytes, and rows and columns.
"""
GIVEN, FACTORS = PACKED.index("given"), PACKED.index("factors")
PLACES, ADDRESSES, REPORTED = len(PACKED), 8, PACKED[-2:]
BASE, REPORT, PHI, C, THETA, P, MANY, NOW, FLAGS, PLAIN, ROWS = range(PLACES, PLACES + 11)
"""Further rows of the table, whose first entry is an address; of FLAGS the output lags that leaves have of their own,
and whether the noise is unknown and events are independent; of PLAIN whether all leaves have one regressor, all changes
are walks and all sensors differ in their noise alone, and whether all changes are walks; and how many rows there are.
"""


@kernel
def packed(t: Array, k: int) -> Any:
    """One of the packed arrays, of floats."""
    return floats(t[BASE if k < PLACES - 2 else REPORT, 0] + t[k, 0], t[k, 1], t[k, 2])


@kernel
def whole(t: Array, k: int) -> Any:
    """One of the packed arrays, of whole numbers."""
    return wholes(t[BASE, 0] + t[k, 0], t[k, 1], t[k, 2])


@outside
def bank(table: int) -> None:
    """`advance` on the arrays of a table."""
    t = wholes(table, ROWS, 3)
    n = t[THETA, 1]
    many, now = wholes(t[MANY, 0], 1, COUNT)[0], floats(t[NOW, 0], 1, SIZE)[0]
    head = floats(t[REPORT, 0], 1, HEAD)[0]
    if many[SETTLED] != 1:
        packed(t, 13)[CAP, 0] = GROWTH * trace(floats(t[P, 0], n, n))
        wait(
            packed(t, 1), packed(t, 2), many, now, floats(t[THETA, 0], 1, n)[0], floats(t[P, 0], n, n), packed(t, 28),
            t[FLAGS, 0],
        )  # fmt: skip
        root = packed(t, 23)
        for row in range(len(root)):
            root[row, 0] = packed(t, 1)[row, 0]
        head[0], head[1], head[2], head[3] = 0.0, 0.0, 1.0, 1.0
        note(packed(t, 26), many[CLOCK], 0.0, packed(t, 28))
        return
    advance(
        packed(t, 0), packed(t, 1), packed(t, 2), packed(t, 3), packed(t, 4), whole(t, 5), whole(t, 6)[0],
        whole(t, 7)[0], many, now, packed(t, 8),
        floats(t[PHI, 0], 1, n)[0], packed(t, 9), packed(t, 10), floats(t[C, 0], 1, n)[0], packed(t, 11)[0],
        packed(t, 12), packed(t, 13), packed(t, 14), packed(t, 15), packed(t, 16)[0], packed(t, 17)[0],
        packed(t, 18), packed(t, 19)[0], packed(t, 20)[0], packed(t, 21)[0], packed(t, 29), packed(t, 22),
        packed(t, 23), packed(t, 24), packed(t, 25), packed(t, 27), packed(t, 28), floats(t[THETA, 0], 1, n)[0],
        floats(t[P, 0], n, n), t[FLAGS, 0], t[FLAGS, 1] > 0, t[FLAGS, 2] > 0, t[PLAIN, 0] > 0,
        t[PLAIN, 1] > 0,
    )  # fmt: skip
    head[0], head[1], head[2], head[3] = now[EVIDENCE], now[WINDOW], now[KEPT], many[LEAVES]
    note(packed(t, 26), many[CLOCK], now[WINDOW], packed(t, 28))
