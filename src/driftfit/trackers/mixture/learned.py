"""What the bank learns beside theta, and its start: the noise, means of regressors, the covariance of the drift.

With p the joint probabilities of modes and states of the noise after a sample, the mean of v^2 given y,

    E(v^2 | y) = sum p (r - r^2 / s + (r e / s)^2)

is exact, and a noise variance that is learned from it needs no bounds: r is its mean over samples that are no outliers,
with a memory of `MEMORY_OF_R`, and log f follows that of samples that are not quiet, with a memory of `QUICK`. Readings
that repeat tell nothing of r. The probability of outliers is their share.

The drift covariance Q, in units of r / (c_i c_j)^(1/2), is estimated from the scores of the disturbance smoother. With
P the drift that the bank assumes, and e, 1 / s and k the innovation, its inverse variance and the gain of the mixture,
a backward pass over the last samples gives

    u <- phi (e / s - k' u) + u,        N <- phi phi' / s + (I - phi k') N (I - k phi')
    E(u u' - N + N P N) = N Q N

Sums B of the left side, and M of N, that fade from pass to pass, determine the leading direction a of Q, from the
largest l_1 of the l with B a = l M a; sums of the squares of N its diagonal q >= 0, by non-negative least squares. The
bank drifts with (1 - w) diag(q) + w a a', w = l_1 / sum max(l, 0), both of largest entry 1.

Beside an intercept, inputs whose mean is more than three deviations from 0 drift about their means:  U = sum_i d_i d_i'
/ v_i,  d_i = e_i - (m_i / m_k) e_k,  with k the constant column. An input without mean and the same input with an
offset of any size thus have the same drift.

Coloured noise, y_t = phi_t' theta + v_t + c v_(t-1), is taken out by regressors phi* = phi - c phi*_(t-1) and outputs
y - c y*_(t-1); c is estimated by weighted least squares on the derivative of the prediction, bounded and shrunk.

Source: the moments of the noise are those of an EM step, Shumway and Stoffer (1982); scores are Koopman and Shephard's
(1992); recursive maximum likelihood for c is Soderstrom's (1973), see Ljung and Soderstrom (1983), section 3.7; the
estimates from them are ours. Cost per sample: O(n^2); O(n^3) at every `BLOCK`-th.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from driftfit.engine.kernel import Array, State, exp, kernel, log, shared
from driftfit.trackers.forms.coordinates import frame, whiten_within
from driftfit.trackers.forms.covariance import prediction
from driftfit.trackers.forms.diffuse import ENTERING, absorb_on_roots, forecast_on_roots
from driftfit.trackers.forms.excitation import DULL, FIRST, LARGE, MEMORY, learn_information, learn_scales
from driftfit.trackers.mixture.filters import (
    ASSUMED,
    CALM,
    DIRECTION,
    FIRST_ALONE,
    FIRST_LEARNED,
    FLOOR,
    OUTLYING,
    SCORE,
    SHIFT,
    SLOPE,
    STATES,
    STAY,
    WEIGHT,
    A,
    B,
    M,
    N,
    T,
    V,
    enter_filters,
    innovate,
    least_noise,
    repeated_rounding,
    sum_of_row,
    update_filters,
    variance_in,
    weigh,
)

MEMORY_OF_R, QUICK, RARITY, OFTEN = 70.0, 2.0, 50.0, 1000.0
"""Memories of r and f, in samples; samples that the first probability of outliers counts for, and memory of later
ones."""
BLOCK, WINDOW = 20, 40
"""Samples between two passes, and samples of a pass."""
FADE = 0.985
"""Factor of the sums at every pass."""
SWEEPS, ROTATIONS = 30, 6
"""Sweeps over the parameters for the diagonal, and over pairs of them for the eigenvectors."""
ROUNDED = 1e-6
"""Added to the diagonal of M, relative to it."""
E, PRECISION, PHI = range(3)
"""Entries of a stored sample before its regressor: the innovation over its variance, and the inverse variance, both in
units of r."""
COLOUR_FADE, SHRUNK, BOUND, MOST, GAP = 0.995, 5.0, 2.0, 0.95, 1.5
"""Fading of the sums for c; the square of its t value up to which noise is white; the bound of innovations in standard
deviations; the largest c; and the interval that separates a sample from its past."""
LOG_RATIOS = (-math.log(math.pi), -1.5 * math.log(2.0), math.log(2.0 / (math.pi * math.sqrt(3.0))))
"""log(gamma((nu + 1) / 2) / gamma(nu / 2) / sqrt(pi nu)) of Student's density, for nu = 1, 2, 3."""


