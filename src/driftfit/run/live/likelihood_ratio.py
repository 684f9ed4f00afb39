"""Windowed likelihood ratios and score CUSUM on a frozen reference model, recursive and in constant memory.

    e_t = y_t - phi_t' theta,                 theta of the reference, frozen
    w_t = e_t - sum_k a_k e_(t-k)             the noise of the reference was an autoregression; phi in the same way
    x_t = w_t / (scale sqrt(h_t))             h_(t+1) = 1 - alpha - beta + alpha h_t g_t^2 / v + beta h_t
    g_t = x_t clipped at +-clip               score; E g^2 = v, var g^2 = kappa, E dg/dx = k in the reference

For a window of L samples S = sum phi g, G = sum phi phi', Q = sum g^2. theta was estimated, with covariance C, so that
without a fault S ~ N(0, V), V = v G + k^2 G C G. The statistics are

    one            max_j (g_j' V^-1 S)^2 / g_j' V^-1 g_j,  g_j = G e_j      one parameter moved by d_j
    parameters     S' V^-1 S                                                any of them did
    noise          Q against L v, both tails                                the noise variance changed

as normal deviates (Wilson and Hilferty 1931), each the largest over windows of 8, 12, 16, 24, .., 384 samples. Level j
has sums over blocks of 2^j samples, of which it keeps twelve; a block is the sum of two of the level below, so nothing
is ever subtracted, and windows of 8 and 12 blocks are compared whenever a block is complete. The size of the change is
d_j = g_j' V^-1 U / g_j' V^-1 g_j with U = sum phi x, and of the noise sqrt(mean x^2), with x not clipped.

The score CUSUM of parameter j, both signs, is C <- max(0, C + log likelihood ratio of a shift by SHIFT standard
deviations of the noise). The CUSUM of the noise is the same for its variance. Reported is sqrt(2 C), again a deviate.

Where the reference knows little of a direction that a sample excites, as of an input that hardly moved, most of x may
be the error of theta. V allows for that, but Q and the CUSUM do not: a sample with phi' C phi above `UNSURE` of the
noise variance (and above `USUAL` n / N, which rows of the reference themselves seldom exceed) says nothing there, and
one above `UNKNOWN` is passed over.

A sample that cannot be used is passed over, and so is one that excites a direction in which the reference says nothing,
as an input does that was 0 or constant there: what it does to y is unknown, and would be taken for a change. An
autoregression then waits until its lags are complete. Source: Lai (1998) for windowed likelihood ratios, Huber (1964)
for the score, Bollerslev (1986) for h. Departures: the covariance of the reference within the statistic; windows of 8
and 12 blocks, of which the longer ones are compared less often.
Cost per sample: O(n^3 + p n) on average, some 2 microseconds with four parameters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.drivers import SMALLEST
from driftfit.engine.kernel import Array, Driver, exp, kernel, log, part

LEVELS, BLOCKS, SHORT = 6, 12, 8
"""Levels of blocks of 1, 2, 4, .. samples; blocks that each keeps; blocks of the shorter window."""
GAP = 1.5
"""An interval longer than this breaks an autoregression."""
SHIFT = 0.5
"""The shift for which the score CUSUM is designed, in standard deviations of the noise per root mean square regressor.
"""
FLAT = 1e-9
SAME = 1e-6
"""A regressor that differs by less than this share from what it was in the whole reference has not changed."""
UNSURE, USUAL = 0.2, 8.0
"""Variances of a prediction by theta, as shares of that of the noise, from which on a sample does not judge the noise.
"""
UNKNOWN = 1.0
"""The same, from which on a sample judges nothing: its residual is the error of theta, and clipped."""
WIDE = 30.0
"""x is limited to this for the size of a change."""
SCALE, CLIP, K, V, KAPPA, ALPHA, BETA, INSIDE, RAW, SPREAD, LONGEST, NORMAL = range(12)
"""Entries of `Frozen.numbers`. INSIDE is the mean of x^2 where x is not clipped and 0 elsewhere, RAW and SPREAD are the
mean and variance of x^2, LONGEST is the longest window that judges the noise, NORMAL the size of the reference.
"""
SINCE, LEVEL, COUNT = range(3)
"""Entries of `Memory.counts`: usable samples in a row, h, samples that were used."""
ONE, JOINT, NOISE, WHICH, SIZE, STD, WINDOW, RATIO, NOISE_WINDOW, CUSUM = range(10)
"""Entries of the findings of a sample; the CUSUM of n parameters and of the noise come last."""


ROW = ("y", "ok", "noise", "dt")
Y, OK, NOISE_FACTOR, INTERVAL = range(4)
"""Columns of a row after its regressors, by the names of the fields of a tile, and by their places."""
UNUSED, UNSEEN, USED = range(3)
"""What becomes of a sample; `UNSEEN` is one that excites what the reference did not, or hardly."""


class Frozen(NamedTuple):
    """The reference model as the compiled routines take it; regressors are in units of ``unit``."""

    theta: Array
    unit: Array
    ar: Array
    cov: Array
    numbers: Array
    unseen: Array = np.zeros((0, 0))
    """(k, n): directions of the regressors in which the reference has none, such as that of an input that was 0."""


class Memory(NamedTuple):
    """The state: lags, block sums, the statistics of every window, CUSUM, counts, and the sums and statistics of the
    last sample; ``work`` is scratch.
    """

    past: Array
    sums: Array
    last: Array
    cusum: Array
    counts: Array
    work: Array
    sample: Array
    findings: Array


def memory_of(n: int, p: int) -> Memory:
    """The state before the first sample, for n parameters and an autoregression of order p."""
    last = np.full((LEVELS, 2, CUSUM), np.nan)
    sums = np.zeros((LEVELS, BLOCKS, size_of(n)))
    work = np.zeros((2 * n + 4, size_of(n)))
    counts, findings = np.array([0.0, 1.0, 0.0]), np.full(CUSUM + n + 1, np.nan)
    past, cusum = np.zeros((p + 1, n + 1)), np.zeros((n + 1, 2))
    return Memory(past, sums, last, cusum, counts, work, np.zeros(size_of(n)), findings)


def size_of(n: int) -> int:
    """Numbers in the sums of a block: S, U, Q, sum x^2 and the lower triangle of G."""
    return 2 * n + 2 + n * (n + 1) // 2


@part
def enter(sums: Array, sample: Array, count: int) -> None:
    """Add a sample as a block of level 0, and every block that it completes; ``count`` samples with this one."""
    levels, blocks, size = sums.shape
    for i in range(size):
        sums[0, count % blocks, i] = sample[i]
    for j in range(1, levels):
        if count % (1 << j) != 0:
            break
        b = count >> j
        for i in range(size):
            sums[j, b % blocks, i] = sums[j - 1, (2 * b - 1) % blocks, i] + sums[j - 1, (2 * b) % blocks, i]


@kernel
def cube_root(x: float) -> float:
    return exp(log(x) / 3.0) if x > SMALLEST else 0.0


@part
def cube_deviate(ratio: float, shape: float) -> float:
    """A gamma variable of this shape over its mean as a normal deviate (Wilson and Hilferty 1931)."""
    z: float = (cube_root(ratio) - (1.0 - 1.0 / (9.0 * shape))) * 3.0 * np.sqrt(shape)
    return z


@part
def variance(total: Array, frozen: Frozen, work: Array) -> None:
    """V of the sums of a window in work[:n], G in work[n:2n], symmetric."""
    n = frozen.theta.shape[0]
    v, k, at = frozen.numbers[V], frozen.numbers[K], 2 * n + 2
    for i in range(n):
        for j in range(i + 1):
            work[n + i, j] = work[n + j, i] = total[at]
            at += 1
    for i in range(n):
        for j in range(n):
            value = 0.0
            for m in range(n):
                value += work[n + i, m] * frozen.cov[m, j]
            work[2 * n, j] = value
        for j in range(i + 1):
            value = 0.0
            for m in range(n):
                value += work[2 * n, m] * work[n + m, j]
            work[i, j] = v * work[n + i, j] + k * k * value


@part
def factor(work: Array, n: int) -> int:
    """Cholesky factor of work[:n] in place, a column of zeros where there is no direction left; returns the rank."""
    rank = 0
    for j in range(n):
        own = work[j, j]
        pivot = own
        for m in range(j):
            pivot -= work[j, m] * work[j, m]
        good = pivot > FLAT * own and own > 0.0
        root = np.sqrt(pivot) if good else 0.0
        rank += 1 if good else 0
        work[j, j] = root
        for i in range(j + 1, n):
            value = work[i, j]
            for m in range(j):
                value -= work[i, m] * work[j, m]
            work[i, j] = value / root if good else 0.0
    return rank


@part
def solve(work: Array, n: int, given: Array, into: Array) -> None:
    """into = factor^-1 given."""
    for i in range(n):
        value = given[i]
        for m in range(i):
            value -= work[i, m] * into[m]
        into[i] = value / work[i, i] if work[i, i] > 0.0 else 0.0


@part
def compare(total: Array, L: int, frozen: Frozen, work: Array, findings: Array) -> None:
    """The statistics of one window into findings."""
    n = frozen.theta.shape[0]
    numbers = frozen.numbers
    variance(total, frozen, work)
    rank = factor(work, n)
    z, u, g = work[2 * n], work[2 * n + 1], work[2 * n + 2]
    # with V = F F': z = F^-1 S and u = F^-1 U, so that S' V^-1 S = z'z
    solve(work, n, total[:n], z)
    solve(work, n, total[n : 2 * n], u)
    square = 0.0
    for i in range(n):
        square += z[i] * z[i]
    findings[JOINT] = cube_deviate(square / rank, 0.5 * rank) if rank > 0 else np.nan
    best, findings[ONE] = -1.0, np.nan
    for j in range(n):
        # a change of parameter j alone: (g'z)^2 / g'g, its size g'u / g'g
        solve(work, n, work[n + j, :n], g)
        length, score, raw = 0.0, 0.0, 0.0
        for i in range(n):
            length += g[i] * g[i]
            score += g[i] * z[i]
            raw += g[i] * u[i]
        if length > 0.0 and score * score > best * length:
            best = score * score / length
            findings[WHICH], findings[SIZE] = j, raw / length
            findings[STD] = np.sqrt(numbers[RAW] / (numbers[V] * length))
    if best >= 0.0:
        findings[ONE] = np.sqrt(best)
    # the variance of the noise: sum g^2 against L v, as a deviate
    findings[NOISE], findings[WINDOW] = np.nan, L
    if numbers[LONGEST] >= L:
        ratio = total[2 * n] / (L * numbers[V])
        z_noise = cube_deviate(ratio, L * numbers[V] * numbers[V] / numbers[KAPPA])
        findings[NOISE] = abs(z_noise) / np.sqrt(1.0 + L / numbers[NORMAL])
        findings[RATIO] = np.sqrt(total[2 * n + 1] / (L * numbers[RAW]))


@part
def windows(memory: Memory, frozen: Frozen, count: int) -> None:
    """Compare the windows that end with a block that the last sample completed."""
    sums, work, size = memory.sums, memory.work, memory.sums.shape[2]
    total = work[work.shape[0] - 1]
    for j in range(sums.shape[0]):
        b = count >> j
        if count % (1 << j) != 0 or b < SHORT:
            break
        for i in range(size):
            total[i] = 0.0
        for kind in range(2):
            blocks, begin = (SHORT, 0) if kind == 0 else (BLOCKS, SHORT)
            if b < blocks:
                break
            for back in range(begin, blocks):
                for i in range(size):
                    total[i] += sums[j, (b - back) % BLOCKS, i]
            compare(total, blocks << j, frozen, work, memory.last[j, kind])


@part
def leverage(sample: Array, frozen: Frozen) -> float:
    """phi' C phi of a sample: the variance of its prediction by theta, as a share of that of the noise."""
    n, total = frozen.theta.shape[0], 0.0
    at = 2 * n + 2
    for i in range(n):
        for j in range(i + 1):
            total += (1.0 if i == j else 2.0) * frozen.cov[i, j] * sample[at]
            at += 1
    return total


