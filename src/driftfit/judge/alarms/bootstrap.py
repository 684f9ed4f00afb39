"""Limits of the "glr" and "cusum" alarms by a bootstrap of the reference.

Every simulated record has its own reference. Its residuals x are drawn from those of the observed reference, in blocks
and with random signs (sums of fitted residuals in their order vary too little). They are given the variances h of the
model, and scale and variances are estimated from them again; an error of theta is drawn from its covariance. In the
record that follows, regressors and residuals are drawn together, and its scores are those of the model that was
estimated from its own reference. The limits therefore allow for everything that is estimated: a stream keeps these
errors for as long as it runs. Whether the variance changes at all is seldom certain, so alpha and beta of each record
are drawn from those that the reference leaves plausible. So is the autoregression that colours the noise of a record,
which is whitened by the one that was estimated. Fault codes keep their sign and their regressors.

A window of L samples is beyond a limit c of "glr" if its deviate z is, with

    z^2 > c^2 + 2 EVEN log(384 / L)

and the false alarms of its three statistics are in the relation `SHARES`.

With a deviate c as statistic the logarithm of the rate of onsets falls nearly as a straight line in c^2. A limit that
is rarer than the simulated records can show is found along that line, which also gives the probability of an extreme.

Source: Kunsch (1989) for blocks; Wu (1986) for signs. Cost: half a second at n = 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import scipy

from driftfit.engine.kernel import Array
from driftfit.judge.alarms.calibration import limits_of
from driftfit.judge.alarms.frozen import FAULTY, GARCH, Rows, noise_models, plausible, slopes_of
from driftfit.judge.alarms.side_by_side import SimulatedRecords, statistics_of
from driftfit.judge.alarms.variances import residuals, variances
from driftfit.judge.statistics.whiteness import whiteness
from driftfit.run.live.reference_model import (
    ALPHA,
    BETA,
    CLIP,
    CONSTANT,
    LEVELS,
    SCALE,
    SHORT,
    Frozen,
    K,
    stable,
    stationary,
)

RECORDS, SAMPLES = 64, 1000
"""Simulated records, and the samples of each that count."""
START = SHORT << (LEVELS - 1)
"""Samples at the beginning of a record that are not counted: the longest window is not complete."""
ENOUGH = 100.0
"""Onsets in all records from which a limit is known; rarer ones are extrapolated."""
OFTEN = 10.0
"""The smallest number of samples from one onset to the next from which a limit is extrapolated."""
CORRELATED = 1e-3
"""p-value of whiteness of squared scores below which residuals are drawn in blocks."""
SHARES = (4.0, 2.0, 1.0)
"""Shares of one parameter, all parameters and the noise in the false alarms of "glr". Most changes are of one
parameter, and the noise exceeds its share where its variance comes in bursts that a short reference hardly shows.
"""
STRATA = 10
"""Residuals are drawn from the rows with the same tenth of all leverages."""
STEP = 8.0
"""Factor between the two rates that determine the line."""


def simulated(frozen: Frozen, rows: Rows, seed: int, records: int = RECORDS) -> SimulatedRecords:
    """Records without a change; fewer records are the first of more."""
    (N, n), T = rows.phi.shape, SAMPLES + START
    draws = [np.random.default_rng([seed, k]) for k in (0, 1, 2, 5)]
    root = np.linalg.cholesky(frozen.cov)
    code = np.abs(rows.x) > FAULTY
    if drawn_in_blocks(frozen, rows.x):
        block = int(np.clip(N // 20, 20, 200))
        known, own = (_blocks(rng, (records, length), N, block) for rng, length in zip(draws[:2], (N, T), strict=True))
        later = own
    else:
        known = draws[0].integers(0, N, (records, N))
        later = (draws[3].integers(0, N, (records, 1)) + np.arange(T)) % N
        own = _of_like_rows(np.einsum("ti,ij,tj->t", rows.phi, frozen.cov, rows.phi), later, draws[1])
        own = np.where(code[later] | code[own], later, own)
    signs = draws[2].integers(0, 2, (records, N + T)) * 2.0 - 1.0
    drawn = np.tile(frozen.numbers, (records, 1))
    drawn[:, [ALPHA, BETA]] = _variances(frozen, rows.x, _evenly(records, seed))
    drawn_rows = np.hstack([known, own])
    x = rows.x[drawn_rows] * np.where(code[drawn_rows], 1.0, signs)
    w = np.hstack([residuals(x[:, :N], drawn), residuals(x[:, N:], drawn)])
    numbers, _ = noise_models(w[:, :N], n)
    w *= np.sqrt(N / max(N - n, 1))  # what follows has not been fitted
    if len(frozen.ar):
        w[:, N:] = _whitened_again(w[:, N:], frozen.ar, N, np.random.default_rng([seed, 6]))
    z = _normal(n, records, seed) * np.sqrt(N / max(N - n - 1, 1))  # nor are its regressors those of the reference
    w = w[:, N:] / numbers[:, SCALE, None]
    h = variances(w, numbers)
    phi = rows.phi[later] / np.sqrt(h)[..., None]
    clip, k = numbers[:, CLIP, None], numbers[:, K, None]
    g = np.clip(w / np.sqrt(h), -clip, clip) - k * np.einsum("rti,ri->rt", phi, z @ root.T)
    numbers[:, CONSTANT] = frozen.numbers[CONSTANT]
    cov, slopes = (np.broadcast_to(one, (records, *one.shape)) for one in (frozen.cov, slopes_of(frozen)))
    return SimulatedRecords(cov, numbers, phi, g, slopes)


@lru_cache(64)
def _normal(n: int, records: int, seed: int) -> Array:
    """Normal numbers (records, n) that fill space evenly."""
    sobol = scipy.stats.qmc.Sobol(n, rng=np.random.default_rng([seed, 3]))
    drawn = sobol.random_base2(int(np.ceil(np.log2(records))))[:records]
    return np.asarray(scipy.special.ndtri(drawn * (1.0 - 1e-9) + 5e-10))


def _evenly(records: int, seed: int) -> Array:
    """Numbers (records,) that fill the interval from 0 to 1 evenly: multiples of the golden ratio."""
    return np.asarray(
        (np.random.default_rng([seed, 4]).random() + np.arange(records) * 0.5 * (np.sqrt(5.0) - 1.0)) % 1.0
    )


def together(parts: Sequence[SimulatedRecords]) -> SimulatedRecords:
    """The records of several references in one."""
    return SimulatedRecords(*map(np.concatenate, zip(*parts, strict=True)))


def drawn_in_blocks(frozen: Frozen, x: Array) -> bool:
    """Whether the size of the residuals is correlated even after the GARCH part, so that they are drawn in blocks.

    With blocks, the sums of squares of a short window are those that occur in the reference, so that none exceeds its
    largest.
    """
    g = np.clip(x, -frozen.numbers[CLIP], frozen.numbers[CLIP])
    return whiteness(g * g - np.mean(g * g)).p <= CORRELATED


def _blocks(rng: np.random.Generator, shape: tuple[int, int], N: int, block: int) -> Array:
    """Indices (R, T) of blocks of a record of N samples."""
    R, T = shape
    first = rng.integers(0, N, (R, T // block + 1))
    return np.asarray((first[..., None] + np.arange(block)).reshape(R, -1)[:, :T] % N)


def _of_like_rows(leverage: Array, rows: Array, rng: np.random.Generator) -> Array:
    """Indices (R, T), each drawn from the rows whose leverage (N,) is about as large as that of ``rows`` (R, T)."""
    N = len(leverage)
    order, place = np.argsort(leverage), np.empty(N, np.int64)
    place[order] = np.arange(N)
    size = -(-N // STRATA)
    first = np.minimum(place // size * size, N - size)
    return np.asarray(order[first[rows] + rng.integers(0, size, rows.shape)])


def _whitened_again(w: Array, ar: Array, N: int, rng: np.random.Generator) -> Array:
    """White noise w (R, T) coloured by an autoregression, and whitened by ``ar`` (p,), its estimate from N samples.

    Errors of the estimate have the covariance (stationary covariance of p lags)^-1 / N.
    """
    root = np.linalg.cholesky(np.linalg.inv(stationary(ar)) / N)
    made = np.empty_like(w)
    for k, z in enumerate(rng.normal(size=(len(w), len(ar)))):
        true = stable(ar + root @ z)
        made[k] = scipy.signal.lfilter(np.append(1.0, -ar), np.append(1.0, -true), w[k])
    return made


def _variances(frozen: Frozen, x: Array, chance: Array) -> Array:
    """alpha and beta (R, 2) of the records, drawn from those that the reference leaves plausible; ``chance`` (R,)."""
    numbers = frozen.numbers[None]
    which = np.searchsorted(np.cumsum(plausible(residuals(x[None], numbers), numbers)), chance)
    return np.asarray(GARCH[:, np.minimum(which, GARCH.shape[1] - 1)].T)


def limits(records: SimulatedRecords, cusum: bool, every: float) -> tuple[Array, Array, float]:
    """Limits (c,) of "glr" or "cusum" for one onset in ``every`` samples; growth (c,) of their square with its log; and
    the standard deviation of the log of the rate that a stream has with these limits, since it keeps the errors of its
    reference.

    Each record has such errors of its own, so that the numbers of onsets in its halves are correlated; that onsets come
    in groups makes no difference to this. The exponent of a rate, and so its error, grows with the square of the limit.
    """
    statistic = statistics_of(records, cusum, START)
    base = min(every, max(SAMPLES * len(statistic) / ENOUGH, STEP * OFTEN))
    often = max(base / STEP, OFTEN)
    near, nearer = limits_of([(one, 0) for one in statistic], base, often, shares=() if cusum else SHARES)
    growth = np.maximum(near**2 - nearer**2, 0.1) / np.log(base / often)
    found = np.sqrt(near**2 + growth * np.log(every / base))
    idle = ~statistic.any(axis=(0, 1))
    found[idle], growth[idle] = found[~idle].max(), growth[~idle].max()
    active = np.logical_or.reduce([statistic[..., j] > limit for j, limit in enumerate(near)])
    begun, half = active & ~np.column_stack([np.zeros(len(active), bool), active[:, :-1]]), active.shape[1] // 2
    halves = np.column_stack([begun[:, :half].sum(axis=1), begun[:, half:].sum(axis=1)])
    mean = max(float(halves.mean()), 1e-9)
    beyond = np.log1p(max(float(np.cov(halves.T)[0, 1]), 0.0) / mean**2)
    return found, growth, float(np.sqrt(beyond) * np.mean(found**2) / np.mean(near**2))
