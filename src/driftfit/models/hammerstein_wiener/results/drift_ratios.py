"""Estimate the ratio of drift to noise: filters with several ratios in parallel, weighted by how well they predict y.

    filter j     Kalman with r = 1, q = rho_j I;   sigma_j^2 <- discounted mean of e^2 / s
    L_j,t        = 0.998 L_j,t-1 - 1/2 log(sigma_j^2 s) - e^2 / (2 sigma_j^2 s) + log F'(y_t; d_t)

with sigma_j^2 from before the sample and d after it. The result at t is the estimate of the filter with the largest L
at that time: nothing looks ahead. Without the Jacobian F' the likelihood prefers estimates with F' = 0.

Use it if there is no record to which `tune` could fit a ratio, or if the ratio changes. The filters are one grid,
`track` with a list, which distributes them over the cores. Cost: that of the filters. As lanes of one tile seven
filters take 1.2 times as long as separately at n = 7, and 1.6 times at n = 14: lanes pay only if the model's step
vectorises over them, as that of an `ARX` does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.kernel import Array, Driver
from driftfit.engine.settings import numbers
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.run.fleet import Fleet
from driftfit.run.track import track
from driftfit.trackers.kalman import Kalman

RHOS = tuple(10.0**k for k in range(-4, 3))
FADE = 0.998


class Ratios(NamedTuple):
    """The result of `track_ratios`."""

    rhos: Array
    """(J,)"""
    rho: Array
    """(T,): the ratio with the highest likelihood."""
    theta: Array
    """(T, n): the estimate of its filter."""
    score: Array
    """(T, J): discounted log-likelihoods of y."""
    runs: Any
    """The run of every filter, by its index."""


def track_ratios(
    model: HammersteinWiener, y: Any, u: Any, *, rhos: Sequence[float] = RHOS, fade: float = FADE, p0: float = 1e8,
    theta0: Any = 0.01,
) -> Ratios:  # fmt: skip
    """Track with every ratio, and return the results of the one with the highest likelihood.

    Parameters
    ----------
    model : HammersteinWiener
    y, u : (T,)
    rhos : numbers
        Ratios q / r, of the unit of the squared estimates over that of the squared equation error: the default is for
        data of unit size, or for bases on ranges, whose values are of unit size.
    fade : number
        Weight of a sample's likelihood one sample later; below 1.
    p0, theta0
        Initial covariance, in units of r, and mean.

    Raises
    ------
    ValueError
        For another model, or a fade outside 0 to 1.
    """
    if not isinstance(model, HammersteinWiener):
        raise ValueError(f"track_ratios: needs a HammersteinWiener model; got {type(model).__name__}.")
    keep = numbers("track_ratios", "fade", fade, ndim=0, low=0.0, strict=True)
    if not keep < 1.0:
        raise ValueError(f"track_ratios: fade must lie between 0 and 1; got {fade!r}.")
    trackers = [Kalman(q=rho, r=1.0, p0=p0, theta0=theta0) for rho in rhos]
    grid = track(model, trackers, y, u)
    assert isinstance(grid, Fleet)
    found = [grid[j] for j in range(len(trackers))]
    score = np.stack([_score(run, keep) for run in found], axis=1)
    leads = np.argmax(score, axis=1)
    theta = np.empty_like(found[0].theta)
    for j, run in enumerate(found):
        theta[leads == j] = run.theta[leads == j]
    return Ratios(np.array(rhos), np.array(rhos)[leads], theta, score, found)


def _score(run: Any, fade: float) -> Array:
    """Discounted log-likelihood of y of one run."""
    ok = run.ok
    with np.errstate(invalid="ignore"):
        ratio = (run.innovation / run.innovation_std) ** 2
        size = 2.0 * np.log(run.innovation_std)
    scores = np.empty(len(run))
    _discount(ok, ratio, size, run.model.log_jacobian(run.theta, run.y), float(run.model.n), fade, scores)
    return scores


@Driver
def _discount(ok: Array, ratio: Array, size: Array, slope: Array, n: float, fade: float, scores: Array) -> None:
    """L_t from e^2 / s, log s and log F' of every sample."""
    total, weight, squares = 0.0, 0.0, 0.0
    for t in range(ok.shape[0]):
        if ok[t]:
            if weight > n:
                sigma2 = max(squares / weight, 1e-300)
                total = fade * total - 0.5 * (np.log(sigma2) + size[t] + ratio[t] / sigma2) + slope[t]
            weight, squares = fade * weight + 1.0, fade * squares + ratio[t]
        scores[t] = total
