"""Noise that is louder where the regressors are large, as where an error is a percentage of what is measured.

    w_t                                    white residuals of the segments, divided by the level of the noise around t
    sigma_t^2 = a + sum_i b_i x_ti^2       a, b >= 0;  x_t regressors
    g_t = sigma_t / median of sigma

Rows of equal weight would let the few largest regressors decide, and their errors divide a record of constants. Rows
divided by g have noise of one size. Where the squares of w, regressed on those of x, show no dependence, g is not used.
a and b are weighted least squares of w^2 on x^2, and w is limited to three sigma, each from the round before.

Source: White (1980), Koenker (1981) for the test; Harvey (1976) for the weights. Cost: O(N n^2).
"""

from __future__ import annotations

import numpy as np
import scipy

from driftfit.engine.kernel import Array
from driftfit.judge.statistics.noise import HELD, Noise, whitened
from driftfit.judge.statistics.robust import deviation
from driftfit.smooth.parts.rank import column_sizes

DOUBT = 0.01
"""Probability that noise of one size is said to depend on the regressors."""
TIED = 0.25
"""Share of equal outputs above which they are a bound, or counts."""
ROUNDS = 10
LEAST = 0.05
"""Smallest g."""


def relative_size(phi: Array, y: Array, found: Noise) -> Array | None:
    """g (N,) of the noise found in y (N,) on phi (N, n); None if the noise does not depend on the regressors.

    A value that the output often has, such as a bound, is not an error that grows with a regressor.
    """
    if np.unique(y, return_counts=True)[1].max() > TIED * len(y):
        return None
    p = len(found.ar)
    w = whitened(phi[:, :0], found.residual / found.level, found.ar)[1]
    squares = (phi / column_sizes(phi)) ** 2
    squares = np.column_stack([np.ones(len(phi)), squares[:, np.ptp(squares, axis=0) > 1e-9]])
    if not _depends(squares[p:] / (1.0 + squares[p:]), w[p:]):
        return None
    from scipy import optimize  # a tenth of a second to import

    sigma = np.full(len(w), deviation(w[p:]))
    for _ in range(ROUNDS):
        held = np.clip(w, -HELD * sigma, HELD * sigma)[p:] ** 2
        weight = 1.0 / sigma[p:] ** 2
        share = optimize.nnls(squares[p:] * weight[:, None], held * weight)[0]
        variance = squares @ share
        sigma = np.sqrt(np.maximum(variance, LEAST**2 * (np.median(variance) or np.mean(variance))))
    return np.asarray(sigma / np.median(sigma))


def _depends(squares: Array, w: Array) -> bool:
    """Whether w (N,) squared depends on the squares (N, k) of regressors, the first of them 1."""
    limit = HELD * deviation(w)
    held = np.clip(w, -limit, limit) ** 2
    held = held - held.mean()
    fitted, _, rank, _ = np.linalg.lstsq(squares, held)
    if rank < 2 or len(w) < 4 * rank or not held.any():
        return False
    explained = squares @ fitted
    gain = len(w) * (explained @ explained) / (held @ held)
    return bool(scipy.special.gammaincc(0.5 * (rank - 1), 0.5 * gain) < DOUBT)
