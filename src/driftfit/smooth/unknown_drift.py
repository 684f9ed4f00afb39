"""The smoother of records whose drift nobody has given: jumps, drifts and slopes of any size are hypotheses.

Between two samples the parameters drift, and with probability `PER_SAMPLE` all of them, or those of one group, jump:

    theta_t = theta_{t-1} + w_t,    Var w_t(i) = (rho_i tau_t + v) r / c_i,    v = 0, or the size of a jump

with `SIZES` for jumps, r the typical noise variance, c_i the mean square of regressor i, and tau_t the nominal
intervals of drift, or these weighted by the drift that the tracker found, which must be T / `SHARE` better in log
evidence: it was found in the same noise. `driftfit.smooth.mixture` sums over all sequences of jumps. The ratios are
found in three steps:

    1. tau, and one ratio of all parameters, of greatest evidence among `LEVELS`;
    2. with the expected squares of its jumps as known drift the problem has one Gaussian, whose likelihood costs a
       hundredth (`driftfit.smooth.solvers.elimination`): climb by half powers of ten, for all parameters or one group,
       and average over the ratios that were tried, of which the smallest moves the path by less than its error;
    3. the drift of the path is the average over `SCALES` of these ratios, weighted by the evidence.

Variances grow by the spread of the paths of step 2: a slow walk can look as if nothing moved. Slopes that walk are
another model of the same record (`driftfit.smooth.solvers.slopes`) and are averaged likewise; where they are more
probable than not, they are taken.

Source: Hoeting, Madigan, Raftery and Volinsky (1999) for averaging over models by their likelihood; the three steps are
ours. Cost per sample: eight filters of `FEW` components, two or three smoothers of mixtures, and O(n^3) for each try.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from itertools import product

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.smooth import mixture
from driftfit.smooth.mixture import Alternatives, Mixture, Passes, Problem
from driftfit.smooth.solvers import elimination, slopes
from driftfit.smooth.solvers.components import Noises
from driftfit.smooth.solvers.rank import column_scale
from driftfit.smooth.solvers.walk import Walk

Groups = Sequence[Sequence[int]]
Point = tuple[int, ...]
SIZES = (15.0, 900.0)
"""Variances of jumps, in units of r / c; a group alone has their geometric mean."""
PER_SAMPLE = 3e-3
"""Probability of a jump before a sample, as in `driftfit.trackers.mixture.filters`."""
LEVELS = (0.0, 1e-4, 1e-2, 1.0)
EDGE = 10.0
"""The smallest ratio times T^2, and the largest."""
SCALES = 4.0 ** np.arange(-1, 2)
SHARE = 200.0
FEW = 8
"""Components with which evidences are computed, and the path where they suffice."""
LIKELY_RATIO = 0.01
"""Share of the best below which ratios or slopes are left out."""
TRENDS = 3.0
"""Penalty of slopes that walk, in units of the log-likelihood."""


def average_drift(walk: Walk, times: tuple[Array, Array], trend: Array, groups: Groups) -> Walk:
    """The walk with the average of the drifts, with the moments of all hypotheses, and with paths of other drifts.

    ``times`` are the two tau (T,), of which the second need not have a unit, ``trend`` (T,) the intervals of motion
    along a slope. Regressors that are always 0 take no part, and their parameters stay at 0.
    """
    moved = np.flatnonzero(np.any(walk.phi[walk.weight > 0.0] != 0.0, axis=0))
    if len(moved) == walk.phi.shape[1] or not len(moved):
        return averaged(walk, times, trend, groups)
    inner = [own for group in groups if (own := np.flatnonzero(np.isin(moved, group)).tolist())]
    some = averaged(walk.of(moved), times, trend, inner)
    known, whole = some.mixture, np.eye(walk.phi.shape[1])[moved]
    if known is not None:
        known = known.turned(whole.T)._replace(moves=known.moves @ whole > 0.0)
    paths, drift_root = some.paths @ whole if len(some.paths) else some.paths, some.drift_root @ whole
    return walk._replace(drift_root=drift_root, trend=some.trend, paths=paths, belief=some.belief, mixture=known)


def averaged(walk: Walk, times: tuple[Array, Array], trend: Array, groups: Groups) -> Walk:
    """The same where every regressor moves."""
    used, (T, n) = walk.weight > 0.0, walk.phi.shape
    if used.sum() <= n or not times[1].any():
        return walk._replace(drift_root=np.zeros_like(walk.phi))
    r = float(np.median(1.0 / walk.weight[used]))
    power = r * np.mean(walk.weight[used, None] * walk.phi[used] ** 2, axis=0)
    unit = r / np.where(power > 0.0, power, 1.0)
    found = times[1] * (times[0].sum() / times[1].sum())
    plain, weighed = (hypotheses(walk, time, unit, groups) for time in (times[0], found))
    likeliest: list[tuple[float, Passes]] = []

    @cache
    def tried(at: Point) -> float:
        level, time = at
        problem = drifting((plain, weighed)[time], np.diag(np.sqrt(LEVELS[level] * unit)))
        passes = Passes(problem, np.full(T, FEW))
        value = float(passes.forward() - time * T / SHARE)
        likeliest[:] = [max([*likeliest, (value, passes)], key=lambda one: one[0])]
        return value

    def near(at: Point) -> list[Point]:
        return [(level, at[1]) for level in (at[0] - 1, at[0] + 1) if at[1] <= level < len(LEVELS)]

    level, _ = best = summit(tried, (1, 0), near)
    summit(tried, best, lambda at: [*near(at), (max(level, 1), 1)])
    passes = likeliest[0][1]
    first, problem = passes.smoothed(False), passes.problem
    jumps = (1.0 - first.events[:, :1]) * (first.shift**2 + first.shift_var)
    time = problem.sizes[:, :1] ** 2
    likely = climbed(walk, time, jumps, unit, groups if len(groups) > 1 else [])
    if likely is None:
        return walk._replace(drift_root=np.sqrt(np.diag(problem.alternatives.roots[0]) ** 2 * time + jumps))
    price = TRENDS + np.sum(1.0 - first.events[:, 0]) * np.log(PER_SAMPLE)
    p, paths, q = likely
    walk = walk._replace(drift_root=np.sqrt(q * time + jumps), mixture=of_scales(problem, q, first.needed))
    return with_slopes(walk, p, paths, trend, price)


def summit(value: Callable[[Point], float], best: Point, near: Callable[[Point], list[Point]]) -> Point:
    """The point that is reached from ``best`` by stepping to the best neighbour until none is better."""
    while True:
        before, best = best, max((best, *near(best)), key=value)
        if best == before:
            return best


def neighbours(at: Point, groups: Groups, top: int, steps: Sequence[int] = (-1, 1)) -> list[Point]:
    """Points one up or down in all coordinates, or a step away in those of one group, within 0 .. top."""
    near = [tuple(np.clip(np.add(at, step), 0, top).tolist()) for step in (-1, 1)]
    for group, step in product(groups, steps):
        level = min(max(at[group[0]] + step, 0), top)
        near.append(tuple(level if i in group else own for i, own in enumerate(at)))
    return near


def with_slopes(walk: Walk, likely: Array, paths: Array, trend: Array, price: float) -> Walk:
    """The problem with slopes if they are more probable, and with the paths of all that are probable at all."""
    rates, better = slopes.compared(walk, trend, paths[np.argmax(likely), 0])
    p = shares(np.append(0.0, better - price))
    which = np.flatnonzero(p[1:] >= LIKELY_RATIO)
    others = [slopes.smooth(sloped(walk, trend, rates[k])).theta for k in which]
    if p[0] < 0.5:
        walk = sloped(walk, trend, p[1:] @ rates / p[1:].sum())._replace(mixture=None)
    return walk._replace(paths=np.array([*paths, *others]), belief=np.append(p[0] * likely, p[1 + which]))


def sloped(walk: Walk, trend: Array, rate: Array) -> Walk:
    """The problem with slopes that drift by ``rate`` (n,) per nominal interval instead of levels."""
    return walk._replace(trend=trend, drift_root=np.sqrt(trend[:, None] * rate))


def shares(logs: Array) -> Array:
    """Probabilities (K,) of hypotheses of these log likelihoods, alike before."""
    p = np.exp(logs - logs.max())
    return np.asarray(p / p.sum())


def hypotheses(walk: Walk, time: Array, unit: Array, groups: Groups) -> Problem:
    """The problem without drift; ``unit`` (n,) is r / c."""
    T, n = walk.phi.shape
    apart = groups if len(groups) > 1 else []
    jumps = [(size * unit, (0.5 if apart else 1.0) / len(SIZES)) for size in SIZES]
    jumps += [(np.sqrt(np.prod(SIZES)) * unit * np.isin(np.arange(n), group), 0.5 / len(groups)) for group in apart]
    roots = np.array([np.diag(np.sqrt(q)) for q in (np.zeros(n), *(q for q, _ in jumps))])
    label, zero = np.arange(len(roots)), np.zeros(len(roots), int)
    with np.errstate(divide="ignore"):
        log_prob = np.log([np.eye(1, len(roots))[0], [1.0 - PER_SAMPLE, *(PER_SAMPLE * p for _, p in jumps)]])
    moves = Alternatives(zero, zero, label, log_prob, roots, adds=True)
    r = np.divide(1.0, walk.weight, out=np.full(T, np.inf), where=walk.weight > 0.0)
    table, sizes = (time > 0.0).astype(int), np.column_stack([np.sqrt(time), np.ones((T, len(jumps)))])
    return Problem(
        walk.phi, walk.y.copy(), r, moves, table, sizes, np.zeros((0, n + 1)), Noises(np.eye(1, 2), np.zeros((1, 1)))
    )


def drifting(problem: Problem, root: Array) -> Problem:
    """The problem with a drift of this root (n, n) per unit of time, an upper triangle."""
    roots = problem.alternatives.roots.copy()
    roots[0] = root
    return problem._replace(alternatives=problem.alternatives._replace(roots=roots))


def climbed(walk: Walk, time: Array, jumps: Array, unit: Array, groups: Groups) -> tuple[Array, ...] | None:
    """Probabilities (K,) and paths (K, T, n) of likely ratios with known squares of jumps (T, n), and the average drift
    (n,); None if no likelihood is accurate.
    """
    n, T = len(unit), len(time)
    least = np.ceil(2.0 * np.log10(EDGE / T**2)) / 2.0
    ratios = np.append(0.0, 10.0 ** np.arange(least, np.log10(EDGE) + 0.25, 0.5))
    size, top = column_scale(walk.phi, walk.signals), len(ratios) - 1
    known: dict[Point, float] = {}
    paths: dict[Point, Array] = {}

    def value(at: Point) -> float:
        nonlocal paths
        if at not in known:
            root = np.sqrt(ratios[list(at)] * unit * time + jumps)
            found = elimination.smooth(walk._replace(drift_root=root), size)
            known[at] = -np.inf if found is None else found.log_likelihood
            if found is not None:
                paths, least = {**paths, at: found.theta}, max(known.values()) + np.log(LIKELY_RATIO)
                paths = {one: path for one, path in paths.items() if known[one] > least}
        return known[at]

    common = max(((level,) * n for level in range(top + 1)), key=value)
    best = summit(value, common, lambda at: neighbours(at, groups, top, (-top, -1, 1)))
    if known[best] == -np.inf:
        return None
    p = shares(np.array([known[at] for at in paths]))
    return p, np.array([*paths.values()]), p @ ratios[np.array([*paths])] * unit


def of_scales(problem: Problem, q: Array, keep: Array) -> Mixture:
    """The mixture with the drift q (n,) times the average of `SCALES`."""
    logs = np.array([mixture.filtered(drifting(problem, np.diag(np.sqrt(scale * q))), FEW)[0] for scale in SCALES])
    return mixture.smooth(drifting(problem, np.diag(np.sqrt(shares(logs) @ SCALES * q))), True, keep)