def nothing_learned(n: int) -> dict[str, Any]:
    """Fields before the first sample."""
    return {
        "mean": np.zeros(n), "variance": np.zeros(n), "moved": np.zeros(n),
        "samples": np.zeros((WINDOW, PHI + 2 * n)), "remembered": 0,
        "sums": np.eye(A + 6 * n, 1, -WEIGHT) * np.ones(n), 
        "white": np.zeros(n), "past": np.zeros(n), "past_y": 0.0, "explained": 0.0, "colour": 0.0, "psi": 0.0,
        "colour_scores": np.zeros(3),
    }  # fmt: skip


@kernel
def noise_prior(s: State, l: int) -> None:
    """Probabilities of the states before the sample."""
    usual = 1.0 - s.nu_prior[OUTLYING, l]
    s.nu_prior[0, l] = usual * (STAY * s.nu[0, l] + (1.0 - CALM) * s.nu[1, l])
    s.nu_prior[1, l] = usual * ((1.0 - STAY) * s.nu[0, l] + CALM * s.nu[1, l])


@partial(kernel, inline=False)
def learn_noise(s: State, l: int) -> None:
    """r and f from the moments of the noise of this sample."""
    K, more = s.modes[l], s.vague[l] + repeated_rounding(s, l)
    usual = s.nu[0, l] / (variance_in(s, 0, l) + more) + s.nu[1, l] / (variance_in(s, 1, l) + more)
    far = max(variance_in(s, OUTLYING, l), s.e[l] * s.e[l]) + more
    s.usual_noise[l] = 1.0 / (s.noise[l] * ((1.0 - s.nu[OUTLYING, l]) * usual + s.nu[OUTLYING, l] / far))
    if s.alike[l] > 0.0:
        return
    ordinary, wild = 0.0, 0.0
    for j in range(STATES):
        least = variance_in(s, j, l)
        widest = np.inf if j == OUTLYING else 0.0
        for k in range(K):
            e2, v = s.e_k[k, l] * s.e_k[k, l], s.inverse[j, k, l]
            own = max(least, min(e2, widest))
            s.row[k, l] = s.joint[j, k, l] * (own * (1.0 - own * v) + own * v * own * v * e2)
        moment = sum_of_row(s, l) / s.noise[l]
        ordinary += moment if j < OUTLYING else 0.0
        wild += moment if j > 0 else 0.0
    s.count[l] += 1.0
    # s.nu counts an outlier for the states that were expected
    away = 1.0 - s.nu[0, l] + s.nu[OUTLYING, l] * s.nu_prior[0, l] / (1.0 - s.nu_prior[OUTLYING, l])
    f = variance_in(s, 1, l) / s.noise[l]
    s.restless[l] = f * exp(away / QUICK * log(wild / (away * f))) if (away > 0.0) & (wild > 0.0) else f
    s.nu_prior[OUTLYING, l] += (s.nu[OUTLYING, l] - s.nu_prior[OUTLYING, l]) / (RARITY + min(s.count[l], OFTEN))
    move = (ordinary / s.r[l] - (1.0 - s.nu[OUTLYING, l])) / min(s.count[l] + 1.0, MEMORY_OF_R)
    s.r[l] = max(s.r[l] * exp(min(1.0, max(-1.0, move))), least_noise(s, l))


