"""Drift while the inputs rest, of which the record shows only what it does to the output.

While the regressors x of successive samples are the same, theta is observed along x only, and how the drift q_t (n,)
was divided among the parameters before decides which of them seems to move. In a rest that is far longer than usual,
each parameter with x_i != 0 may be the one that moves alone, by as much at the output,

    q_ti = sum_j x_j^2 q_tj / x_i^2,   q_tj = 0 for all others,

and at both ends of the rest, where the change may begin or end as well, by all of that at once. The likelihoods L_i of
the record under these drifts, and L_0 under q, which was fitted to it, tell where the change outlasts the rest:
otherwise those of all i are equal. Variances grow by the spread of the paths within the rest,

    sum_i w_i (theta_i - theta) (theta_i - theta)',   w_i = L_i / (L_1 + .. + L_n + L_0 exp(-PRICE))

Regressors with lags of an output never rest. Source: ours. Cost: n smoothers for each of at most `MOST` rests.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.smooth.parts.elimination import smooth_and_weigh
from driftfit.smooth.parts.walk import Walk

SHORTEST, USUAL = 20, 10.0
"""Least number of samples of a rest, also in units of the median number of samples for which regressors are the same.
"""
MOST = 3
LITTLE = 1.0
"""Variance of the drift of the output in a rest, in units of that of its noise, that is not worth a comparison."""
PRICE = 5.0
"""Penalty of the drift that was fitted to the record, in units of the log-likelihood."""
ALIKE = 3.0
"""Log-likelihood ratio up to which two parameters explain a rest equally: how far each jumps is known by that much."""
BESIDE = 3
"""A change at either end of a rest may have been found so many samples beside it."""
SAME = 1e-9
"""Change of a regressor, as a share of it, that is rounding."""


def rests(phi: Array, weight: Array) -> list[tuple[int, int]]:
    """(first, end) of the rests among samples (T, n); samples without weight may lie between."""
    used = np.flatnonzero(weight > 0.0)
    if not len(used):
        return []
    x = phi[used]
    same = np.all(np.abs(np.diff(x, axis=0)) <= SAME * np.abs(x[1:]), axis=1)
    edges = np.concatenate([[0], np.flatnonzero(~same) + 1, [len(used)]])
    length = np.diff(edges)
    least = max(SHORTEST, USUAL * float(np.median(length)))
    return [(int(used[edges[k]]), int(used[edges[k + 1] - 1]) + 1) for k in np.flatnonzero(length >= least)]


def beside(first: int, end: int) -> slice:
    """The samples of a rest, and those in which a change at its ends may have been found."""
    return slice(max(first - BESIDE, 0), end + BESIDE)


def drift_of_output(walk: Walk, q: Array, rest: tuple[int, int]) -> float:
    """The variance by which q (T, n) moves the output during a rest, in units of that of its noise."""
    first, end = rest
    return float(np.sum(q[beside(first, end)] @ walk.phi[first] ** 2) * np.median(walk.weight[first:end]))


def alone(q: Array, x: Array, i: int, first: int, end: int) -> Array:
    """The drift (T, n) if only parameter i moves in a rest at x (n,), and at its ends."""
    span, found = beside(first, end), q.copy()
    own = q[span] @ x**2 / x[i] ** 2
    found[span] = 0.0
    found[first:end, i] = own[first - span.start :][: end - first]
    found[[first, min(end, len(q) - 1)], i] += own.sum()
    return found


def undecided(walk: Walk, size: Array) -> Array:
    """Paths (K, T, n) of which the squared distances from the path of the walk add up to the spread; K is 0 where no
    rest leaves anything undecided. ``size`` is that of the columns.
    """
    q, n = walk.drift_root**2, walk.phi.shape[1]
    moved = {one: drift_of_output(walk, q, one) for one in rests(walk.phi, walk.weight) if n > 1}
    found = sorted((one for one in moved if moved[one] > LITTLE), key=lambda one: -moved[one])[:MOST]
    base = smooth_and_weigh(walk, size) if found else None
    if base is None:
        return np.zeros((0, *walk.phi.shape))
    theta, log_p = base[0].theta, base[1]
    paths = np.repeat(theta[None], n, axis=0)
    for first, end in found:
        x = walk.phi[first]
        others = {
            int(i): smooth_and_weigh(walk._replace(drift_root=np.sqrt(alone(q, x, int(i), first, end))), size)
            for i in np.flatnonzero(x)
        }
        known = {i: one for i, one in others.items() if one is not None}
        logs = np.array([log_p - PRICE, *(one[1] for one in known.values())])
        w = np.exp(np.minimum(logs - logs.max() + ALIKE, 0.0))
        w /= w.sum()
        for (i, one), share in zip(known.items(), w[1:], strict=True):
            paths[i, first:end] += np.sqrt(share) * (one[0].theta - theta)[first:end]
    return paths
