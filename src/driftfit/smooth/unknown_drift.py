"""The smoother of records whose drift nobody has given: jumps and drifts of any size are hypotheses.

Between two samples nothing happens but the drift, with probability 1 - `PER_SAMPLE`, or all parameters, or those of one
group, jump too:

    theta_t = theta_{t-1} + w_t,    Var w_t(i) = (rho_i tau_t + v) r / c_i,    v = 0 or one of `SIZES`

with r the typical noise variance, c_i the mean square of regressor i, and tau_t the nominal intervals of drift. All
sequences are summed by `driftfit.smooth.mixture`. The drift ratios rho_i are constant, and found in three steps:

    1. one ratio of all parameters, of greatest evidence among `LEVELS`;
    2. with the expected squares of its jumps as known drift the problem has one Gaussian, whose likelihood costs a
       hundredth (`driftfit.smooth.parts.elimination`): climb in steps of `RATIOS`, for all parameters or one of them,
       and average over the ratios that were tried;
    3. the path is the average over `SCALES` of these ratios, weighted by the evidence.

Variances grow by the spread of the paths of step 2: a slow walk can look as if nothing moved. Slopes that walk are
another model of the same record (`driftfit.smooth.parts.slope_drift`) and are averaged likewise; where they are more
probable than not, they are taken.

Source: Hoeting, Madigan, Raftery and Volinsky (1999) for averaging over models by their likelihood; the three steps are
ours. Cost per sample: eight filters of `FEW` components, about three smoothers of mixtures, and O(n^3) for each try.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.smooth import mixture
from driftfit.smooth.mixture import Alternatives, Mixture, Problem
from driftfit.smooth.parts import slopes
from driftfit.smooth.parts.components import Noises
from driftfit.smooth.parts.elimination import smooth_and_weigh
from driftfit.smooth.parts.rank import column_scale
from driftfit.smooth.parts.slope_drift import compared
from driftfit.smooth.parts.walk import Walk

SIZES = ((9.0, 0.7), (900.0, 0.3))
"""Variances of jumps, in units of r / c, and their shares."""
PER_SAMPLE = 5e-3
"""Probability of a jump before a sample."""
LEVELS = (0.0, 1e-4, 1e-2, 1.0)
RATIOS = np.append(0.0, 10.0 ** np.arange(-6.0, 1.5, 0.5))
SCALES = np.array([1.0 / 3.0, 1.0, 3.0, 9.0])
FEW = 8
"""Components with which evidences are computed, and the path where they suffice."""
LIKELY = 0.1
"""Scales that are less likely than this share of the best are left out."""
LEAST = 1e-3
"""Ratios with a smaller probability do not count in the variances."""
TRENDS = 3.0
"""Penalty of slopes that walk, in units of the log-likelihood."""


class Weighed(NamedTuple):
    """Models of a record with their probabilities."""

    p: Array
    """(K,)"""
    theta: Array
    """(K, T, n)"""


def average_drift(walk: Walk, time: Array, trend: Array, groups: Sequence[Sequence[int]]) -> Walk:
    """The walk with the average of the drifts, with the mixture of all hypotheses, and paths of other drifts.

    ``time`` (T,) are the intervals of drift before each sample, and ``trend`` (T,) those of motion along a slope.
    Regressors that are always 0 take no part, and their parameters stay at 0.
    """
    moved = np.flatnonzero(np.any(walk.phi[walk.weight > 0.0] != 0.0, axis=0))
    if len(moved) == walk.phi.shape[1] or not len(moved):
        return averaged(walk, time, trend, groups)
    place = {int(i): k for k, i in enumerate(moved)}
    inner = [own for group in groups if (own := [place[i] for i in group if i in place])]
    some = averaged(walk.of(moved), time, trend, inner)
    drift_root, paths = np.zeros_like(walk.phi), np.zeros((len(some.paths), *walk.phi.shape))
    drift_root[:, moved], paths[:, :, moved] = some.drift_root, some.paths
    known = some.mixture
    if known is not None:
        theta, cov = np.zeros_like(walk.phi), np.zeros((len(walk.phi), *walk.q.shape))
        theta[:, moved], cov[:, moved[:, None], moved] = known.theta, known.cov
        known = known._replace(theta=theta, cov=cov)
    return walk._replace(drift_root=drift_root, trend=some.trend, paths=paths, belief=some.belief, mixture=known)


def averaged(walk: Walk, time: Array, trend: Array, groups: Sequence[Sequence[int]]) -> Walk:
    """The same where every regressor moves."""
    used, n = walk.weight > 0.0, walk.phi.shape[1]
    if used.sum() <= n:
        return walk._replace(drift_root=np.zeros_like(walk.phi))
    r = float(np.median(1.0 / walk.weight[used]))
    power = r * np.mean(walk.weight[used, None] * walk.phi[used] ** 2, axis=0)
    unit = r / np.where(power > 0.0, power, 1.0)
    problem = hypotheses(walk, time, unit, groups)
    keep, levels = np.full(len(time), FEW), [one * unit for one in LEVELS]
    best = max(levels, key=lambda q: mixture.filtered(drifting(problem, q), FEW)[0])
    first = mixture.Passes(drifting(problem, best), keep).smoothed(False)
    jumps = (1.0 - first.events[:, :1]) * (first.shift**2 + first.shift_var)
    one = Weighed(np.ones(1), first.theta[None])
    found = climbed(walk, time, jumps, unit, groups if len(groups) > 1 else [])
    q, weighed = (best, one) if found is None else found
    gaussian = walk._replace(drift_root=np.sqrt(q * time[:, None] + jumps))
    if found is None:
        return gaussian
    total = mean_of(problem, q, keep)
    return with_slopes(gaussian._replace(mixture=total), weighed, trend)


def with_slopes(walk: Walk, weighed: Weighed, trend: Array) -> Walk:
    """The problem with slopes if they are more probable, and with the paths of all that are probable at all."""
    most = int(np.argmax(weighed.p))
    rates, better = compared(walk, trend, weighed.theta[most, 0])
    p = np.append(0.0, better - TRENDS)
    p = np.exp(p - p.max())
    p /= p.sum()
    which = np.flatnonzero(p[1:] >= LEAST)
    others = [slopes.smooth(sloped(walk, trend, rates[k])).theta for k in which]
    belief = np.append(p[0] * weighed.p, p[1 + which])
    if p[0] < 0.5:
        rate = p[1:] @ rates / p[1:].sum()
        walk = sloped(walk, trend, rate)._replace(mixture=None)
    return walk._replace(paths=np.array([*weighed.theta, *others]), belief=belief)


def sloped(walk: Walk, trend: Array, rate: Array) -> Walk:
    """The problem with slopes that drift by ``rate`` (n,) per nominal interval instead of levels."""
    return walk._replace(trend=trend, drift_root=np.sqrt(trend[:, None] * rate))


def hypotheses(walk: Walk, time: Array, unit: Array, groups: Sequence[Sequence[int]]) -> Problem:
    """The problem without drift; ``unit`` (n,) is r / c."""
    T, n = walk.phi.shape
    each = [np.ones(n), *(np.isin(np.arange(n), group) for group in groups)] if len(groups) > 1 else [np.ones(n)]
    shares = [1.0] if len(each) == 1 else [0.5] + [0.5 / len(groups)] * len(groups)
    jumps = [(size * unit * own, share * p) for (own, share), (size, p) in product(zip(each, shares), SIZES)]
    roots = np.array([np.diag(np.sqrt(q)) for q in (np.zeros(n), *(q for q, _ in jumps))])
    label, zero = np.arange(len(roots)), np.zeros(len(roots), int)
    with np.errstate(divide="ignore"):
        log_prob = np.log([np.eye(1, len(roots))[0], [1.0 - PER_SAMPLE, *(PER_SAMPLE * p for _, p in jumps)]])
    which = np.column_stack([zero, np.where(label > 0, label, -1)])
    moves = Alternatives(zero, zero, label, log_prob, roots, which, np.tile([0, 1], (len(roots), 1)))
    r = np.divide(1.0, walk.weight, out=np.full(T, np.inf), where=walk.weight > 0.0)
    sizes = np.column_stack([np.sqrt(time), np.ones(T)])
    noise = Noises(np.array([[1.0, 0.0]]), np.zeros((1, 1)))
    table = (time > 0.0).astype(int)
    return Problem(walk.phi, walk.y.copy(), r, moves, table, sizes, np.zeros((0, n + 1)), noise)


def drifting(problem: Problem, q: Array) -> Problem:
    """The problem with this drift (n,) per nominal interval."""
    roots = problem.alternatives.roots.copy()
    roots[0] = np.diag(np.sqrt(q))
    return problem._replace(alternatives=problem.alternatives._replace(roots=roots))


def climbed(walk: Walk, time: Array, jumps: Array, unit: Array, groups: Any) -> tuple[Array, Weighed] | None:
    """The average drift (n,) with known squares of jumps (T, n), and the paths; None if no likelihood is accurate."""
    n, top = len(unit), len(RATIOS) - 1
    size = column_scale(walk.phi, walk.signals)
    known: dict[tuple[int, ...], tuple[float, Array]] = {}

    def value(at: tuple[int, ...]) -> float:
        if at not in known:
            q = RATIOS[list(at)] * unit
            solved = smooth_and_weigh(walk._replace(drift_root=np.sqrt(q * time[:, None] + jumps)), size)
            known[at] = (-np.inf, jumps) if solved is None else (solved[1], solved[0].theta)
        return known[at][0]

    best = max(((level,) * n for level in range(top + 1)), key=value)
    before = None
    while best != before:
        before = best
        near = [tuple(np.clip(np.add(best, step), 0, top).tolist()) for step in (-1, 1)]
        for group in groups:
            level = best[group[0]]
            for other in (0, max(level - 1, 0), min(level + 1, top)):
                near.append(tuple(other if i in group else own for i, own in enumerate(best)))
        best = max((best, *near), key=value)
    if known[best][0] == -np.inf:
        return None
    likely = [at for at, (logs, _) in known.items() if logs > known[best][0] + np.log(LEAST)]
    p = np.exp([known[at][0] - known[best][0] for at in likely])
    p /= p.sum()
    return p @ RATIOS[np.array(likely)] * unit, Weighed(p, np.array([known[at][1] for at in likely]))


def mean_of(problem: Problem, q: Array, keep: Array) -> Mixture:
    """The average of the mixtures with all likely scales of the drift q."""
    scales = [drifting(problem, scale * q) for scale in SCALES]
    logs = np.array([mixture.filtered(one, FEW)[0] for one in scales])
    order = [k for k in np.argsort(-logs) if logs[k] > logs.max() + np.log(LIKELY)]
    w = np.exp(logs[order] - logs.max())
    w /= w.sum()
    first = mixture.smooth(scales[order[0]], True, keep)
    found = [first, *(mixture.smooth(scales[k], True, first.kept) for k in order[1:])]
    theta = np.asarray(np.einsum("k,kti->ti", w, np.array([one.theta for one in found])))
    away = [one.theta - theta for one in found]
    cov = sum(share * (one.cov + d[:, :, None] * d[:, None, :]) for share, one, d in zip(w, found, away, strict=True))
    return first._replace(theta=theta, cov=np.asarray(cov))
