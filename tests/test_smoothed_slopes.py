"""The smoother of `AdaptiveKalman` follows slopes where slopes walk, and levels where levels do."""

import numpy as np
import pytest

from driftfit import FLS, AdaptiveKalman, Kalman, Regression, track
from driftfit.smooth.solvers.slopes import log_likelihood

T = 600


def path(kind, rng):
    if kind == "slopes walk":
        return 1.0 + np.cumsum(np.cumsum(1e-3 * rng.normal(size=(T, 2)), axis=0), axis=0)
    if kind == "a ramp":
        return np.column_stack([np.linspace(0.0, 2.0, T), np.ones(T)])
    return 1.0 + np.cumsum(0.02 * rng.normal(size=(T, 2)), axis=0)


def record(kind, seed, noise=0.3):
    rng = np.random.default_rng([seed, *kind.encode()])
    theta, u = path(kind, rng), rng.normal(size=(T, 2))
    return theta, (u * theta).sum(axis=1) + noise * rng.normal(size=T), u


def errors(kind, seed, tracker):
    theta, y, u = record(kind, seed)
    smoothed = track(Regression(2), tracker, y, u).smooth()
    away = smoothed.theta - theta
    return np.mean(away**2), np.mean(np.abs(away) < 1.96 * smoothed.std)


@pytest.mark.parametrize("kind", ["slopes walk", "a ramp"])
def test_as_near_as_second_differences_of_the_best_penalty(kind):
    own = np.mean([errors(kind, seed, AdaptiveKalman()) for seed in range(6)], axis=0)
    fixed = [
        np.mean([errors(kind, seed, FLS(mu, differences=2))[0] for seed in range(6)]) for mu in 10.0 ** np.arange(3, 9)
    ]
    assert own[0] < 1.7 * min(fixed)
    assert 0.88 < own[1] <= 1.0


def test_a_walk_has_no_slope():
    for seed in range(4):
        _, y, u = record("a walk", seed)
        with pytest.raises(ValueError, match="random walk"):
            _ = track(Regression(2), AdaptiveKalman(), y, u).smooth().slope


def test_slopes_are_those_of_time():
    """Half the rows: the slope per nominal interval is the same."""
    _theta, y, u = record("a ramp", 0, 0.1)
    half = track(Regression(2), AdaptiveKalman(), y[::2], u[::2], time=np.arange(0.0, T, 2.0)).smooth()
    y[1::2] = np.nan
    missing = track(Regression(2), AdaptiveKalman(), y, u).smooth()
    assert np.mean(half.slope[:, 0]) == pytest.approx(2.0 / T, rel=0.1)
    assert np.mean(missing.slope[:, 0]) == pytest.approx(2.0 / T, rel=0.1)


def test_the_likelihood_is_that_of_the_filter():
    """Without slopes it is the Kalman filter's, whose prior stands before the first sample too."""
    _theta, y, u = record("a walk", 1)
    run = track(Regression(2), Kalman(q=4e-4, r=1.0, p0=10.0), y, u)
    samples = np.column_stack([u, y, np.ones(T)])
    P = np.diag([10.0, 10.0, 0.0, 0.0])
    parts = np.zeros(3)
    log_likelihood(samples, np.full((T, 2), 4e-4), np.zeros(2), np.ones(T), np.zeros(4), P, parts)
    assert parts.sum() == pytest.approx(run.loglik + 0.5 * T * np.log(2.0 * np.pi), rel=1e-9)
