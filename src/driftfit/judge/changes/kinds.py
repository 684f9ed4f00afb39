"""What kind of change: steps, a gradual one, a walk, or a walk with jumps, by one criterion.

    BIC = N log(rss) + sum log f_t + (number of coefficients + number of dates) log N

    rest      constants
    steps     the segments, with the changes that are needed
    gradual   theta_j constant, then on a straight line from one date to another, then constant; or continuous lines
              between evenly spaced knots
    walk      theta_j(t) = theta_j(t - 1) + w_t,  var w = q / mean(x_j^2); f_t are the variances of its innovations, and
              constants are estimated on the innovations of all columns
    jumps     the walk, with those steps that it still needs

A date costs as much as a coefficient. The walk is tried beside the noise of the segments
and beside white noise, since an autoregression takes a walk for noise. The weights of the kinds are exp(-BIC / 2).

Source: Schwarz (1978); Ansley and Kohn (1985) for constants beside a filter. Cost: O(N) for each of some hundred
paths.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver
from driftfit.judge.changes.dates import Dated
from driftfit.judge.changes.fit import hats, left, order_of, split, white_rows
from driftfit.judge.changes.null import Model
from driftfit.judge.changes.scan import SINGULAR, SMALL
from driftfit.judge.changes.which import Which

KNOTS = (3, 4, 5, 6, 8, 10, 13, 17, 22, 28)
CORNERS = 24
"""Cells at whose ends a gradual change may begin or end."""
STEPS = tuple(10.0**k for k in np.arange(-7.0, 0.5, 0.5))
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


def _filter(H: Array, q: Array, W: Array, state: Array, P: Array, gain: Array, total: Array) -> None:
    """Innovations, in place and over their deviation, of columns W (N, c) as outputs of a walk on H (N, J) with steps
    of variance q (J,), known at the start, in noise of variance 1; the sum of log f to total (1,)."""
    N, J = H.shape
    for t in range(N):
        f = 1.0
        for i in range(J):
            P[i, i] += q[i]
        for i in range(J):
            gain[i] = 0.0
            for j in range(J):
                gain[i] += P[i, j] * H[t, j]
            f += H[t, i] * gain[i]
        for i in range(J):
            for j in range(J):
                P[i, j] -= gain[i] * gain[j] / f
        root = np.sqrt(f)
        total[0] += np.log(f)
        for c in range(W.shape[1]):
            e = W[t, c]
            for i in range(J):
                e -= H[t, i] * state[i, c]
            for i in range(J):
                state[i, c] += gain[i] * e / f
            W[t, c] = e / root


_filtered = Driver(_filter)


def innovations(H: Array, q: Array, W: Array) -> tuple[Array, float]:
    """Innovations of columns W (N, c) over their deviation, and the sum of log f."""
    J, W, total = H.shape[1], W.copy(), np.zeros(1)
    _filtered(np.ascontiguousarray(H), q, W, np.zeros((J, W.shape[1])), np.zeros((J, J)), np.zeros(J), total)
    return W, float(total[0])


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
    ends, path = _ramp(Z, z, phi[:, moves], model, found), np.zeros((N, 0))
    shapes = [(_rise(N, ends)[:, None], ends, DATE * 2)]
    shapes += [(hats(N, knots)[:, 1:], (0, N - 1), 0.0) for knots in KNOTS if len(moves) * knots <= N // 8]
    for shape, own, more in shapes:
        columns = np.hstack([phi[:, j : j + 1] * shape for j in moves])
        both = np.hstack([Z, white_rows(columns, model.y, lags, found.ar, g)[0]])
        beta = np.linalg.lstsq(both, z, rcond=None)[0]
        rss = max(float(np.sum((z - both @ beta) ** 2)), model.floor)
        score = M * np.log(rss) + (len(beta) + more) * price
        if score < scores.get("gradual", np.inf):
            scores["gradual"], ends, path = score, own, np.tile(beta[:n], (N, 1))
            path[:, moves] += shape @ beta[n:].reshape(len(moves), -1).T
    scores["walk"], scores["jumps"], dates = _walks(phi, model, found, changes, moves)
    low = min(scores.values())
    weights = {name: float(np.exp(-0.5 * (score - low))) for name, score in scores.items()}
    total = sum(weights.values())
    weights = {name: weight / total for name, weight in weights.items()}
    names = {"rest": "", "steps": "steps", "gradual": "gradual", "walk": "wandering", "jumps": "drift with jumps"}
    likely = max((name for name in weights if name != "rest"), key=lambda name: weights[name])
    return Kind(names[likely], weights, ends, path / np.where(size > 0.0, size, 1.0), dates)


def _rise(N: int, ends: tuple[int, int]) -> Array:
    """(N,): 0 up to the first end, 1 from the last one on."""
    return np.asarray(np.clip((np.arange(N) - ends[0]) / max(ends[1] - ends[0], 1), 0.0, 1.0))


def _ramp(Z: Array, z: Array, columns: Array, model: Model, found: Dated) -> tuple[int, int]:
    """The ends of the best single gradual change of columns (N, J)."""
    N, J = columns.shape
    Q = np.linalg.qr(Z)[0]
    r = z - Q @ (Q.T @ z)
    places = np.unique(np.linspace(0, N - 1, min(CORNERS, N // 8) + 1).astype(int))
    best = (-np.inf, (0, N - 1))
    for i, start in enumerate(places[:-1]):
        ends = [(int(start), int(stop)) for stop in places[i + 1 :]]
        made = np.hstack([columns * _rise(N, one)[:, None] for one in ends])
        white = white_rows(made, model.y, model.noise.lags, found.ar, model.noise.g)[0]
        rest = (white - Q @ (Q.T @ white)).reshape(len(z), -1, J).transpose(1, 2, 0)
        A, b = rest @ rest.transpose(0, 2, 1), rest @ r
        least = SINGULAR * np.sum(white**2, axis=0).reshape(-1, J).max(axis=1) + SMALL
        gain = np.sum(np.linalg.solve(A + least[:, None, None] * np.eye(J), b[..., None])[..., 0] * b, axis=1)
        best = max(best, (float(gain.max()), ends[int(np.argmax(gain))]))
    return best[1]


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
        used = int(np.count_nonzero(ar))
        for step in STEPS:
            W, total = innovations(Z[:, moves] / np.sqrt(unit), np.full(len(moves), step), np.column_stack([Z, z]))
            score = len(z) * np.log(left(W[:, :n], W[:, -1], model.floor)) + total + (n + 1 - len(lags) + used) * price
            walk = min(walk, score)
            kept = list(range(K))
            while kept:
                some = [i for i, (k, _) in enumerate(steps) if k in kept]
                score = (len(z) * np.log(left(W[:, [*range(n), *(n + i for i in some)]], W[:, -1], model.floor)) + total
                         + (n + 1 + len(some) + DATE * len(kept) - len(lags) + used) * price)  # fmt: skip
                if score < both:
                    both, dates = score, tuple(kept)
                without = []
                for k in kept:
                    rest = [n + i for i, (date, _) in enumerate(steps) if date in kept and date != k]
                    without.append(left(W[:, [*range(n), *rest]], W[:, -1], model.floor))
                kept.remove(kept[int(np.argmin(without))])
    return float(walk), float(both), dates
