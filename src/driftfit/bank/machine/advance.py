"""One sample of a bank: forecast, reduce, grow, weigh, select the leaves to keep, report.

A sample that is not used only lets time pass: every leaf makes its time update under the nominal change, no weight
changes, and no leaf is dropped. Other changes that may have happened, and the reduction that was planned, wait for the
next sample that can be used (`driftfit.bank.machine.gap`).
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np

from driftfit.bank.layout import ENTER, FORECAST, NEVER, READY, SAMPLE_HEAD, table_at
from driftfit.bank.leaves.forecast import expect, expect_together, weighted
from driftfit.bank.leaves.forget import BEFORE, GROWTH, PER_CAP, for_interval, foresee
from driftfit.bank.leaves.lags import push, shift_covariance, widen_by_lags
from driftfit.bank.leaves.leaf_matrix import (
    AGE,
    FIRST,
    LOG,
    NU,
    WEIGHT,
    S,
    increments,
    later,
    mixture,
    normalise,
    priors,
    regressors,
    standstill,
    variance_factor,
)
from driftfit.bank.machine.ancestry import chained, descend, marginals, shift
from driftfit.bank.machine.framed import enter, write_changes
from driftfit.bank.machine.gap import SINCE, chances, close, covariances, extend, odds, widen
from driftfit.bank.machine.grow import grow
from driftfit.bank.machine.markov_gap import add_covariance, add_variance, further, go_on, origins, split
from driftfit.bank.reducing.merge import combine, mix, sort, take
from driftfit.bank.reducing.refilter import NOISE, TIME, Y, histories, refilter
from driftfit.bank.reducing.selection import (
    BEAM,
    CUT,
    DEPTH,
    HYBRID,
    INTERACT,
    KIND,
    MERGE,
    REFILTER,
    RESAMPLE,
    WAIT,
    beam,
    decide,
    hybrid,
    merge,
    number,
    resample,
)
from driftfit.engine.kernel import machine, shared
from driftfit.engine.simd import WIDTH

MEMORY = 500.0
"""Samples after which a learned probability has forgotten two thirds of what it was. Without forgetting the errors in
the last table of `benchmarks/bank_prior.py` are 1.28, 1.40 and 1.96; where nothing changes it costs 3 % at most.
"""


@shared
def increments_now(t: Any) -> None:
    """Covariances of the changes in this interval; where it is one level, a change happens in one nominal sample."""
    time, dt = t.time, t.dt
    increments(t, time, time / dt if t.apart > 0 and dt > 0.0 else time)


@shared
def count(t: Any) -> None:
    """Count the changes of the oldest level, given all samples since:

    c_i <- a_i + (1 - 1 / MEMORY) (c_i - a_i) + p(change i at this level | data)
    """
    oldest, Hm = t.lag_prob[len(t.lag_prob) - 1], len(t.sensors)
    for i in range(t.counts.shape[1]):
        t.counts[1, i] -= (t.counts[1, i] - t.counts[0, i]) / MEMORY
        for e in range(i * Hm, (i + 1) * Hm):
            t.counts[1, i] += oldest[e]


@shared
def learned_chain(t: Any) -> None:
    """The prior of the events with the mean p_i = c_i / sum c of the Dirichlet distribution of the changes."""
    before, now, P, Hm, all_before, all_now = t.counts[0], t.counts[1], t.transition, len(t.sensors), 0.0, 0.0
    for i in range(len(now)):
        all_before, all_now = all_before + before[i], all_now + now[i]
    for e in range(len(P)):
        for to in range(len(P)):
            t.chain[e, to] = P[e, to] * (now[to // Hm] * all_before / (before[to // Hm] * all_now))


@shared
def prepare(t: Any) -> None:
    """Prepare the priors of the events in this interval, and the covariances that changes add."""
    dt, used, Hm = t.dt, t.ok > 0.0, len(t.sensors)
    given = t.given[0] == t.given[0]
    if t.given_chain[0] == t.given_chain[0]:
        chained(t.given_chain, t.transition, Hm, t.chain)
        t.chained = 1
    elif t.chained > 0:
        t.chained = 0
        for e in range(len(t.chain)):
            for to in range(len(t.chain)):
                t.chain[e, to] = t.transition[e, to]
    if len(t.counts) > 0 and t.chained == 0:
        learned_chain(t)
    source = t.given if given else t.initial if t.levels == 0 else t.chain[0]
    for e in range(len(source)):
        t.row[e] = source[e]
    alike = given or t.levels == 0 or (t.independent > 0 and t.chained == 0)
    wide = t.apart > 0 and (t.open > 0 or dt != 1.0 or not used)
    parted = len(t.path) > 0 and t.levels > 0 and (t.open + t.taken > 0 or t.expanded == 0)
    parted = parted and (t.open > 0 or not used or further(dt) > 0)
    t.alike, t.wide, t.parted = 1 if alike else 0, 1 if wide else 0, 1 if parted else 0
    increments_now(t)
    if parted:
        go_on(t, dt, used)
    if wide:
        odds(t.gap, t.row, Hm, dt, given)
        covariances(t.gap, dt, used, t.Q)
    if t.walks_only == 0:
        for_interval(t.maps_nominal, dt, t.maps)


@shared
def outlook(t: Any, L: int, expanded: bool, whole: bool) -> None:
    """Probabilities of the events of this interval, or of the ``whole`` gap, for every leaf."""
    dt, Hm, wide = t.dt, len(t.sensors), t.wide > 0
    priors(t, L, expanded)
    if dt == 0.0:
        standstill(t.prior, 0, L, Hm)
    elif dt > 1.0 and t.apart == 0 and t.alike == 0:
        later(t.prior, L, t.chain, further(dt), t.spare)
    if wide:
        chances(t.prior, L, Hm, t.gap, whole)


@shared
def forecast(t: Any, L: int) -> None:
    """Mean and variance of the output before it is observed, over all leaves and events.

    If leaves share one regressor and all changes are random walks, the mixture of the last sample suffices.
    """
    used, interacts = t.ok > 0.0, int(t.reduction[KIND]) == INTERACT
    parted = t.parted > 0
    plain = t.plain > 0 and t.open == 0 and not parted  # in a gap the mixture is wider than its leaves
    one_for_all = plain and t.alike > 0 and used and not interacts
    outlook(t, 1 if one_for_all else L, t.expanded > 0, True)
    variance_factor(t, t.scores, 0, L)
    if plain:
        t.y_hat, t.s = expect_together(t, L)
    if not plain or not used:
        regressors(t.n, t, t.leaves, L, min(L, 1), t.phi)
        foresee(t, L, len(t.walks), len(t.sensors))
        widen_by_lags(t, t.leaves, L, L)
        if parted:
            add_variance(t, L)
    if not plain:
        t.y_hat, t.s = expect(t, L)


@shared
def accept(t: Any, gone: float) -> None:
    """Accept a sample that some leaf can explain; ``gone`` is its log density under all leaves."""
    t.evidence = gone - math.log(t.kept)
    for i in range(t.n):
        t.places[BEFORE, i] = t.phi[i]
    if t.held < len(t.stamps):
        t.stamps[t.held] = float(t.clock)
    t.held += 1
    if t.open > 0:
        t.open = 0
        for i in range(len(t.gap)):
            t.gap[i, t.gap.shape[1] - WIDTH + SINCE] = 1.0 if i == 0 else 0.0
    t.taken = 0


@shared
def reject(t: Any, K: int) -> None:
    """No leaf can explain the sample: continue as if it had been missing."""
    t.impossible += 1
    t.open, t.taken = t.open if t.apart > 0 else 0, 0
    t.many_leaves, t.expanded = K, 1
    for row in range(len(t.parents)):
        for l in range(K):
            t.leaves[row, l] = t.parents[row, l]
    normalise(t.leaves, K)
    shift_covariance(t, t.leaves, K, 0, K, False)
    push(t, t.leaves, K, 0, K, t.y, False)
    outlook(t, K, True, False)
    shift(t, K)


@shared
def choose(t: Any, L: int) -> None:
    """Plan the reduction, which `reduce` carries out before the next sample that is used."""
    samples, kind = t.samples, int(t.reduction[KIND])
    if kind == CUT:
        phi = t.phi
        if t.reduction[WAIT] > 0.0:  # the last regressor before the open events represents the next one
            phi = samples[max(t.stored - 1 - t.held, 0) % len(samples), TIME + 1 :]
        decide(t, L, phi)
        t.groups = number(t.group, L, t.order)
    elif kind == MERGE:
        t.groups = merge(t, L)
    elif kind == BEAM:
        t.groups = beam(t, L)
    elif kind == RESAMPLE:
        t.groups = resample(t, L)
    elif kind == HYBRID:
        t.groups = hybrid(t, L)


@shared
def reduce(t: Any) -> int:
    """Carry out the reduction that `choose` planned; returns the number of parents of the next level."""
    L, kind, order = t.many_leaves, int(t.reduction[KIND]), t.order
    t.kept = 1.0
    full = kind == REFILTER and t.stored >= int(t.reduction[DEPTH])
    alone = kind in (CUT, BEAM, RESAMPLE)  # every group is one leaf, in order
    if kind == REFILTER and not full:
        for l in range(L):
            order[l] = l
        t.groups, alone = L, True
    elif kind in (MERGE, HYBRID):
        alone = sort(t.group, L, t.groups, t.start, order) == t.groups
    if not alone and t.expanded == 0:
        descend(t, L, False)
    if full:
        t.stored -= 1
        L = refilter(t, L)
        histories(t, L)
        return int(L)
    if kind == INTERACT:
        return int(mix(t, L))
    G = t.groups
    if alone:
        descend(t, G, True)
        kept = take(t, G)
    else:
        kept = combine(t, L, G)
    t.kept = 1.0 if kind == RESAMPLE else min(kept, 1.0)
    return int(G)


@shared
def keep_sample(t: Any) -> None:
    """Store the sample, for growing the tree again or for looking ahead."""
    kept = t.samples[t.stored % len(t.samples)]
    kept[Y], kept[NOISE], kept[TIME] = t.y, t.noise, t.time
    for i in range(t.n):
        kept[TIME + 1 + i] = t.phi[i]
    t.stored += 1


@shared
def take_in(t: Any) -> None:
    """Process a sample that is used: reduce, grow, weigh, and plan the next reduction."""
    prior, kind = t.prior, int(t.reduction[KIND])
    waits, own, again = t.reduction[WAIT] > 0.0, kind == INTERACT, kind == REFILTER
    K = reduce(t)
    if again:
        increments_now(t)
    if again or waits:
        keep_sample(t)
    t.expanded = 0
    if own:
        for e in range(len(prior)):
            for l in range(K):
                prior[e, l] = 1.0 if e == l else 0.0
    elif t.parted > 0:
        origins(t, t.many_leaves, K)
        K = split(t, K)
    elif t.alike == 0 or again:
        outlook(t, K, True, True)
    if t.open > 0 and t.apart > 0:
        close(t, K)
    L = grow(t, K, own, t.phi, t.y, t.last, t.noise)
    gone = normalise(t.leaves, L)
    t.many_parents, t.many_leaves = K, L
    if gone == gone:
        accept(t, gone)
    else:
        reject(t, K)
    t.levels += 1
    if t.wide > 0 and waits:  # the next interval is nominal
        increments(t, 1.0, 1.0)
    choose(t, t.many_leaves)


@shared
def let_pass(t: Any, L: int) -> None:
    """Process a sample that is not used: the time update of the leaves."""
    B, n, dt, apart = t.leaves, t.n, t.dt, t.apart > 0
    observed = t.observed > 0.0
    shift_covariance(t, B, L, 0, L, not observed)
    push(t, B, L, 0, L, t.y, False)
    if dt == 0.0:
        return
    if t.expanded == 0:
        descend(t, L, False)
    if apart:
        outlook(t, L, True, False)
    shift(t, L)
    if t.parted > 0:
        t.open += 1
        t.taken = 0
    if apart:  # leaves make the update of the nominal change only
        for l in range(L):
            t.prior[0, l] = 1.0
        foresee(t, L, 1, 1)
        extend(t.gap)
        t.open += 1
    for k in range(n):
        t.places[BEFORE, k] = 0.0
        for l in range(L):
            B[FIRST + k, l] = t.m[k, l]
    for k in range(0 if t.parted > 0 else n * (n + 1) // 2):
        for l in range(L):
            B[FIRST + n + k, l] = t.C[k, l]
    t.levels += 1


@shared
def look(t: Any) -> None:
    """The time update of a sample, and its forecast."""
    t.evidence = 0.0
    for k in range(len(t.decided)):
        t.decided[k, 0] = -1.0
    prepare(t)
    forecast(t, t.many_leaves)
    t.looked = 1 if t.ok > 0.0 else 0


@shared
def advance(t: Any) -> None:
    """Process one sample, whose forecast is known, with a tree that has begun."""
    if (t.looked > 0) != (t.ok > 0.0):  # it was refused since
        look(t)
    levels = t.levels
    if t.ok > 0.0:
        take_in(t)
    else:
        let_pass(t, t.many_leaves)
    t.clock += 1
    L = t.many_leaves
    mixture(t.n, t, L)
    t.unit = weighted(t.leaves, L, t.from_C, t.n) if t.unknown > 0 else 1.0
    if t.open > 0 and t.parted > 0:
        add_covariance(t, L)
    elif t.open > 0:
        widen(t.gap, t.unit, t.cov)
    t.window = marginals(t, L)
    if len(t.counts) > 0 and t.levels > levels:
        count(t)


@shared
def lone_density(t: Any) -> float:
    """Log density of a sample under the single filter that runs before the tree grows; 0 if it has none.

    It is Gaussian, or Student's where the noise variance is estimated.
    """
    far, s, nu = t.y - t.y_hat, t.s, t.freedom
    if not (t.ok > 0.0 and 0.0 < s < math.inf):
        return 0.0
    if nu < math.inf:
        ratio = math.lgamma(0.5 * (nu + 1.0)) - math.lgamma(0.5 * nu)
        wide = math.log(math.pi * nu * s) + (nu + 1.0) * math.log(1.0 + far * far / (nu * s))
        return ratio - 0.5 * wide  # type: ignore[no-any-return]
    return -0.5 * (math.log(2.0 * math.pi * s) + far * far / s)  # type: ignore[no-any-return]


@shared
def begin(t: Any, nu: float, squares: float) -> None:
    """Set the single leaf from which a bank starts; P, in units of an unknown noise variance, is converted to units of
    theta.
    """
    B, theta, P, history = t.leaves, t.theta, t.cov, t.history
    n, H = len(theta), len(t.initial)
    at, unit = FIRST + n, squares / (nu - 2.0) if nu > 2.0 else 1.0
    t.unit = unit
    for row in range(LOG, FIRST):
        B[row, 0] = 0.0
    B[WEIGHT, 0], B[NU, 0], B[S, 0], B[AGE, 0] = 1.0, nu, squares, NEVER
    for i in range(n):
        B[FIRST + i, 0] = theta[i]
        for j in range(i + 1):
            B[at, 0] = P[i, j]
            P[i, j] *= unit
            at += 1
    for at in range(history.shape[1]):
        history[0, at] = 1.0 if at % (H + 1) == H else 0.0
    t.many_leaves, t.groups, t.expanded, t.settled = 1, 1, 1, 1


@shared
def wait(t: Any) -> None:
    """Before the tree grows there is one leaf and no event; the tracker runs its filter."""
    t.lag_prob[0, 0] = 1.0
    t.expected[1, 0] = t.y_hat if abs(t.y_hat) < np.inf else 0.0
    push(t, t.leaves, 1, 0, 1, t.y, False)
    t.clock += 1
    if t.settled == READY:
        begin(t, t.times, max(t.squares, t.least * t.times))


@shared
def limit_forgetting(t: Any) -> None:
    """The caps of variances, from those of the single filter."""
    for i in range(t.n):
        t.places[PER_CAP, i] = 1.0 / (GROWTH * t.cov[i, i]) if t.cov[i, i] > 0.0 else 0.0


@partial(machine, short=True)  # rows of a dozen leaves: copies of loops for long rows made it a tenth slower
def bank(address: int) -> None:
    """The forecast of a sample, or its processing, by its phase, given the table of a bank."""
    t = table_at(address)
    head = t.report
    begun = t.settled == 1
    if t.phase >= ENTER:
        enter(t, t.phase == ENTER)
        return
    if t.phase == FORECAST:
        if t.framed > 0:
            write_changes(t)
        t.last = t.reading - t.shift
        if begun:
            look(t)
        return
    if begun:
        advance(t)
        head[0], head[1], head[2], head[3] = t.evidence, t.window, t.kept, t.many_leaves
    else:
        limit_forgetting(t)
        wait(t)
        for row in range(len(t.root)):
            t.root[row, 0] = t.leaves[row, 0]
        head[0], head[1], head[2], head[3] = lone_density(t), 0.0, 1.0, 1.0
    t.elapsed += t.dt
    if t.observed > 0.0:
        t.reading = t.y + t.shift
    # for events of a stream: also the final probabilities of the event W - 1 levels back
    row, oldest, last = t.ring[(t.clock - 1) % len(t.ring)], len(t.lag_prob) - 1, len(t.newest) - 1
    row[0], row[1], row[2] = head[1], t.ok, t.elapsed
    for e in range(t.lag_prob.shape[1]):
        row[SAMPLE_HEAD + e] = t.lag_prob[oldest, e]
        for k in range(len(t.newest)):
            t.newest[k, e] = t.lag_prob[k if k < last else oldest, e]
