"""Limits of alarms by simulation: the model of the reference makes records, and each is watched as a stream is.

    y*_t = phi*_t' theta + v_t,    v_t = sum_k a_k v_(t-k) + scale sqrt(h_t) x_t

phi* has the inputs of the reference in their own order, and the lags of y* itself. x are residuals of the reference,
drawn with random signs; how their variance h changes is drawn from what the reference leaves plausible. The first N
samples are the reference of the record, from which its model is estimated anew, with the order of its noise; the others
are scanned by the routine that watches streams. The limits therefore allow for everything that is estimated: a stream
keeps these errors for as long as it runs. Fault codes keep their place and size. Residuals whose size is correlated
even after the GARCH part are drawn in blocks.

With a deviate c as statistic the logarithm of the rate of onsets falls nearly as a straight line in c^2. Of the three
statistics `SHARES` are their parts in the false alarms; then the rate of all together, with their ends, is that which
is set. A limit that is rarer than the simulated records can show is found along that line, which also gives the
probability of an extreme.

Source: Kunsch (1989) for blocks; Wu (1986) for signs. Cost: `RECORDS` reference models and as many streams.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from driftfit.engine.kernel import Array
from driftfit.judge.alarms.frozen import FAULTY, GARCH, Known, frozen_model, plausible, variances
from driftfit.judge.changes.recursion import Recursion, play
from driftfit.judge.statistics.whiteness import whiteness
from driftfit.run.live.likelihood_ratio import scan
from driftfit.run.live.reference_model import (
    ALPHA,
    BETA,
    BLAMED,
    CLIP,
    CONSTANT,
    FINDINGS,
    LENGTHS,
    NOISE_FACTOR,
    OK,
    SCALE,
    Frozen,
    Y,
    memory_of,
    stable,
)
from driftfit.run.live.rule import OFTENER

RECORDS, SAMPLES = 64, 1000
"""Simulated records, and the samples of each that count, after the longest window is complete."""
ENOUGH = 100.0
"""Onsets in all records from which a limit is known; rarer ones are extrapolated."""
OFTEN = 10.0
"""The smallest number of samples from one onset to the next from which a limit is extrapolated."""
CORRELATED = 1e-3
"""p-value of whiteness of squared scores below which residuals are drawn in blocks."""
SHARES = (4.0, 2.0, 1.0)
"""Shares of one parameter, all parameters and the noise in the false alarms. Most changes are of one parameter, and
the noise exceeds its share where its variance comes in bursts that a short reference hardly shows.
"""
STEP = 8.0
"""Factor between the two rates that determine the line."""
LEVELS = 41
"""Levels that are tried between these two."""


class Normal(NamedTuple):
    """A reference, and what was estimated from it."""

    rows: Array
    """(N, n + 4): regressors and the columns of `ROW`."""
    delays: tuple[tuple[int, int], ...]
    """(column, lag) of each regressor that is an earlier output."""
    frozen: Frozen
    known: Known


def drawn_in_blocks(normal: Normal) -> bool:
    """Whether the size of the residuals is correlated even after the GARCH part.

    With blocks, the sums of squares of a short window are those that occur in the reference, so that none exceeds its
    largest.
    """
    clip = normal.frozen.numbers[CLIP]
    g = np.clip(normal.known.x, -clip, clip)
    return bool(whiteness(g * g - np.mean(g * g)).p <= CORRELATED)


class Source:
    """Records that the model of a reference makes."""

    def __init__(self, normal: Normal, seed: int) -> None:
        self.normal, self.rng = normal, np.random.default_rng(seed)
        self.rows, (self.at, x) = normal.rows, normal.known
        frozen, (N, width) = normal.frozen, normal.rows.shape
        self.N, self.n, self.p = N, width - 4, len(frozen.ar)
        self.code = np.abs(x) > FAULTY
        self.pool = x[~self.code] * np.sqrt(len(x) / max(len(x) - self.n - self.p, 1))
        self.block = int(np.clip(len(self.pool) // 20, 20, 200)) if drawn_in_blocks(normal) else 1
        h = np.empty(len(x))
        variances(x, frozen.numbers, True, h)
        self.share = plausible(x * np.sqrt(h), frozen.numbers)
        self.theta, constant = frozen.theta.copy(), int(frozen.numbers[CONSTANT])
        if len(frozen.mean):
            self.theta[constant] -= frozen.mean @ frozen.theta
        self.columns = columns = [column for column, _ in normal.delays]
        if [lag for _, lag in normal.delays] == list(range(1, len(columns) + 1)):
            self.theta[columns] = stable(self.theta[columns])

    def _noise(self, M: int) -> Array:
        """White noise (M,), whose variance may change."""
        first = self.rng.integers(0, len(self.pool), M // self.block + 1)
        drawn = (first[:, None] + np.arange(self.block)).ravel()[:M] % len(self.pool)
        x = self.pool[drawn] * self.rng.choice([-1.0, 1.0], M)
        numbers, h = self.normal.frozen.numbers.copy(), np.empty(M)
        numbers[[ALPHA, BETA]] = GARCH[:, self.rng.choice(len(self.share), p=self.share)]
        variances(x, numbers, True, h)
        return np.asarray(numbers[SCALE] * np.sqrt(h) * x)

    def record(self, T: int) -> Array:
        """Rows (N + T, n + 4) of a reference and of the stream that follows."""
        N, n, frozen = self.N, self.n, self.normal.frozen
        order = np.concatenate([np.arange(N), (self.rng.integers(0, N) + np.arange(T)) % N])
        made = self.rows[order]
        made[made[:, n + OK] <= BLAMED, n + OK] = 0.0
        used = made[:, n + OK] > 0.0
        root = np.sqrt(np.where(used, made[:, n + NOISE_FACTOR], 1.0))
        phi = np.where(used[:, None], made[:, :n], 0.0) / root[:, None]
        columns, lags = np.array(self.columns, np.int64), np.array([lag for _, lag in self.normal.delays], np.int64)
        source = np.arange(N + T)[:, None] - lags
        way = Recursion(
            phi, np.zeros((0, 0)), columns, source, root[source] / root[:, None], self.theta, frozen.ar,
            np.zeros(N + T), self._noise(N + T),
        )  # fmt: skip
        drawn, y = np.empty((N + T, n)), np.empty(N + T)
        play(way, np.arange(1, self.p + 1), np.ones(N + T), np.empty(N + T), drawn, y)
        place = np.zeros(N)
        place[self.at[self.code]] = frozen.numbers[SCALE] * self.normal.known.x[self.code]
        made[:, :n], made[:, n + Y] = drawn * root[:, None], y * root + place[order]
        return np.asarray(made)


def simulated(normal: Normal, seed: int, records: int = RECORDS) -> Array:
    """Statistics (R, SAMPLES, 3) of streams without a change; fewer records are the first of more."""
    source, made, before = Source(normal, seed), [], LENGTHS[-1]
    for _ in range(records):
        rows = source.record(before + SAMPLES)
        found = frozen_model(rows[: source.N], int(normal.frozen.numbers[CONSTANT]), source.columns, source.p)
        if found is None or not np.isfinite(rows).all():
            continue
        findings = np.empty((before + SAMPLES, FINDINGS))
        scan(rows[source.N :], found[0], memory_of(found[0]), findings, np.zeros(before + SAMPLES, np.int8))
        made.append(np.nan_to_num(findings[before:, :3]))
    return np.array(made)


def limits(statistic: Array, every: float) -> tuple[Array, Array, float]:
    """Limits (3,) for one onset in ``every`` samples; growth (3,) of their square with its log; and the standard
    deviation of the log of the rate that a stream has with these limits, since it keeps the errors of its reference.

    Each record has such errors of its own, so that the numbers of onsets in its halves are correlated; that onsets come
    in groups makes no difference to this. The exponent of a rate, and so its error, grows with the square of the limit.
    """
    samples = statistic[..., 0].size
    base = max(min(every, samples / ENOUGH), STEP * OFTEN)
    often = base / STEP
    share = np.array(SHARES) / np.sum(SHARES)
    near, nearer = (
        np.array([exceeded(one, samples / rate * part) for one, part in zip(statistic.T, share, strict=True)])
        for rate in (base, often)
    )
    growth = np.maximum(near**2 - nearer**2, 0.1) / np.log(base / often)
    idle = ~statistic.any(axis=(0, 1))
    near[idle], growth[idle] = near[~idle].max(), growth[~idle].max()
    # in units of the logarithm of a rate, the largest of the three
    joint = np.max((statistic**2 - near**2) / growth, axis=2)
    level = held_level(joint, samples / base)
    found = np.sqrt(np.maximum(near**2 + growth * (level + np.log(every / base)), 0.0))
    active = joint > level
    begun, half = active & ~np.column_stack([np.zeros(len(active), bool), active[:, :-1]]), active.shape[1] // 2
    halves = np.column_stack([begun[:, :half].sum(axis=1), begun[:, half:].sum(axis=1)])
    mean = max(float(halves.mean()), 1e-9)
    beyond = np.log1p(max(float(np.cov(halves.T)[0, 1]), 0.0) / mean**2)
    return found, growth, float(np.sqrt(beyond) * np.mean(found**2) / np.mean(near**2))


def exceeded(values: Array, allowed: float) -> float:
    """The smallest level from which upwards none is passed by more than ``allowed`` onsets; values (T, R) of R records.

    A step from a to b > a is an onset over the levels c with a <= c < b, so the number at c is that of the a up to c
    minus that of the b up to c.
    """
    after = values.T.ravel()
    before = np.column_stack([np.full(values.shape[1], -np.inf), values.T[:, :-1]]).ravel()
    rising = after > before
    below, above = np.sort(before[rising]), np.sort(after[rising])
    begun = np.searchsorted(below, above, side="right") - np.searchsorted(above, above, side="right")
    most = np.maximum.accumulate(begun[::-1])[::-1]
    return float(above[min(int(np.searchsorted(-most, -allowed)), len(above) - 1)])


def held_level(joint: Array, allowed: float) -> float:
    """The smallest level of joint (R, T) down to which so many alarms begin at most, if each lasts until log(`OFTENER`)
    below it; not below that at which most begin: at a lower one they hardly end. Those that are on at the first sample
    began before it; between two levels that are tried the number grows in proportion.
    """
    width, place, most, found = np.log(OFTENER), np.arange(joint.shape[1]), 0, float(np.log(STEP))
    for level in np.linspace(found, -found, LEVELS):
        begins = joint > level
        decided = np.maximum.accumulate(np.where(begins | (joint <= level - width), place, 0), axis=1)
        active = np.take_along_axis(begins, decided, axis=1)
        begun = int(np.sum(active[:, 1:] & ~active[:, :-1]))
        if begun > allowed:
            return float(level + (found - level) * (begun - allowed) / (begun - most))
        most, found = (begun, float(level)) if begun >= most else (most, found)
    return found
