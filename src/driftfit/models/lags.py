"""What the models with lags share: how inputs age, when a record begins, which value an output has as a lag.

With a tracker that marks outliers, lags of outputs may be wrong, and are doubted.

A reading y far from its prediction y_hat is one of two things, and the reading alone does not tell which. Either the
sensor was wrong and the plant did not move (an additive outlier): later samples have the prediction as their lag, with
its variance s. Or the plant moved (an innovation outlier): the lag is the reading. Each lag therefore has a
probability d of the first. Its regressor is the mean, and the doubt adds V to the noise of the sample (field
``vague``):

    phi_i = y + d (y_hat - y),    V = sum_i a_i^2 (d (1 - d) (y_hat - y)^2 + d s)

d begins at p pi, with p the probability of an outlier by the tracker (field ``outlier``) and pi the share of outliers
of this record that were additive, which is estimated. Every later sample with the lag in its regressor changes it,

    d / (1 - d)  <-  d / (1 - d)  f(e_1; s_1) / f(e_0; s_0)

with e_1, s_1 the innovation and its variance if the prediction is the lag, and e_0, s_0 if the reading is. f is a
normal density with the tails of a Cauchy distribution, because another outlier is no evidence. With several outputs, f
is the product over all of them. A lag that was filled because its output is missing has d = 1: it adds its variance.

The covariances of lags with each other and with theta are neglected. The leaves of a `Bank` with additive outliers
decide the same question by hypotheses, and carry the covariance of their lags (`driftfit.bank.leaves.lags`).

Source: additive and innovation outliers are Fox's (1972); deciding between them by later samples is the idea of Chang,
Tiao and Chen (1988); the recursion is ours. Cost per sample: O(na), and O(ny^2 na) for ny outputs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from driftfit.engine.drivers import LARGEST
from driftfit.engine.kernel import State, exp, kernel
from driftfit.models.base import GAP

ADDITIVE_SHARE = 0.3
"""Share of outliers that are taken to be additive before the first one."""
SHARE_COUNT, SHARE_MEMORY = 1.0, 100.0
"""Number of outliers that this share counts for, and over how many it is remembered."""
SMALLEST_DOUBT = 0.02
"""A probability d below this is 0."""
OUTLIER_SHARE = 0.02
"""Probability that a sample is an outlier itself, and no evidence."""


@kernel
def shift_inputs(s: State, m: int, l: int) -> None:
    """Inputs become lags, which a long interval breaks; the present input is lag 0."""
    broken = s.dt[l] > GAP
    for j in range(m):
        for i in range(s.u_lag.shape[1] - 1, 0, -1):
            lag = s.u_lag[j, i - 1, l]
            s.u_lag[j, i, l] = np.nan if broken else lag
        s.u_lag[j, 0, l] = s.u[j, l]


@kernel
def wait_for_lags(s: State, l: int) -> None:
    """No time passes for the tracker until every regressor has been there once: "drop" of `ARX`."""
    before, dt, complete = s.started[l], s.dt[l], 1.0
    for i in range(s.phi.shape[0]):
        complete = complete if abs(s.phi[i, l]) < LARGEST else 0.0
    started = 1.0 if complete > 0.0 else before
    s.started[l] = started
    s.dt[l] = dt if started > 0.0 else 0.0


@kernel
def take_input(s: State, l: int) -> None:
    """`ModelSteps.apply`: the present input is the first of its lags."""
    for j in range(s.u_lag.shape[0]):
        s.u_lag[j, 0, l] = s.u[j, l]


@kernel
def refuse_lag(s: State, signal: int, age: int, l: int) -> None:
    """`ModelSteps.refuse`."""
    s.u_lag[signal, age, l] = np.nan


@kernel
def informed(s: State, l: int) -> bool:
    """Whether the prediction of this sample is one: all regressors were known, and span their directions.

    A prediction of infinite variance carries no information (a diffuse start) and must not become a lag.
    """
    return (s.valid[l] > 0.0) & ((s.s[l] != np.inf) | (s.noise[l] == np.inf))  # type: ignore[no-any-return]


@kernel
def take_output(s: State, na: int, o: int, lane: int, l: int) -> None:
    """Output o, of this lane, is its first lag; where it is missing its prediction, for na samples in a row."""
    y, y_hat, filled, observed = s.y[lane], s.y_hat[lane], s.filled[o, l], s.observed[lane] > 0.0
    known = informed(s, lane) & (filled < na)
    fill = y_hat if known else np.nan
    s.filled[o, l] = 0.0 if observed else filled + 1.0
    if na > 0:
        s.y_lag[o, 0, l] = y if observed else fill


def no_doubts(ny: int, na: int) -> Mapping[str, Any]:
    """Fields for the lags (ny, na) before the first sample."""
    zero = np.zeros((ny, na))
    share = {"false_share": np.full(ny, ADDITIVE_SHARE), "false_count": np.full(ny, SHARE_COUNT)}
    return {"doubt": zero, "suspect": zero, "aside": zero, "blur": zero, **share}


@kernel
def density(e: float, v: float) -> float:
    """Density of an innovation, up to a constant factor."""
    body = (1.0 - OUTLIER_SHARE) * exp(-0.5 * min(e * e / v, 1400.0)) / np.sqrt(2.0 * np.pi * v)
    return body + OUTLIER_SHARE * np.sqrt(v) / (np.pi * (v + e * e))  # type: ignore[no-any-return]


@kernel
def lag_variance(s: State, o: int, i: int, l: int) -> float:
    """Variance of lag i of output o."""
    d, away = s.doubt[o, i, l], s.aside[o, i, l]
    return d * (1.0 - d) * away * away + d * s.blur[o, i, l]  # type: ignore[no-any-return]


@kernel
def doubted(s: State, o: int, i: int, l: int, lag: float) -> float:
    """The mean of lag i of output o, whose reading is ``lag``; its variance is added to that of the noise."""
    k = o * s.doubt.shape[1] + i
    before = s.vague[l] if k > 0 else 0.0
    s.vague[l] = before + s.theta[k, l] * s.theta[k, l] * lag_variance(s, o, i, l)
    return lag + s.doubt[o, i, l] * s.aside[o, i, l]  # type: ignore[no-any-return]


@kernel
def judge(s: State, o: int, i: int, l: int, first: int, step: int, ny: int) -> None:
    """Bayes' rule for lag i of output o, by the innovations of the ny lanes ``first``, first + step, .."""
    d, away, k = s.doubt[o, i, l], s.aside[o, i, l], o * s.doubt.shape[1] + i
    if (d > 0.0) & (d < 1.0):
        wrong, right, own = d, 1.0 - d, lag_variance(s, o, i, l)
        for q in range(ny):
            p = first + q * step
            a = s.theta[k, p]
            if (s.ok[p] > 0.0) & (s.s[p] < np.inf):
                rest = max(s.s[p] - a * a * own, 0.1 * s.s[p])
                wrong *= density(s.e[p] - a * (1.0 - d) * away, rest + a * a * s.blur[o, i, l])
                right *= density(s.e[p] + a * d * away, rest)
        d = wrong / (wrong + right) if wrong + right > 0.0 else d
        s.doubt[o, i, l] = d if d > SMALLEST_DOUBT else 0.0


