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
"""For the size of a change x is limited to this, so that one outlier does not count more, or to twice the last e."""
SCALE, CLIP, K, V, KAPPA, ALPHA, BETA, INSIDE, RAW, SPREAD, LONGEST, NORMAL, CONSTANT = range(13)
"""Entries of `Frozen.numbers`. INSIDE is the mean of x^2 where x is not clipped and 0 elsewhere, RAW and SPREAD are the
mean and variance of x^2, LONGEST is the longest window that judges the noise, NORMAL the size of the reference,
CONSTANT the index of the regressor that the others are centred on (read only if some are).
"""
ALIKE = 1.0
"""Twice the logarithm of the likelihood ratio up to which a step is of the level, not of a slope through zero."""
LITTLE = 0.2
"""Share of a slope in a step through zero below which it is that of the level, which has a CUSUM of its own."""
MOST = 0.5
"""Share of sum g^2, of what it is where every score is clipped, from which on scores no longer show what moved."""
SINCE, LEVEL, COUNT = range(3)
"""Entries of `Memory.counts`: usable samples in a row, h, samples that were used."""
ONE, JOINT, NOISE, WHICH, SIZE, STD, WINDOW, RATIO, NOISE_WINDOW, CUSUM = range(10)
"""Entries of the findings of a sample; the CUSUM of n parameters and of the noise come last."""
FIT = NOISE_WINDOW
"""Entry of a window in its place: where scores are clipped, how well one change explains it, or 0; otherwise NaN."""


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
    """(n,): regressors in the reference as multiples of the constant, 0 where they were near zero; none if all were."""


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


def memory_of(frozen: Frozen) -> Memory:
    """The state before the first sample."""
    n, p, centred = len(frozen.theta), len(frozen.ar), len(frozen.mean)
    last = np.full((LEVELS, 2, CUSUM), np.nan)
    sums = np.zeros((LEVELS, BLOCKS, size_of(n)))
    work = np.zeros((2 * n + 4 + (centred > 0), size_of(n)))
    counts, findings = np.array([0.0, 1.0, 0.0]), np.full(CUSUM + n + 1, np.nan)
    past, cusum = np.zeros((p + 1, n + 1)), np.zeros((n + 1 + centred, 2))
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


@kernel
def through_zero(frozen: Frozen, j: int, constant: int) -> tuple[float, float]:
    """(a, b): a step of the slope j through zero moves that about the mean by a, and the level by b; both in units."""
    own, level = frozen.unit[j], frozen.mean[j] * frozen.unit[constant]
    size = np.sqrt(own * own + level * level)
    return own / size, level / size


@part
def explain(g: Array, z: Array, u: Array, j: int, share: float, clipped: bool, named: float, findings: Array) -> float:
    """Consider a change along g (n,), of which parameter j has a share; returns the best square by which one is named.

    By residuals if scores are clipped, which then show only that there is a change.
    """
    length, score, raw = 0.0, 0.0, 0.0
    for i in range(g.shape[0]):
        length += g[i] * g[i]
        score += g[i] * z[i]
        raw += g[i] * u[i]
    if not length > 0.0:
        return named
    square = score * score / length
    if not findings[ONE] >= square:
        findings[ONE] = square
    by = (raw * raw / length if clipped else square) - (ALIKE if share < 1.0 else 0.0)
    if by > named:
        findings[WHICH], findings[SIZE], findings[STD] = j, share * raw / length, share / np.sqrt(length)
    return max(by, named)


