"""Windowed likelihood ratios on a frozen reference model, recursive and in constant memory, and what changed.

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
too, is compared as well.

Once a statistic is beyond its end, the residuals x of the last samples show what changed, and since when: for every L,
up to 384, what a change L samples ago explains of their squares,

    a step of one parameter     (d'G V^-1 U)^2 / d'G V^-1 G d,   U = sum phi x,   its size d'G V^-1 U / d'G V^-1 G d
    the noise                   (L - n) (r - 1 - log r) / c,     r = (sum x^2 - U' G^-1 U) / (L - n), over that before

twice the log likelihood ratio of a Gaussian noise; c corrects the second for tails, and the noise has changed only as
far as no change of parameters explains its squares. The change is the largest of all; but the level, where another is
larger by less than `ALIKE`: the record does not tell them apart. It is not known while it is less than `FEWEST` samples
old. Its size is the mean over all L, each weighted by its likelihood, and its standard error allows for what the size
varies by between them.

Source: Lai (1998); Dumbgen and Spokoiny (2001) for limits that depend on the length. Departures: the covariance of the
reference within the statistic; windows of 8 and 12 blocks, of which the longer ones are compared less often.
Cost per sample: O(n^3 + p n) on average, some 2 microseconds with four parameters; during an alarm some 100.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.drivers import SMALLEST
from driftfit.engine.kernel import Array, Driver, exp, kernel, log, part
from driftfit.run.live.reference_model import (
    BLOCKS,
    CONSTANT,
    COUNT,
    COVARIANCE,
    EVEN,
    FLAT,
    INSTEAD,
    JOINT,
    JUDGED,
    KAPPA,
    KEPT,
    LENGTH,
    LONGEST,
    NOISE,
    NORMAL,
    ONE,
    RAW,
    SHORT,
    SHORTER,
    SIZE,
    SPREAD,
    STD,
    WHICH,
    Frozen,
    K,
    Memory,
    V,
    enter_row,
    through_zero,
)

OWN, BEST, AGE, SUM = 0, 3, 4, 5
"""Rows of `Memory.best`: gain, size and std at one age; the largest gain; its age; sums of w, w size and w size^2."""
ALIKE = 1.0
"""Twice the logarithm of the likelihood ratio up to which two changes explain a record alike."""
FEWEST = 4
"""Samples since a change from which on it is told what it is."""
FINE = 32
"""Ages of a change are tried one by one up to this, then in steps of this part of them."""


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
def variance(total: Array, v: float, k: float, cov: Array, work: Array) -> None:
    """v G + k^2 G C G of the sums of a window in work[:n], G in work[n:2n], symmetric."""
    n = cov.shape[0]
    at = n + 1
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
def explain(z: Array, g: Array, share: float, j: int, best: Array) -> None:
    """What a change along g (n,), of which parameter j has a share, explains of z; kept if it is more than before.

    best (3, ..): the square, the size and its standard error.
    """
    length, score = 0.0, 0.0
    for i in range(g.shape[0]):
        length += g[i] * g[i]
        score += g[i] * z[i]
    if length > 0.0 and score * score / length > best[0, j]:
        best[0, j], best[1, j], best[2, j] = score * score / length, share * score / length, share / np.sqrt(length)


@part
def steps(frozen: Frozen, work: Array, best: Array) -> None:
    """What a step of each parameter explains of the sums whose whitened z is in work[2n], with the factor in work[:n]
    and G in work[n:2n]: about the mean of its regressor, and through zero.
    """
    n = frozen.theta.shape[0]
    z, g, level = work[2 * n, :n], work[2 * n + 1, :n], work[2 * n + 2, :n]
    centred = frozen.mean.shape[0] > 0
    if centred:
        solve(work, n, work[n + int(frozen.numbers[CONSTANT]), :n], level)
    for j in range(n):
        solve(work, n, work[n + j, :n], g)
        explain(z, g, 1.0, j, best)
        if centred and frozen.mean[j] != 0.0:
            a, b = through_zero(frozen, j, int(frozen.numbers[CONSTANT]))
            for i in range(n):
                g[i] = a * g[i] + b * level[i]
            explain(z, g, a, j, best)


@part
def compare(total: Array, L: int, frozen: Frozen, memory: Memory, into: Array) -> None:
    """The statistics of one window."""
    n, numbers, work, best = frozen.theta.shape[0], frozen.numbers, memory.work, memory.best
    variance(total, numbers[V], numbers[K], memory.known[COVARIANCE : COVARIANCE + n], work)
    rank = factor(work, n)
    # with V = F F': z = F^-1 S, so that S' V^-1 S = z'z
    z = work[2 * n]
    solve(work, n, total[:n], z)
    square, one = 0.0, 0.0
    for i in range(n):
        square += z[i] * z[i]
        best[0, i] = 0.0
    steps(frozen, work, best)
    for i in range(n):
        one = max(one, best[0, i])
    into[ONE] = np.sqrt(one) if rank > 0 else np.nan
    into[JOINT] = cube_deviate(square / rank, 0.5 * rank) if rank > 0 else np.nan
    # the variance of the noise: sum g^2 against L v, as a deviate
    into[NOISE] = np.nan
    if numbers[LONGEST] >= L:
        deviate = cube_deviate(total[n] / (L * numbers[V]), L * numbers[V] * numbers[V] / numbers[KAPPA])
        into[NOISE] = abs(deviate) / np.sqrt(1.0 + L / numbers[NORMAL])


@part
def windows(memory: Memory, frozen: Frozen, count: int) -> None:
    """Compare the windows that end with a block that the last sample completed."""
    sums, total = memory.sums, memory.work[memory.work.shape[0] - 1]
    size = sums.shape[2]
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
            compare(total, blocks << j, frozen, memory, memory.last[j, kind])


@part
def noise(left: float, freedom: int, numbers: Array, own: Array) -> None:
    """What a change of the noise explains, of which ``left`` squares are left."""
    n, raw, spread = own.shape[1] - 1, numbers[RAW], numbers[SPREAD]
    ratio = left / (freedom * raw)
    own[0, n] = freedom * (ratio - 1.0 - log(max(ratio, SMALLEST))) / max(1.0, 0.5 * spread / (raw * raw))
    own[1, n], own[2, n] = np.sqrt(ratio), 0.5 * np.sqrt(ratio * spread / freedom) / raw


@part
def weigh(best: Array, L: int, ages: int) -> None:
    """Add what changes of this age explain, which stands for so many ages, to the sums over all of them."""
    for j in range(best.shape[1]):
        gain, size = best[0, j], best[1, j]
        if gain > best[BEST, j]:
            less = exp(0.5 * (best[BEST, j] - gain))
            for i in range(SUM, SUM + 3):
                best[i, j] *= less
            best[BEST, j], best[AGE, j] = gain, L
        weight = ages * exp(0.5 * (gain - best[BEST, j]))
        best[SUM, j] += weight
        best[SUM + 1, j] += weight * size
        best[SUM + 2, j] += weight * (size * size + best[2, j] * best[2, j])


@part
def search(memory: Memory, frozen: Frozen, around: int) -> None:
    """What changes of each parameter and of the noise, up to `KEPT` samples ago, explain, into memory.best.

    The older ages are tried coarsely, but all of those about ``around``.
    """
    n, numbers, work, best = frozen.theta.shape[0], frozen.numbers, memory.work, memory.best
    count, total, age = int(memory.counts[COUNT]), work[work.shape[0] - 1], 1
    cov, z = memory.known[COVARIANCE : COVARIANCE + n], work[2 * n]
    for i in range(total.shape[0]):
        total[i] = 0.0
    for i in range(best.shape[0]):
        for j in range(n + 1):
            best[i, j] = 0.0
    for L in range(1, min(count, KEPT) + 1):
        row, at = memory.recent[(count - L) % KEPT], n + 1
        for i in range(n):
            total[i] += row[i] * row[n]
            for j in range(i + 1):
                total[at] += row[i] * row[j]
                at += 1
        total[n] += row[n] * row[n]
        near = abs(L - around) <= around // FINE
        if age > L and not near:
            continue
        ages = 1 if near else 1 + L // FINE
        age = L + ages
        for i in range(OWN, OWN + 3):
            for j in range(n + 1):
                best[i, j] = 0.0
        variance(total, 0.0, 1.0, cov, work)
        for i in range(n):
            for j in range(n):
                work[i, j] = work[n + i, j]
        rank = factor(work, n)
        solve(work, n, total[:n], z)
        left = total[n]
        for j in range(n):
            left -= z[j] * z[j]
        variance(total, numbers[RAW], 1.0, cov, work)
        factor(work, n)
        solve(work, n, total[:n], z)
        steps(frozen, work, best)
        if rank + 1 < L:
            noise(max(left, 0.0), L - rank, numbers, best)
        weigh(best, L, ages)


@part
def tell(memory: Memory, frozen: Frozen, findings: Array) -> None:
    """What changed, by how much, how many samples ago, and what else would explain them as well."""
    n, best, constant = frozen.theta.shape[0], memory.best, int(frozen.numbers[CONSTANT])
    which, around = 0, 0
    for _ in range(2):
        search(memory, frozen, around)
        which = 0
        for j in range(n + 1):
            which = j if best[BEST, j] > best[BEST, which] else which
        around = int(best[AGE, which])
    if constant >= 0 and best[BEST, constant] > best[BEST, which] - ALIKE:
        which = constant
    findings[INSTEAD], most = np.nan, best[BEST, which] - ALIKE
    for j in range(n + 1):
        if j != which and best[BEST, j] > most:
            most, findings[INSTEAD] = best[BEST, j], j
    L, size = best[AGE, which], best[SUM + 1, which] / best[SUM, which]
    findings[WHICH], findings[LENGTH], findings[SIZE] = which if L >= FEWEST else np.nan, L, size
    findings[STD] = np.sqrt(max(best[SUM + 2, which] / best[SUM, which] - size * size, 0.0))


@part
def judge(memory: Memory, frozen: Frozen, findings: Array) -> None:
    """Add the sample whose sums are in memory.sample, and write its findings."""
    last, beyond = memory.last, False
    memory.counts[COUNT] += 1.0
    count = int(memory.counts[COUNT])
    enter(memory.sums, memory.sample, count)
    windows(memory, frozen, count)
    for i in range(findings.shape[0]):
        findings[i] = np.nan
    for w in range(2 * last.shape[0]):
        less = 2.0 * frozen.numbers[EVEN] * SHORTER[w]
        for i in range(3):
            own = last[w // 2, w % 2, i]
            z = np.sqrt(max(own * abs(own) - less, 0.0)) if not np.isnan(own) else np.nan
            if z > findings[i] or np.isnan(findings[i]):
                findings[i] = z
    for i in range(3):
        beyond = beyond or findings[i] > frozen.ends[i]
    if beyond:
        tell(memory, frozen, findings)


@Driver
def scan(rows: Array, frozen: Frozen, memory: Memory, findings: Array, use: Array) -> None:
    """Judge rows (T, n + 4), regressors and the columns of `ROW`: findings (T, FINDINGS) are repeated at rows without
    a result.

    use (T,) is what every row was good for, `NOTHING` to `JUDGED`.
    """
    for t in range(rows.shape[0]):
        use[t] = enter_row(rows[t], frozen, memory)
        if use[t] == JUDGED:
            judge(memory, frozen, memory.findings)
        for i in range(findings.shape[1]):
            findings[t, i] = memory.findings[i]