@kernel
def learn_means(s: State, l: int) -> None:
    """Means and variances of the regressors, over samples at which they move."""
    for i in range(s.parameters[l]):
        off = s.phi[i, l] - s.mean[i, l]
        own = s.variance[i, l]
        moves = (s.moved[i, l] < 1.0) | (off * off > DULL * own * s.noise[l])
        s.moved[i, l] += s.ok[l] if moves else 0.0
        share = s.ok[l] / min(max(s.moved[i, l], 1.0), MEMORY) if moves else 0.0
        s.mean[i, l] += share * off
        square = off * (s.phi[i, l] - s.mean[i, l]) / s.noise[l]
        most = LARGE * own if s.moved[i, l] > FIRST else np.inf
        s.variance[i, l] += share * (min(square, most) - own)


@kernel
def whiten_noise(s: State, l: int) -> None:
    """The regressor phi* and the known part of y."""
    c = s.colour[l] if s.dt[l] <= GAP else 0.0
    s.explained[l] = c * s.past_y[l]
    for i in range(s.theta.shape[0]):
        s.white[i, l] = s.phi[i, l] - c * s.past[i, l]


@kernel
def learn_colour(s: State, weighed: float, l: int) -> None:
    """Update c, and store the past of the next sample; s.theta is still the prediction. An outlier is no past."""
    c, v = s.colour[l] if s.dt[l] <= GAP else 0.0, s.past_y[l]
    ordinary = weighed * (1.0 - s.nu[OUTLYING, l])
    for i in range(s.theta.shape[0]):
        v -= s.past[i, l] * s.theta[i, l]
        s.past[i, l] = ordinary * s.white[i, l]
    s.past_y[l] = ordinary * (s.y[l] - s.explained[l])
    psi = (v - c * s.psi[l]) if s.dt[l] <= GAP else 0.0
    share = ordinary * min(1.0, s.noise[l] * s.r[l] / s.s[l]) if weighed > 0.0 else 0.0
    weight = share / s.s[l] if share > 0.0 else 0.0
    bound = BOUND * np.sqrt(s.s[l]) if share > 0.0 else 0.0
    slope, e = max(-bound, min(bound, psi)), max(-bound, min(bound, s.e[l])) if share > 0.0 else 0.0
    a = COLOUR_FADE * s.colour_scores[0, l] + weight * slope * slope
    b = COLOUR_FADE * s.colour_scores[1, l] + weight * slope * (e + c * slope)
    v = COLOUR_FADE * s.colour_scores[2, l] + weight * share * slope * slope
    s.colour_scores[0, l], s.colour_scores[1, l], s.colour_scores[2, l] = a, b, v
    s.psi[l] = ordinary * psi
    square = b * b / v if v > 0.0 else 0.0
    known = b / a * (1.0 - SHRUNK / square) if square > SHRUNK else 0.0
    s.colour[l] = max(-MOST, min(MOST, known))


def colour(lane: Mapping[str, Array]) -> tuple[tuple[str, str], ...]:
    """The line of the summary about coloured noise; none where innovations are white."""
    c = float(lane["colour"])
    return (("Coloured noise", f"v + {c:.2g} v of the sample before; the previous innovation is used"),) if c else ()


@shared
def step_back(past: Array, at: int, t: Array) -> None:
    """One backward step of u and N."""
    n = t.shape[1]
    move, more = past[at, E], past[at, PRECISION]
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += t[N + 6 * i, j] * past[at, PHI + n + j]
        t[SHIFT, i] = total
    for i in range(n):
        move -= past[at, PHI + n + i] * t[SCORE, i]
        more += past[at, PHI + n + i] * t[SHIFT, i]
    for i in range(n):
        x = past[at, PHI + i]
        t[SCORE, i] += x * move
        for j in range(i + 1):
            other = past[at, PHI + j]
            t[N + 6 * i, j] += x * other * more - x * t[SHIFT, j] - t[SHIFT, i] * other
            t[N + 6 * j, i] = t[N + 6 * i, j]


