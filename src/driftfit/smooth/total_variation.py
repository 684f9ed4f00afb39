"""Group total variation: a path with few jumps that is constant in between.

    minimise  F = sum_t weight_t (y_t - phi_t' theta_t)^2 + penalty sum_t |theta_{t+1} - theta_t|_2

by reweighting: solve flexible least squares with D_t = penalty / (2 sqrt(|Delta_t|^2 + eta^2)) I. Each step minimises a
quadratic upper bound of F (with eta) that touches it, so the cost never rises; F is convex.

Certificate: with g_t = 2 sum_{i > t} weight_i phi_i (y_i - phi_i' theta_i), the minimum has |g_t| <= penalty everywhere
and g_t = penalty Delta_t / |Delta_t| at a jump. A path with |g_t| <= penalty costs at most
sum(penalty |Delta_t| - g_t' Delta_t) more than the best one; the iteration stops by this gap. At
penalty >= penalty_max = max |g_t| of constant least squares the path is constant.

Use it for parameters that jump (switching systems). It shrinks the jumps; `refit` estimates each segment again without
shrinkage. The norm couples parameters, so scale them to comparable units first. Source: Rudin, Osher and Fatemi (1992)
for the penalty, Yuan and Lin (2006) for groups. Cost: 100 to 1,000 exact smoothings.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import Array
from driftfit.engine.settings import numbers, whole
from driftfit.run.result import Track
from driftfit.smooth import exact
from driftfit.smooth.problem import walk_of
from driftfit.smooth.solvers.walk import DRIFT, Walk, constants

SMOOTHING = 1e-6
"""eta, relative to the range of theta, but not below the rounding of theta; its size says nothing of its jumps."""


class Piecewise(NamedTuple):
    """A path with few jumps."""

    theta: Array
    """(T, n)"""
    jumps: Array
    """Samples at which a new segment begins."""
    refit: Array
    """(T, n): separate least squares on each segment."""
    penalty_max: float
    """At this penalty and above the path is constant."""
    costs: Array
    """F with eta after every step; it never rises."""
    pull: float
    """max |g_t| / penalty: at most 1 at the minimum."""
    gap: float
    """Upper bound of how much this path costs above the minimum, as a share of F."""


def total_variation(run: Track, penalty: float, tol: float = 1e-4, max_steps: int = 1000) -> Piecewise:
    """Smooth a run with a penalty on jumps.

    Parameters
    ----------
    run : Track
        A run of any tracker; only its regressors and outputs are used.
    penalty : number
        Penalty of a jump of size 1, in squared units of y; positive.
    tol : number
        Stop when the gap is below this share of the cost, and |g_t| exceeds the penalty by at most a thousandth.
    max_steps : int
        Largest number of steps; ``pull`` and ``gap`` show how close the result is.

    Raises
    ------
    ValueError
        If penalty is not positive.
    """
    price = float(numbers("total_variation", "penalty", penalty, ndim=0, low=0.0, strict=True))
    whole("total_variation", "max_steps", max_steps, 1)
    fixed = walk_of(run, constants(run.model.n))
    walk = fixed._replace(q=np.eye(run.model.n))
    open_ = fixed.drift > 0.0
    theta = exact.smooth(fixed, "std").theta
    penalty_max = float(2.0 * np.linalg.norm(walk.pull(walk.residual(theta))[open_], axis=1).max(initial=0.0))
    theta = exact.smooth(walk, "std").theta
    size, spread = (float(part.max()) for part in (np.abs(theta), np.ptp(theta, axis=0)))
    eta = max(SMOOTHING * spread, ROUNDING * size, 1e-300)
    costs, pull, gap = [], np.inf, np.inf
    for _ in range(max_steps):
        length = np.sqrt(jump_sizes(theta, open_) ** 2 + eta**2)
        theta = exact.smooth(walk.changed(DRIFT, np.where(open_, 2.0 * length / price, 0.0)), "std").theta
        cost, pull, gap = judge(walk, theta, open_, price)
        costs.append(cost + price * float(np.sum(np.sqrt(jump_sizes(theta, open_) ** 2 + eta**2)[open_])))
        if pull <= 1.001 and gap <= tol:
            break
    sizes = jump_sizes(theta, open_)
    jumps = np.flatnonzero(sizes > 1e3 * eta)
    return Piecewise(theta, jumps, refitted(fixed, jumps), penalty_max, np.array(costs), pull, gap)


def jump_sizes(theta: Array, possible: Array) -> Array:
    """|theta_t - theta_{t-1}|, (T,); 0 where no time passes."""
    sizes = np.zeros(len(theta))
    sizes[1:] = np.linalg.norm(np.diff(theta, axis=0), axis=1)
    return np.where(possible, sizes, 0.0)


def judge(walk: Walk, theta: Array, possible: Array, price: float) -> tuple[float, float, float]:
    """(squared residuals, max |g| / penalty, gap as a share of F)."""
    residual = walk.residual(theta)
    g = 2.0 * walk.pull(residual)[possible]
    moves = np.diff(theta, axis=0, prepend=theta[:1])[possible]
    squares = float(np.sum(walk.weight * residual**2))
    variation = price * float(np.linalg.norm(moves, axis=1).sum())
    pull = float(np.linalg.norm(g, axis=1).max(initial=0.0)) / price
    gap = variation - float(np.sum(g * moves)) + max(0.0, pull - 1.0) * (squares + variation)
    return squares, pull, gap / max(squares + variation, 1e-300)


def refitted(fixed: Walk, jumps: Array) -> Array:
    """Least squares between the jumps."""
    parts = []
    for a, b in zip([0, *jumps], [*jumps, len(fixed.y)], strict=True):
        part = fixed._replace(phi=fixed.phi[a:b], signals=fixed.signals[a:b])
        parts.append(exact.smooth(part, "std").theta)
    return np.concatenate(parts)
