"""The frozen model of a reference as the compiled routines take it, and the scores of a sample.

    e_t = y_t - phi_t' theta,                 theta of the reference, frozen; phi about the means of the reference
    w_t = e_t - sum_k a_k e_(t-k)             the noise of the reference was an autoregression; phi in the same way
    x_t = w_t / (scale sqrt(h_t))             h_(t+1) = 1 - alpha - beta + alpha h_t g_t^2 / v + beta h_t
    g_t = x_t clipped at +-clip               score; E g^2 = v, var g^2 = kappa, E dg/dx = k in the reference

A regressor that is far from zero in the reference, or constant, is taken about its mean, as a multiple of the constant
regressor: a slope about the mean does not move the level, so that the two can be told apart.

Where the reference knows little of a direction that a sample excites, as of an input that hardly moved, much of x may
be the error of theta, with the variance phi' C phi in units of the noise. From `UNSURE` on (and from `USUAL` n / N on,
which rows of the reference seldom exceed), a sample corrects theta as a Kalman filter without drift does, until that
variance is n / N, the mean of the N rows of the reference: its error is then divided by its standard deviation, and
judges as any other, but not the noise while the variance is that large. Lags of y do not count in phi, since a fault
moves them. Where nothing is known, as of an input that was 0 or constant, a sample corrects theta as from a diffuse
start and judges nothing. Where an error has more than `CREDIBLE` deviations, or the tracker blames the inputs, the
sample corrects nothing: its error, over its standard deviation, judges with regressors shortened to leverage 1 / N,
that of rows along one direction, so that no reading of an input, however large, counts more than a reading of y. One
false reading of an input comes alone. Therefore a sample beyond the reference corrects theta only if there was another
among the `AGAIN` before, and one with such an error, or blamed, judges only then, and not while the first may be one of
its lags. Other samples that correct nothing are not judged above `UNKNOWN`.

A sample that cannot be used is passed over. Where lags of the autoregression are missing, a Kalman filter predicts
them, [phi, e] together so that a change of theta shows in the same way, and w_t is divided by the standard deviation of
its prediction; at the beginning all lags have the covariance of the process.
Source: Huber (1964) for the score, Bollerslev (1986) for h, Koopman and Durbin (2003) for the diffuse start, Jones
(1980) for lags that are missing.
Cost per sample: O(n^2 + p n).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from driftfit.engine.drivers import LARGEST, SMALLEST
from driftfit.engine.kernel import Array, kernel, part
from driftfit.models.base import GAP

LEVELS, BLOCKS, SHORT = 6, 12, 8
"""Levels of blocks of 1, 2, 4, .. samples; blocks that each keeps; blocks of the shorter window."""
LENGTHS = tuple(blocks << level for level in range(LEVELS) for blocks in (SHORT, BLOCKS))
"""Samples L of the windows: 8, 12, 16, 24, .., 384."""
SHORTER = tuple(float(np.log(LENGTHS[-1] / L)) for L in LENGTHS)
"""log(longest / L) of the windows."""
LONG_GAP = 100.0
"""At most so many are predicted: later ones hardly differ."""
ROOT = 0.999
"""The largest root of an autoregression whose lags are predicted."""
FLAT = 1e-9
SAME = 1e-6
"""A regressor that differs by less than this share from what it was in the whole reference has not changed."""
UNSURE, USUAL, UNKNOWN, HUGE = 0.05, 8.0, 1.0, 1e200
"""Variances of a prediction by theta, as shares of that of the noise: from UNSURE on (and from USUAL times the mean of
the reference on, which rows of the reference seldom exceed) a sample may correct theta, and does not judge the noise;
from UNKNOWN on it judges nothing if it cannot correct theta; from HUGE on squares may overflow.
"""
CREDIBLE = 3.0
"""Standard deviations up to which an error corrects theta: false readings of an input have larger ones."""
AGAIN = 8.0
"""Samples for which one that is beyond the reference, or blamed, is remembered."""
ROW = ("y", "ok", "noise", "dt")
Y, OK, NOISE_FACTOR, INTERVAL = range(4)
"""Columns of a row after its regressors, by the names of the fields of a tile, and by their places."""
BLAMED = 0.5
"""`OK` of a sample whose inputs the tracker blames: it is judged, but is no lag and corrects nothing."""
NOTHING, UNLIKE, JUDGED = range(3)
"""What a row is good for: nothing, as it cannot be used, or as it is unlike the reference; or it is judged."""
WIDE = 30.0
"""Scales from which on a residual is a fault code, and no lag."""
SCALE, CLIP, K, V, KAPPA, ALPHA, BETA, INSIDE, RAW, SPREAD, LONGEST, NORMAL, CONSTANT, EVEN = range(14)
"""Entries of `Frozen.numbers`. INSIDE is the mean of x^2 where x is not clipped and 0 elsewhere, RAW and SPREAD are the
mean and variance of x^2, LONGEST is the longest window that judges the noise, NORMAL the size of the reference,
CONSTANT the index of the regressor that the others are centred on, EVEN how evenly windows of all lengths share the
false alarms, from 0 (all have the same limit) to 1.
"""
NUMBERS = EVEN + 1
SINCE, LEVEL, COUNT = range(3)
"""Entries of `Memory.counts`: usable samples in a row, h, samples that were used."""
ONE, JOINT, NOISE, WHICH, SIZE, STD, LENGTH, INSTEAD = range(8)
"""Entries of the findings of a sample: the statistics, and the change that explains the last samples best."""
FINDINGS = INSTEAD + 1
KEPT = LENGTHS[-1]
"""Samples in which the beginning of a change is searched."""
LEARNED, COVARIANCE = 0, 1
"""Rows of `Memory.known`."""


class Frozen(NamedTuple):
    """The reference model as the compiled routines take it; regressors are in units of ``unit``."""

    theta: Array
    unit: Array
    ar: Array
    cov: Array
    numbers: Array
    unseen: Array = np.zeros((0, 0))
    """(k, n): directions of the regressors in which the reference has none, such as that of an input that was 0."""
    mean: Array = np.zeros(0)
    """(n,): regressors in the reference as multiples of the constant, 0 if they moved about zero; none if all did."""
    lag: Array = np.zeros(0)
    """(n,): 1 for regressors that are earlier outputs, which a fault moves, and 0 for inputs."""
    ends: Array = np.full(3, np.inf)
    """(3,): statistics above which it is told what changed."""


class Memory(NamedTuple):
    """The state: lags, block sums, the statistics of every window, counts, and the sums and findings of the last
    sample; ``work`` is scratch.
    """

    past: Array
    sums: Array
    last: Array
    counts: Array
    work: Array
    sample: Array
    findings: Array
    recent: Array
    """(KEPT, n + 1): regressors and residuals of the last samples."""
    best: Array
    """(8, n + 1): scratch, what a change of each parameter and of the noise explains."""
    known: Array
    """(n + 2, n): row LEARNED is how far theta is from that of the reference; n rows from COVARIANCE on are its
    covariance C, which has no part in ``unknown``; and the last row begins with the result of `noted`.
    """
    unknown: Array
    """(k, n): what is left of `Frozen.unseen`, as no row after the reference has excited it either."""
    lags: Array
    """(p + 1, p): covariance of the errors of the lags ``past``, in units of the variance of w, read while fewer than p
    samples in a row were usable, at first that of the process; the last row is scratch.
    """


def memory_of(frozen: Frozen) -> Memory:
    """The state before the first sample."""
    n, p = len(frozen.theta), len(frozen.ar)
    last, sums = np.full((LEVELS, 2, 3), np.nan), np.zeros((LEVELS, BLOCKS, size_of(n)))
    work = np.zeros((2 * n + 5, size_of(n)))
    counts, findings = np.array([0.0, 1.0, 0.0]), np.full(FINDINGS, np.nan)
    excited = np.eye(n) - frozen.unseen.T @ frozen.unseen
    known = np.vstack([np.zeros((1, n)), excited @ frozen.cov @ excited, np.zeros((1, n))])
    unknown, lags = frozen.unseen.copy(), np.vstack([stationary(frozen.ar), np.zeros((1, p))])
    past, recent, best = np.zeros((p + 1, n + 1)), np.zeros((KEPT, n + 1)), np.zeros((8, n + 1))
    return Memory(past, sums, last, counts, work, np.zeros(size_of(n)), findings, recent, best, known, unknown, lags)


def stable(ar: Array) -> Array:
    """An autoregression (p,) whose roots are at most at `ROOT`."""
    p = len(ar)
    A = np.eye(p, k=1)
    A[p - 1 :] = ar[::-1]
    largest = np.max(np.abs(np.linalg.eigvals(A)), initial=ROOT)
    return np.asarray(ar * (ROOT / largest) ** np.arange(1, p + 1))


def stationary(ar: Array) -> Array:
    """Covariance (p, p) of p successive values of an autoregression whose innovations have the variance 1, `stable`."""
    p = len(ar)
    A, noise = np.eye(p, k=1), np.zeros((p, p))
    A[p - 1 :], noise[p - 1 :, p - 1 :] = stable(ar)[::-1], 1.0
    return np.linalg.solve(np.eye(p * p) - np.kron(A, A), noise.ravel()).reshape(p, p)


def size_of(n: int) -> int:
    """Numbers in the sums of a block: S, Q and the lower triangle of G."""
    return n + 1 + n * (n + 1) // 2


def judgeable(fields: Any, lane: int, y: Array, noise: Array) -> Array:
    """`OK` of samples (T,): 1 for those that the tracker used, and complete ones whose reading y a gate refused;
    `BLAMED` for those whose inputs it blames; 0 for those that cannot be judged.

    A gate refuses readings that contradict all before, or repeat the last one, since the tracker would lose its
    estimate. An alarm that left them out would never report a sensor that fails again and again; its scores are
    bounded. Where a model has no reading, y is -0, and none is left.
    """
    ok, valid, observed = (fields[name][..., lane] > 0.0 for name in ("ok", "valid", "observed"))
    refused = (fields["y"][..., lane] == 0.0) & np.signbit(fields["y"][..., lane])
    given = valid & (np.abs(y) < LARGEST) & (noise < np.inf) & ~refused
    return np.where(ok, 1.0, np.where(given, np.where(observed, BLAMED, 1.0), 0.0))


@kernel
def through_zero(frozen: Frozen, j: int, constant: int) -> tuple[float, float]:
    """(a, b): a step of the slope j through zero moves that about the mean by a, and the level by b; both in units."""
    own, level = frozen.unit[j], frozen.mean[j] * frozen.unit[constant]
    size = np.sqrt(own * own + level * level)
    return own / size, level / size


@part
def leverage(phi: Array, cov: Array, lag: Array) -> float:
    """phi' C phi without lags: the variance of the prediction by theta, as a share of that of the noise."""
    total = 0.0
    for i in range(lag.shape[0]):
        for j in range(i):
            total += 2.0 * cov[i, j] * phi[i] * phi[j] * (1.0 - lag[i]) * (1.0 - lag[j])
        total += cov[i, i] * phi[i] * phi[i] * (1.0 - lag[i])
    return total


