"""Weights of the drift of the single parameters, learned from the scores of the disturbance smoother.

With p_i the independent drift that the mixture assumes for parameter i, in units of r / c_i, and e, 1 / s and k the
innovation, its inverse variance and the gain of the mixture, a backward pass over the last samples gives

    r <- phi e / s + (I - phi k') r,        N <- phi phi' / s + (I - phi k') N (I - k phi')

If the parameters drift by rho instead of p, the mean of r_i^2 - N_ii is sum_j N_ij^2 (rho_j - p_j), so rho is estimated
as the non-negative solution of

    sum_j A_ij rho_j = b_i,    A_ij = sum N_ij^2,    b_i = sum (r_i^2 - N_ii + sum_j N_ij^2 p_j)

whose sums fade. The pass is made every `BLOCK` samples over the last `WINDOW`, and counts the oldest block, for which
later samples show which parameter moved. The second ladder of drift ratios climbs in these proportions, rho_i / max_j
rho_j (`driftfit.trackers.parts.modes.ladder`). The same pass finds the direction in which all parameters may drift
together (`driftfit.trackers.parts.modes.drifts.one_direction`). The drift about the means is not counted in p: it is
none of single parameters, and what its filters explain, these need not explain again.

Source: the smoother and its scores are Koopman and Shephard (1992); solving for all variances together, as data
arrive, is ours. Cost per sample: O(n^2).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, cubes, kernel, machine, shared
from driftfit.trackers.parts.modes.drifts.one_direction import (
    FACTOR,
    TIME,
    B,
    M,
    add_block,
    assume_along,
    take_direction,
    turn,
)
from driftfit.trackers.parts.modes.rows import sum_of_row
from driftfit.trackers.parts.proportion import LEVERAGE

BLOCK, WINDOW = 50, 100
"""Samples between two passes, and samples of a pass."""
FADE = 0.97
"""Factor of the sums at every pass."""
SWEEPS = 20
"""Sweeps over the parameters for the solution."""
FLOOR = 0.001
"""Smallest weight."""
SOUND = 10.0 * WINDOW * LEVERAGE
"""No entry of N is larger: each sample adds at most `LEVERAGE`, and coloured noise four times as much."""
TINY = 1e-300
"""Added to what is divided by."""

E, PRECISION, SPAN, PHI = range(4)
"""Entries of a stored sample before its regressor: the innovation over its variance, the inverse variance (both in
units of r), and the intervals of drift; and where that begins."""
ASSUMED, SLOPE, WEIGHT, ADJOINT, SHIFT, A, N = range(7)
"""Rows (n,) of the estimation: p, b, the weights, r, N k; then the rows of A and of N by turns, so that they are in the
same place for any number of parameters (`driftfit.trackers.parts.common_size`)."""


def no_weights(n: int) -> dict[str, Any]:
    """Fields before the first sample."""
    return {
        "samples": np.zeros((WINDOW, PHI + n)),
        "gains": np.zeros((WINDOW, n)),
        "remembered": 0,
        "scores": np.zeros((A + 2 * n, n)),
        "weight": np.ones(n),
    }


@shared
def step_back(past: Array, gains: Array, at: int, t: Array) -> None:
    """One backward step of r and N."""
    n = t.shape[1]
    move, more = past[at, E], past[at, PRECISION]
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += t[N + 2 * i, j] * gains[at, j]
        t[SHIFT, i] = total
    for i in range(n):
        move -= gains[at, i] * t[ADJOINT, i]
        more += gains[at, i] * t[SHIFT, i]
    for i in range(n):
        x = past[at, PHI + i]
        t[ADJOINT, i] += x * move
        for j in range(i + 1):
            other = past[at, PHI + j]
            t[N + 2 * i, j] += x * other * more - x * t[SHIFT, j] - t[SHIFT, i] * other
            t[N + 2 * j, i] = t[N + 2 * i, j]


@shared
def look_back(past: Array, gains: Array, newest: int, t: Array, moments: Array) -> None:
    """Add the sums of the oldest block."""
    n = t.shape[1]
    moments[TIME, 0] = 0.0
    for i in range(n):
        t[ADJOINT, i] = 0.0
        t[SLOPE, i] *= FADE
        for j in range(n):
            t[N + 2 * i, j] = 0.0
            t[A + 2 * i, j] *= FADE
            moments[B + 3 * i, j] *= FADE
            moments[M + 3 * i, j] *= FADE
            moments[FACTOR + 3 * i, j] = 0.0
    for back in range(WINDOW):
        at = (newest + WINDOW - back) % WINDOW
        step_back(past, gains, at, t)
        if back >= WINDOW - BLOCK:
            span = past[at, SPAN]
            moments[TIME, 0] += span
            for i in range(n):
                t[SLOPE, i] += span * (t[ADJOINT, i] * t[ADJOINT, i] - t[N + 2 * i, i])
                for j in range(n):
                    square = span * span * t[N + 2 * i, j] * t[N + 2 * i, j]
                    t[A + 2 * i, j] += square
                    t[SLOPE, i] += square * t[ASSUMED, j]
                    moments[B + 3 * i, j] += span * (t[ADJOINT, i] * t[ADJOINT, j] - t[N + 2 * i, j])
                    moments[FACTOR + 3 * i, j] += span * t[N + 2 * i, j]


@shared
def forget_rounding(t: Array, moments: Array) -> None:
    """Begin again if N exceeds the information of the samples: regressors differ in their last digits alone."""
    n, sound = t.shape[1], True
    for i in range(n):
        for j in range(n):
            sound = sound and abs(t[N + 2 * i, j]) <= SOUND
    for j in range(0 if sound else n):
        for i in range(t.shape[0]):
            t[i, j] = 0.0
        for i in range(moments.shape[0]):
            moments[i, j] = 0.0


@shared
def solve(t: Array) -> None:
    """Compute the weights from the sums."""
    n = t.shape[1]
    for i in range(n):
        t[WEIGHT, i] = max(t[SLOPE, i], 0.0) / (t[A + 2 * i, i] + TINY)
    for _ in range(SWEEPS):
        for i in range(n):
            rest = t[SLOPE, i]
            for j in range(n):
                rest -= t[A + 2 * i, j] * t[WEIGHT, j]
            t[WEIGHT, i] = max(0.0, t[WEIGHT, i] + rest / (t[A + 2 * i, i] + TINY))
    most = 0.0
    for i in range(n):
        most = max(most, t[WEIGHT, i])
    for i in range(n):
        t[WEIGHT, i] = max(t[WEIGHT, i] / most, FLOOR) if most > 0.0 else 1.0


@partial(machine, short=True)
def machine_weights(past: int, gains: int, newest: int, scores: int, moments: int, n: int, L: int, l: int) -> None:
    """A pass for lane l of L, from the addresses of fields."""
    t, k = cubes(scores, A + 2 * n, n, L)[:, :, l], cubes(gains, WINDOW, n, L)[:, :, l]
    m = cubes(moments, B + 3 * n, n, L)[:, :, l]
    look_back(cubes(past, WINDOW, PHI + n, L)[:, :, l], k, newest, t, m)
    forget_rounding(t, m)
    solve(t)
    add_block(t[ASSUMED], m)
    turn(t[ADJOINT], m)


@kernel
def remember(s: State, at: int, l: int) -> None:
    """Store a sample that the filters used, in units of r and c; s.d is scratch here."""
    n, K = s.theta.shape[0], s.modes[l]
    for k in range(K):
        s.row[k, l] = s.mu[k, l] * s.step[k, l]
    e = sum_of_row(s, l)
    for k in range(K):
        s.row[k, l] = s.mu[k, l] * s.weighted[k, l]
        s.mean_prior[k, l] += (s.prior[k, l] - s.mean_prior[k, l]) / BLOCK
    precision = sum_of_row(s, l)
    for i in range(n):
        for k in range(K):
            s.row[k, l] = s.mu[k, l] * s.weighted[k, l] * s.gain[i, k, l]
        s.d[i, l] = sum_of_row(s, l)
    for i in range(n):
        gain, unit = 0.0, np.sqrt(s.c[i, l])
        for j in range(i, n):
            gain += s.R[i, j, l] * s.d[j, l]
        s.samples[at, PHI + i, l] = s.white[i, l] / unit if unit > 0.0 else 0.0
        s.gains[at, i, l] = gain * unit
    s.samples[at, E, l] = e * np.sqrt(s.r[l])
    s.samples[at, PRECISION, l] = precision * s.r[l]
    s.samples[at, SPAN, l] = s.dt[l] * s.drift[l]


@partial(kernel, short=True)
def end_block(s: State, newest: int, l: int) -> None:
    """A pass over the last samples, and what the filters take from it."""
    n, L = s.d.shape
    for i in range(n):
        for k in range(s.modes[l]):
            s.row[k, l] = s.mean_prior[k, l] * s.ratio[i, k, l]
        s.scores[ASSUMED, i, l] = sum_of_row(s, l)
    assume_along(s, l)
    machine_weights(
        s.samples.ctypes.data, s.gains.ctypes.data, newest, s.scores.ctypes.data, s.moments.ctypes.data, n, L, l
    )
    take_direction(s, l)
    for i in range(n):
        s.weight[i, l] = s.scores[WEIGHT, i, l]
        for k in range(s.modes[l]):
            s.ratio[i, k, l] = s.learned[k, l] * s.weight[i, l] if s.learned[k, l] > 0.0 else s.ratio[i, k, l]


@partial(kernel, inline=False)
def learn_weights(s: State, l: int) -> None:
    """Store a sample, and update the weights and the direction at the end of a block."""
    at = s.remembered[l] % WINDOW
    remember(s, at, l)
    s.remembered[l] += 1
    if s.remembered[l] >= WINDOW and s.remembered[l] % BLOCK == 0:
        end_block(s, at, l)
