"""One sample of a bank: forecast, reduce, grow, weigh, plan, report.

What a sample that is not used does is what time does: every leaf takes in the ordinary course, no weight moves, and no
leaf is dropped; what else may have happened waits, with the reduction that was planned, for the next sample that can be
used (`driftfit.trackers.bank.machine.gaps.gap`).
"""

from __future__ import annotations

import math

from driftfit.engine.kernel import Array, floats, machine, part, shared, wholes
from driftfit.trackers.bank.leaves.forecast import expect, expect_together, weighted
from driftfit.trackers.bank.leaves.forget import BEFORE, CAP, for_interval, foresee
from driftfit.trackers.bank.leaves.lags import push, shift_covariance, widen_by_lags
from driftfit.trackers.bank.leaves.leaves import (
    FIRST,
    WEIGHT,
    increments,
    later,
    mixture,
    normalise,
    priors,
    ready,
    regressors,
    standstill,
    variance_factor,
)
from driftfit.trackers.bank.machine.ancestry import marginals, pick, shift, summary, write_out
from driftfit.trackers.bank.machine.gaps.chain_gap import add_covariance, add_variance, further, go_on, origins, split
from driftfit.trackers.bank.machine.gaps.gap import chances, close, covariances, extend, odds, take_back, widen
from driftfit.trackers.bank.machine.grow import grow
from driftfit.trackers.bank.machine.layout import (
    AGAIN,
    AT,
    BESIDE,
    CLOCK,
    COUNT,
    COV,
    ELAPSED,
    EVIDENCE,
    EXPANDED,
    FADE,
    FAULTS,
    FLAGS,
    FLIPPED,
    FLOORS,
    GROUPS,
    HEAD,
    HELD,
    IMPOSSIBLE,
    IN_DT,
    IN_NOISE,
    IN_OK,
    IN_SEEN,
    IN_TIME,
    IN_Y,
    KEPT,
    LAST,
    LEAST,
    LEAVES,
    LIMIT,
    MANY,
    MOST,
    NOW,
    OPEN,
    OWNERS,
    PARENTS,
    PHI,
    PLAIN,
    POWERS,
    REFUSED,
    REPORT,
    ROWS,
    S2,
    SETTLED,
    SIZE,
    STORED,
    TAKEN,
    THETA,
    WINDOW,
    Y_HAT,
    R,
    packed,
    whole,
)  # fmt: skip
from driftfit.trackers.bank.machine.merge import combine, mix, sort, take
from driftfit.trackers.bank.machine.refilter import NOISE, TIME, Y, histories, refilter
from driftfit.trackers.bank.machine.selection import (
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
from driftfit.trackers.bank.machine.start import GROWTH, trace, wait

FAULTS_IN_A_ROW = 3
"""As many samples in a row may be taken for fault codes."""


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
    L, kind = many[LEAVES], int(knobs[KIND])
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
        many[GROUPS] = beam(B, L, knobs, group, links[3], X)
    elif kind == HYBRID:
        many[GROUPS] = hybrid(B, L, knobs, bases, group, slots, links[3], X)


@part
def advance(
    A: Array, B: Array, T: Array, T2: Array, X: Array, links: Array, group: Array, slots: Array, many: Array,
    now: Array, prior: Array, phi: Array, Q: Array, sizes: Array, c: Array, factors: Array, maps: Array, theta0: Array,
    sensors: Array, P: Array, initial: Array, given: Array, loss: Array, knobs: Array, bases: Array, stamps: Array,
    decided: Array, parts: Array, root: Array, samples: Array, Qt: Array, news: Array, gap: Array, moving: Array,
    path: Array, lag_prob: Array, theta: Array, cov: Array, judges: int, na: int, unknown: bool, same: bool,
    plain: bool, walks: bool, apart: bool,
) -> None:  # fmt: skip
    """One sample. P[0] is the prior row where events are independent (``same``); ``given`` replaces it where finite, or
    the chain of the changes.
    The first row of ``theta0`` is the mean before all samples; its others, and ``maps``, are those of `forget`. Where
    changes are independent events (``apart``) a gap is one floor, of which ``gap`` tells; ``path`` is that of a chain.
    """
    n, H, Hm, L = len(phi), len(initial), len(sensors), many[LEAVES]
    tri = n * (n + 1) // 2
    kind, parent, event = int(knobs[KIND]), links[0], links[1]
    first_table, second_table = T, T2
    T, T2 = (T2, T) if many[FLIPPED] > 0 else (T, T2)
    noise, dt, used = now[IN_NOISE], now[IN_DT], now[IN_OK] > 0.0
    told, first = given[0] == given[0], many[FLOORS] == 0
    if given[H] == given[H]:
        chained(given[H:], P, Hm, moving)
        P, same = moving, False
    wide = apart and (many[OPEN] > 0 or dt != 1.0 or not used)
    expanded = many[EXPANDED] > 0
    parted = len(path) > 0 and not first and (many[OPEN] + many[TAKEN] > 0 or not expanded)
    parted = parted and (many[OPEN] > 0 or not used or further(dt) > 0)
    plain = plain and many[OPEN] == 0 and not parted  # the mixture's covariance then has more in it than the leaves'
    row = given[:H] if told else initial if first else P[0]
    alike = same or told or first
    now[EVIDENCE] = 0.0
    for k in range(len(decided)):
        decided[k, 0] = -1.0
    each = now[IN_TIME] / dt if apart and dt > 0.0 else now[IN_TIME]
    increments(Q, sizes, c, now[R], unknown, now[IN_TIME], each, factors, Qt)
    settings, maps = maps[: len(Q)], maps[len(Q) :]
    with_mean, Qt = Qt, Qt[: len(Q)]
    if parted:
        go_on(path, many, P, row, alike, Hm, dt, used, Qt, X)
    if wide:
        odds(gap, row, Hm, dt, told)
        covariances(gap, dt, used, Qt)
    ready(Qt, n)
    if not walks:
        for_interval(settings, now[IN_DT], maps)

    # forecast: every leaf with all that may happen to it
    C, m, Z, g = X[:tri], X[tri : tri + n], X[tri + n : tri + 2 * n], X[tri + 2 * n : tri + 3 * n]
    expected, factor = X[tri + 3 * n : tri + 3 * n + 2], tri + 3 * n + 2
    h, y_hat = expected[0], expected[1]
    scratch = X[tri + 3 * n + 3 :]
    asked = 1 if plain and alike and kind != INTERACT and used else L  # one stands for all
    outlook(T, event, expanded, first, alike, asked, P, row, prior, dt, Hm, apart, wide, True, gap, scratch)
    variance_factor(B, L, unknown, X, factor)
    if plain:
        now[Y_HAT], now[S2] = expect_together(
            B, L, X, factor, prior, alike, phi, theta, cov, with_mean, sensors, now[R] * noise
        )
    if not plain or not used:
        regressors(phi, B, L, min(L, 1), n, na, Z)
        foresee(B, L, n, na, prior, Hm, Qt, maps, theta0, walks, used, C, m, Z, g, expected, scratch)
        widen_by_lags(B, L, L, n, na, m, h)
        if parted:
            add_variance(h, L, n, na, Z, path, H, H // Hm, event)
    if not plain:
        now[Y_HAT], now[S2] = expect(
            B[WEIGHT], L, y_hat, h, X[factor], prior, sensors, now[R], noise, now[LAST], scratch
        )

    if used and refused(now, many):
        return

    if used:
        K = reduce(
            A, B, T, T2, many, now, prior, row, knobs, bases, links, group, n, na, Hm, unknown, Q, sizes, c, factors,
            maps, theta0, sensors, root, samples, Qt, news, X,
        )  # fmt: skip
        if kind == REFILTER:
            increments(Q, sizes, c, now[R], unknown, now[IN_TIME], each, factors, Qt)
            ready(Qt, n)
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
        elif parted:
            origins(B, L, group, K, event, prior)
            K = split(A, K, T, many[OPEN], n, Hm, path, P, row, alike, dt == 0.0, prior, X)
        elif not alike or kind == REFILTER:
            outlook(T, event, True, first, alike, K, P, row, prior, dt, Hm, apart, wide, True, gap, X)
        if many[OPEN] > 0 and apart:
            take_back(T, K, many[OPEN], gap, H, Hm)
        L = grow(
            A, K, B, phi, now[IN_Y], now[LAST], noise, now[R], unknown, now[FADE], now[LEAST], now[MOST], na, Qt, maps,
            theta0, sensors, prior, own, alike, bases, parent, event, judges, X,
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
            if many[OPEN] > 0:
                many[OPEN] = 0
                close(gap)
            many[TAKEN] = 0
        else:  # no leaf allows what was seen: go on as if it had not been
            many[IMPOSSIBLE] += 1
            many[OPEN], many[TAKEN] = many[OPEN] if apart else 0, 0
            L = recover(A, K, B, len(A))
            many[LEAVES], many[EXPANDED] = L, 1
            shift_covariance(B, L, B, slice(0, L), n, na, False, m, expected, now[R], now[MOST], X[len(X) - na :])
            push(B, L, n, na, now[IN_Y], True, y_hat, now[MOST])
            outlook(T, event, True, first, alike, L, P, row, prior, dt, Hm, apart, wide, False, gap, X)
            shift(T, L, prior, Hm)
        many[FLOORS] += 1
        if wide and knobs[WAIT] > 0.0:  # the interval to come is a nominal one
            increments(Q, sizes, c, now[R], unknown, 1.0, 1.0, factors, Qt)
            ready(Qt, n)
        plan(
            B, many, now, knobs, bases, links, group, slots, loss, P, P[0], same, Qt, maps, theta0[0], sensors, phi,
            unknown, na, stamps, decided, parts, samples, X,
        )  # fmt: skip
    else:
        seen = now[IN_SEEN] > 0.0
        shift_covariance(B, L, B, slice(0, L), n, na, not seen, m, expected, now[R], now[MOST], X[len(X) - na :])
        push(B, L, n, na, now[IN_Y], seen, y_hat, now[MOST])
        if dt != 0.0:
            if not expanded:
                write_out(T, L, H, Hm, parent, event, news, T2)
                flip(many)
                T, T2 = T2, T
                many[EXPANDED] = 1
            if apart:
                outlook(T, event, True, first, alike, L, P, row, prior, dt, Hm, apart, wide, False, gap, scratch)
            shift(T, L, prior, Hm)
            if parted:
                many[OPEN] += 1
                many[TAKEN] = 0
            if apart:  # leaves take in the ordinary course only
                certain(prior, L)
                foresee(
                    B, L, n, na, prior, 1, Qt[:1], maps, theta0, walks, False, C, m, Z, g, expected, scratch
                )  # fmt: skip
                extend(gap)
                many[OPEN] += 1
            for k in range(n):
                theta0[BEFORE, k] = 0.0
                for l in range(L):
                    B[FIRST + k, l] = m[k, l]
            for k in range(0 if parted else tri):
                for l in range(L):
                    B[FIRST + n + k, l] = C[k, l]
            many[FLOORS] += 1
    many[CLOCK] += 1
    mixture(n, B, L, unknown, X, theta, cov)
    if many[OPEN] > 0 and parted:
        add_covariance(cov, B, L, unknown, path, H, H // Hm, event, X)
    elif many[OPEN] > 0:
        variance_factor(B, L, unknown, X, 0)
        widen(gap, weighted(B, L, X, 0), cov)
    now[WINDOW] = marginals(B, L, T, many[EXPANDED] > 0, H, Hm, event, scratch, many[PARENTS], lag_prob)
    if now[IN_SEEN] > 0.0:
        now[LAST] = now[IN_Y]


@part
def outlook(
    T: Array, event: Array, expanded: bool, first: bool, alike: bool, L: int, P: Array, row: Array, prior: Array,
    dt: float, Hm: int, apart: bool, wide: bool, whole: bool, gap: Array, X: Array,
) -> None:  # fmt: skip
    """Probabilities of the events of this interval, or of the ``whole`` gap, for every leaf."""
    priors(T, event, expanded, first, alike, L, P, row, prior)
    if dt == 0.0:
        standstill(prior, L, Hm)
    elif dt > 1.0 and not apart and not alike:
        later(prior, L, P, further(dt), X)
    if wide:
        chances(prior, L, Hm, gap, whole)


@part
def refused(now: Array, many: Array) -> bool:
    """Whether a sample is so far from what was expected that it is taken for a fault code: it counts as missing.

    What keeps coming is no fault code.
    """
    far = now[IN_Y] - now[Y_HAT]
    if many[REFUSED] < FAULTS_IN_A_ROW and far * far > now[LIMIT] * now[LIMIT] * now[S2]:
        now[IN_OK], now[IN_SEEN] = 0.0, 0.0
        many[REFUSED] += 1
        many[FAULTS] += 1
        many[AGAIN] = 1
        return True
    many[REFUSED] = 0
    return False


@shared
def certain(prior: Array, L: int) -> None:
    """The first event, for sure."""
    for l in range(L):
        prior[0, l] = 1.0


@part
def store(sample: Array, now: Array, phi: Array) -> None:
    sample[Y], sample[NOISE], sample[TIME] = now[IN_Y], now[IN_NOISE], now[IN_TIME]
    for i in range(len(phi)):
        sample[TIME + 1 + i] = phi[i]


@shared
def recover(A: Array, K: int, B: Array, rows: int) -> int:
    """The parents again, as if the sample had not come."""
    for row in range(rows):
        for l in range(K):
            B[row, l] = A[row, l]
    normalise(B, K)
    return K


@part
def lone_density(now: Array) -> float:
    """Log density of a sample under the one filter that runs before the tree grows; 0 where it has none."""
    far, s = now[IN_Y] - now[Y_HAT], now[S2]
    if not (now[IN_OK] > 0.0 and 0.0 < s < math.inf):
        return 0.0
    return -0.5 * (math.log(2.0 * math.pi * s) + far * far / s)  # type: ignore[no-any-return]


@shared
def chained(given: Array, P: Array, Hm: int, moving: Array) -> None:
    """The chain of joint events with another chain of the changes, and sensors as they are after the first change."""
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


@part
def note(ring: Array, clock: int, window: float, now: Array, lag_prob: Array) -> None:
    """Remember the probability of a change in the window, whether the sample was used and when it was, and what is
    known at last of the event W - 1 floors back.
    """
    row = (clock - 1) % len(ring)
    ring[row, 0], ring[row, 1], ring[row, 2] = window, now[IN_OK], now[ELAPSED]
    for e in range(lag_prob.shape[1]):
        ring[row, BESIDE + e] = lag_prob[len(lag_prob) - 1, e]


@machine
def bank(table: int) -> None:
    """One sample, by the table of a bank. Only here, where Numba lets a function own memory, can arrays be made of
    addresses; so they are handed to `advance`, into which this writes them.
    """
    t = wholes(table, ROWS, 3)
    n = t[THETA, 1]
    many, now = wholes(t[MANY, 0], 1, COUNT)[0], floats(t[NOW, 0], 1, SIZE)[0]
    theta, cov = floats(t[THETA, 0], 1, n)[0], floats(t[COV, 0], n, n)
    A, B, T, X = packed(t, AT.A), packed(t, AT.B), packed(t, AT.T), packed(t, AT.X)
    theta0, root, lag_prob = packed(t, AT.theta0), packed(t, AT.root), packed(t, AT.lag_prob)
    head = floats(t[REPORT, 0], 1, HEAD)[0]
    begun = many[SETTLED] == 1
    many[AGAIN] = 1 if begun else 0
    while many[AGAIN] == 1:
        many[AGAIN] = 0
        advance(
            A, B, T, packed(t, AT.T2), X, whole(t, AT.links), whole(t, AT.group)[0], whole(t, AT.slots)[0], many, now,
            packed(t, AT.prior), floats(t[PHI, 0], 1, n)[0], packed(t, AT.Q), packed(t, AT.sizes),
            floats(t[POWERS, 0], 1, n)[0], packed(t, AT.factors)[0], packed(t, AT.maps), theta0, packed(t, AT.sensors),
            packed(t, AT.chain), packed(t, AT.initial)[0], packed(t, AT.given)[0], packed(t, AT.loss),
            packed(t, AT.knobs)[0], packed(t, AT.bases)[0], packed(t, AT.stamps)[0], packed(t, AT.decided),
            packed(t, AT.parts), root, packed(t, AT.samples), packed(t, AT.Qt), packed(t, AT.news), packed(t, AT.gap),
            packed(t, AT.moving), packed(t, AT.path), lag_prob, theta, cov, t[OWNERS, 0], t[FLAGS, 0], t[FLAGS, 1] > 0,
            t[FLAGS, 2] > 0, t[PLAIN, 0] > 0, t[PLAIN, 1] > 0, t[PLAIN, 2] > 0,
        )  # fmt: skip
        head[0], head[1], head[2], head[3] = now[EVIDENCE], now[WINDOW], now[KEPT], many[LEAVES]
    if not begun:
        theta0[CAP, 0] = GROWTH * trace(cov)
        wait(B, T, many, now, theta, cov, lag_prob, t[FLAGS, 0])
        for row in range(len(root)):
            root[row, 0] = B[row, 0]
        head[0], head[1], head[2], head[3] = lone_density(now), 0.0, 1.0, 1.0
    now[ELAPSED] += now[IN_DT]
    summary(lag_prob, packed(t, AT.brief))
    note(packed(t, AT.ring), many[CLOCK], head[1], now, lag_prob)
