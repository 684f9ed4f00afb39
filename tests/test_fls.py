"""Flexible least squares, on line: against the published recursion, the smoother of every prefix, the Kalman filter."""

import json

import numpy as np
import pytest

from driftfit import FLS, AugmentedFLS, Kalman, Live, Regression, track
from driftfit.smooth import exact
from driftfit.smooth.solvers.walk import Walk


def record(L=40, n=2, seed=0):
    rng = np.random.default_rng([seed, L, n])
    return rng.standard_normal((L, n)), rng.standard_normal(L)


def published(phi, y, mu, lambda0=None, theta0=0.0):
    """The matrix recursion with Q = mu (U + mu I)^-1 U: theta(k|k) by minimum norm, and the cost of every prefix."""
    n = phi.shape[1]
    Q = np.zeros((n, n)) if lambda0 is None else lambda0
    theta0 = np.zeros(n) + theta0
    p, r = Q @ theta0, theta0 @ Q @ theta0
    path, costs = [], []
    for row, out in zip(phi, y, strict=True):
        U, z = Q + np.outer(row, row), p + row * out
        theta = theta0 + np.linalg.pinv(U, rcond=1e-10) @ (z - U @ theta0)
        path.append(theta)
        costs.append(r + out**2 - z @ theta)
        e = np.linalg.solve(U + mu * np.eye(n), z)
        Q, p, r = mu * np.linalg.solve(U + mu * np.eye(n), U), mu * e, r + out**2 - z @ e
        Q = (Q + Q.T) / 2.0
    return np.array(path), np.array(costs)


@pytest.mark.parametrize("mu", [1e-3, 0.1, 1.0, 30.0, 1e4])
def test_filter_is_the_published_recursion(mu):
    phi, y = record()
    run = track(Regression(2), FLS(mu, theta0=[1.0, -1.0]), y, phi)
    path, costs = published(phi, y, mu, theta0=[1.0, -1.0])
    np.testing.assert_allclose(run.theta, path, rtol=1e-8, atol=1e-9)
    state = run.state
    assert state["squares"] == pytest.approx(costs[-1], rel=1e-9)
    assert state["scale"] == pytest.approx(costs[-1] / 38, rel=1e-9)


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


def test_the_prior_holds_at_the_first_sample():
    phi, y = record()
    p0, mu = np.array([[2.0, 0.3], [0.3, 1.0]]), 4.0
    fls = track(Regression(2), FLS(mu, theta0=1.0, p0=p0), y, phi)
    kalman = track(Regression(2), Kalman(q=1 / mu, r=1.0, theta0=1.0, p0=p0 - np.eye(2) / mu), y, phi)
    np.testing.assert_allclose(fls.theta, kalman.theta, rtol=1e-11)
    path, _ = published(phi, y, mu, np.linalg.inv(p0), 1.0)
    np.testing.assert_allclose(fls.theta, path, rtol=1e-9)
    a, b = fls.smooth("cov"), kalman.smooth("cov")
    np.testing.assert_allclose(a.theta, b.theta, rtol=1e-9)
    np.testing.assert_allclose(a.cov(7) / a.r, b.cov(7), rtol=1e-9)
    np.testing.assert_allclose(a.lag_cov(7) / a.r, b.lag_cov(7), rtol=1e-9)
    assert a.r == pytest.approx(a.cost / 40)


def test_a_price_for_each_parameter_and_a_constant_one():
    phi, y = record()
    run = track(Regression(2), FLS([np.inf, 4.0]), y, phi)
    kalman = track(Regression(2), Kalman(q=[0.0, 0.25], r=1.0), y, phi)
    np.testing.assert_allclose(run.theta, kalman.theta, rtol=1e-12, atol=1e-13)
    assert np.ptp(run.smooth().theta[:, 0]) < 1e-14
    steady = track(Regression(2), FLS(np.inf), y, phi)
    np.testing.assert_allclose(steady.theta[-1], np.linalg.lstsq(phi, y, rcond=None)[0], rtol=1e-10)


def test_uneven_steps_and_factors_scale_the_drift():
    phi, y = record()
    time = np.cumsum(np.random.default_rng(1).uniform(0.2, 2.0, 40))
    drift = np.random.default_rng(2).uniform(0.0, 3.0, 40)
    a = track(Regression(2), FLS(4.0), y, phi, time=time, drift=drift)
    b = track(Regression(2), Kalman(q=0.25, r=1.0), y, phi, time=time, drift=drift)
    np.testing.assert_allclose(a.theta, b.theta, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(a.smooth().theta, b.smooth().theta, rtol=1e-11, atol=1e-12)


def test_stream_is_record_also_after_a_restart(tmp_path):
    phi, y = record()
    y[3] = np.nan
    run = track(Regression(2), FLS(4.0), y, phi)
    live = Live(Regression(2), FLS(4.0))
    for t in range(40):
        if t == 20:
            live.save(tmp_path / "state")
            live = Live.load(tmp_path / "state")
        step = live.update(y[t], phi[t])
        np.testing.assert_array_equal(live.theta, run.theta[t])
        np.testing.assert_array_equal(live.std, run.std[t])
        np.testing.assert_array_equal(step[0], run.prediction[t])


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


def test_inputs_of_many_kinds_are_accepted_and_left_alone():
    phi, y = record()
    base = track(Regression(2), FLS(4.0), y, phi).smooth().theta
    wide = np.repeat(phi, 2, axis=1)[:, ::2]
    wide.flags.writeable = False
    for given_y, given_phi in ((y.tolist(), phi.tolist()), (y, wide), (y[::-1][::-1], np.asfortranarray(phi))):
        before = np.array(given_phi)
        np.testing.assert_array_equal(track(Regression(2), FLS(4.0), given_y, given_phi).smooth().theta, base)
        np.testing.assert_array_equal(given_phi, before)
    single = track(Regression(2), FLS(4.0), y.astype(np.float32), phi.astype(np.float32)).smooth().theta
    assert single.dtype == np.float64
    np.testing.assert_allclose(single, base, rtol=1e-4, atol=1e-5)
    whole = track(Regression(2), FLS(4.0), np.arange(40) % 5, np.arange(80).reshape(40, 2) % 7)
    assert np.isfinite(whole.smooth().theta).all()


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


def test_augmented_is_a_kalman_step_with_a_reset_covariance_and_the_published_matrix():
    phi, y = record()
    run = track(Regression(2), AugmentedFLS(3.0), y, phi)
    theta = np.full(2, 1e-6)
    for k in range(40):
        matrix = np.outer(phi[k], phi[k]) + 3.0 * np.eye(2)
        literal = np.linalg.solve(matrix, phi[k] * y[k] + 3.0 * theta)
        P = np.eye(2) / 3.0
        theta = theta + P @ phi[k] * (y[k] - phi[k] @ theta) / (phi[k] @ P @ phi[k] + 1.0)
        np.testing.assert_allclose(run.theta[k], theta, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(run.theta[k], literal, rtol=1e-10, atol=1e-12)
    frozen = track(Regression(2), AugmentedFLS(1e12), y, phi)
    np.testing.assert_allclose(frozen.theta, 1e-6, atol=1e-9)
