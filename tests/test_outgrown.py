"""A regressor with far more information about a coordinate than all before it, against filters of eighty digits.

Two columns are equal within 1e-7 for 40 samples: their difference is a coordinate in its own unit, which shares a
walking parameter with another one. Then the columns part, and the difference carries 1e14 times the information it had.
"""

from decimal import Decimal, localcontext

import numpy as np
import pytest

from driftfit import Bank, Change, Regression, Sensor, track

N, PARTED, T = 3, 40, 60
EXACT = np.vectorize(Decimal, otypes=[object])


def record(near, seed):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((T, N))
    u[:PARTED, 1] = u[:PARTED, 0] + near * (0.8 * u[:PARTED, 2] + 0.6 * u[:PARTED, 1])
    return u @ [1.0, -2.0, 0.5] + 0.7 * rng.standard_normal(T), u


def taken(m, P, y, phi, r):
    """Mean and covariance after a sample."""
    g = P @ EXACT(phi)
    s, e = EXACT(phi) @ g + Decimal(r), Decimal(y) - EXACT(phi) @ m
    return m + g * (e / s), P - np.outer(g, g) / s


def stds(P):
    return np.sqrt(P.diagonal().astype(float))


@pytest.mark.parametrize("near", [1e-7, 1e-9])
@pytest.mark.parametrize("q", [(0.0, 0.0, 0.0), (1e-3, 1e-3, 5e-2)], ids=["constant", "walking"])
def test_a_bank_keeps_the_correlations_of_an_outgrown_coordinate(near, q):
    y, u = record(near, 4)
    run = track(Regression(N), Bank([Change(q=q)], [Sensor.nominal(r=0.5)]), y, u)
    guessed = track(Regression(N), Bank([Change(q=0.0)], [Sensor.nominal(guess=3.0)]), y, u)
    with localcontext() as context:
        context.prec = 80
        m, P = EXACT(np.zeros(N)), EXACT(np.eye(N)) * Decimal(10) ** 40
        for t in range(T):
            m, P = taken(m, P + EXACT(np.diag(q)), y[t], u[t], 0.5)
            if t >= PARTED:
                np.testing.assert_allclose((run.theta[t] - m.astype(float)) / stds(P), 0.0, atol=1e-12)
                np.testing.assert_allclose(run.std[t], stds(P), rtol=1e-12)
                if not any(q):
                    np.testing.assert_allclose((guessed.theta[t] - m.astype(float)) / stds(P), 0.0, atol=1e-12)
