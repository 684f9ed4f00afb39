"""Huber residuals: the exact smoother for records with outliers.

    minimise  sum_t rho(a_t) + sum_t |G^-1 (theta_t - theta_{t-1})|^2 / drift_t
    a_t = sqrt(weight_t) (y_t - phi_t' theta_t);   rho(a) = a^2 for |a| <= delta,  2 delta |a| - delta^2 beyond

by reweighting: solve with weight_t min(1, delta / |a_t|) until the cost converges. Each step minimises a quadratic
upper bound that touches the cost, so the cost never rises; it is convex, so the limit is the minimum.

Certificate: with psi = clip(a, -delta, delta) the gradient is zero if sum_t sqrt(weight_t) phi_t psi_t = 0 and
theta_{t+1} - theta_t = drift_{t+1} q sum_{i > t} sqrt(weight_i) phi_i psi_i. The residuals of both are reported.

Use it if a few outputs are wrong. Bands are those of the last weighted problem and are approximate. It does not help
against wrong regressors. Source: Huber (1964); reweighting after Beaton and Tukey (1974). Cost: 10 to 50 exact
smoothings.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from driftfit.engine.kernel import Array
from driftfit.engine.settings import numbers, whole
from driftfit.run.result import Track
from driftfit.smooth import exact
from driftfit.smooth.problem import walk_of
from driftfit.smooth.smoothed import Data, Smoothed
from driftfit.smooth.solvers.walk import WEIGHT, Path, Walk

EFFICIENT = 1.345
"""delta in standard deviations: 95 % efficiency on Gaussian residuals."""


class Huber(NamedTuple):
    """A path that is robust to outliers."""

    path: Smoothed
    """The weighted problem at the solution."""
    delta: float
    """The residual of a sample of weight 1 above which the penalty is linear, in units of y."""
    weights: Array
    """(T,): min(1, delta / |residual|), below 1 for downweighted samples; 0 for samples that were not used."""
    costs: Array
    """The cost after every step; it never rises."""
    certificate: float
    """Relative norm of the remaining gradient: 0 at the minimum."""


def huber(run: Track, delta: float | None = None, tol: float = 1e-12, max_steps: int = 200) -> Huber:
    """Smooth a run with Huber residuals.

    Parameters
    ----------
    run : Track
        A run of a random-walk tracker.
    delta : number
        In units of y. None: 1.345 standard deviations, estimated from the median absolute deviation of the
        leave-one-out residuals of the quadratic smoother. inf gives that smoother.
    tol : number
        Stop when a step lowers the cost by less than this share.
    max_steps : int
        Largest number of steps; the certificate shows how close the result is.

    Raises
    ------
    ValueError
        If delta is not positive, or the tracker does not describe a random walk in Gaussian noise.
    """
    whole("huber", "max_steps", max_steps, 1)
    walk = walk_of(run)
    path = exact.smooth(walk)
    if delta is None:
        delta = EFFICIENT * spread_of(Smoothed(path, Data.of(walk), run, walk))
    elif delta != np.inf:
        delta = numbers("huber", "delta", delta, ndim=0, low=0.0, strict=True)
    root = np.sqrt(walk.weight)
    weighted, costs = walk, [np.inf]
    for _ in range(max_steps):
        size = root * np.abs(walk.residual(path.theta))
        held = np.divide(delta, size, out=np.ones_like(size), where=size > delta)
        dynamic = path.cost - path.measurement_cost
        costs.append(2.0 * float(np.sum(scipy.special.huber(delta, size))) + dynamic)
        if costs[-2] - costs[-1] <= tol * costs[-1]:
            break
        weighted = walk.changed(WEIGHT, walk.weight * held)
        path = exact.smooth(weighted)
    return Huber(
        Smoothed(path, Data.of(weighted), run, weighted), delta, np.where(walk.weight > 0.0, held, 0.0),
        np.array(costs[1:]), certificate(walk, path, delta),
    )  # fmt: skip


def spread_of(smoothed: Smoothed) -> float:
    """Standard deviation of the noise of weight 1 from leave-one-out residuals, half of which may be arbitrary."""
    weight = smoothed.weight
    loo = np.sqrt(np.where(weight > 0.0, weight, np.nan)) * smoothed.loo
    return float(np.nanmedian(np.abs(loo - np.nanmedian(loo))) / scipy.special.ndtri(0.75))


def certificate(walk: Walk, path: Path, delta: float) -> float:
    """The larger of the two residuals of the gradient, each relative to the size of its terms."""
    theta, walks = path.theta, path.slope if len(walk.trend) else path.theta
    root = np.sqrt(np.where(walk.weight > 0.0, walk.weight, np.nan))
    residual = walk.residual(theta)
    psi = np.nan_to_num(np.clip(root * residual, -delta, delta) / root)
    pull = walk.pull(psi)
    moved = np.diff(walks, axis=0) - walk.moves(pull)
    whole_pull = np.sum(np.abs(walk.phi) * (walk.weight * np.abs(walk.y))[:, None], axis=0)
    first = np.max(np.abs(pull[0]) / np.maximum(whole_pull, 1e-300)) if walk.p0 is None else 0.0
    return float(max(first, np.max(np.abs(moved), initial=0.0) / max(np.abs(walks).max(), 1e-300)))
