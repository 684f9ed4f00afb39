"""The exact fixed-interval smoother: off-line flexible least squares, the mean and covariance of every theta_t.

It minimises the following cost, and computes the corresponding posterior distribution,

    J = sum_t weight_t (y_t - phi_t' theta_t)^2 + sum_t |G^-1 E_t^-1 (theta_t - theta_{t-1})|^2 / drift_t + prior

with G G' = q and E_t the square roots of the factors of each parameter's drift. There are two methods. The fast one
(`driftfit.smooth.solvers.elimination`) handles a diagonal q if the regressors span all directions, also with a proper
prior, and tests its own result by a second problem with a known solution. If the test fails, and in all other cases,
the safe one (`driftfit.smooth.solvers.two_filters`) works on square roots of information. ``Path.method`` names the
method that was used. Second differences instead of first ones are in `driftfit.smooth.solvers.slopes`.

If the regressors never span all directions, a constant shift in the complement costs nothing. The first point then
takes theta0 there, the limit of a vanishing prior, and std is inf for parameters that are not determined. Rank is
decided on regressors with columns scaled to unit rms.

Use it on a complete record. Bands are valid under the random-walk model and its q. Cost: O(T n^3).

Source: Kalaba and Tesfatsion (1989) for flexible least squares; Rauch, Tung and Striebel (1965) for the smoother.
Departure: the rule for undetermined directions.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.smooth.solvers import elimination, slopes, two_filters
from driftfit.smooth.solvers.rank import column_scale, ranks
from driftfit.smooth.solvers.walk import Path, Walk
from driftfit.trackers.forms.information import triangular_root


def smooth(walk: Walk, keep: str = "fit", rebuild: Callable[[], Walk] | None = None) -> Path:
    """Solve the problem.

    The path has theta and its variances with keep="std", rho and c too with "fit", and the covariances of every sample
    and of neighbouring samples too with "cov"; the safe method adds rho and c anyway. ``rebuild`` is a function that
    makes the problem a second time. If it is given, the fast method writes its solution over phi and signals, which
    saves memory, and the safe one solves the rebuilt problem.
    """
    if len(walk.basis):
        return turned(walk, keep)
    if len(walk.trend):
        return spread(walk, slopes.smooth(walk, keep))
    n = walk.phi.shape[1]
    scale = column_scale(walk.phi, walk.signals)
    rank, unseen = ranks(walk.phi, walk.signals, scale)
    simple = keep != "cov" and rank[-1] == n and np.array_equal(walk.q, np.diag(np.diag(walk.q)))
    found = elimination.smooth(walk, scale, keep, overwrite=rebuild is not None) if simple else None
    if found is None:
        walk = rebuild() if simple and rebuild is not None else walk
        found = safely(walk, scale, unseen, keep)
    return spread(walk, found._replace(rank=rank))


def safely(walk: Walk, scale: Array, unseen: Array, keep: str) -> Path:
    """Solve the problem with the safe method; regressors divided by ``scale`` are orthogonal to ``unseen`` (n, k)."""
    G = triangular_root(walk.q * np.outer(scale, scale))
    return two_filters.smooth(walk, scale, G, two_filters.start(walk, scale, unseen), keep)


def spread(walk: Walk, path: Path) -> Path:
    """The path, or that of the mixture, with the variance between the paths under all drifts that are possible."""
    if walk.mixture is not None:
        path = mixed(walk, path)
    if not len(walk.paths):
        return path
    away = np.sqrt(walk.belief)[:, None, None] * (walk.paths - path.theta)
    cov = path.cov + np.einsum("kti,ktj->tij", away, away) if len(path.cov) else path.cov
    lag = path.lag_cov + np.einsum("kti,ktj->tij", away[:, :-1], away[:, 1:]) if len(path.lag_cov) else path.lag_cov
    return path._replace(var=path.var + np.sum(away**2, axis=0), cov=cov, lag_cov=lag)


def mixed(walk: Walk, path: Path) -> Path:
    """The path with the moments of the mixture; leverages stay those of one Gaussian.

    Other drifts move its mean as far as they move that of one Gaussian.
    """
    cov = walk.mixture.cov
    var = np.where(np.isinf(path.var), np.inf, np.einsum("tii->ti", cov))
    moved = np.einsum("k,kti->ti", walk.belief, walk.paths - path.theta) if len(walk.paths) else 0.0
    path = path._replace(theta=walk.mixture.theta + moved, var=var, cov=cov if len(path.cov) else path.cov)
    error = np.sqrt(np.where(walk.weight > 0.0, walk.weight, np.nan)) * walk.residual(path.theta)
    return path._replace(rho=error / np.where(path.c > 0.0, path.c, 1.0) if len(path.c) else path.rho)


def turned(walk: Walk, keep: str) -> Path:
    """The path of theta = basis z, from that of z. Variances of its slopes neglect that those of z are correlated.

    Rank is decided on the regressors of theta, since those of z may be nothing but rounding.
    """
    basis, z = walk.basis, walk.independent
    scale, size = (column_scale(phi, walk.signals) for phi in (walk.phi, z.phi))
    rank, unseen = ranks(walk.phi, walk.signals, scale)
    hidden = two_filters.unspanned(unseen, scale)
    if len(walk.trend):
        path = slopes.smooth(z, "cov")
        unknown = np.isinf(variances(path.var, basis))
    else:
        path = safely(z, size, np.linalg.solve(basis, hidden.T) * size[:, None], "cov")._replace(rank=rank)
        unknown = two_filters.undetermined(hidden)
    path = spread(z, path)
    theta = path.theta @ basis.T
    theta -= (theta[0] - walk.theta0) @ hidden.T @ hidden
    cov = basis @ path.cov @ basis.T
    return path._replace(
        theta=theta,
        var=np.where(unknown, np.inf, np.diagonal(cov, axis1=1, axis2=2)),
        slope=path.slope @ basis.T if len(path.slope) else path.slope,
        slope_var=variances(path.slope_var, basis) if len(path.slope_var) else path.slope_var,
        cov=cov if keep == "cov" else cov[:0],
        lag_cov=basis @ path.lag_cov @ basis.T if keep == "cov" else path.lag_cov[:0],
    )


def variances(var: Array, basis: Array) -> Array:
    """Variances (T, n) of basis z, from those of z without their covariances; inf with a share of one that is inf."""
    unknown = np.isinf(var)
    return np.where(unknown @ (basis != 0.0).T, np.inf, np.where(unknown, 0.0, var) @ (basis**2).T)