@part
def unsure(sample: Array, frozen: Frozen) -> bool:
    """Whether that is too large for the residual to be noise."""
    usual = USUAL * frozen.theta.shape[0] / frozen.numbers[NORMAL]
    return leverage(sample, frozen) > max(UNSURE, usual)  # type: ignore[no-any-return]


@part
def accumulate(sample: Array, frozen: Frozen, cusum: Array) -> None:
    """One step of the CUSUM of every parameter, the last row that of the noise; columns are up and down."""
    n = frozen.theta.shape[0]
    k, v, kappa = frozen.numbers[K], frozen.numbers[V], frozen.numbers[KAPPA]
    at = 2 * n + 2
    for j in range(n + 1):
        at += j
        if j < n:
            z, mean, var, power = sample[j], SHIFT * k, v, sample[at + j]
        else:
            z, mean, var, power = sample[2 * n] - v, SHIFT * v, kappa, 1.0
        for side in range(2):
            step = (mean * z if side == 0 else -mean * z) - 0.5 * mean * mean * power
            cusum[j, side] = max(0.0, cusum[j, side] + step / var)


@part
def enter_scores(phi: Array, g: float, x: float, sample: Array) -> None:
    """The sums of a single sample: phi g, phi x, g^2, x^2, phi phi'."""
    n, at = phi.shape[0], 2 * phi.shape[0] + 2
    for i in range(n):
        sample[i], sample[n + i] = phi[i] * g, phi[i] * x
        for j in range(i + 1):
            sample[at] = phi[i] * phi[j]
            at += 1
    sample[2 * n], sample[2 * n + 1] = g * g, x * x