@shared
def look_back(past: Array, newest: int, t: Array) -> None:
    """Add the sums of the older half of the window."""
    n = t.shape[1]
    for i in range(n):
        t[SCORE, i] = 0.0
        t[SLOPE, i] *= FADE
        for j in range(n):
            t[A + 6 * i, j] *= FADE
            t[B + 6 * i, j] *= FADE
            t[M + 6 * i, j] *= FADE
            t[N + 6 * i, j], t[T + 6 * i, j] = 0.0, 0.0
    for back in range(WINDOW):
        step_back(past, (newest + WINDOW - back) % WINDOW, t)
        if back >= WINDOW - BLOCK:
            for i in range(n):
                t[SLOPE, i] += t[SCORE, i] * t[SCORE, i] - t[N + 6 * i, i]
                for j in range(n):
                    square = t[N + 6 * i, j] * t[N + 6 * i, j]
                    t[A + 6 * i, j] += square
                    t[SLOPE, i] += square * t[ASSUMED, j]
                    t[B + 6 * i, j] += t[SCORE, i] * t[SCORE, j] - t[N + 6 * i, j]
                    t[T + 6 * i, j] += t[N + 6 * i, j]
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += t[T + 6 * i, k] * t[ASSUMED, k] * t[T + 6 * k, j]
            t[B + 6 * i, j] += total / BLOCK
            t[M + 6 * i, j] += t[T + 6 * i, j]


@shared
def diagonal(t: Array) -> None:
    """q by non-negative least squares, largest entry 1."""
    n, most = t.shape[1], 0.0
    for i in range(n):
        t[WEIGHT, i] = 0.0
    for _ in range(SWEEPS):
        for i in range(n):
            rest = t[SLOPE, i]
            for j in range(n):
                rest -= t[A + 6 * i, j] * t[WEIGHT, j]
            t[WEIGHT, i] = max(0.0, t[WEIGHT, i] + rest / (t[A + 6 * i, i] + 1e-300))
    for i in range(n):
        most = max(most, t[WEIGHT, i])
    for i in range(n):
        t[WEIGHT, i] = t[WEIGHT, i] / most if (most > 0.0) & (most < np.inf) else 1.0


@shared
def whitened(t: Array) -> None:
    """N <- L^-1 B L^-T with L L' = M, in the unit of M's diagonal; T <- L."""
    n = t.shape[1]
    for j in range(n):
        for i in range(j, n):
            left = t[M + 6 * i, j] * (1.0 + ROUNDED if i == j else 1.0)
            for k in range(j):
                left -= t[T + 6 * i, k] * t[T + 6 * j, k]
            if i == j:
                t[T + 6 * j, j] = np.sqrt(left) if left > 0.0 else 0.0
            else:
                t[T + 6 * i, j] = left / t[T + 6 * j, j] if t[T + 6 * j, j] > 0.0 else 0.0
    for i in range(n):
        for j in range(n):
            t[N + 6 * i, j] = t[B + 6 * i, j]
    for side in range(2):
        for c in range(n):
            for i in range(n):
                total = t[N + 6 * i, c] if side == 0 else t[N + 6 * c, i]
                for k in range(i):
                    total -= t[T + 6 * i, k] * (t[N + 6 * k, c] if side == 0 else t[N + 6 * c, k])
                total = total / t[T + 6 * i, i] if t[T + 6 * i, i] > 0.0 else 0.0
                if side == 0:
                    t[N + 6 * i, c] = total
                else:
                    t[N + 6 * c, i] = total


@shared
def rotate(t: Array, p: int, q: int) -> None:
    """One rotation of Jacobi's, after which N_pq is 0; V collects them."""
    n, off = t.shape[1], t[N + 6 * p, q]
    if off * off <= 1e-30 * abs(t[N + 6 * p, p] * t[N + 6 * q, q]):
        return
    ratio = 0.6 * (t[N + 6 * q, q] - t[N + 6 * p, p]) / off
    tangent = (1.0 if ratio >= 0.0 else -1.0) / (abs(ratio) + np.sqrt(1.0 + ratio * ratio))
    cosine = 1.0 / np.sqrt(1.0 + tangent * tangent)
    sine = tangent * cosine
    for k in range(n):
        u, v = t[N + 6 * k, p], t[N + 6 * k, q]
        t[N + 6 * k, p], t[N + 6 * k, q] = cosine * u - sine * v, sine * u + cosine * v
    for k in range(n):
        u, v = t[N + 6 * p, k], t[N + 6 * q, k]
        t[N + 6 * p, k], t[N + 6 * q, k] = cosine * u - sine * v, sine * u + cosine * v
        u, v = t[V + 6 * k, p], t[V + 6 * k, q]
        t[V + 6 * k, p], t[V + 6 * k, q] = cosine * u - sine * v, sine * u + cosine * v


