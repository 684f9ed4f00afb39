"""Ladders of drift ratios as modes of a Markov chain, and the interaction that mixes their filters.

    c_j = sum_i mu_i T_ij
    m_j = sum_i (mu_i T_ij / c_j) m_i
    C_j = sum_i (mu_i T_ij / c_j) (C_i + (m_i - m_j)(m_i - m_j)')

In the common ladder all parameters drift; its top is the rung of ratio 1, and those above are for noise that is small
compared with the drift. In a second ladder the parameters have learned weights
(`driftfit.trackers.parts.modes.weights`), and the filters of a third follow a trend
(`driftfit.trackers.parts.modes.drifts.trend`). In a fourth they drift together, in a direction that is learned
(`driftfit.trackers.parts.modes.drifts.one_direction`), and in a fifth about the mean regressors
(`driftfit.trackers.parts.modes.drifts.about_means`). Each parameter has a short ladder of its own, on which it alone
drifts: the change of one parameter neither has to be learned first nor makes the others uncertain. Groups have theirs
instead.

T moves one rung up or down, and leads to each mode from all others with the same small probability a_j:

    T_ij = a_j + (1 - sum a - up_j - down_j) [i = j] + up_i [j = i + 1] + down_i [j = i - 1]

so the filters that arrive at j are the mixture itself, whose moments are known, and the interaction costs O(K) instead
of O(K^2). Jumps arrive at rungs of ratio 1, which soon move down again: from there to no drift directly only with the
small a_0, since mixing the wide covariance of the top filter into the one without drift costs more than anything else
when nothing changes. Two filters are not mixed with others: the last, which comes to rest directly
(`driftfit.trackers.parts.modes.drifts.at_rest`), and the one before it, which takes an outlier for a jump
(`driftfit.trackers.parts.modes.drifts.after_outlier`). All but what moves down has the factor calm <= 1, learned from
how often rungs of ratio 1 end: what never changed in thousands of samples is expected to change less often
(`learn_rate`).

The top filter may also *leap*: if a move as large as the innovation, in directions 1 / c_i and up to LEAP standard
deviations of the output (times p of `driftfit.trackers.parts.proportion`), at this regressor and at one
of mean square c_i, explains the sample better by more than a factor 1 / RARE, its covariance grows by that move.

Source: Blom and Bar-Shalom (1988); the ladders and their transitions are ours. Cost per sample: O(K n^2) for K modes,
vectorised over the modes.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, kernel, log
from driftfit.trackers.parts.modes.drifts.about_means import ABOUT, no_means
from driftfit.trackers.parts.modes.drifts.at_rest import no_rest
from driftfit.trackers.parts.modes.drifts.one_direction import ALONG, no_direction
from driftfit.trackers.parts.modes.drifts.trend import TREND, no_trend
from driftfit.trackers.parts.modes.rows import sum_of_row

LADDER = (0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.04, 0.2, 1.0, 1.5, 30.0)
"""Drift ratios of the modes in which all parameters drift."""
LEARNED = (1e-3, 1e-2, 0.1)
"""Ratios of the ladder whose parameters have learned weights."""
ALONE = (3e-3, 0.05, 1.0)
"""Ratios of the ladders in which one parameter drifts."""
GROUP = (1e-4, 1e-3, 1e-2, 0.04, 0.2, 1.0)
"""Ratios of the ladders of groups, which replace those of single parameters."""
MOST_ALONE = 8
"""Number of parameters up to which each has a ladder of its own."""
CLIMB, BACK = 0.0003, 0.1
"""Probabilities: to the rung above, and from a rung of ratio 1 to the one below."""
DESCEND = ((0.005, 0.001), (0.02, 0.002), (0.1, 0.004), (np.inf, 0.01))
"""Probability to the rung below, for ratios up to a limit: what moves fast may come to rest soon."""
JUMP, REST, ACROSS = 0.0015, 0.0001, 0.00005
"""Probabilities of arriving from the mixture: at rungs of ratio 1; at the foot of the common
ladder (three tenths of it at each other rung of it below the top); and at the other rungs of each kind of ladder."""
ABOUT_MEANS = 0.2
"""Jumps about the means, as a share of all others; half of these are of one parameter."""
SELDOM = 5.0
"""Factor by which arrivals at the filters that drift in one direction are rarer than at each other kind."""

TOP = LADDER.index(1.0)
"""The mode that detects jumps, and may leap; the rungs above it are for noise that is small compared with the drift."""
EVENTS, SPAN, CALMEST = 1.0, 20_000.0, 0.02
"""Jumps that the prior of their rate counts for, memory of the rate in samples, and its smallest share of `JUMP`."""
AT_REST, COMMON = 0.3, 0.45
"""Probabilities before the first sample: of no drift, and of drift of all parameters at one of the common ratios."""
LEAP, RARE = 3.0, 0.02
"""Standard deviations of the output that a leap may reach, and its prior probability in the top mode."""
STAY, BELOW, ABOVE, MIXED = range(4)
"""Where a filter comes from: rows of ``share``."""


def ladders(n: int, groups: Any) -> tuple[Array, Array, Array, Array, Array]:
    """Ratios (n, K) of independent drifts, probabilities (3, K) of climbing, descending and going back, arrivals (K,),
    (K,) the ratios of the modes with learned weights, 0 for others, and the rungs (K,)."""
    single, several, every = groups is None and 1 < n <= MOST_ALONE, n > 1, np.ones(n)
    masks = [np.isin(np.arange(n), one).astype(float) for one in (range(n) if single else groups or ())]
    alone, about = 0.5 if masks else 0.0, ABOUT_MEANS if several else 0.0  # shares of jumps
    kinds = [(LADDER, every, 1.0 - alone, 1.0), (LEARNED, every, 0.0, 1.0), (TREND, every, 0.0, 1.0)]
    kinds += [(ALONG, every, 0.0, SELDOM), (ABOUT, np.zeros(n), about, 1.0)] if several else []
    kinds += [(ALONE if single else GROUP, mask, alone / len(masks), len(masks)) for mask in masks]
    kinds += 2 * [((0.0,), every, 0.0, np.inf)]  # others replace these, and none are mixed with them
    ratio, learned, moves, arrive, rungs = [], [], [], [], []
    for which, (ladder, mask, jumps, parts) in enumerate(kinds):
        for k, rung in enumerate(ladder):
            ratio.append(rung * mask)
            rungs.append(rung)
            learned.append(rung if which == 1 else 0.0)
            down = next(p for most, p in DESCEND if rung <= most) if k else 0.0
            back = BACK if rung == LADDER[TOP] else 0.0
            moves.append((CLIMB if k + 1 < len(ladder) else 0.0, 0.0 if back else down, back))
            if rung == LADDER[TOP]:
                arrive.append(JUMP * jumps)
            elif which == 0:
                arrive.append(REST * (1.0 if k == 0 else 0.3 if k < TOP else 0.0))
            else:
                arrive.append(ACROSS / len(ladder) / parts)
    return np.array(ratio).T, np.array(moves).T, np.array(arrive), np.array(learned), np.array(rungs)


def chain(moves: Array, arrive: Array) -> tuple[Array, Array]:
    """Transitions (K, K) of the modes as A + calm B."""
    K = len(arrive)
    climb, descend, back = moves
    A = np.diag(1.0 - back) + np.diag(back[1:], -1)
    B = np.diag(-arrive.sum() - climb - descend) + np.diag(climb[:-1], 1) + np.diag(descend[1:], -1)
    return A, B + np.broadcast_to(arrive, (K, K))


def filters(n: int, groups: Any) -> dict[str, Any]:
    """Fields of the K filters before the first sample: modes, means m, covariances C (lower triangle), scratch."""
    ratio, moves, arrive, learned, rungs = ladders(n, groups)
    K = len(arrive)
    # one parameter has none of these filters; in the state of several they are not among those of the one
    along = len(LADDER) + len(LEARNED) + len(TREND) if n > 1 else K
    start = np.full(K, (1.0 - AT_REST - COMMON) / (K - len(LADDER)))
    start[: len(LADDER)] = COMMON / (len(LADDER) - 1)
    start[0] = AT_REST
    return {
        "modes": K,
        "parameters": n,
        "ratio": ratio,
        "moves": moves,
        "arrive": arrive,
        "arrivals": arrive.sum(),
        "calm": 1.0,
        "busy": 1.0,
        "jumps": 0.0,
        "watched": 0.0,
        "learned": learned,
        "mu": start,
        "prior": start,
        "mu_next": np.zeros(K),
        "share": np.zeros((4, K)),
        "row": np.zeros(K + 8),
        "m": np.zeros((n, K)),
        "m_next": np.zeros((n, K)),
        "C": np.zeros((n, n, K)),
        **no_rest(rungs),
        **no_trend(n, len(LADDER) + len(LEARNED)),
        **no_direction(n, along),
        **no_means(n, along + len(ALONG)),
        "Z": np.zeros((n, n)),
        "rare": 1.0,
        "leapt": 0.0,
        "gained": 0.0,
    }


@kernel
def find_shares(s: State, l: int) -> None:
    """Prior probabilities of the next sample, and where each filter comes from."""
    K, calm = s.modes[l], s.calm[l]
    for j in range(K):
        leaves = calm * (s.arrivals[l] + s.moves[0, j, l] + s.moves[1, j, l]) + s.moves[2, j, l]
        s.share[STAY, j, l] = s.mu[j, l] * (1.0 - leaves)
        s.share[MIXED, j, l] = calm * s.arrive[j, l]
        s.share[BELOW, j, l] = 0.0
        s.share[ABOVE, j, l] = 0.0
    for j in range(1, K):
        s.share[BELOW, j, l] = s.mu[j - 1, l] * calm * s.moves[0, j - 1, l]
    for j in range(K - 1):
        s.share[ABOVE, j, l] = s.mu[j + 1, l] * (calm * s.moves[1, j + 1, l] + s.moves[2, j + 1, l])
    for j in range(K):
        s.prior[j, l] = (s.share[STAY, j, l] + s.share[BELOW, j, l]) + (s.share[ABOVE, j, l] + s.share[MIXED, j, l])
        s.mu[j, l] = s.prior[j, l]
        part = 1.0 / s.prior[j, l]
        s.share[STAY, j, l] *= part
        s.share[BELOW, j, l] *= part
        s.share[ABOVE, j, l] *= part
        s.share[MIXED, j, l] *= part


@kernel
def learn_rate(s: State, l: int) -> None:
    """How rare changes are: those that the modes of ratio 1 end, as a share of those expected; calm is never above 1,
    and busy never below."""
    for j in range(s.modes[l]):
        s.row[j, l] = s.moves[2, j, l] * s.mu[j, l]
    fade = 1.0 - 1.0 / SPAN
    s.jumps[l] = fade * s.jumps[l] + sum_of_row(s, l)
    s.watched[l] = fade * s.watched[l] + 1.0
    rate = (EVENTS + s.jumps[l]) / (EVENTS + JUMP * s.watched[l])
    s.calm[l], s.busy[l] = max(CALMEST, min(1.0, rate)), max(1.0, rate)


@partial(kernel, inline=False)
def mix(s: State, l: int) -> None:
    """Interaction: every filter continues from the mixture of its predecessors; mu becomes that of the next sample.

    Means are taken relative to that of the mixture, d, so that moments may be added before the mean is subtracted.
    """
    n, K = s.theta.shape[0], s.modes[l]
    learn_rate(s, l)
    find_shares(s, l)
    s.row[0, l], s.row[K + 1, l] = 0.0, 0.0
    for a in range(n):
        for j in range(K):
            s.m[a, j, l] -= s.d[a, l]
            s.row[j + 1, l] = s.m[a, j, l]
        for j in range(K):
            s.m_next[a, j, l] = s.share[STAY, j, l] * s.row[j + 1, l] + (
                s.share[BELOW, j, l] * s.row[j, l] + s.share[ABOVE, j, l] * s.row[j + 2, l]
            )
        for b in range(a + 1):
            for j in range(K):
                s.row[j + 1, l] = s.C[a, b, j, l] + s.m[a, j, l] * s.m[b, j, l]
            for j in range(K):
                near = s.share[BELOW, j, l] * s.row[j, l] + s.share[ABOVE, j, l] * s.row[j + 2, l]
                far = s.share[MIXED, j, l] * s.Z[a, b, l] - s.m_next[a, j, l] * s.m_next[b, j, l]
                s.C[a, b, j, l] = s.share[STAY, j, l] * s.row[j + 1, l] + (near + far)
    for a in range(n):
        for j in range(K):
            s.m[a, j, l] = s.d[a, l] + s.m_next[a, j, l]


@kernel
def leap(s: State, l: int, noise: float) -> None:
    """Let the top filter explain the innovation by a jump of any size, if that is more likely."""
    most = LEAP * s.widening[l]
    square, v, unit = s.e_k[TOP, l] * s.e_k[TOP, l], s.h_k[TOP, l] + noise, 0.0
    for i in range(s.theta.shape[0]):
        own = s.ratio[i, TOP, l] / s.c[i, l] if s.c[i, l] > 0.0 else 0.0
        unit += own * s.white[i, l] * s.white[i, l]
    # a regressor near 0 says nothing about a move: none that would exceed the reach where regressors are as usual
    wide = max(v, min(square, most * most * s.spread[l] * min(1.0, unit / s.noise[l])))
    better = 0.5 * square * (1.0 / v - 1.0 / wide) > 0.5 * log(wide / v) - log(RARE)
    s.rare[l], s.leapt[l], s.gained[l] = 1.0, 0.0, 0.0
    if better and unit > 0.0:
        s.rare[l], s.leapt[l], s.gained[l] = RARE, (wide - v) / unit, wide - v
        for i in range(s.theta.shape[0]):
            own = s.leapt[l] * s.ratio[i, TOP, l] / s.c[i, l] if s.c[i, l] > 0.0 else 0.0
            for a in range(i + 1):
                s.gain[a, TOP, l] += own * s.S[a, i, l] * s.white[i, l]
                for b in range(a + 1):
                    s.C[a, b, TOP, l] += own * s.S[a, i, l] * s.S[b, i, l]
        s.h_k[TOP, l] += s.gained[l]
