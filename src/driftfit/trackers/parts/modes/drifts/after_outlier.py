"""A filter that takes the last outlier for a jump, because only a later sample can tell which of the two it was.

Where a regressor is rarely other than 0, the samples after a jump of its parameter say nothing about the jump, and the
mixture has forgotten the possibility before one does: every response to a pulse would be an outlier for ever. At an
outlier the filter last but one therefore becomes the most probable one, k, with a jump in theta as large as the
innovation, and takes the sample as one with ordinary noise:

    C <- C_k + (e_k^2 - s_k) M diag(w) M' / sum_i w_i phi_i^2,      w_i = 1 / mean phi_i^2

Here the mean is over all samples, so the parameter moves that is seldom excited, which earlier samples have not shown
at its new value. Where regressors are near 0, the jump would be larger than any, and none is supposed. The probability
is that of a jump relative to that of an outlier, JUMP RARE calm / max(OUTLIER, share of outliers so far). The filter is
not mixed with others: samples that confirm the jump make it probable, others make it vanish. Until then another outlier
does not take its place, nor confirm it while it predicts no better than the density of outliers does
(`driftfit.trackers.parts.modes.filters`).

Source: deciding later is as in multiple hypothesis tracking (Reid, 1979); a single such hypothesis beside a mixture is
ours. Cost per sample: O(n), and O(n^3 + J K) at outliers.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import State, kernel
from driftfit.trackers.parts.coarse.resolution import lasting
from driftfit.trackers.parts.modes.drifts.at_rest import CONFIRMED
from driftfit.trackers.parts.modes.ladder import JUMP, RARE, TOP
from driftfit.trackers.parts.modes.noise_levels import OUTLIER, noise_at

REFUTED = 0.001
"""The jump did not happen if the filter is less probable than this share of its first probability."""
USUAL = 0.5
"""Least sum of w_i phi_i^2 at which a jump is supposed."""


def no_jump(n: int) -> dict[str, Any]:
    """Fields before the first sample: the number of outliers, whether a jump waits for a decision, and the variances of
    one that begins now."""
    return {"outliers": 0.0, "pending": 0, "jumped": np.zeros(n)}


@partial(kernel, inline=False)
def begin_filter(s: State, own: int, best: int, share: float, noise: float, l: int) -> None:
    """The filter ``own`` becomes ``best`` with a jump of variances ``jumped``, and has the probability ``share``."""
    n, K = s.theta.shape[0], s.modes[l]
    kept = (1.0 - share) / (1.0 - s.mu[own, l])
    for k in range(K):
        s.mu[k, l] *= kept
    for j in range(s.nu.shape[0]):
        for k in range(K):
            s.joint[j, k, l] *= kept
        s.joint[j, own, l] = 0.0
    s.mu[own, l], s.joint[0, own, l] = share, share
    s.e_k[own, l], s.h_k[own, l] = s.e_k[best, l], s.h_k[best, l]
    for i in range(n):
        s.m[i, own, l], s.gain[i, own, l] = s.m[i, best, l], s.gain[i, best, l]
        for a in range(i + 1):
            s.C[i, a, own, l] = s.C[i, a, best, l]
    for i in range(n):
        s.h_k[own, l] += s.jumped[i, l] * s.white[i, l] * s.white[i, l]
        for a in range(i + 1):
            moved = s.jumped[i, l] * s.S[a, i, l]
            s.gain[a, own, l] += moved * s.white[i, l]
            for b in range(a + 1):
                s.C[a, b, own, l] += moved * s.S[b, i, l]
    s.inverse[0, own, l] = 1.0 / (s.h_k[own, l] + noise)


@partial(kernel, inline=False)
def jump(s: State, own: int, share: float, l: int) -> None:
    """The filter ``own`` becomes the most probable one with a jump, if one of a possible size explains the sample."""
    best, unit = 0, 0.0
    for k in range(s.modes[l]):
        best = k if (s.mu[k, l] > s.mu[best, l]) & (k != TOP) & (k != own) else best
    for i in range(s.theta.shape[0]):
        if s.c[i, l] > 0.0:
            s.jumped[i, l] = s.power_samples[l] / (s.c[i, l] * max(s.active[i, l], 1.0))
            unit += s.jumped[i, l] * s.white[i, l] * s.white[i, l]
    noise = noise_at(s, 1.0, l) + lasting(s, l)
    gained = s.e_k[best, l] * s.e_k[best, l] - s.h_k[best, l] - noise
    begins = (unit > USUAL * s.noise[l]) & (gained > 0.0)
    for i in range(s.theta.shape[0]):
        s.jumped[i, l] *= gained / unit if begins else 0.0
    if begins:
        s.pending[l] = 1
        begin_filter(s, own, best, share, noise, l)


@partial(kernel, inline=False)
def suppose_jump(s: State, l: int) -> None:
    """Begin the filter at an outlier; it takes the sample with the others (`update_filters`)."""
    s.outliers[l] += s.outlier[l]
    rate = (1.0 + s.outliers[l]) / (1.0 / OUTLIER + s.count[l])
    own, share = s.modes[l] - 2, JUMP * RARE * s.calm[l] / max(OUTLIER, rate)
    probable = s.mu[own, l]
    undecided = (s.pending[l] > 0) & (probable > REFUTED * share) & (probable < CONFIRMED)
    s.pending[l] = 1 if undecided else 0
    for i in range(s.theta.shape[0]):
        s.jumped[i, l] = 0.0
    if (s.outlier[l] > 0.5) & (not undecided) & (probable < CONFIRMED):
        jump(s, own, share, l)
