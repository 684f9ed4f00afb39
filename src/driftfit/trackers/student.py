"""The predictive density where the noise variance is estimated: Student's t.

    y_t | past ~ t_nu(y_hat_t, s_t),   s_t = scale s0_t,   scale = sum(e^2 / s0) / nu over the nu samples before
    log p = lgamma((nu + 1) / 2) - lgamma(nu / 2) - 1/2 log(pi nu s_t) - (nu + 1) / 2 log(1 + e^2 / (nu s_t))

This is exact for constant parameters with the improper prior 1 / sigma^2 of the noise variance: the sum is the log
evidence given the samples that determined the parameters and the first residual, since no density of the first
residual exists (nu = 0: NaN). A Gaussian density with an estimated variance instead counts an innovation of ten
estimated standard deviations as fifty nats, where after one residual it is a matter of course. The degrees of freedom
are the number of residuals, also while parameters drift or are forgotten.

Variances that are reported while few residuals determine the noise are w times as large,

    w = (t / z)^2,    t, z: the .975 quantiles of Student's distribution with nu degrees of freedom and of the normal

so that theta +- 1.96 std contains the truth in 95 % of all records, from the first residual on (nu = 1: w = 42). At
other levels this is an approximation. From four residuals on t is its expansion in 1 / nu, within half a percent.

Source: Gelman et al., Bayesian Data Analysis (2013), section 14.2; West and Harrison (1997), section 4.5; the expansion
is that of Fisher and Cornish (1960). Cost: O(1), and O(n^2) for each sample of a start.
"""

from __future__ import annotations

import numpy as np
import scipy

from driftfit.engine.kernel import Array, State, kernel

WIDER = (42.0277, 4.8192, 2.6365)
"""w for 1, 2 and 3 residuals."""
TERMS = (1.21036, 1.44008, 1.30403)
"""Coefficients of t / z - 1 in powers of 1 / nu."""

RESIDUALS = 4
"""Residuals from which on they determine the variance of the noise."""


def log_student(e: Array, s: Array, nu: Array) -> Array:
    """Log densities of innovations e whose squares are about s, with nu degrees of freedom; NaN where nu is 0."""
    known = np.where(nu > 0.0, nu, np.nan)
    gamma = scipy.special.gammaln
    ratio = gamma(0.5 * (known + 1.0)) - gamma(0.5 * known)
    with np.errstate(invalid="ignore", divide="ignore"):
        far = 0.5 * (known + 1.0) * np.log1p(e * e / (known * s))
        return np.asarray(ratio - 0.5 * np.log(np.pi * known * s) - far)


def residuals_before(ok: Array, s: Array, first: float) -> Array:
    """The number of residuals before each sample (T,), ``first`` before all of them: of used samples that did not
    determine a new direction (s = inf).
    """
    counted = ok & ~np.isinf(s)
    return np.asarray(first + np.cumsum(counted) - counted)


def band_ratio(nu: Array, level: float) -> Array:
    """Student's quantile of a two-sided band over the normal one; 1 where nu is 0, and so no variance is known."""
    p = 0.5 + level / 2.0
    return np.where(nu > 0.0, scipy.special.stdtrit(np.maximum(nu, 1.0), p) / scipy.special.ndtri(p), 1.0)


@kernel
def wider(residuals: float) -> float:
    """w; 1 where there is no residual, and so no variance."""
    x = 1.0 / max(residuals, 1.0)
    ratio = 1.0 + x * (TERMS[0] + x * (TERMS[1] + x * TERMS[2]))
    few = WIDER[0] if residuals < 1.5 else WIDER[1] if residuals < 2.5 else WIDER[2]
    many: float = few if residuals < 3.5 else ratio * ratio
    return many if residuals > 0.5 else 1.0


@kernel
def widen_estimates(s: State, l: int) -> None:
    """The covariance that is reported while its factor is s.scale, from s.count residuals, and the state is s.S."""
    w = wider(s.count[l])
    for i in range(s.theta.shape[0]):
        s.var[i, l] *= w
        for j in range(i + 1):
            s.P[i, j, l] *= w