@part
def correct(phi: Array, x: float, noise: float, gain: Array, known: Array) -> None:
    """theta + K x, and (I - K phi') C (I - K phi')' + K noise K' with K = gain[0], which no size of C makes negative
    (Joseph's form); gain[1] is scratch.
    """
    n = known.shape[1]
    for j in range(n):
        gain[1, j] = 0.0
        for i in range(n):
            gain[1, j] += phi[i] * known[COVARIANCE + i, j]
    for i in range(n):
        known[LEARNED, i] += gain[0, i] * x
        for j in range(n):
            known[COVARIANCE + i, j] -= gain[0, i] * gain[1, j]
    for i in range(n):
        gain[1, i] = 0.0
        for j in range(n):
            gain[1, i] += known[COVARIANCE + i, j] * phi[j]
    for i in range(n):
        for j in range(i + 1):
            value = known[COVARIANCE + i, j] - gain[1, i] * gain[0, j] + noise * gain[0, i] * gain[0, j]
            known[COVARIANCE + i, j] = known[COVARIANCE + j, i] = value


@part
def learn(phi: Array, x: float, h: float, frozen: Frozen, known: Array, gain: Array) -> None:
    """Correct theta by the error x of a prediction of variance h, as a Kalman filter does; gain (2, n) is scratch."""
    n, noise = frozen.theta.shape[0], frozen.numbers[V] / frozen.numbers[K] ** 2
    for i in range(n):
        gain[0, i] = 0.0
        for j in range(n):
            gain[0, i] += known[COVARIANCE + i, j] * phi[j] / (noise + h)
    correct(phi, x, noise, gain, known)


