"""Identities between algorithms, and between the recursions and dense solutions.

They use Regression(1) and ARX(2, 2), the combinations that the other tests compile too.
"""

import math

import numpy as np
import pytest
from support import arx_record, run_lanes, same

from driftfit import ARX, RLS, AugmentedFLS, Kalman, Live, Regression, track
from driftfit.engine.kernel import exp, kernel, log
from driftfit.engine.tiles import WIDTH, make_tile

R = 0.3


def rows_of(y, u):
    """Regressors and outputs of ARX(2, 2) after the start."""
    return np.stack([y[1:-1], y[:-2], u[1:-1], u[:-2]], axis=1), y[2:]


def test_rls_is_kalman_without_drift_is_least_squares_at_every_prefix():
    """Also while the rank is below n: the least squares solution of least norm, P of its span, inf elsewhere."""
    y, u = arx_record(120, 1)
    phi, target = rows_of(y, u)
    rls, kalman = track(ARX(2, 2), RLS(1.0), y, u), track(ARX(2, 2), Kalman(q=0.0, r=R), y, u)
    for k in range(1, len(target) + 1):
        theta, _, rank, _ = np.linalg.lstsq(phi[:k], target[:k])
        scale = np.abs(theta).max()
        np.testing.assert_allclose(rls.theta[k + 1], theta, rtol=1e-7, atol=1e-8 * scale)
        np.testing.assert_allclose(kalman.theta[k + 1], theta, rtol=1e-7, atol=1e-8 * scale)
        assert np.isinf(kalman.std[k + 1]).all() == (rank < 4)
    P = np.linalg.inv(phi.T @ phi)
    np.testing.assert_allclose(kalman.cov(-1), R * P, rtol=1e-8)
    np.testing.assert_allclose(rls.cov(-1) / rls.state["scale"], P, rtol=1e-8)


def test_minimum_norm_is_about_theta0():
    y, u = arx_record(30, 2)
    phi, target = rows_of(y, u)
    theta0 = np.array([1.0, -1.0, 2.0, 0.5])
    run = track(ARX(2, 2), Kalman(q=0.0, r=R, theta0=theta0), y, u)
    for k in (1, 2, 3, 4, 20):
        theta = theta0 + np.linalg.lstsq(phi[:k], target[:k] - phi[:k] @ theta0)[0]
        np.testing.assert_allclose(run.theta[k + 1], theta, rtol=1e-8, atol=1e-8)


def test_least_squares_with_weights():
    y, u = arx_record(80, 3)
    phi, target = rows_of(y, u)
    weights = np.random.default_rng(0).choice([0.0, 0.5, 1.0, 3.0], 80)
    root = np.sqrt(weights[2:])
    theta = np.linalg.lstsq(phi * root[:, None], target * root)[0]
    P = np.linalg.inv((phi * weights[2:, None]).T @ phi)
    for tracker, r in ((RLS(1.0), None), (Kalman(q=0.0, r=R), R)):
        run = track(ARX(2, 2), tracker, y, u, weights=weights)
        np.testing.assert_allclose(run.theta[-1], theta, rtol=1e-8)
        np.testing.assert_allclose(run.cov(-1) / (r or run.state["scale"]), P, rtol=1e-8)


def test_noise_estimate_of_rls_is_that_of_least_squares():
    """sum(e^2 / s) of recursive residuals is the residual sum of squares (Brown, Durbin and Evans 1975)."""
    y, u = arx_record(200, 4)
    phi, target = rows_of(y, u)
    run = track(ARX(2, 2), RLS(1.0), y, u)
    rest = np.linalg.lstsq(phi, target)[1][0]
    np.testing.assert_allclose(run.state["scale"], rest / (len(target) - 4), rtol=1e-8)
    np.testing.assert_allclose(
        run.std[-1], np.sqrt(np.diag(np.linalg.inv(phi.T @ phi)) * rest / (len(target) - 4)), rtol=1e-8
    )


def test_exponential_forgetting_is_weighted_least_squares_and_linear_forgetting():
    y, u = arx_record(150, 5)
    phi, target = rows_of(y, u)
    lam = 0.95
    run = track(ARX(2, 2), RLS(lam), y, u)
    root = lam ** (0.5 * np.arange(len(target))[::-1])
    np.testing.assert_allclose(run.theta[-1], np.linalg.lstsq(phi * root[:, None], target * root)[0], rtol=1e-7)
    # exponential == a random walk with Q(t) = (1 / lam - 1) P(t|t)
    P, theta = np.linalg.inv(phi[:10].T @ phi[:10]), np.linalg.lstsq(phi[:10], target[:10])[0]
    fast = track(ARX(2, 2), RLS(lam, p0=P, theta0=theta), y[10:], u[10:])
    for row, value in zip(phi[10:], target[10:], strict=True):
        P = P + (1.0 / lam - 1.0) * P
        gain = P @ row / (1.0 + row @ P @ row)
        theta, P = theta + gain * (value - row @ theta), P - np.outer(gain, row @ P)
    np.testing.assert_allclose(fast.theta[-1], theta, rtol=1e-8)