@part
def judge(memory: Memory, frozen: Frozen, findings: Array) -> None:
    """Add the sample whose sums are in memory.sample, and write its statistics."""
    n = frozen.theta.shape[0]
    sums, last = memory.sums, memory.last
    memory.counts[COUNT] += 1.0
    count = int(memory.counts[COUNT])
    enter(sums, memory.sample, count)
    windows(memory, frozen, count)
    if not unsure(memory.sample, frozen):
        accumulate(memory.sample, frozen, memory.cusum)
    for i in range(findings.shape[0]):
        findings[i] = np.nan
    for j in range(last.shape[0]):
        for kind in range(2):
            one = last[j, kind]
            if one[JOINT] > findings[JOINT] or np.isnan(findings[JOINT]):
                findings[JOINT] = one[JOINT]
            if one[ONE] > findings[ONE] or np.isnan(findings[ONE]):
                for i in (ONE, WHICH, SIZE, STD, WINDOW):
                    findings[i] = one[i]
            if one[NOISE] > findings[NOISE] or np.isnan(findings[NOISE]):
                findings[NOISE], findings[RATIO], findings[NOISE_WINDOW] = one[NOISE], one[RATIO], one[WINDOW]
    for j in range(n + 1):
        findings[CUSUM + j] = np.sqrt(2.0 * max(memory.cusum[j, 0], memory.cusum[j, 1]))