@part
def discover(phi: Array, x: float, frozen: Frozen, memory: Memory, gain: Array) -> None:
    """Correct theta along the directions D of which nothing was known, with the gain of an exact diffuse start,
    D'c / c'c with c = D phi; then D <- (I - c c' / c'c) D. gain (2, n) is scratch.
    """
    n, noise, unknown = frozen.theta.shape[0], frozen.numbers[V] / frozen.numbers[K] ** 2, memory.unknown
    c, size = gain[1], 0.0
    for m in range(unknown.shape[0]):
        c[m] = 0.0
        for j in range(n):
            c[m] += unknown[m, j] * phi[j]
        size += c[m] * c[m]
    for j in range(n):
        gain[0, j] = 0.0
        for m in range(unknown.shape[0]):
            gain[0, j] += unknown[m, j] * (c[m] / size)
    for m in range(unknown.shape[0]):
        left = 0.0
        for j in range(n):
            unknown[m, j] -= c[m] * gain[0, j]
            left += unknown[m, j] * unknown[m, j]
        for j in range(n):
            unknown[m, j] *= 1.0 if left > FLAT * FLAT else 0.0
    correct(phi, x, noise, gain, memory.known)


@part
def enter_scores(phi: Array, g: float, sample: Array) -> None:
    """The sums of a single sample: phi g, g^2, phi phi'."""
    n, at = phi.shape[0], phi.shape[0] + 1
    for i in range(n):
        sample[i] = phi[i] * g
        for j in range(i + 1):
            sample[at] = phi[i] * phi[j]
            at += 1
    sample[n] = g * g


