"""`AdaptiveKalman` after a jump, and where one parameter walks as fast as the noise or faster."""

import numpy as np
import pytest

from driftfit import ARX, RLS, AdaptiveKalman, Kalman, Regression, track

T, AT, NOISE = 500, 300, 0.3


def squares(run, theta):
    """Squared error of theta at every sample."""
    return np.sum((run.theta - theta) ** 2, axis=1)


def test_after_a_jump_constants_are_learned_as_by_least_squares():
    """From 30 to 100 samples after a jump, compared with least squares that begin at the jump: at most 2.2 times the
    mean square."""
    own, least = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        theta = np.where(np.arange(T)[:, None] < AT, rng.normal(size=4), rng.normal(size=4))
        u = rng.normal(size=(T, 4))
        y = np.sum(u * theta, axis=1) + NOISE * rng.normal(size=T)
        late = slice(AT + 30, AT + 100)
        own.append(squares(track(Regression(4), AdaptiveKalman(), y, u), theta)[late].mean())
        least.append(squares(track(Regression(4), RLS(1.0), y[AT:], u[AT:]), theta[AT:])[30:100].mean())
    assert np.mean(own) < 2.2 * np.mean(least)


@pytest.mark.parametrize(("std", "limit"), [(0.4, 1.25), (1.0, 1.7)])
def test_one_parameter_that_walks_fast(std, limit):
    """Drift that adds 2 and 11 times the noise variance in a sample."""
    ratios, inside = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        theta = np.cumsum(std * rng.normal(size=(T, 1)), axis=0)
        u = rng.normal(size=(T, 1))
        y = (u * theta)[:, 0] + NOISE * rng.normal(size=T)
        run = track(Regression(1), AdaptiveKalman(), y, u)
        known = track(Regression(1), Kalman(q=std**2, r=NOISE**2), y, u)
        ratios.append(np.sqrt(squares(run, theta)[150:].mean() / squares(known, theta)[150:].mean()))
        inside.append(np.mean(np.abs(run.theta - theta)[150:] < 1.96 * run.std[150:]))
    assert np.mean(ratios) < limit
    assert 0.92 < np.mean(inside) < 0.98


@pytest.mark.parametrize("model", [Regression(1), Regression(1, intercept=True), ARX(1, 1, intercept=True)])
def test_a_jump_of_the_response_to_rare_pulses(model):
    """By forty deviations, at inputs that are 0 in 98 of 100 samples: every response was left out as an outlier."""
    for seed in (0, 4, 6):
        rng = np.random.default_rng(seed)
        u, gain = (rng.random(1000) < 0.02) * 1.0, np.where(np.arange(1000) < 500, 5.0, 1.0)
        lag = 0.7 if isinstance(model, ARX) else 0.0
        y = np.zeros(1000)
        for t in range(1, 1000):
            y[t] = lag * y[t - 1] + (gain * u)[t - 1 if lag else t] + 0.1 * rng.normal()
        run = track(model, AdaptiveKalman(), y, u)
        i = 1 if lag else 0
        last = np.flatnonzero(u[:-1])[-1] + i  # until the next pulse another jump may be hidden
        assert abs(run.theta[last, i] - 1.0) < 3.0 * run.std[last, i]
        assert run.std[last, i] < 0.5
        path = run.smooth()
        np.testing.assert_allclose(path.theta[[100, -1], i], [5.0, 1.0], atol=0.2)


def test_a_response_to_rare_pulses_that_rises():
    """It is far outside the range of all readings, but not of responses, and was left out as a fault code."""
    rng = np.random.default_rng(0)
    u = (rng.random(1500) < 0.02) * 1.0
    y = np.where(np.arange(1500) < 750, 1.0, 5.0) * u + 2.0 + 0.1 * rng.normal(size=1500)
    run = track(Regression(1, intercept=True), AdaptiveKalman(), y, u)
    assert run.theta[-1, 0] == pytest.approx(5.0, abs=0.2)


def test_outliers_at_rare_pulses_are_forgotten_with_the_next_pulse():
    """Nothing tells one from a jump before."""
    rng = np.random.default_rng(0)
    u = (rng.random(1000) < 0.04) * 1.0
    y = 5.0 * u + 0.1 * rng.normal(size=1000)
    y[np.flatnonzero(u)[::4]] += rng.normal(scale=4.0, size=len(np.flatnonzero(u)[::4]))
    run = track(Regression(1, intercept=True), AdaptiveKalman(), y, u)
    assert np.median(np.abs(run.theta[200:, 0] - 5.0)) < 0.1


def test_an_outlier_at_a_regressor_near_0_is_no_jump():
    """A jump that explains it would be so large that, improbable as it is, it moved the estimate by up to 1.8."""
    errors = []
    for seed in (108, 111, 136):
        rng = np.random.default_rng(seed)
        u = rng.normal(size=600)
        y = u + 0.1 * rng.normal(size=600)
        faulty = rng.random(600) < 0.05
        run = track(Regression(1), AdaptiveKalman(), y + 3.0 * faulty * rng.choice([-1.0, 1.0], 600), u)
        errors.append(np.abs(run.theta[60:, 0] - 1.0).max())
    assert max(errors) < 0.3
