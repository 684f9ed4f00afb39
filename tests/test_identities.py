"""Identities between algorithms, and between the recursions and dense solutions.

They use Regression(1) and ARX(2, 2), the combinations that the other tests compile too.
"""

import math

import numpy as np
import pytest
from support import arx_record, run_lanes, same

from driftfit import ARX, RLS, AugmentedFLS, Kalman, Live, track
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


def test_weights_of_augmented_fls_from_those_of_fls():
    assert AugmentedFLS.from_fls_mu(100.0, 2, 2.0).mu == pytest.approx(9.05, abs=0.01)
    assert AugmentedFLS.from_fls_mu(10.0, 5, 5.0).mu == pytest.approx(1.53, abs=0.01)
    assert AugmentedFLS.from_fls_mu(3.0, 1, 1.0).mu == pytest.approx(6.0 / (1.0 + math.sqrt(13.0)), rel=1e-12)


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
