"""The start of the bank: every filter sees the first samples again, with its own drift.

Filters that began from least squares without drift would be certain of something wrong where the parameters moved
while the samples were collected. So each of the samples so far runs through all of them, from m = d and C = `LOOSE` I
in units of r, in which least squares have C = I, so that next to nothing of this prior is left:

    m_k, C_k,    S_k = sum e_k^2 / s_k,    log p_k = -1/2 sum log s_k - (nu / 2) log S_k

with nu the number of residuals, and p_k Student's density of the samples given the drift of mode k, whatever r. The
modes start with probabilities proportional to p_k, and with r the mean of S_k / nu.

Source: marginal likelihood under an inverse-gamma variance, West and Harrison, Bayesian Forecasting and Dynamic Models
(1997), section 4.5. Cost: O(K n^2) for each sample of the start, once.
"""

from __future__ import annotations

import math
from functools import partial

from driftfit.engine.kernel import State, exp, kernel, log
from driftfit.trackers.parts.diffuse import absorb_on_roots, forecast_on_roots
from driftfit.trackers.parts.excitation import learn_information, learn_scales
from driftfit.trackers.parts.mixture.filters import absorb, project, wander
from driftfit.trackers.parts.mixture.learned import PHI, WINDOW, learn_means
from driftfit.trackers.parts.mixture.noise import note_reading
from driftfit.trackers.parts.mixture.rows import least_of_row, sum_of_row

Y, SPAN = range(2)
"""Entries of a stored sample of the start before its regressor, at `PHI`: the output over the root of the noise factor,
and intervals of drift since the one before. The regressor is over that root too."""
LOOSE = 1e4
"""Variance of each coordinate before the first sample, in units of what least squares leave. A larger one would cost
as many digits of the estimates."""
LOG_RATIOS = (-math.log(math.pi), -1.5 * math.log(2.0), math.log(2.0 / (math.pi * math.sqrt(3.0))))
"""log(gamma((nu + 1) / 2) / gamma(nu / 2) / sqrt(pi nu)) of Student's density, for nu = 1, 2, 3."""


@kernel
def start_density(e: float, s: float, nu: float) -> float:
    """Student's log density of an innovation of the start, which has fewer than `RESIDUALS` before it; NaN for none."""
    ratio = LOG_RATIOS[0] if nu < 1.5 else LOG_RATIOS[1] if nu < 2.5 else LOG_RATIOS[2]
    return ratio - 0.5 * (log(s) + (nu + 1.0) * log(1.0 + e * e / (nu * s)))  # type: ignore[no-any-return]


@kernel
def keep(s: State, l: int) -> None:
    """Store a sample of the start, where those of `driftfit.trackers.parts.mixture.learned` will be."""
    if s.ok[l] > 0.0:
        if s.remembered[l] < WINDOW:
            at, root = s.remembered[l], 1.0 / math.sqrt(s.noise[l])
            for i in range(s.theta.shape[0]):
                s.samples[at, PHI + i, l] = root * s.phi[i, l]
            s.samples[at, Y, l], s.samples[at, SPAN, l] = root * s.y[l], s.waited[l]
        s.remembered[l] += 1
        s.waited[l] = 0.0


@kernel
def forecast_start(s: State, l: int) -> None:
    """Prediction of least squares, and its variance in units of the noise so far."""
    forecast_on_roots(s, l)
    s.s[l] = s.scale[l] * (s.h[l] + s.r[l] * s.noise[l]) if s.h[l] < math.inf else math.inf


@partial(kernel, short=True)
def take_start(s: State, l: int) -> None:
    """A sample of least squares, and its residual if the reading did not repeat the one before."""
    s.waited[l] += s.dt[l] * s.drift[l]
    note_reading(s, l)
    learn_scales(s, l)
    learn_means(s, l)
    learn_information(s, s.noise[l], l)
    absorb_on_roots(s, l)
    if (s.h[l] < math.inf) & (s.repeats[l] < 1.0):
        s.squares[l] += s.ok[l] * s.e[l] * s.e[l] / (s.h[l] + s.r[l] * s.noise[l])
        s.count[l] += s.ok[l]
        s.scale[l] = s.squares[l] / s.count[l]  # NaN until there is a residual
    keep(s, l)


@kernel
def whitened(s: State, at: int, l: int) -> None:
    """x of a stored sample, which is in the span of the columns that are not free."""
    for j in range(s.theta.shape[0]):
        u = s.samples[at, PHI + j, l]
        for i in range(j):
            u -= s.S[i, j, l] * s.x[i, l]
        s.x[j, l] = u / s.S[j, j, l] if s.S[j, j, l] > 0.0 else 0.0


@kernel
def run_again(s: State, l: int) -> None:
    """Every filter over the stored samples, in units of r; sums of squares in ``mu``, of logs in ``prior``."""
    n, K = s.theta.shape[0], s.modes[l]
    for k in range(K):
        s.mu[k, l], s.prior[k, l] = 0.0, 0.0
    for i in range(n):
        for k in range(K):
            s.C[i, i, k, l] *= LOOSE
    for at in range(s.remembered[l]):
        if at > 0:
            wander(s, s.samples[at, SPAN, l], l)
        whitened(s, at, l)
        project(s, l)
        for k in range(K):
            e, v = s.samples[at, Y, l] - s.e_k[k, l], s.h_k[k, l] + 1.0
            s.mu[k, l] += e * e / v
            s.prior[k, l] += log(v)
            s.step[k, l], s.curve[k, l] = e / v, 1.0 / v
        absorb(s, l)


@partial(kernel, short=True)
def begin_with_drift(s: State, least: float, l: int) -> None:
    """Estimates, r, which is at least ``least``, and probabilities of the filters, which have m = d and C = I."""
    n, K, count = s.theta.shape[0], s.modes[l], s.count[l]
    if s.remembered[l] <= WINDOW:
        for k in range(K):
            s.share[0, k, l] = s.mu[k, l]
        run_again(s, l)
        for k in range(K):
            # residuals below the floor of r are rounding, and say nothing about the drift
            s.step[k, l] = max(s.mu[k, l] / count, least)
            s.curve[k, l] = s.prior[k, l] + count * log(s.step[k, l])
            s.row[k, l] = s.curve[k, l]
        nearest = least_of_row(s, l)
        for k in range(K):
            s.row[k, l] = s.share[0, k, l] * exp(-0.5 * (s.curve[k, l] - nearest))
        share = 1.0 / sum_of_row(s, l)
        for k in range(K):
            s.mu[k, l] = s.row[k, l] * share
            s.row[k, l] = s.mu[k, l] * s.step[k, l]
        s.r[l] = sum_of_row(s, l)
    for i in range(n):
        for j in range(i + 1):
            for k in range(K):
                s.C[i, j, k, l] *= s.r[l]
    s.restless[l] = s.r[l]
    s.remembered[l] = 0