@kernel
def learn_share(s: State, o: int, l: int, na: int) -> None:
    """The last lag of output o is dropped: which kind of outlier it was counts for later ones."""
    last = na - 1
    p, d, share = s.suspect[o, last, l], s.doubt[o, last, l], s.false_share[o, l]
    if p > 0.0:
        moved = (1.0 - d) * p * (1.0 - share) / (1.0 - p * share)
        s.false_count[o, l] = min(s.false_count[o, l] + d + moved, SHARE_MEMORY)
        s.false_share[o, l] += (d - (d + moved) * share) / s.false_count[o, l]


@kernel
def shift_doubts(s: State, o: int, l: int, own: int, first: int, step: int, ny: int, na: int) -> None:
    """Judge the na lags of output o by this sample, and move them by one.

    ``own`` is the lane of that output; the lanes of all ny outputs are ``first``, first + step, ..
    """
    for i in range(na):
        judge(s, o, i, l, first, step, ny)
    learn_share(s, o, l, na)
    for i in range(na - 1, 0, -1):
        s.doubt[o, i, l], s.suspect[o, i, l] = s.doubt[o, i - 1, l], s.suspect[o, i - 1, l]
        s.aside[o, i, l], s.blur[o, i, l] = s.aside[o, i - 1, l], s.blur[o, i - 1, l]
    outlier, observed, known = s.nu[2, own], s.observed[own] > 0.0, s.s[own] < np.inf
    doubt = s.false_share[o, l] * outlier
    some = observed & known & (doubt > SMALLEST_DOUBT)
    s.suspect[o, 0, l] = outlier if some else 0.0
    s.doubt[o, 0, l] = doubt if some else (0.0 if observed else 1.0)
    s.aside[o, 0, l] = s.y_hat[own] - s.y[own] if some else 0.0
    s.blur[o, 0, l] = s.s[own] if known & (some | (not observed)) else 0.0