@shared
def turn(t: Array) -> None:
    """The leading direction a, and its share of the positive eigenvalues."""
    n, best, positive, largest = t.shape[1], 0, 0.0, 0.0
    for i in range(n):
        for j in range(n):
            t[V + 6 * i, j] = 1.0 if i == j else 0.0
    for _ in range(ROTATIONS):
        for p in range(n):
            for q in range(p + 1, n):
                rotate(t, p, q)
    for i in range(n):
        positive += max(t[N + 6 * i, i], 0.0)
        best = i if t[N + 6 * i, i] > t[N + 6 * best, best] else best
    for back in range(n):
        i = n - 1 - back
        total = t[V + 6 * i, best]
        for k in range(i + 1, n):
            total -= t[T + 6 * k, i] * t[DIRECTION, k]
        t[DIRECTION, i] = total / t[T + 6 * i, i] if t[T + 6 * i, i] > 0.0 else 0.0
        largest = max(largest, abs(t[DIRECTION, i]))
    sound = (t[N + 6 * best, best] > 0.0) & (positive < np.inf) & (largest > 0.0) & (largest < np.inf)
    share = t[N + 6 * best, best] / positive if sound else 0.0
    for i in range(n):
        t[DIRECTION, i] = np.sqrt(share) * t[DIRECTION, i] / largest if sound else 0.0
        t[WEIGHT, i] *= 1.0 - share


@partial(kernel, inline=False)
def remember(s: State, at: int, l: int) -> None:
    """Store a sample that the filters used, in units of r and c."""
    n, K = s.parameters[l], s.modes[l]
    for k in range(K):
        a = s.joint[0, k, l] * s.inverse[0, k, l] + s.joint[1, k, l] * s.inverse[1, k, l]
        s.curve[k, l] = s.row[k, l] = a + s.joint[2, k, l] * s.inverse[2, k, l]
    s.samples[at, PRECISION, l] = sum_of_row(s, l) * s.r[l]
    for k in range(K):
        s.row[k, l] = s.curve[k, l] * s.e_k[k, l]
    s.samples[at, E, l] = sum_of_row(s, l) * np.sqrt(s.r[l])
    for i in range(n):
        for k in range(K):
            s.row[k, l] = s.curve[k, l] * s.gain[i, k, l]
        s.away[0, i, l] = sum_of_row(s, l)
    for i in range(n):
        gain, unit = 0.0, np.sqrt(s.c[i, l])
        for j in range(i, n):
            gain += s.R[i, j, l] * s.away[0, j, l]
        s.samples[at, PHI + i, l] = s.white[i, l] / unit if unit > 0.0 else 0.0
        s.samples[at, PHI + s.theta.shape[0] + i, l] = gain * unit
    together = 0.0
    for k in range(FIRST_LEARNED):
        together += s.mu[k, l] * s.ratio[k, l] if s.ratio[k, l] < 1.0 else 0.0
    scaled = 0.0
    for k in range(FIRST_LEARNED, FIRST_ALONE):
        scaled += s.mu[k, l] * s.ratio[k, l] if s.ratio[k, l] < 1.0 else 0.0
    for i in range(n):
        own = together + scaled * (s.sums[WEIGHT, i, l] + FLOOR + s.sums[DIRECTION, i, l] * s.sums[DIRECTION, i, l])
        for k in range(s.alone[0, i, l], s.alone[1, i, l]):
            own += s.mu[k, l] * s.ratio[k, l] if s.ratio[k, l] < 1.0 else 0.0
        s.sums[ASSUMED, i, l] = own / BLOCK + (s.sums[ASSUMED, i, l] if s.remembered[l] % BLOCK > 0 else 0.0)


