"""Drift while inputs rest, of which the record shows only what it does to the output.

While the regressors x_i of some parameters G stay the same, as that of an intercept always does, only sum_G x_i theta_i
is observed, and how the drift q_t (n,) was divided among them before decides which of them seems to move. In a rest
that is far longer than usual, each of G with x_i != 0 may be the one of them that moves, by as much at the output,

    q_ti = sum_{j in G} x_j^2 q_tj / x_i^2,   q_tj = 0 for the others in G,

and at both ends of the rest, where the change may begin or end as well, by all of that at once. The likelihoods L_i of
the record under these drifts, and L_0 under q, which was fitted to it, tell where the change outlasts the rest:
otherwise those of all i are equal. Variances grow by the spread of the paths within the rest,

    sum_i w_i (theta_i - theta) (theta_i - theta)',   w_i = L_i / (sum_{j in G} L_j + L_0 exp(-PRICE))

Lags of an output never rest. Source: ours. Cost: n smoothers for each of at most `MOST` rests.
"""

from __future__ import annotations

from typing import NamedTuple

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


class Rest(NamedTuple):
    """Samples first .. end - 1, and the parameters whose regressors stay the same."""

    first: int
    end: int
    same: tuple[int, ...]


def rests(phi: Array, weight: Array) -> list[Rest]:
    """The rests among samples (T, n) in which two parameters or more cannot be told apart; samples without weight may
    lie between.
    """
    used = np.flatnonzero(weight > 0.0)
    if not len(used):
        return []
    x = phi[used]
    moves = np.vstack([np.abs(np.diff(x, axis=0)) > SAME * np.abs(x[1:]), np.ones(phi.shape[1], bool)])
    found = set()
    for own in moves.T:
        ends = np.flatnonzero(own) + 1
        length = np.diff(ends, prepend=0)
        least = max(SHORTEST, USUAL * float(np.median(length)))
        for end, count in zip(ends[length >= least], length[length >= least], strict=True):
            part = slice(end - count, end)
            same = np.flatnonzero(~moves[part][:-1].any(axis=0) & (x[end - count] != 0.0))
            if len(same) > 1:
                found.add(Rest(int(used[end - count]), int(used[end - 1]) + 1, tuple(same.tolist())))
    return sorted(found)


def beside(first: int, end: int) -> slice:
    """The samples of a rest, and those in which a change at its ends may have been found."""
    return slice(max(first - BESIDE, 0), end + BESIDE)


def drift_of_output(walk: Walk, q: Array, rest: Rest) -> float:
    """The variance by which the drift of its parameters moves the output in a rest, in units of that of the noise."""
    first, end, same = rest
    share = q[beside(first, end)][:, same] @ walk.phi[first, same] ** 2
    return float(np.sum(share) * np.median(walk.weight[first:end]))


def alone(q: Array, x: Array, i: int, rest: Rest) -> Array:
    """The drift (T, n) if only parameter i of those of a rest at x (n,) moves in it, and at its ends."""
    first, end, same = rest
    span, found = beside(first, end), q.copy()
    own = q[span][:, same] @ x[list(same)] ** 2 / x[i] ** 2
    found[span, same] = 0.0
    found[first:end, i] = own[first - span.start :][: end - first]
    found[[first, min(end, len(q) - 1)], i] += own.sum()
    return found


def undecided(walk: Walk, size: Array) -> Array:
    """Paths (K, T, n) of which the squared distances from the path of the walk add up to the spread; K is 0 where no
    rest leaves anything undecided. ``size`` is that of the columns.
    """
    q = walk.drift_root**2
    moved = {one: drift_of_output(walk, q, one) for one in rests(walk.phi, walk.weight)}
    found = sorted((one for one in moved if moved[one] > LITTLE), key=lambda one: -moved[one])[:MOST]
    base = smooth_and_weigh(walk, size) if found else None
    if base is None:
        return np.zeros((0, *walk.phi.shape))
    theta, paths = base[0].theta, []
    for rest in found:
        part = slice(rest.first, rest.end)
        drifts = [alone(q, walk.phi[rest.first], i, rest) for i in rest.same]
        others = [smooth_and_weigh(walk._replace(drift_root=np.sqrt(one)), size) for one in drifts]
        known = [one for one in others if one is not None]
        logs = np.array([base[1] - PRICE, *(one[1] for one in known)])
        w = np.exp(np.minimum(logs - logs.max() + ALIKE, 0.0))
        w /= w.sum()
        for one, share in zip(known, w[1:], strict=True):
            paths.append(theta.copy())
            paths[-1][part] += np.sqrt(share) * (one[0].theta - theta)[part]
    return np.array(paths)
