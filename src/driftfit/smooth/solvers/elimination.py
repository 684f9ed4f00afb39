"""The fast path of the exact smoother: elimination of one increment at a time, from both ends of the record.

For a diagonal q, with U, z the information on theta_t (U theta = z), which begins as P0^-1 and P0^-1 theta0 before the
first sample (zero if the start is diffuse) and as zero after the last one, the increment of parameter i before sample t
has variance g = q_i drift_t drift_root_ti^2, and leaves

    f = 1 / (1 + g U_ii);   a_i = f,  a_j = -g f U_ji;   b = g f z_i
    U_jk <- U_jk + a_j U_ik,  U_ij <- f U_ij;   z_j <- z_j + a_j z_i,  z_i <- f z_i          towards the middle
    theta_i <- a' theta + b;   C_ii <- a' C a + g f,  C_ij <- (C a)_j                        back to the ends

between which the sample adds w phi phi' to U and w phi y to z. This is the recursion of flexible least squares,
theta_t = e_t + M_t theta_{t+1}, with M_t as a product of n steps, so O(n^2) for means and no matrix to invert. A random
walk has no direction of time: the same recursion runs from the last sample backwards, and where the two meet U and z
are the sums of both (`driftfit.smooth.solvers.halves`). A proper prior adds its term of J when theta_0 has been found.

Test: together with z, the recursion carries the information of a second record, which the constant path 1 / (rms of
each regressor) produces without noise. The largest difference of its solution from that path estimates the relative
error of all solutions with these regressors, weights and drifts. The result is accepted if it is small, no step
cancelled more than six digits (f), and no sample has a leverage so close to 1 that its leave-one-out residual is lost.
Otherwise `driftfit.smooth.solvers.two_filters` solves the problem; drift far above the noise and collinear regressors
fail the test.

Sources: Kalaba and Tesfatsion (1989); Higham (2002), section 1.3, for problems of known solution. Cost: O(T n^3),
mostly means at O(T n^2); in addition to the results, (n^2 + 2 n) / 64 numbers per sample are stored.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.smooth.solvers.halves import BLOCK, Found, Samples, inwards, outwards, workspace
from driftfit.smooth.solvers.walk import Path, Walk

ERROR = 1e-10
"""Largest error of the known path, relative to its values."""

CANCELLED = 1e-6
"""Smallest f: below it U has lost more than six digits in one step."""

CORRELATED = 1e4
"""Largest condition number of the correlations of a prior, whose inverse the known path does not test."""


def smooth(walk: Walk, scale: Array, keep: str = "std", overwrite: bool = False) -> Path | None:
    """Solve a problem with a diagonal q and regressors of full rank; None if the result is not accurate enough.

    ``scale`` (n,) is the size of each regressor. With keep="fit" the path has rho and c. ``overwrite``: phi and signals
    take the solution, which saves memory. With U of the middle sample, -2 log L = J + log |U| - sum log f, since each f
    is 1 / (1 + g U_ii).
    """
    T, n = walk.phi.shape
    K = T // 2 + 1
    before = np.zeros((n, n)) if walk.p0 is None else inverse(walk.p0, CORRELATED)
    if before is None:
        return None
    work = workspace(n).copy()
    work["q"], work["truth"] = np.diag(walk.q)[:, None], 1.0 / scale[:, None]
    work["U"][0, ..., 0], work["z"][0, :, 0] = np.tril(before), before @ walk.theta0
    work["known_z"][0, :, 0] = before @ (1.0 / scale)
    drift_root = np.ascontiguousarray(walk.drift_root if len(walk.drift_root) else np.ones((1, n)))
    samples = Samples(np.ascontiguousarray(walk.phi), np.ascontiguousarray(walk.signals), drift_root)
    kept = np.empty((-(-K // BLOCK), n + 2, n, 2))
    least, logs = inwards(work, samples, K, kept)
    U = work["U"][0].sum(axis=-1)
    U += np.tril(U, -1).T
    C = inverse(U)
    if C is None or least < CANCELLED:
        return None
    volume = float(np.linalg.slogdet(U)[1]) - logs
    work["C"][0], work["theta"][0] = C[..., None], (C @ work["z"][0].sum(axis=-1))[:, None]
    work["known"][0] = (C @ work["known_z"][0].sum(axis=-1))[:, None]
    theta, var = (samples.signals, samples.phi) if overwrite else (np.empty((T, n)), np.empty((T, n)))
    of_fit = T if keep == "fit" else 0
    found = Found(theta, var, np.empty(of_fit), np.empty(of_fit))
    cost, measured, spread, doubtful = outwards(work, samples, K, kept, found)
    error = float((work["error"][0] * scale[:, None]).max())
    if not (error <= ERROR and doubtful == 0):
        return None
    empty = np.zeros((0, n, n))
    theta = np.ascontiguousarray(theta[:, :n])
    away = work["theta"][0, :, 0] - walk.theta0
    cost += float(away @ before @ away)
    return Path(
        theta, var, found.rho, found.c, cost, measured, spread, empty, empty, "fast",
        log_likelihood=-0.5 * (cost + volume),
    )  # fmt: skip


def inverse(U: Array, limit: float = np.inf) -> Array | None:
    """U^-1 after scaling its diagonal to 1; None if its condition number is then above the limit, or it is singular."""
    size = np.sqrt(np.diag(U))
    if not (size > 0.0).all():
        return None
    cross = np.outer(size, size)
    try:
        if limit < np.inf and not np.linalg.cond(U / cross) <= limit:
            return None
        C: Array = np.linalg.inv(U / cross) / cross
    except np.linalg.LinAlgError:
        return None
    return C