@part
def outside(phi: Array, unseen: Array) -> bool:
    """Whether a row excites a direction that the reference did not, beyond the rounding of its terms."""
    for i in range(unseen.shape[0]):
        total, size = 0.0, 0.0
        for j in range(unseen.shape[1]):
            term = unseen[i, j] * phi[j]
            total, size = total + term, size + abs(term)
        if abs(total) > SAME * size:
            return True
    return False


@part
def enter_row(row: Array, frozen: Frozen, memory: Memory) -> int:
    """Scores of a row into memory.sample; returns what becomes of it."""
    n, p = frozen.theta.shape[0], frozen.ar.shape[0]
    past, counts, numbers, phi = memory.past, memory.counts, frozen.numbers, memory.work[0]
    if not row[n + INTERVAL] > 0.0:
        return UNUSED
    if not row[n + OK] > 0.0:
        counts[SINCE] = 0.0
        return UNUSED
    if row[n + INTERVAL] > GAP:
        counts[SINCE] = 0.0
    # residual and regressors, scaled to the noise variance of weight 1
    root = 1.0 / np.sqrt(row[n + NOISE_FACTOR])
    e = row[n + Y]
    for i in range(n):
        e -= row[i] * frozen.theta[i]
        past[p, i] = row[i] * root / frozen.unit[i]
    past[p, n] = e * root
    # whitened by the autoregression, and divided by the present standard deviation
    scale = numbers[SCALE] * np.sqrt(counts[LEVEL])
    for i in range(n + 1):
        value = past[p, i]
        for lag in range(p):
            value -= frozen.ar[lag] * past[p - 1 - lag, i]
        phi[i] = value / np.sqrt(counts[LEVEL]) if i < n else value / scale
    # shift the lags; after a gap they must first be filled again
    for lag in range(p):
        for i in range(n + 1):
            past[lag, i] = past[lag + 1, i]
    counts[SINCE] += 1.0
    if counts[SINCE] <= p:
        return UNUSED
    if outside(phi, frozen.unseen):
        return UNSEEN
    x, clip = min(WIDE, max(-WIDE, phi[n])), numbers[CLIP]
    g = min(clip, max(-clip, x))
    enter_scores(phi[:n], g, x, memory.sample)
    if leverage(memory.sample, frozen) > UNKNOWN:
        return UNSEEN
    if unsure(memory.sample, frozen):
        memory.sample[2 * n], memory.sample[2 * n + 1] = numbers[V], numbers[RAW]
    # the GARCH recursion for h at the next sample
    fed = numbers[ALPHA] * memory.sample[2 * n] / numbers[V] + numbers[BETA]
    counts[LEVEL] = 1.0 - numbers[ALPHA] - numbers[BETA] + fed * counts[LEVEL]
    return USED


@Driver
def scan(rows: Array, frozen: Frozen, memory: Memory, findings: Array) -> int:
    """Judge rows (T, n + 4), regressors and the columns of `ROW`; findings (T, CUSUM + n + 1) are those of the last.

    Returns how many rows excite what the reference did not, or hardly, and are therefore not judged.
    """
    unseen = 0
    for t in range(rows.shape[0]):
        fate = enter_row(rows[t], frozen, memory)
        if fate == USED:
            judge(memory, frozen, memory.findings)
        elif fate == UNSEEN:
            unseen += 1
        for i in range(findings.shape[1]):
            findings[t, i] = memory.findings[i]
    return unseen