@part
def explained(total: Array, frozen: Frozen, work: Array, j: int, constant: int) -> float:
    """The squares that a step of parameter j explains, about its mean or through zero."""
    n = frozen.theta.shape[0]
    own, level = total[n + j], total[n + constant]
    most: float = own * own / work[n + j, j]
    if frozen.mean.shape[0] > 0 and frozen.mean[j] != 0.0:
        a, b = through_zero(frozen, j, constant)
        length = a * a * work[n + j, j] + 2.0 * a * b * work[n + j, constant] + b * b * work[n + constant, constant]
        most = max(most, (a * own + b * level) ** 2 / max(length, SMALLEST))
    return most


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
    clipped = total[2 * n] > MOST * L * numbers[CLIP] * numbers[CLIP]
    centred, named, findings[ONE] = frozen.mean.shape[0] > 0, -ALIKE, np.nan
    constant = int(numbers[CONSTANT]) if centred else 0
    if centred:
        solve(work, n, work[n + constant, :n], work[2 * n + 3])
    for j in range(n):
        # a change of parameter j alone: (g'z)^2 / g'g, its size g'u / g'g
        solve(work, n, work[n + j, :n], g)
        named = explain(g[:n], z, u, j, 1.0, clipped, named, findings)
        if centred and frozen.mean[j] != 0.0:
            a, b = through_zero(frozen, j, constant)
            for i in range(n):
                g[i] = a * g[i] + b * work[2 * n + 3, i]
            named = explain(g[:n], z, u, j, a, clipped, named, findings)
    findings[ONE] = np.sqrt(findings[ONE])
    # squares of the residuals in units of those of the reference, and what that change leaves of them
    fit = explained(total, frozen, work, int(findings[WHICH]), constant) if findings[ONE] >= 0.0 else 0.0
    squares = total[2 * n + 1] / (L * numbers[RAW])
    left = max(total[2 * n + 1] - fit, 0.0) / ((L - 1.0) * numbers[RAW])
    moved = squares > 1.0 and left * left < squares
    findings[STD] *= np.sqrt(numbers[RAW] * (max(left, 1.0) if moved else 1.0) / numbers[V])
    findings[FIT] = np.nan if not clipped else fit / max(left, SMALLEST) if moved else 0.0
    # the variance of the noise: sum g^2 against L v, as a deviate
    findings[NOISE], findings[WINDOW] = np.nan, L
    if numbers[LONGEST] >= L:
        ratio = total[2 * n] / (L * numbers[V])
        z_noise = cube_deviate(ratio, L * numbers[V] * numbers[V] / numbers[KAPPA])
        findings[NOISE] = abs(z_noise) / np.sqrt(1.0 + L / numbers[NORMAL])
        findings[RATIO] = np.nan if moved else np.sqrt(squares)  # a parameter explains more of them than the noise


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


@kernel
def entry(n: int, i: int, j: int) -> int:
    """Where the sums of a block contain phi_i phi_j, j <= i."""
    return 2 * n + 2 + i * (i + 1) // 2 + j


@part
def climb(cusum: Array, z: float, mean: float, var: float, power: float) -> None:
    """One step of a CUSUM up and of one down."""
    for side in range(2):
        step = (mean * z if side == 0 else -mean * z) - 0.5 * mean * mean * power
        cusum[side] = max(0.0, cusum[side] + step / var)