@part
def outside(phi: Array, unseen: Array) -> bool:
    """Whether a row excites a direction that the reference did not, beyond the rounding of its terms."""
    for i in range(unseen.shape[0]):
        total, size = 0.0, 0.0
        for j in range(unseen.shape[1]):
            term = unseen[i, j] * phi[j]
            total, size = total + term, size + abs(term)
        if abs(total) > max(SAME * size, SMALLEST):
            return True
    return False


@part
def error_of_prediction(ar: Array, memory: Memory) -> float:
    """Variance of the error that the lags leave in a prediction; lags[p] are its covariances with theirs."""
    lags, p = memory.lags, ar.shape[0]
    total = 0.0
    for lag in range(p):
        lags[p, lag] = 0.0
        for k in range(p):
            lags[p, lag] += lags[lag, k] * ar[p - 1 - k]
        total += lags[p, lag] * ar[p - 1 - lag]
    return total


@part
def shift_errors(memory: Memory, p: int, newest: float) -> None:
    """The covariance of the lags a sample later, whose error has the variance ``newest``, and with them lags[p]."""
    lags = memory.lags
    for lag in range(p - 1):
        for k in range(p - 1):
            lags[lag, k] = lags[lag + 1, k + 1]
    for lag in range(p - 1):
        lags[lag, p - 1] = lags[p - 1, lag] = lags[p, lag + 1]
    lags[p - 1, p - 1] = newest


@part
def predict_lag(ar: Array, memory: Memory, n: int) -> None:
    """Enter the prediction of a missing sample as its lag."""
    past, lags, p = memory.past, memory.lags, ar.shape[0]
    if p == 0:
        return
    if memory.counts[SINCE] >= p:
        for lag in range(p):
            for k in range(p):
                lags[lag, k] = 0.0
    memory.counts[SINCE] = 0.0
    for i in range(n + 1):
        past[p, i] = 0.0
        for lag in range(p):
            past[p, i] += ar[lag] * past[p - 1 - lag, i]
        for lag in range(p):
            past[lag, i] = past[lag + 1, i]
    shift_errors(memory, p, error_of_prediction(ar, memory) + 1.0)


@part
def observe_lags(ar: Array, memory: Memory, innovation: Array, n: int) -> float:
    """Correct the lags by the ``innovation`` [phi, w] of a sample; returns the variance of w."""
    past, lags, p = memory.past, memory.lags, ar.shape[0]
    s: float = 1.0 + error_of_prediction(ar, memory)
    for lag in range(p):
        gain = lags[p, lag] / s
        for i in range(n + 1):
            past[lag, i] += gain * innovation[i]
        for k in range(p):
            lags[lag, k] -= gain * lags[p, k]
    for lag in range(p):
        lags[p, lag] = 0.0  # the sample itself is known
    shift_errors(memory, p, 0.0)
    return s


