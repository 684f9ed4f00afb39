"""Bands while few residuals determine the noise variance: variances that are reported are w times as large,

    w = (t / z)^2,    t, z: the .975 quantiles of Student's distribution with nu degrees of freedom and of the normal

so that theta +- 1.96 std contains the truth in 95 % of all records, from the first residual on (nu = 1: w = 42). At
other levels this is an approximation. From four residuals on t is its expansion in 1 / nu, within half a percent.

Source: Student (1908); the expansion is that of Fisher and Cornish (1960). Cost: O(n^2) for each sample of a start.
"""

from __future__ import annotations

from driftfit.engine.kernel import State, kernel

WIDER = (42.0277, 4.8192, 2.6365)
"""w for 1, 2 and 3 residuals."""
TERMS = (1.21036, 1.44008, 1.30403)
"""Coefficients of t / z - 1 in powers of 1 / nu."""

RESIDUALS = 4
"""Residuals from which on they determine the variance of the noise."""


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
