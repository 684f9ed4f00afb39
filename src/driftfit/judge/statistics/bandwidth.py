"""How many lags of correlation a test of constancy must allow for, estimated from the record.

    w_t      scores phi_t psi(e_t), whitened: sum w_t w_t' = N I
    G        sum w_t w_(t-1)' / N                      correlation of neighbours
    rho^2    square of the largest eigenvalue of (G + G') / 2, minus its expectation without correlation,
             (2 / n) sum |w_t|^2 |w_(t-1)|^2 / N^2, which is 2 n / N for constant noise
    lags     1.1447 (4 rho^2 / (1 - rho^2)^2 N)^(1/3)      best for a Bartlett window and an autoregression

rho belongs to the most correlated of all combinations of the scores, however the regressors are scaled or combined.

Source: Andrews (1991), equations 5.3 and 6.4. Newey and West (1994) for the rule of thumb, 4 (N / 100)^(2/9).
Departures: one direction instead of weights, and the subtraction of the expectation.
"""

from __future__ import annotations

import numpy as np

from driftfit.engine.drivers import ROUNDING
from driftfit.engine.kernel import Array


def rule_of_thumb(N: int) -> int:
    """4 (N / 100)^(2/9)."""
    return int(4.0 * (N / 100.0) ** (2.0 / 9.0))


def plugged_in(phi: Array, psi: Array) -> int:
    """Lags for the scores of regressors phi (N, n) and bounded residuals psi (N,)."""
    N = len(phi)
    scores = phi * psi[:, None]
    values, vectors = np.linalg.eigh(scores.T @ scores / N)
    kept = values > ROUNDING * values[-1]
    if not kept.any():
        return 0
    white = scores @ (vectors[:, kept] / np.sqrt(values[kept]))
    G = white[1:].T @ white[:-1] / N
    largest = float(np.max(np.abs(np.linalg.eigvalsh(0.5 * (G + G.T)))))
    size = np.sum(white * white, axis=1)
    chance = 2.0 * float(size[1:] @ size[:-1]) / (len(G) * N * N)
    square = min(max(largest**2 - chance, 0.0), 0.9)
    return min(int(1.1447 * (4.0 * square / (1.0 - square) ** 2 * N) ** (1.0 / 3.0)), N // 8)
