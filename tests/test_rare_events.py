"""The verdict on rare events: constant rates are not said to move, and rates that change are found."""

import numpy as np
import pytest

from driftfit.judge.statistics.constancy import constancy


def rare(kind, seed, T=400):
    """Constant rates of rare events, beside an input, in ways that say the same."""
    rng = np.random.default_rng(seed)
    u, counts, sales = rng.normal(size=T), rng.poisson(0.13, T), rng.poisson(4.0, T) * (rng.random(T) < 0.4)
    y = {
        "counts": counts,
        "counts missed, of twenty": 20 - counts,
        "bursts": 0.01 * rng.normal(size=T) + (rng.random(T) < 0.12) * rng.exponential(3.0, T),
        "sales in proportion": sales * np.exp(0.5 * u),
    }[kind]
    return np.column_stack([u, np.ones(T)]), y.astype(float)


@pytest.mark.parametrize("kind", ["counts", "counts missed, of twenty", "bursts", "sales in proportion"])
def test_error_rate_of_rare_events(kind):
    """Of 100 constant records at most 11 % are rejected, three standard errors above 5 %."""
    p = np.array([constancy(*rare(kind, seed)).p_joint for seed in range(100)])
    assert np.mean(p < 0.05) <= 0.11


def test_rare_events_that_become_frequent_for_a_time_are_found():
    """Also if nearly all of y is rare events: the change of the rate is not taken for correlated noise."""
    for seed in range(10):
        phi, y = rare("counts", seed)
        y[220:330] += np.random.default_rng(seed).poisson(1.2, 110)
        test = constancy(phi, y)
        assert test.p_joint < 1e-3
        assert test.noise is not None
        assert len(test.noise.breaks) > 0