@part
def accumulate(sample: Array, frozen: Frozen, cusum: Array) -> None:
    """One step of the CUSUM of every parameter, of the noise, and of slopes through zero; columns are up and down."""
    n = frozen.theta.shape[0]
    k, v, kappa = frozen.numbers[K], frozen.numbers[V], frozen.numbers[KAPPA]
    at = 2 * n + 2
    for j in range(n):
        at += j
        climb(cusum[j], sample[j], SHIFT * k, v, sample[at + j])
    climb(cusum[n], sample[2 * n] - v, SHIFT * v, kappa, 1.0)
    constant = int(frozen.numbers[CONSTANT]) if frozen.mean.shape[0] > 0 else 0
    for j in range(frozen.mean.shape[0]):
        a, b = through_zero(frozen, j, constant) if frozen.mean[j] != 0.0 else (0.0, 0.0)
        if a > LITTLE:
            low, high = min(j, constant), max(j, constant)
            both = sample[entry(n, high, low)]
            power = a * a * sample[entry(n, j, j)] + 2.0 * a * b * both + b * b * sample[entry(n, constant, constant)]
            climb(cusum[n + 1 + j], a * sample[j] + b * sample[constant], SHIFT * k, v, power)


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
    best, fit = 0, np.nan
    for w in range(2 * last.shape[0]):
        one = last[w // 2, w % 2]
        if one[JOINT] > findings[JOINT] or np.isnan(findings[JOINT]):
            findings[JOINT] = one[JOINT]
        if one[ONE] > findings[ONE] or np.isnan(findings[ONE]):
            best, fit, findings[ONE] = w, one[FIT], one[ONE]
        if one[NOISE] > findings[NOISE] or np.isnan(findings[NOISE]):
            findings[NOISE], findings[RATIO], findings[NOISE_WINDOW] = one[NOISE], one[RATIO], one[WINDOW]
    # where scores are clipped, the window that one change explains best shows which
    for w in range(2 * last.shape[0]):
        if last[w // 2, w % 2, FIT] > fit:
            best, fit, findings[RATIO] = w, last[w // 2, w % 2, FIT], np.nan
    for i in (WHICH, SIZE, STD, WINDOW):
        findings[i] = last[best // 2, best % 2, i]
    for j in range(n + 1):
        highest = max(memory.cusum[j, 0], memory.cusum[j, 1])
        if j < frozen.mean.shape[0]:
            highest = max(highest, memory.cusum[n + 1 + j, 0], memory.cusum[n + 1 + j, 1])
        findings[CUSUM + j] = np.sqrt(2.0 * highest)


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
def enter_row(row: Array, frozen: Frozen, memory: Memory) -> bool:
    """Scores of a row [phi, y, ok, noise, dt] into memory.sample; whether it can be used."""
    n, p = frozen.theta.shape[0], frozen.ar.shape[0]
    past, counts, numbers, phi = memory.past, memory.counts, frozen.numbers, memory.work[0]
    if not row[n + 3] > 0.0:
        return False
    if not row[n + 1] > 0.0:
        counts[SINCE] = 0.0
        return False
    if row[n + 3] > GAP:
        counts[SINCE] = 0.0
    # residual and centred regressors, scaled to the noise variance of weight 1
    root, before, centred = 1.0 / np.sqrt(row[n + 2]), abs(past[p, n]), frozen.mean.shape[0] > 0
    e, level = row[n], row[int(numbers[CONSTANT])] if centred else 0.0
    for i in range(n):
        own = row[i] - frozen.mean[i] * level if centred else row[i]
        e -= own * frozen.theta[i]
        past[p, i] = own * root / frozen.unit[i]
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
    if counts[SINCE] <= p or outside(phi, frozen.unseen):
        return False
    wide, clip = max(WIDE, 2.0 * before / scale), numbers[CLIP]
    x = min(wide, max(-wide, phi[n]))
    g = min(clip, max(-clip, x))
    enter_scores(phi[:n], g, x, memory.sample)
    if leverage(memory.sample, frozen) > UNKNOWN:
        return False
    if unsure(memory.sample, frozen):
        memory.sample[2 * n], memory.sample[2 * n + 1] = numbers[V], numbers[RAW]
    # the GARCH recursion for h at the next sample
    fed = numbers[ALPHA] * memory.sample[2 * n] / numbers[V] + numbers[BETA]
    counts[LEVEL] = 1.0 - numbers[ALPHA] - numbers[BETA] + fed * counts[LEVEL]
    return True


@Driver
def scan(rows: Array, frozen: Frozen, memory: Memory, findings: Array) -> None:
    """Judge rows (T, n + 4) = [phi, y, ok, noise, dt]: findings (T, CUSUM + n + 1), repeated at unused rows."""
    for t in range(rows.shape[0]):
        if enter_row(rows[t], frozen, memory):
            judge(memory, frozen, memory.findings)
        for i in range(findings.shape[1]):
            findings[t, i] = memory.findings[i]
