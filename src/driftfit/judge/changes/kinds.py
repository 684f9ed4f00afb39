"""What kind of change: steps, a gradual one, a walk, or a walk with jumps, by one criterion.

    BIC = N log(rss) + sum log f_t + (number of coefficients + number of dates) log N

    rest      constants
    steps     the segments, with the changes that are needed
    gradual   theta_j constant, then on a straight line from one date to another, then constant
    walk      theta_j(t) = theta_j(t - 1) + w_t,  var w = q / mean(x_j^2); f_t are the variances of its innovations, and
              constants are estimated on the innovations of all columns
    jumps     the walk, with those steps that it still needs

A date costs as much as a coefficient. The walk is tried beside the noise of the segments and beside white noise, since
an autoregression takes a walk for noise. The weights of the kinds are exp(-BIC / 2).

Source: Schwarz (1978); Ansley and Kohn (1985) for constants beside a filter. Cost: O(N) for each of some hundred
paths.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from driftfit.engine.kernel import Array, Driver
from driftfit.judge.changes.dates import Dated
from driftfit.judge.changes.fit import coefficients, corners, left, order_of, ramp, rise, split, white_rows
from driftfit.judge.changes.null import Model
from driftfit.judge.changes.which import Which
from driftfit.judge.statistics.robust import invertible

CORNERS, FINER = 24, 8
"""Cells at whose ends a gradual change may begin or end, and the parts of a cell in which these are then moved."""
STEPS = 10.0 ** np.arange(-7.0, 0.5, 0.5)
"""Variances of a step of the walk, as shares of the noise."""
UNIT_ROOT = 14.1
"""N (1 - root) below which a unit root is not rejected at 5 % (Dickey and Fuller, 1979, with a constant)."""
DATE = 1.0
"""What a date costs, in coefficients."""


class Kind(NamedTuple):
    """What kind of change it is."""

    name: str
    """"steps", "gradual", "wandering" or "drift with jumps"; "" for constants."""
    weights: dict[str, float]
    """Weights of rest, steps, gradual, walk and jumps, of sum 1."""
    ends: tuple[int, int]
    """First and last row of a gradual change."""
    path: Array
    """(N, n): the parameters, in units of the model, of a gradual change; empty otherwise."""
    dates: tuple[int, ...]
    """Of a drift with jumps, the dates that it needs."""
    moves: tuple[int, ...]
    """Parameters that change; of those that move at dates, a gradual change is of those that it needs."""


@Driver
def _filter(H: Array, steps: Array, columns: Array, scratch: tuple[Array, ...], products: Array, totals: Array) -> None:
    """Of a walk on H (N, J), known at the start, in noise of variance 1, for steps of each variance (S,): sums of
    products (S, c, c) of the innovations of columns (N, c) over their deviation, and the sum of log f to totals."""
    state, P, gain, row = scratch
    N, J = H.shape
    for s in range(steps.shape[0]):
        for i in range(J):
            for c in range(state.shape[1]):
                state[i, c] = 0.0
            for j in range(J):
                P[i, j] = 0.0
        for t in range(N):
            f = 1.0
            for i in range(J):
                P[i, i] += steps[s]
            for i in range(J):
                gain[i] = 0.0
                for j in range(J):
                    gain[i] += P[i, j] * H[t, j]
                f += H[t, i] * gain[i]
            for i in range(J):
                for j in range(J):
                    P[i, j] -= gain[i] * gain[j] / f
            totals[s] += np.log(f)
            for c in range(state.shape[1]):
                row[c] = columns[t, c]
                for i in range(J):
                    row[c] -= H[t, i] * state[i, c]
                for i in range(J):
                    state[i, c] += gain[i] * row[c] / f
                for d in range(c + 1):
                    products[s, c, d] += row[c] * row[d] / f
        for c in range(state.shape[1]):
            for d in range(c):
                products[s, d, c] = products[s, c, d]


def innovations(H: Array, steps: Array, columns: Array) -> tuple[Array, Array]:
    """Sums of products (S, c, c) of the innovations of columns (N, c), and the sums (S,) of log f, by steps (S,)."""
    J, c, S = H.shape[1], columns.shape[1], len(steps)
    products, totals = np.zeros((S, c, c)), np.zeros(S)
    scratch = np.zeros((J, c)), np.zeros((J, J)), np.zeros(J), np.zeros(c)
    _filter(np.ascontiguousarray(H), steps, columns, scratch, products, totals)
    return products, totals


def unexplained(products: Array, columns: Sequence[int], floor: float) -> Array:
    """Sums of squares (..) that some columns leave of the last one, by sums of products (.., c, c) of all."""
    own = np.array(columns)
    b = products[..., own, -1]
    solution = np.linalg.solve(invertible(products[..., own[:, None], own]), b[..., None])[..., 0]
    return np.asarray(np.maximum(products[..., -1, -1] - np.sum(b * solution, axis=-1), floor))


def kind(model: Model, found: Dated, changes: Which, moving: tuple[int, ...]) -> Kind:
    """The kind of change of the parameters ``moving``."""
    N, n = model.phi.shape
    lags, g, price = model.noise.lags, model.noise.g, np.log(N)
    K = len(found.breaks)
    size = np.sqrt(np.mean(model.phi**2, axis=0))
    phi = model.phi / np.where(size > 0.0, size, 1.0)
    Z, z = white_rows(phi, model.y, lags, found.ar, g)
    M = len(z)
    moves = list(moving)
    scores = {"rest": M * np.log(left(Z, z, model.floor)) + n * price}
    if K:
        scores["steps"] = M * np.log(max(changes.rss, model.floor)) + (changes.used + DATE * K) * price
    slow, ends, path, tried = moves, (0, N - 1), np.zeros((N, 0)), [moves]
    while tried:
        for own in tried:
            noise, places = (lags, found.ar, g), corners(N, CORNERS)
            near = [
                end + places[1] * np.arange(-FINER, FINER + 1) // FINER
                for end in ramp(phi, model.y, noise, own, places)
            ]
            at = ramp(phi, model.y, noise, own, np.unique(np.clip(near, 0, N - 1)))
            shape = rise(N, at)[:, None]
            both = np.hstack([Z, white_rows(shape * phi[:, own], model.y, lags, found.ar, g)[0]])
            score = M * np.log(left(both, z, model.floor)) + (n + len(own) + DATE * 2) * price
            if score < scores.get("gradual", np.inf):
                scores["gradual"], slow, ends, beta = score, own, at, coefficients(both, z)
                path = np.tile(beta[:n], (N, 1))
                path[:, own] += shape * beta[n:]
        fewer = len(slow) == len(tried[0]) > 1
        tried = [[i for i in slow if i != j] for j in slow] if fewer else []
    scores["walk"], scores["jumps"], dates = _walks(phi, model, found, changes, moves)
    weights = dict(zip(scores, scipy.special.softmax(-0.5 * np.array([*scores.values()])).tolist(), strict=True))
    names = {"rest": "", "steps": "steps", "gradual": "gradual", "walk": "wandering", "jumps": "drift with jumps"}
    likely = max((name for name in weights if name != "rest"), key=lambda name: weights[name])
    path = path / np.where(size > 0.0, size, 1.0)
    return Kind(names[likely], weights, ends, path, dates, tuple(slow if likely == "gradual" else moves))


def _walks(
    phi: Array, model: Model, found: Dated, changes: Which, moves: list[int]
) -> tuple[float, float, tuple[int, ...]]:
    """(BIC of a walk, BIC of a walk with jumps, the dates of these jumps)."""
    N, n = phi.shape
    lags, g, price = model.noise.lags, model.noise.g, np.log(N)
    first, K = order_of(lags), len(found.breaks)
    steps = [(k, j) for k, own in enumerate(changes.at) for j in own]
    columns = split(phi, found.breaks)[:, [*range(n), *(n * (k + 1) + j for k, j in steps)]]
    walk, both = np.inf, np.inf
    dates: tuple[int, ...] = ()
    for ar in (found.ar, np.zeros(len(lags)))[: 2 if first else 1]:
        Z, z = white_rows(columns, model.y, lags, ar, g)
        unit = np.mean(Z[:, moves] ** 2, axis=0)
        products, totals = innovations(Z[:, moves] / np.sqrt(unit), STEPS, np.column_stack([Z, z]))
        totals += (n + 1 - len(lags) + int(np.count_nonzero(ar))) * price
        walk = min(walk, float(np.min(len(z) * np.log(unexplained(products, range(n), model.floor)) + totals)))
        kept = list(range(K))
        while kept:
            some = {k: [n + i for i, (date, _) in enumerate(steps) if date in kept and date != k] for k in [*kept, K]}
            score = len(z) * np.log(unexplained(products, [*range(n), *some[K]], model.floor)) + totals
            score += (len(some[K]) + DATE * len(kept)) * price
            best = int(np.argmin(score))
            if score[best] < both:
                both, dates = float(score[best]), tuple(kept)
            kept.remove(min(kept, key=lambda k: unexplained(products[best], [*range(n), *some[k]], model.floor)))
    return walk, both, dates
