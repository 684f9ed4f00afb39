"""Windowed likelihood ratios on a frozen reference model, recursive and in constant memory.

For a window of L samples S = sum phi g, G = sum phi phi', Q = sum g^2, with the scores of
`driftfit.run.live.reference_model`. theta was estimated, with covariance C, so that without a fault S ~ N(0, V),
V = v G + k^2 G C G. The statistics are

    one            max_d (d'G V^-1 S)^2 / d'G V^-1 G d                      one parameter moved along d
    parameters     S' V^-1 S                                                any of them did
    noise          Q against L v, both tails                                the noise variance changed

as normal deviates z (Wilson and Hilferty 1931), each the largest sqrt(z^2 - 2 EVEN log(384 / L)), at least 0, over
windows of L = 8, 12, 16, 24, .., 384 samples: with one limit for all z, nearly all false alarms would be those of short
windows, of which a record has many that are independent, and long windows would find small changes late. Level j
has sums over blocks of 2^j samples, of which it keeps twelve; a block is the sum of two of the level below, so nothing
is ever subtracted, and windows of 8 and 12 blocks are compared whenever a block is complete. d is a step of one
parameter; where a regressor is centred that is a slope about its mean, and a slope through zero, which moves the level
too, is compared as well. The size of the change is d'G V^-1 U / d'G V^-1 G d with U = sum phi x, and of the noise
sqrt(mean x^2), with x not clipped.

Which parameter moved is the one with the largest statistic; but the level, not a slope through zero, where these are
within `ALIKE`. Where most scores are clipped they show only that there is a change: the residuals x then show which, in
the window that one step explains best. It is not the noise that changed if a step explains most of the squares.

Source: Lai (1998); Dumbgen and Spokoiny (2001) for limits that depend on the length. Departures: the covariance of the
reference within the statistic; windows of 8 and 12 blocks, of which the longer ones are compared less often.
Cost per sample: O(n^3 + p n) on average, some 2 microseconds with four parameters.

The score CUSUM of the same model accumulates

    C <- max(0, C + log likelihood ratio of a shift by SHIFT standard deviations of the noise)

for each parameter and both signs, and for the variance of the noise. Where a regressor is centred, its parameter also
has sums for a step of the slope through zero, unless that is hardly more than one of the level. Reported is the larger
of them as sqrt(2 C), a deviate. Above TOP the sum forgets exponentially: it would otherwise grow for as long as a fault
lasts, and the alarm would stay on for up to nine times as long after it. The column with the largest drift still has
the largest sum. Source: Page (1954). Cost per sample: O(n).
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.drivers import SMALLEST
from driftfit.engine.kernel import Array, Driver, exp, kernel, log, part
from driftfit.run.live.reference_model import (
    ALIKE,
    BLOCKS,
    BOUND,
    CLIP,
    CONSTANT,
    COUNT,
    COVARIANCE,
    CUSUM,
    EVEN,
    FIT,
    FLAT,
    FULLY,
    JOINT,
    KAPPA,
    LITTLE,
    LONGEST,
    MOST,
    NOISE,
    NOISE_WINDOW,
    NORMAL,
    ONE,
    PARAMETERS,
    RATIO,
    RAW,
    SAME,
    SHIFT,
    SHORT,
    SHORTER,
    SIZE,
    STD,
    TOP,
    WHICH,
    WINDOW,
    WINDOWS,
    Frozen,
    K,
    Memory,
    V,
    enter_row,
    through_zero,
)

LASTING = 0.98
"""What is kept, per sample, of the excess of a sum over the largest that counts."""


@part
def climb(cusum: Array, z: float, mean: float, var: float, power: float, most: float) -> None:
    """One step of a CUSUM up and of one down, which forget what they are above ``most``."""
    for side in range(2):
        step = (mean * z if side == 0 else -mean * z) - 0.5 * mean * mean * power
        value = max(0.0, cusum[side] + step / var)
        cusum[side] = most + LASTING * (value - most) if value > most else value


@part
def idle(j: int, frozen: Frozen) -> bool:
    """Whether regressor j was always 0 in the reference, or constant and is centred, so that it has no unit there."""
    share = 0.0
    for m in range(frozen.unseen.shape[0]):
        share += frozen.unseen[m, j] * frozen.unseen[m, j]
    return share > 1.0 - SAME


@part
def accumulate(phi: Array, g: float, noise: bool, frozen: Frozen, cusum: Array) -> None:
    """One step of the CUSUM of every parameter, of the noise, and of slopes through zero; columns are up and down."""
    n = frozen.theta.shape[0]
    k, v, kappa = frozen.numbers[K], frozen.numbers[V], frozen.numbers[KAPPA]
    most = 0.5 * frozen.numbers[TOP] ** 2 if frozen.numbers[TOP] > 0.0 else np.inf
    for j in range(n):
        own = np.sign(phi[j]) if idle(j, frozen) else min(BOUND, max(-BOUND, phi[j]))
        climb(cusum[j], own * g, SHIFT * k, v, own * own, most)
    if noise:
        climb(cusum[n], g * g - v, SHIFT * v, kappa, 1.0, most)
    constant = int(frozen.numbers[CONSTANT]) if frozen.mean.shape[0] > 0 else 0
    for j in range(frozen.mean.shape[0]):
        a, b = through_zero(frozen, j, constant) if frozen.mean[j] != 0.0 else (0.0, 0.0)
        if a > LITTLE and not idle(j, frozen):
            own = min(BOUND, max(-BOUND, a * phi[j] + b * phi[constant]))
            climb(cusum[n + 1 + j], own * g, SHIFT * k, v, own * own, most)


@part
def report(cusum: Array, frozen: Frozen, deviates: Array) -> None:
    """sqrt(2 C) of the parameters and of the noise into deviates (n + 1,)."""
    n = frozen.theta.shape[0]
    for j in range(n + 1):
        highest = max(cusum[j, 0], cusum[j, 1])
        if j < frozen.mean.shape[0]:
            highest = max(highest, cusum[n + 1 + j, 0], cusum[n + 1 + j, 1])
        deviates[j] = np.sqrt(2.0 * highest)


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
def variance(total: Array, cov: Array, frozen: Frozen, work: Array) -> None:
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
                value += work[n + i, m] * cov[m, j]
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
def compare(total: Array, L: int, cov: Array, frozen: Frozen, work: Array, findings: Array) -> None:
    """The statistics of one window into findings."""
    n = frozen.theta.shape[0]
    numbers = frozen.numbers
    variance(total, cov, frozen, work)
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
    cov = memory.known[COVARIANCE : COVARIANCE + frozen.theta.shape[0]]
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
            compare(total, blocks << j, cov, frozen, work, memory.last[j, kind])


@part
def judge(memory: Memory, frozen: Frozen, findings: Array) -> None:
    """Add the sample whose sums are in memory.sample, and write its statistics."""
    sums, last = memory.sums, memory.last
    memory.counts[COUNT] += 1.0
    count = int(memory.counts[COUNT])
    enter(sums, memory.sample, count)
    windows(memory, frozen, count)
    for i in range(CUSUM):
        findings[i] = np.nan
    best, fit, most, loudest = 0, np.nan, np.nan, np.nan
    for w in range(2 * last.shape[0]):
        one, less = last[w // 2, w % 2], 2.0 * frozen.numbers[EVEN] * SHORTER[w]
        for i in (ONE, JOINT, NOISE):
            z = np.sqrt(max(one[i] * abs(one[i]) - less, 0.0)) if not np.isnan(one[i]) else np.nan
            if z > findings[i] or np.isnan(findings[i]):
                findings[i] = z
        if one[ONE] > most or np.isnan(most):
            best, fit, most = w, one[FIT], one[ONE]
        if one[NOISE] > loudest or np.isnan(loudest):
            loudest, findings[RATIO], findings[NOISE_WINDOW] = one[NOISE], one[RATIO], one[WINDOW]
    # where scores are clipped, the window that one change explains best shows which
    for w in range(2 * last.shape[0]):
        if last[w // 2, w % 2, FIT] > fit:
            best, fit, findings[RATIO] = w, last[w // 2, w % 2, FIT], np.nan
    for i in (WHICH, SIZE, STD, WINDOW):
        findings[i] = last[best // 2, best % 2, i]


@Driver
def scan(rows: Array, frozen: Frozen, memory: Memory, findings: Array, use: Array) -> None:
    """Judge rows (T, n + 4), regressors and the columns of `ROW`: findings (T, CUSUM + n + 1) are repeated at
    rows without a result.

    use (T,) is what every row could judge, `NOTHING` to `FULLY`.
    """
    n = frozen.theta.shape[0]
    for t in range(rows.shape[0]):
        use[t] = enter_row(rows[t], frozen, memory)
        if use[t] >= PARAMETERS:
            accumulate(memory.work[0, :n], memory.work[0, n], use[t] == FULLY, frozen, memory.cusum)
        if use[t] >= WINDOWS:
            judge(memory, frozen, memory.findings)
            report(memory.cusum, frozen, memory.findings[CUSUM:])
        for i in range(findings.shape[1]):
            findings[t, i] = memory.findings[i]