@part
def whiten(row: Array, frozen: Frozen, memory: Memory) -> float:
    """[phi, x] of a row into memory.work[0]; returns the limit of x, 0 if it cannot be used.

    x is limited to `WIDE`, or to twice the last e, so that one outlier does not count more.
    """
    n, p = frozen.theta.shape[0], frozen.ar.shape[0]
    past, counts, numbers, phi = memory.past, memory.counts, frozen.numbers, memory.work[0]
    if not row[n + INTERVAL] > 0.0:
        return 0.0
    if row[n + INTERVAL] > GAP:
        for _ in range(int(min(row[n + INTERVAL] - 0.5, LONG_GAP))):
            predict_lag(frozen.ar, memory, n)
    if not row[n + OK] > 0.0:
        predict_lag(frozen.ar, memory, n)
        return 0.0
    # residual and centred regressors, scaled to the noise variance of weight 1
    root, before, centred = 1.0 / np.sqrt(row[n + NOISE_FACTOR]), abs(past[p, n]), frozen.mean.shape[0] > 0
    e, level = row[n + Y], row[int(numbers[CONSTANT])] if centred else 0.0
    for i in range(n):
        own = row[i]
        if centred and frozen.mean[i] != 0.0:
            own -= frozen.mean[i] * level
            own = 0.0 if abs(own) <= FLAT * abs(row[i]) else own
        e -= own * frozen.theta[i]
        past[p, i] = own * root / frozen.unit[i]
    past[p, n] = e * root
    # whitened by the autoregression, and divided by the present standard deviation
    for i in range(n + 1):
        phi[i] = past[p, i]
        for lag in range(p):
            phi[i] -= frozen.ar[lag] * past[p - 1 - lag, i]
    level = np.sqrt(counts[LEVEL])
    trusted = row[n + OK] > BLAMED
    if trusted and counts[SINCE] < p and abs(phi[n]) <= WIDE * numbers[SCALE] * level:
        level *= np.sqrt(observe_lags(frozen.ar, memory, phi, n))
    scale = numbers[SCALE] * level
    for i in range(n + 1):
        phi[i] /= level if i < n else scale
    limit: float = max(WIDE, 2.0 * before / scale)
    if abs(phi[n]) > WIDE or not trusted:  # a fault code is no lag, but the limit of the next sample
        last = past[p, n]
        predict_lag(frozen.ar, memory, n)
        past[p, n] = last
        return limit
    for lag in range(p):
        for i in range(n + 1):
            past[lag, i] = past[lag + 1, i]
    counts[SINCE] += 1.0
    return limit


@part
def noted(left: float, strange: bool, n: int) -> float:
    """How long the last strange sample is still remembered, one sample later.

    Above AGAIN it may be a lag of the next, for n samples after the first.
    """
    if not strange:
        return max(left - 1.0, 0.0)
    return AGAIN if 0.0 < left <= AGAIN else (AGAIN + n if left <= 0.0 else left - 1.0)


@part
def enter_row(row: Array, frozen: Frozen, memory: Memory) -> int:
    """Scores of a row into memory.sample, and [phi, x] into memory.recent; what it is good for."""
    n, numbers, known = frozen.theta.shape[0], frozen.numbers, memory.known
    phi, scratch = memory.work[0], memory.work[1:3]
    wide = whiten(row, frozen, memory)
    if not wide > 0.0:
        return NOTHING
    reference, x = leverage(phi, frozen.cov, frozen.lag), phi[n]
    if not reference < HUGE:
        return UNLIKE
    if outside(phi, frozen.unseen):
        reference = np.inf
    for i in range(n):
        x -= phi[i] * known[LEARNED, i]
    clip, least, blamed = numbers[CLIP], max(UNSURE, USUAL * n / numbers[NORMAL]), row[n + OK] <= BLAMED
    # the variance can only have become smaller since the reference
    h = reference if reference <= least else leverage(phi, known[COVARIANCE : COVARIANCE + n], frozen.lag)
    sure, root = h <= least, np.sqrt(1.0 + h * numbers[K] * numbers[K] / numbers[V])
    far = abs(x) > CREDIBLE * root
    unlike, alone = reference > least and not blamed, blamed or (far and not sure)
    before = known[n + 1, 0]
    teaches, known[n + 1, 0] = unlike and before > 0.0, noted(before, unlike or alone, n)
    if outside(phi, memory.unknown):
        if teaches:
            discover(phi, x, frozen, memory, scratch)
        return UNLIKE
    learns = teaches and h > n / numbers[NORMAL] and not far
    if (h > UNKNOWN and not (learns or far)) or (alone and not 0.0 < before <= AGAIN):
        return NOTHING if blamed else UNLIKE
    if learns:
        learn(phi, x, h, frozen, known, scratch)
    if learns or alone:
        shorter = 1.0 / root
        if alone and h * shorter * shorter > 1.0 / numbers[NORMAL]:
            shorter = 1.0 / np.sqrt(numbers[NORMAL] * h)
        x /= root
        for i in range(n):
            phi[i] *= shorter
    enter_scores(phi[:n], min(clip, max(-clip, x)), memory.sample)
    if not sure:
        memory.sample[n] = numbers[V]
    newest = memory.recent[int(memory.counts[COUNT]) % KEPT]
    for i in range(n):
        newest[i] = phi[i]
    newest[n] = min(wide, max(-wide, x))
    # the GARCH recursion for h at the next sample
    fed = numbers[ALPHA] * memory.sample[n] / numbers[V] + numbers[BETA]
    memory.counts[LEVEL] = 1.0 - numbers[ALPHA] - numbers[BETA] + fed * memory.counts[LEVEL]
    return JUDGED
