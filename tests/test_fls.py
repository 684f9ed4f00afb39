"""Flexible least squares, on line: against the smoother of every prefix and the Kalman filter."""

import json

import numpy as np
import pytest

from driftfit import FLS, Kalman, Regression, track
from driftfit.smooth import exact
from driftfit.smooth.solvers.walk import Walk


def record(L=40, n=2, seed=0):
    rng = np.random.default_rng([seed, L, n])
    return rng.standard_normal((L, n)), rng.standard_normal(L)


@pytest.mark.parametrize("mu", [1e-3, 1.0, 1e4])
def test_filter_is_the_last_point_of_the_smoother_of_every_prefix(mu):
    """Also while the regressors do not span: the first three are collinear."""
    phi, y = record(30)
    phi[:3] = np.outer([1.0, -2.0, 0.5], phi[0])
    run = track(Regression(2), FLS(mu, theta0=[0.5, 2.0]), y, phi)
    for k in range(1, 31):
        signals = np.column_stack([y[:k], np.ones(k), np.append(0.0, np.ones(k - 1))])
        problem = Walk(phi[:k], signals, np.eye(2) / mu, np.array([0.5, 2.0]), None, None)
        np.testing.assert_allclose(run.theta[k - 1], exact.smooth(problem).theta[-1], rtol=1e-10, atol=1e-10)


def test_filter_is_kalman_with_an_estimated_scale():
    phi, y = record()
    y[[5, 6]] = np.nan
    fls, kalman = track(Regression(2), FLS(4.0), y, phi), track(Regression(2), Kalman(q=0.25, r=1.0), y, phi)
    np.testing.assert_allclose(fls.theta, kalman.theta, rtol=1e-12, atol=1e-13)
    scale = fls.state["scale"]
    np.testing.assert_allclose(fls.cov(-1), scale * kalman.cov(-1), rtol=1e-12)
    np.testing.assert_allclose(fls.prediction, kalman.prediction, rtol=1e-12, atol=1e-13)


def test_settings_survive_a_file():
    tracker = FLS([1.0, np.inf], theta0=[0.0, 1.0], p0=2.0)
    assert FLS.from_settings(json.loads(json.dumps(tracker.settings()))) == tracker


@pytest.mark.parametrize("mu", [0.0, -1.0, np.nan, [1.0, 0.0], [[1.0]], "stiff", -np.inf])
def test_mu_must_be_positive(mu):
    with pytest.raises(ValueError, match="FLS: mu must be"):
        FLS(mu)


def test_other_bad_settings_are_named():
    with pytest.raises(ValueError, match="mu must be given"):
        track(Regression(1), FLS(), [1.0], [1.0])
    with pytest.raises(ValueError, match="FLS: mu has shape"):
        track(Regression(2), FLS([1.0, 2.0, 3.0]), np.ones(4), np.ones((4, 2)))
    with pytest.raises(ValueError, match="FLS: p0 must be"):
        FLS(1.0, p0=-1.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_bad_value_marks_the_sample(bad):
    phi, y = record()
    reference = y.copy()
    reference[8] = np.nan
    expected = track(Regression(2), FLS(4.0), reference, phi).smooth()
    for where in ("y", "phi"):
        a, b = phi.copy(), y.copy()
        (b if where == "y" else a)[8] = bad
        run = track(Regression(2), FLS(4.0), b, a)
        assert not run.ok[8]
        np.testing.assert_array_equal(run.smooth().theta, expected.theta)
