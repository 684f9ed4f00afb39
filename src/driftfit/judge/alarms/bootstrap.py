"""Limits of the "glr" and "cusum" alarms by a bootstrap of the reference.

Every simulated record has its own reference. The residuals x of the reference are drawn in blocks, with random signs
(sums of fitted residuals in their order vary too little), they get the variances h of the model, and scale and
variances are estimated from them again; so is the error of theta, from its covariance. A record of regressors and
residuals drawn together follows, whose scores are those of the model that was estimated from its own reference. The
limits so allow for everything that is estimated: a stream carries these errors for ever.

With a deviate c as statistic the logarithm of the rate of onsets falls nearly as a straight line in c^2. A limit that
is rarer than the simulated records can show is found along that line, which also gives the probability of an extreme.

Source: Kunsch (1989) for blocks; Wu (1986) for signs. Cost: half a second at n = 4.
"""

from __future__ import annotations

import numpy as np
import scipy

from driftfit.engine.kernel import Array
from driftfit.judge.alarms.calibration import limit_of
from driftfit.judge.alarms.frozen import Rows, noise_model
from driftfit.judge.statistics.whiteness import whiteness
from driftfit.run.live.likelihood_ratio import (
    CLIP,
    CUSUM,
    LEVELS,
    SCALE,
    SHORT,
    Frozen,
    K,
    levels,
    memory_of,
    played,
    scan_scores,
)

RECORDS, SAMPLES = 64, 1000
"""Simulated records, and the samples of each that count."""
START = SHORT << (LEVELS - 1)
"""Samples at the beginning of a record that are not counted: the longest window is not complete."""
SEEN = 100.0
"""Onsets in all records from which a limit is known; rarer ones are extrapolated."""
OFTEN = 10.0
"""The smallest number of samples from one onset to the next from which a limit is extrapolated."""
CORRELATED = 1e-3
"""p-value of whiteness of squared scores below which residuals are drawn in blocks."""
STEP = 8.0
"""Factor between the two rates that determine the line."""

Made = list[tuple[Array, int]]
"""(statistics (T, c), first sample that counts) of simulated records."""


def simulated(frozen: Frozen, rows: Rows, seed: int, records: int = RECORDS) -> Made:
    """The statistics of records without a change; fewer records are the first of more."""
    rng = np.random.default_rng(seed)
    (N, n), T = rows.phi.shape, SAMPLES + START
    root, block = np.linalg.cholesky(frozen.cov), _block(frozen, rows.x)
    drawn = scipy.special.ndtri(scipy.stats.qmc.Sobol(n, rng=seed).random(records) * (1.0 - 1e-9) + 5e-10)
    made = []
    for z in drawn:
        known, later = _played(frozen, rows.x[_blocks(rng, N, N, block)], rng), _blocks(rng, N, T, block)
        numbers, _ = noise_model(known, 0)
        w, h = _played(frozen, rows.x[later], rng) / numbers[SCALE], np.empty(T)
        levels(w, numbers, h)
        phi = rows.phi[later] / np.sqrt(h)[:, None]
        g = np.clip(w / np.sqrt(h), -numbers[CLIP], numbers[CLIP]) - numbers[K] * (phi @ (root @ z))
        findings = np.empty((T, CUSUM + n + 1))
        scan_scores(phi, g, frozen._replace(numbers=numbers), memory_of(n, 0), findings)
        made.append((findings, START))
    return made


def _block(frozen: Frozen, x: Array) -> int:
    """Length of blocks: 1, unless the size of the residuals is correlated even so.

    In blocks, a short window has no other sums of squares than those of the reference, whose largest is then the
    largest of all.
    """
    g = np.clip(x, -frozen.numbers[CLIP], frozen.numbers[CLIP])
    return 1 if whiteness(g * g - np.mean(g * g)).p > CORRELATED else int(np.clip(len(x) // 20, 20, 200))


def _blocks(rng: np.random.Generator, N: int, T: int, block: int) -> Array:
    """Indices (T,) of blocks of a record of N samples."""
    first = rng.integers(0, N, T // block + 1)
    return np.asarray((first[:, None] + np.arange(block)).ravel()[:T] % N)


def _played(frozen: Frozen, x: Array, rng: np.random.Generator) -> Array:
    """Residuals with the variances of the model and random signs."""
    w = np.empty(len(x))
    played(x * rng.choice((-1.0, 1.0), len(x)), frozen.numbers, w)
    return w


def limits(made: Made, columns: list[int], every: float) -> tuple[Array, Array]:
    """Limits (c,) of columns for one onset in ``every`` samples, and the growth (c,) of their square with its log."""
    parts = [(findings[:, columns], start) for findings, start in made]
    base = min(every, max(SAMPLES * len(made) / SEEN, STEP * OFTEN))
    often = max(base / STEP, OFTEN)
    near, nearer = limit_of(parts, base), limit_of(parts, often)
    growth = np.maximum(near**2 - nearer**2, 0.1) / np.log(base / often)
    return np.sqrt(near**2 + growth * np.log(every / base)), growth