def test_augmented_fls_is_kalman_with_its_covariance_reset():
    y, u = arx_record(60, 6)
    mu = 2.0
    run = track(ARX(2, 2), AugmentedFLS(mu), y, u)
    theta = np.full(4, 1e-6)
    for t in range(2, 60):
        step = track(
            ARX(2, 2), Kalman(q=0.0, r=1.0, p0=1.0 / mu, theta0=theta), y[t - 2 : t + 1], u[t - 2 : t + 1]
        )  # one sample after two lags
        theta = step.theta[-1]
        np.testing.assert_allclose(run.theta[t], theta, rtol=1e-10, atol=1e-13)


def test_augmented_fls_residual_and_limits():
    rng = np.random.default_rng(7)
    u = rng.standard_normal(50)
    y = 2.0 * u + 0.1 * rng.standard_normal(50)
    mu = 0.5
    run = track(Regression(1), AugmentedFLS(mu), y, u)
    after = y - u * run.theta[:, 0]
    np.testing.assert_allclose(after, run.innovation * mu / (mu + u * u), rtol=1e-9, atol=1e-14)
    frozen = track(Regression(1), AugmentedFLS(1e12), y, u)
    np.testing.assert_allclose(frozen.theta, 1e-6, atol=1e-9)
    assert AugmentedFLS.from_fls_mu(100.0, 2, 2.0).mu == pytest.approx(9.05, abs=0.01)
    assert AugmentedFLS.from_fls_mu(10.0, 5, 5.0).mu == pytest.approx(1.53, abs=0.01)
    assert AugmentedFLS.from_fls_mu(3.0, 1, 1.0).mu == pytest.approx(6.0 / (1.0 + math.sqrt(13.0)), rel=1e-12)


