"""The particle filter: the Kalman filter as its limit, two peaks, random numbers."""

import numpy as np
import pytest
from scipy import stats

from driftfit import JointKalman, Live, ParticleFilter, StateSpace, track
from driftfit.trackers.state_space.particle_steps import normal

BENDING = StateSpace(
    """
    x = 0.5 * x[-1] + 25 * x[-1] / (1 + x[-1] ** 2) + 8 * cos(1.2 * clock)
    y = x * x / 20 + theta.b * u
    """,
    start={"b": 0.0},
)
"""The growth model of Gordon, Salmond and Smith (1993), whose output does not know the sign of x; b is linear in it."""

VARIANCES = {"q": {"x": 10.0}, "r": 1.0, "p0": {"b": 4.0, "x": 5.0}}
SMOOTH = StateSpace("x = 0.9 * x[-1] + theta.b * u \n y = x + theta.c", start={"b": 0.0, "c": 0.0})
GAUSSIAN = {"q": {"b": 1e-3, "c": 1e-3, "x": 0.1}, "r": 0.2, "p0": 1.0}


def bending(T, seed):
    rng = np.random.default_rng(seed)
    u, x, paths, y = rng.normal(size=T), 0.0, [], []
    for t in range(T):
        x = 0.5 * x + 25.0 * x / (1.0 + x * x) + 8.0 * np.cos(1.2 * t) + np.sqrt(10.0) * rng.normal()
        paths.append(x)
        y.append(x * x / 20.0 + 1.5 * u[t] + rng.normal())
    return np.array(y), u, np.array(paths)


def smooth(T, seed):
    rng = np.random.default_rng(seed)
    u, x, y = rng.normal(size=T), 0.0, np.zeros(T)
    for t in range(T):
        x = 0.9 * x + 0.7 * u[t] + np.sqrt(0.1) * rng.normal()
        y[t] = x + 0.5 + np.sqrt(0.2) * rng.normal()
    y[40:50], u[70] = np.nan, np.nan
    return y, u


def test_with_nothing_drawn_it_is_the_kalman_filter_and_with_the_state_drawn_it_comes_near():
    y, u = smooth(150, 0)
    exact = track(SMOOTH, JointKalman(**GAUSSIAN, method="extended"), y, u)
    run = track(SMOOTH, ParticleFilter(200, **GAUSSIAN, sampled=()), y, u)
    for name in ("theta", "std", "prediction", "innovation_std"):
        np.testing.assert_allclose(getattr(run, name), getattr(exact, name), rtol=1e-9, atol=1e-12, err_msg=name)
    assert run.loglik == pytest.approx(exact.loglik, rel=1e-9)
    drawn = [track(SMOOTH, ParticleFilter(200, **GAUSSIAN, seed=seed), y, u) for seed in range(8)]
    apart = np.array([(one.theta - exact.theta) / exact.std for one in drawn])
    assert np.sqrt(np.mean(apart**2)) < 0.4
    assert abs(np.mean([one.loglik for one in drawn]) - exact.loglik) < 1.5


def test_two_peaks_where_kalman_filters_fail():
    errors, inside = {"particles": [], "unscented": []}, []
    for seed in range(4):
        y, u, x = bending(300, seed)
        run = track(BENDING, ParticleFilter(500, **VARIANCES), y, u)
        errors["particles"].append(run.theta[:, 1] - x)
        errors["unscented"].append(track(BENDING, JointKalman(**VARIANCES), y, u).theta[:, 1] - x)
        inside.append(np.abs(errors["particles"][-1]) < 1.96 * run.std[:, 1])
    size = {name: np.sqrt(np.mean(np.square(one))) for name, one in errors.items()}
    assert size["particles"] < 5.0
    assert size["unscented"] > 7.0
    assert 0.9 < np.mean(inside) < 0.98


def test_random_numbers_are_normal_and_do_not_depend_on_their_neighbours():
    z = np.array([[normal(k, seed) for k in range(4000)] for seed in (0, 1, 2**40)])
    for row in z:
        assert stats.kstest(row, "norm").pvalue > 0.01
        assert abs(np.corrcoef(row[1:], row[:-1])[0, 1]) < 0.05
    assert np.abs(np.corrcoef(z)[np.triu_indices(3, 1)]).max() < 0.05
    assert normal(2**33, 0) != normal(0, 0)


def test_what_it_cannot_follow_is_refused():
    with pytest.raises(ValueError, match="sampled names 'z'"):
        Live(SMOOTH, ParticleFilter(10, **GAUSSIAN, sampled=["z"]))
    with pytest.raises(ValueError, match="particles must be"):
        ParticleFilter(0)
    with pytest.raises(ValueError, match="particles"):
        Live(SMOOTH, ParticleFilter(**GAUSSIAN))


def test_a_state_without_drift_is_not_drawn():
    """Drawn, it would move at the first sample alone, and with it what is learned of the parameters."""
    y, u = smooth(150, 0)
    still = {**GAUSSIAN, "q": {"b": 1e-3, "c": 1e-3}}
    exact = track(SMOOTH, JointKalman(**still, method="extended"), y, u)
    run = track(SMOOTH, ParticleFilter(200, **still), y, u)
    np.testing.assert_allclose(run.theta, exact.theta, rtol=1e-9, atol=1e-12)
