"""The start of the filters: each from generalised least squares with its own drift, on the samples so far.

Least squares without drift determine the coordinates z and their estimate d. When there are residuals, every filter
runs again over the samples so far, from m = d and C = `LOOSE` I in units of r, in which least squares have C = I, so
that next to nothing of this prior is left:

    m_k, C_k,    S_k = sum e_k^2 / s_k,    log p_k = -1/2 sum log s_k - (nu / 2) log S_k

with nu the number of residuals, and p_k Student's density of the samples given the drift of filter k, whatever r. The
filters start with probabilities proportional to p_k, and with r the mean of S_k / nu. Parameters that move from the
first sample on are therefore neither taken for noise nor for estimates that many samples agree on.

Before that the samples are judged together (`driftfit.trackers.parts.faults.first_samples`). If some are fault codes,
least squares, scales and proportions start again without them; until that can be decided, the start continues.

Source: marginal likelihood under an inverse-gamma variance, West and Harrison, Bayesian Forecasting and Dynamic Models
(1997), section 4.5. Cost: O(K n^2) for each sample of the start, once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, exp, kernel, log
from driftfit.trackers.parts.coarse.resolution import learn_resolved_scale, reading, same_reading
from driftfit.trackers.parts.diffuse import know_nothing, take_in
from driftfit.trackers.parts.excitation import learn_information, learn_scales
from driftfit.trackers.parts.faults.first_samples import (
    NOISE,
    PHI,
    RESIDUALS_IN_DOUBT,
    SPAN,
    Y,
    contradict,
    doubtful,
)
from driftfit.trackers.parts.faults.outlying_readings import bound_leverage, learn_proportion
from driftfit.trackers.parts.faults.stored_samples import (
    doubtful_samples,
    recall,
    squares_left,
    store,
    without_fault,
)
from driftfit.trackers.parts.faults.strange_inputs import learn_stored_inputs
from driftfit.trackers.parts.modes.drifts.about_means import forget_mean, learn_means
from driftfit.trackers.parts.modes.filters import absorb, project, wander
from driftfit.trackers.parts.modes.rows import least_of_row, sum_of_row
from driftfit.trackers.parts.modes.weights import WINDOW

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
    """Store a sample of the start, where those of `driftfit.trackers.parts.modes.weights` will be."""
    if s.ok[l] > 0.0:
        if s.remembered[l] < WINDOW:
            store(s, l)
        s.remembered[l] += 1
        s.waited[l] = 0.0


@kernel
def take_first(s: State, l: int) -> None:
    """One sample of least squares, and its residual, with the noise variance s.noise."""
    learn_information(s, s.noise[l], l)
    learn_proportion(s, l, 0.0)
    take_in(s, l)
    if s.s[l] < np.inf:
        learn_resolved_scale(s, l)


@partial(kernel, short=True)
def take_start(s: State, l: int) -> None:
    """A sample of the start."""
    s.waited[l] += s.dt[l] * s.drift[l]
    if s.remembered[l] == 0:
        for i in range(s.theta.shape[0]):
            s.m[i, 0, l] = s.theta[i, l]  # no filter needs it yet
    learn_scales(s, l)
    learn_means(s, l)
    bound_leverage(s, l)  # the drift is in units of scales that such a regressor did not move much either
    noise = s.noise[l]
    s.noise[l] = noise * s.leverage[l]
    take_first(s, l)
    keep(s, l)
    s.noise[l] = noise


@kernel
def forget(s: State, l: int) -> None:
    """As before the first sample, but for the readings that `driftfit.trackers.parts.coarse.resolution` compares."""
    n = s.theta.shape[0]
    for i in range(n):
        s.theta[i, l], s.c[i, l], s.active[i, l] = s.m[i, 0, l], 0.0, 0.0
        forget_mean(s, i, l)
        for j in range(n):
            s.information[i, j, l] = 0.0
    know_nothing(s, l)
    s.squares[l], s.count[l], s.scale[l] = 0.0, 0.0, np.nan
    s.power_samples[l], s.power[l] = 0.0, 0.0
    s.middle[l], s.spread[l], s.readings[l], s.widening[l] = 0.0, 0.0, 0.0, 1.0


@partial(kernel, short=True)
def repeat(s: State, every: bool, l: int) -> float:
    """Repeat least squares, with every sample or without the doubtful ones.

    Returns the sum of squares of the residuals of those that are not doubtful.
    """
    last = np.nan
    forget(s, l)
    for at in range(s.remembered[l]):
        if every or s.samples[at, NOISE, l] > 0.0:
            recall(s, at, l)
            s.fresh[l] = 0.0 if same_reading(s, last, l) else 1.0
            last = reading(s, l)
            learn_scales(s, l)
            learn_means(s, l)
            take_first(s, l)
    return squares_left(s, l)  # type: ignore[no-any-return]


@kernel
def drop(s: State, l: int) -> None:
    """Remove the doubtful samples."""
    rows, columns = s.remembered[l], PHI + s.theta.shape[0]
    left, waited = 0, 0.0
    for at in range(rows):
        waited += s.samples[at, SPAN, l]
        if s.samples[at, NOISE, l] > 0.0:
            for i in range(columns):
                s.samples[left, i, l] = s.samples[at, i, l]
            s.samples[left, SPAN, l] = waited
            left, waited = left + 1, 0.0
    s.waited[l] += waited
    s.left_out[l] += rows - left
    s.remembered[l] = left


@partial(kernel, short=True)
def reconsider(s: State, enough: bool, l: int) -> bool:
    """Whether the filters may start: if there are ``enough`` samples, and `RESIDUALS_IN_DOUBT` if some are doubtful.

    Estimates are those without the doubtful samples before that too, because models compute later regressors with them.
    """
    found, before, rows = 0, 0, s.remembered[l]
    if rows <= WINDOW:
        for at in range(rows):
            before += 1 if s.samples[at, NOISE, l] < 0.0 else 0
        found = doubtful_samples(s, 1, l)
    if found + before == 0:
        return enough
    y, y_hat, e, v, noise, shift = s.y[l], s.y_hat[l], s.e[l], s.s[l], s.noise[l], s.shift[l]
    ok, observed, fresh, leverage = s.ok[l], s.observed[l], s.fresh[l], s.leverage[l]
    s.ok[l], s.observed[l], s.leverage[l] = 1.0, 1.0, 1.0
    alone, residuals = repeat(s, False, l), s.count[l]
    ready = enough and (residuals >= RESIDUALS_IN_DOUBT or found == 0)
    contradicted = found > 0 and contradict(repeat(s, True, l), alone, residuals)
    if contradicted:
        repeat(s, False, l)
    recall(s, rows - 1, l)
    s.y[l], s.y_hat[l], s.e[l], s.s[l], s.noise[l], s.shift[l] = y, y_hat, e, v, noise, shift
    s.ok[l], s.observed[l], s.fresh[l], s.leverage[l] = ok, observed, fresh, leverage
    if contradicted and ok > 0.0:
        without_fault(s, y_hat, l)
    if contradicted and ready:
        drop(s, l)
    return ready


def faults(field: Callable[[str], Any], phi: Array, y: Array, ok: Array) -> Array:
    """Which samples (T,) of the start `reconsider` left out."""
    start = int(np.argmax(field("settled") > 0)) + 1
    rows, found = np.flatnonzero(ok[:start]), np.zeros(len(y), bool)
    if field("left_out")[start - 1] > 0.0:
        found[rows] = doubtful(phi[rows], y[rows], y[rows] + field("shift")[rows])
    return found


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
    """Every filter over the stored samples, in units of r; sums of squares in ``weighted``, of logs in ``mu_next``."""
    n, K = s.theta.shape[0], s.modes[l]
    for k in range(K):
        s.weighted[k, l], s.mu_next[k, l] = 0.0, 0.0
    for i in range(n):
        for k in range(K):
            s.C[i, i, k, l] *= LOOSE
    for at in range(s.remembered[l]):
        if at > 0:
            wander(s, s.samples[at, SPAN, l], l)
        whitened(s, at, l)
        project(s, l)
        for k in range(K):
            e, v = s.samples[at, Y, l] - s.e_k[k, l], s.h_k[k, l] + abs(s.samples[at, NOISE, l])
            s.weighted[k, l] += e * e / v
            s.mu_next[k, l] += log(v)
            s.step[k, l], s.h_k[k, l] = e / v, 1.0 / v
        absorb(s, l)


@partial(kernel, short=True)
def begin_with_drift(s: State, least: float, l: int) -> None:
    """Estimates, r, which is at least ``least``, and probabilities of the filters, which have m = d and C = I; and the
    ranges of the inputs.
    """
    learn_stored_inputs(s, l)
    n, K = s.theta.shape[0], s.modes[l]
    if s.remembered[l] <= WINDOW:
        run_again(s, l)
        for k in range(K):
            # residuals below the floor of r are rounding, and say nothing about the drift
            s.weighted[k, l] = max(s.weighted[k, l] / s.count[l], least)
            s.row[k, l] = s.mu_next[k, l] + s.count[l] * log(s.weighted[k, l])
        nearest = least_of_row(s, l)
        for k in range(K):
            s.row[k, l] = s.mu[k, l] * exp(-0.5 * (s.mu_next[k, l] + s.count[l] * log(s.weighted[k, l]) - nearest))
        share = 1.0 / sum_of_row(s, l)
        for k in range(K):
            s.mu[k, l] = s.row[k, l] * share
            s.row[k, l] = s.mu[k, l] * s.weighted[k, l]
        s.r[l] = sum_of_row(s, l)
    for i in range(n):
        for j in range(i + 1):
            for k in range(K):
                s.C[i, j, k, l] *= s.r[l]
    s.remembered[l] = 0
