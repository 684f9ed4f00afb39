"""Gaps: the events that may have happened since the last used sample, as one level of the tree.

A tree that grew by a level at every missing sample would fill up with histories that the data cannot distinguish.
Leaves therefore make only the nominal time update, sample by sample, and the alternatives are kept in a table: the
probability a_0 that only nominal changes happened, and for every other change i the probability a_i that it was the
first, with the mean A_i of the covariance that it and all further changes add. After an interval in which change i is
the first with probability r_i (none: r_0) and adds Q_i, they are

    a_i A_i <- a_i (A_i + D) + a_0 r_i (Q_i + M),    a_i <- a_i + a_0 r_i,    a_0 <- a_0 r_0

where D is the mean of all changes of the interval and M that of those after its first. An interval of dt nominal
samples has r_0 = p_0^dt, and dt (1 - p_0) changes on average. The next used sample grows one level with the
probabilities a and the covariances A; its event represents the whole gap.

That is exact in the probability of any change and in the first two moments of the parameters after the gap given the
first change, and entirely exact if at most one change falls into a gap; the drift of the normal course is not removed
for the samples at which another change took its place. Changes that follow a Markov chain are treated in
`driftfit.bank.machine.markov_gap`. Cost: O(H n^2) for each sample that is not used.
"""

from __future__ import annotations

from typing import Any

from driftfit.bank.layout import tables
from driftfit.bank.machine.ancestry import settle
from driftfit.engine.kernel import Array, exp, log, shared
from driftfit.engine.simd import WIDTH

SINCE, NOW, SCALE, MORE = range(4)
"""Columns of the table of a gap after the covariances: a_i; r_i; r_i over the prior probability for one nominal sample;
and in the first row how many changes follow the first of an interval on average.
"""


@shared
def odds(gap: Array, row: Array, Hm: int, dt: float, given: bool) -> None:
    """The probabilities of this interval; those ``given`` by the user apply to the interval, whatever its length."""
    at = gap.shape[1] - WIDTH
    none, rest = 0.0, 0.0
    for e in range(len(row)):
        none, rest = (none + row[e], rest) if e < Hm else (none, rest + row[e])
    quiet, scale, more = none, 1.0, 0.0
    if dt != 1.0 and not given and rest > 0.0:
        quiet = exp(dt * log(none)) if none > 0.0 else 0.0
        scale = (1.0 - quiet) / rest
        more = max(dt / scale - 1.0, 0.0) if scale > 0.0 else 0.0
    gap[0, at + NOW], gap[0, at + SCALE] = quiet, quiet / none if none > 0.0 else 1.0
    gap[0, at + MORE] = more
    for i in range(1, len(gap)):
        gap[i, at + NOW], gap[i, at + SCALE] = 0.0, scale
        for j in range(Hm):
            gap[i, at + NOW] += row[i * Hm + j] * scale
    if dt == 0.0:  # nothing changes
        for i in range(len(gap)):
            gap[i, at + NOW], gap[i, at + SCALE] = 1.0 if i == 0 else 0.0, 1.0


@shared
def covariances(gap: Array, dt: float, used: bool, Q: Array) -> None:
    """Turn Q of single changes into Q of the level. A sample that is not ``used`` leaves this to the next one."""
    at = gap.shape[1] - WIDTH
    before, more, chance = gap[0, at + SINCE], gap[0, at + MORE], 0.0
    for i in range(1, len(gap)):
        chance += gap[i, at + NOW]
    apart = max(dt - 1.0 - more, 0.0) / dt if dt > 0.0 else 0.0
    for k in range(Q.shape[1]):
        mean = 0.0
        for i in range(1, len(gap)):
            mean += gap[i, at + NOW] * Q[i, k] / chance if chance > 0.0 else 0.0
        for i in range(1, len(gap)):
            earlier, now = gap[i, at + SINCE], before * gap[i, at + NOW]
            both = earlier + now
            if both > 0.0:
                kept = earlier * (gap[i, k] + chance * (1.0 + more) * mean) + now * (Q[i, k] + more * mean)
                if earlier + more + apart > 0.0:
                    Q[i, k] = (kept + (earlier + now * apart) * Q[0, k]) / both
                    kept = kept / both
                else:  # one nominal sample: the same bits as if it were used
                    kept = Q[i, k]
                if not used:
                    gap[i, k] = kept


@shared
def chances(prior: Array, L: int, Hm: int, gap: Array, whole: bool) -> None:
    """Turn the prior of one nominal sample into that of the interval, or of the ``whole`` gap."""
    at = gap.shape[1] - WIDTH
    for j in range(Hm):
        for l in range(L):
            share = 0.0
            for i in range(len(gap)):
                share += prior[i * Hm + j, l]
            for i in range(len(gap)):
                first = gap[i, at + SINCE] if whole and i > 0 else 0.0
                now = gap[i, at + SCALE] * (gap[0, at + SINCE] if whole else 1.0)
                prior[i * Hm + j, l] = now * prior[i * Hm + j, l] + first * share


@shared
def extend(gap: Array) -> None:
    """Extend the gap by a sample that is not used."""
    at = gap.shape[1] - WIDTH
    for i in range(1, len(gap)):
        gap[i, at + SINCE] += gap[0, at + SINCE] * gap[i, at + NOW]
    gap[0, at + SINCE] *= gap[0, at + NOW]


@shared
def close(t: Any, L: int) -> None:
    """Close the gap before the level that contains it: the levels of the gap in histories have no changes."""
    T, H, Hm = tables(t)[0], len(t.initial), len(t.sensors)
    for l in range(L):
        settle(T, l, t.open, H, Hm, 0)


@shared
def widen(gap: Array, unit: float, P: Array) -> None:
    """Widen the covariance of the mixture by the changes that may have happened in the gap, in units of ``unit``."""
    at = gap.shape[1] - WIDTH
    for c in range(1, len(gap)):
        share, k = unit * gap[c, at + SINCE], 0
        for i in range(len(P)):
            for j in range(i + 1):
                P[i, j] += share * gap[c, k]
                k += 1