@partial(kernel, inline=False)
def learn_drift(s: State, l: int) -> None:
    """Store a sample, and update the drift covariance at the end of a block."""
    at = s.remembered[l] % WINDOW
    remember(s, at, l)
    s.remembered[l] += 1
    if s.remembered[l] % BLOCK == 0 and s.remembered[l] >= WINDOW:
        t = s.sums[:, :, l]
        look_back(s.samples[:, :, l], at, t)
        diagonal(t)
        whitened(t)
        turn(t)


@kernel
def start_density(e: float, s: float, nu: float) -> float:
    """Student's log density of an innovation of the start, which has fewer than `RESIDUALS` before it; NaN for none."""
    ratio = LOG_RATIOS[0] if nu < 1.5 else LOG_RATIOS[1] if nu < 2.5 else LOG_RATIOS[2]
    return ratio - 0.5 * (log(s) + (nu + 1.0) * log(1.0 + e * e / (nu * s)))  # type: ignore[no-any-return]


@kernel
def forecast_start(s: State, l: int) -> None:
    """Prediction of least squares, and its variance in units of the noise so far."""
    forecast_on_roots(s, l)
    s.s[l] = s.scale[l] * (s.h[l] + s.r[l] * s.noise[l]) if s.h[l] < math.inf else math.inf


@partial(kernel, short=True)
def take_start(s: State, l: int) -> None:
    """A sample of least squares, and its residual if the reading did not repeat the one before."""
    learn_scales(s, l)
    learn_means(s, l)
    learn_information(s, s.noise[l], l)
    absorb_on_roots(s, l)
    if (s.h[l] < math.inf) & (s.alike[l] < 1.0):
        sum_before = s.scale[l] * s.count[l] if s.count[l] > 0.0 else 0.0
        s.count[l] += s.ok[l]  # the scale is NaN until there is a residual
        s.scale[l] = (sum_before + s.ok[l] * s.e[l] * s.e[l] / (s.h[l] + s.r[l] * s.noise[l])) / s.count[l]
    s.remembered[l] += int(s.ok[l])


@partial(kernel, short=True)
def settle(s: State, l: int) -> None:
    """Start the filters from least squares once there are residuals to estimate r: z = M theta ~ N(d, r I)."""
    s.r[l] = max(s.scale[l], least_noise(s, l))
    s.scale[l] = 1.0
    for i in range(s.theta.shape[0]):
        for k in range(s.modes[l]):
            s.m[i, k, l] = s.d[i, l]
            s.C[i, i, k, l] = s.r[l] if s.S[i, i, l] > 0.0 else 0.0
    frame(s, l)
    s.restless[l], s.usual_noise[l], s.remembered[l] = s.r[l], s.r[l], 0


@partial(kernel, inline=False)
def look_ahead(s: State, l: int) -> None:
    """Prediction of the filters, and its variance; x, and the column by which the regressor leaves the span, or -1."""
    frame(s, l)
    whiten_noise(s, l)
    column = whiten_within(s, s.white[:, l], l)
    noise_prior(s, l)
    innovate(s, l)
    if column >= 0:
        s.y_hat[l] = prediction(s, l)
        s.e[l], s.s[l] = s.y[l] - s.y_hat[l], np.inf


@partial(kernel, inline=False)
def follow(s: State, l: int) -> None:
    """One sample of the running filters."""
    s.nu[OUTLYING, l], s.usual_noise[l], weighed = 0.0, s.r[l], 0.0
    column = int(s.at_start[ENTERING, l])
    if s.ok[l] > 0.0 and column >= 0:
        enter_filters(s, column, l)
    elif s.ok[l] > 0.0:
        weighed = 1.0
        weigh(s, repeated_rounding(s, l), l)
        update_filters(s, l)
        learn_drift(s, l)
        learn_noise(s, l)
    learn_colour(s, weighed, l)
    learn_scales(s, l)
    learn_means(s, l)
    learn_information(s, s.noise[l], l)