@pytest.mark.parametrize("q", [0.0, 0.01])
def test_diffuse_start_is_the_limit_of_a_large_prior(q):
    y, u = arx_record(60, 8)
    diffuse = track(ARX(2, 2), Kalman(q=q, r=R), y, u)
    large = track(ARX(2, 2), Kalman(q=q, r=R, p0=1e8), y, u)
    np.testing.assert_allclose(diffuse.theta[3:], large.theta[3:], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(diffuse.std[6:], large.std[6:], rtol=1e-4)
    assert diffuse.loglik == pytest.approx(large.loglik + 2.0 * math.log(2.0 * math.pi * 1e8), abs=1e-3)


def test_a_proper_prior_gives_the_likelihood_of_the_joint_gaussian():
    rng = np.random.default_rng(10)
    u, q, p0 = rng.standard_normal(30), 0.05, 2.0
    y = 1.5 * u + 0.5 * rng.standard_normal(30)
    run = track(Regression(1), Kalman(q=q, r=R, p0=p0, theta0=0.7), y, u)
    when = np.minimum.outer(np.arange(30), np.arange(30)) + 1.0
    S = np.outer(u, u) * (p0 + q * when) + R * np.eye(30)
    e = y - 0.7 * u
    dense = -0.5 * (30 * np.log(2 * np.pi) + np.linalg.slogdet(S)[1] + e @ np.linalg.solve(S, e))
    assert run.loglik == pytest.approx(dense, abs=1e-9)


def test_drift_as_number_vector_and_matrix():
    y, u = arx_record(100, 11)
    number = track(ARX(2, 2), Kalman(q=0.01, r=R), y, u)
    vector = track(ARX(2, 2), Kalman(q=[0.01] * 4, r=R), y, u)
    matrix = track(ARX(2, 2), Kalman(q=0.01 * np.eye(4), r=R), y, u)
    assert same(number.theta, vector.theta)
    assert same(number.theta, matrix.theta)
    assert same(number.cov(50), matrix.cov(50))


def test_a_matrix_of_drifts_keeps_its_digits_in_other_units():
    """Outputs a hundred million times larger: the variances of q are then 1e16 times apart."""
    y, u = arx_record(40, 12)
    q, c = 0.01 * (np.eye(4) + 0.3), 1e8
    unit = np.array([1.0, 1.0, c, c])
    for given in ({}, {"p0": np.eye(4) + 0.3, "form": "sqrt"}):
        base = track(ARX(2, 2), Kalman(q=q, r=R, **given), y, u)
        if "p0" in given:
            given = {**given, "p0": given["p0"] * np.outer(unit, unit)}
        louder = track(ARX(2, 2), Kalman(q=q * np.outer(unit, unit), r=R * c * c, **given), c * y, u)
        np.testing.assert_allclose(louder.theta[6:] / unit, base.theta[6:], rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(louder.std[6:] / unit, base.std[6:], rtol=1e-8)


def test_other_units_change_nothing_but_the_numbers():
    """y scaled by c: theta, sqrt(r), sqrt(q) by c. u scaled: theta by 1 / c. loglik by -log c a used sample."""
    rng = np.random.default_rng(12)
    u = rng.standard_normal(100)
    y = 2.0 * u + rng.standard_normal(100)
    base = track(Regression(1), Kalman(q=0.01, r=R), y, u)
    c = 8.0  # a power of two: the same bits
    louder = track(Regression(1), Kalman(q=0.01 * c * c, r=R * c * c), c * y, u)
    assert same(louder.theta, c * base.theta)
    assert same(louder.std, c * base.std)
    assert louder.loglik == pytest.approx(base.loglik - 99 * math.log(c), abs=1e-9)
    finer = track(Regression(1), Kalman(q=0.01 / c**2, r=R), y, c * u)
    assert same(finer.theta, base.theta / c)
    assert same(finer.prediction, base.prediction)
    assert same(track(Regression(1), RLS(0.9), c * y, u).std[5:], c * track(Regression(1), RLS(0.9), y, u).std[5:])
    plain = track(Regression(1), AugmentedFLS(1.0, theta0=0.0), y, u)
    scaled = track(Regression(1), AugmentedFLS(c * c, theta0=0.0), c * y, c * u)
    assert same(plain.theta, scaled.theta)


def test_a_gap_is_missing_samples_in_between():
    """Without lags, three intervals at once are three samples of which two are missing."""
    rng = np.random.default_rng(13)
    u = rng.standard_normal(60)
    y = 2.0 * u + 0.3 * rng.standard_normal(60)
    keep = np.ones(60, bool)
    keep[[20, 21, 40]] = False
    holes = np.where(keep, y, np.nan)
    for tracker in (Kalman(q=0.01, r=R), RLS(0.95)):
        full = track(Regression(1), tracker, holes, u)
        gaps = track(Regression(1), tracker, y[keep], u[keep], time=np.arange(60.0)[keep])
        np.testing.assert_allclose(gaps.theta, full.theta[keep], rtol=1e-10)
        np.testing.assert_allclose(gaps.std[3:], full.std[keep][3:], rtol=1e-10)


def test_live_cov_is_the_cov_of_the_record():
    y, u = arx_record(50, 14)
    live = Live(ARX(2, 2), Kalman(q=0.01, r=R))
    run = track(ARX(2, 2), Kalman(q=0.01, r=R), y, u)
    for t in range(50):
        live.update(y[t], u[t : t + 1])
        assert same(live.cov, run.cov(t))


@kernel
def into_theta(s, l):
    s.theta[0, l] = exp(s.y[l])
    s.theta[1, l] = log(s.u[0, l])


def elementary(x, L):
    """exp(x) and log(exp-like positive numbers) by the kernels, L lanes at a time."""
    from numba import njit

    @njit(error_model="numpy")
    def fill(tile):
        s = tile[0]
        for l in range(s.theta.shape[1]):
            into_theta(s, l)

    tile = make_tile(2, 1, {}, [{"theta": np.zeros(2)}] * L)
    out = np.empty((2, len(x)))
    for a in range(0, len(x), L):
        tile["y"][0], tile["u"][0, 0] = x[a : a + L], np.exp(x[a : a + L] / 2)
        fill(tile)
        out[:, a : a + L] = tile["theta"][0]
    return out


def test_exp_and_log_are_within_2_ulp_and_the_same_in_every_lane():
    rng = np.random.default_rng(15)
    x = np.concatenate([rng.uniform(-700, 700, 3200), rng.uniform(-2, 2, 3200), rng.uniform(-1e-6, 1e-6, 320)])
    x = np.concatenate([x, [0.0, 1.0, -1.0, 0.5, 2.0, 1e-300, -708.0, 709.0] * 4])
    one, many = elementary(x, 1), elementary(x, WIDTH)
    assert same(one, many)
    for got, expected in zip(one, (np.exp(x), np.log(np.exp(x / 2))), strict=True):
        assert (np.abs(got - expected) <= 2.0 * np.spacing(np.abs(expected))).all()


def test_settings_side_by_side_are_a_grid():
    """Lanes with settings of their own over one series: a grid for tuning."""
    y, u = arx_record(80, 16)
    trackers = [Kalman(q=10.0 ** -(1 + lane / 8), r=R) for lane in range(WIDTH)]
    spread = np.ones((1, 3, WIDTH))
    ys, us = np.repeat(y[:, None], WIDTH, 1), np.repeat(u[:, None, None], WIDTH, 2)
    out, _ = run_lanes(ARX(2, 2).bind(1), trackers, ys, us, spread)
    for lane in (0, 7, 31):
        assert same(out["theta"][..., lane], track(ARX(2, 2), trackers[lane], y, u).theta)
