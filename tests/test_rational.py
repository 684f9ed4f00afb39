"""Rational models: the direct fit is consistent and its standard deviations hold, least squares is biased."""

import numpy as np
import pytest

from driftfit.use.system_from_path import rational_model

TRUTH = np.array([0.3, 0.7, 0.8, 0.2])


def record(seed, T, sigma=0.2):
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=T + 1), np.zeros(T + 1)
    for t in range(1, T + 1):
        y[t] = (0.3 * y[t - 1] + 0.7 * u[t - 1]) / (1.0 + 0.8 * u[t - 1] ** 2 + 0.2 * y[t - 1] ** 2)
        y[t] += sigma * rng.normal()
    return y[1:], np.column_stack([y[:-1], u[:-1]]), np.column_stack([u[:-1] ** 2, y[:-1] ** 2])


def test_standard_deviations_are_those_of_the_errors():
    found = [rational_model(*record(seed, 1000)) for seed in range(200)]
    z = np.array([(np.r_[one.a, one.b] - TRUTH) / one.std for one in found])
    np.testing.assert_allclose(np.mean(z, axis=0), 0.0, atol=3.5 / np.sqrt(200))
    np.testing.assert_allclose(np.mean(z**2, axis=0), 1.0, atol=3.5 * np.sqrt(2.0 / 200))
    assert np.mean([one.sigma**2 for one in found]) == pytest.approx(0.04, rel=0.02)


def test_compensation_takes_the_bias_of_least_squares_away():
    """At little noise and a long record: least squares is off by ten times its compensation."""
    found = rational_model(*record(0, 100_000, sigma=0.05))
    assert np.abs(found.least_squares - TRUTH).max() > 0.1
    assert np.abs(found.compensated - TRUTH).max() < 0.02
    assert np.abs(np.r_[found.a, found.b] - TRUTH).max() < 3.5 * found.std.max()


def test_missing_samples_and_refusals():
    y, phi, psi = record(1, 300)
    y[10], phi[20, 0], psi[30, 1] = np.nan, np.inf, 1e200
    kept = np.delete(np.arange(300), [10, 20, 30])
    np.testing.assert_allclose(
        rational_model(y, phi, psi).a, rational_model(y[kept], phi[kept], psi[kept]).a, rtol=1e-12
    )
    with pytest.raises(ValueError, match="phi is y itself"):
        rational_model(y[:9], np.column_stack([y, phi[:, 1]])[:9], psi[:9])
    with pytest.raises(ValueError, match="4 usable samples cannot determine 4"):
        rational_model(y[:4], phi[:4], psi[:4])
