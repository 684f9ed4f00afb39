"""Flexible least squares with second differences: against dense least squares, and the promises of every tracker."""

import naive_smoother as naive
import numpy as np
import pytest

from driftfit import ARX, FLS, Live, Regression, Track, frontier, track, tune
from driftfit.checks import check_tracker
from driftfit.smooth.huber import huber

TWO = Regression(2)


def record(L=30, seed=0):
    rng = np.random.default_rng([seed, L])
    return rng.standard_normal((L, 2)), rng.standard_normal(L)


def bent(seed, L, walk, noise=0.3):
    """Two parameters whose slopes walk at random, observed through white regressors."""
    rng = np.random.default_rng(seed)
    theta = np.cumsum(np.cumsum(walk * rng.standard_normal((L, 2)), axis=0), axis=0)
    phi = rng.standard_normal((L, 2))
    return np.sum(phi * theta, axis=1) + noise * rng.standard_normal(L), phi, theta


def known(L=30, seed=1):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.5, 1.4, L), rng.uniform(0.2, 3.0, (L, 2)), rng.uniform(0.3, 2.0, L)


@pytest.mark.parametrize("mu", [1e-2, 1.0, 300.0])
@pytest.mark.parametrize("even", [True, False])
def test_path_covariances_and_cost_are_those_of_the_dense_problem(mu, even):
    phi, y = record()
    phi[:3] = phi[0]
    dt, drift, w = known()
    given = {} if even else {"time": np.cumsum(dt), "drift": drift, "weights": w}
    A, b = naive.second_differences(phi, y, mu) if even else naive.second_differences(phi, y, mu, dt, drift, w)
    theta, C = np.linalg.lstsq(A, b, rcond=None)[0], np.linalg.inv(A.T @ A)
    run = track(TWO, FLS(mu, differences=2), y, phi, **given)
    for path in (run.smooth(), run.smooth("cov")):
        np.testing.assert_allclose(path.theta.ravel(), theta, rtol=0, atol=1e-10 * np.abs(theta).max())
        np.testing.assert_allclose((path.std**2 / path.r).ravel(), np.diag(C), rtol=1e-9)
        assert path.cost == pytest.approx(np.sum((A @ theta - b) ** 2), rel=1e-10)
    np.testing.assert_allclose(path.cov(7) / path.r, C[14:16, 14:16], rtol=1e-8)
    np.testing.assert_allclose(path.lag_cov(7) / path.r, C[14:16, 16:18], rtol=1e-8)
    np.testing.assert_allclose(run.theta[-1], path.theta[-1], rtol=1e-10)
    np.testing.assert_allclose(run.cov(-1), path.cov(-1), rtol=1e-9)
    steps = np.ones(29) if even else dt[1:]
    np.testing.assert_allclose(path.slope[1:], np.diff(path.theta, axis=0) / steps[:, None], atol=1e-10)
    slope = np.zeros((2, 60))  # of the second parameter before sample 10
    slope[0, 21], slope[0, 19] = 1.0 / steps[9], -1.0 / steps[9]
    assert path.slope_std[10, 1] ** 2 / path.r == pytest.approx(slope[0] @ C @ slope[0], rel=1e-8)
    moves = path.walk.moves(path.walk.pull(path.walk.residual(path.theta)))
    np.testing.assert_allclose(np.diff(path.slope, axis=0)[1:], moves[1:], atol=1e-10)


@pytest.mark.parametrize("ratio", [1e-8, 1.0, 1e10])
def test_accuracy_against_eighty_digits(ratio):
    phi, y = record(20)
    mu = ratio * np.mean(np.sum(phi**2, axis=1))
    theta, var = naive.exact_normal_equations(*naive.second_differences(phi, y, mu))
    path = track(TWO, FLS(mu, differences=2), y, phi).smooth()
    np.testing.assert_allclose(path.theta.ravel(), theta, rtol=0, atol=1e-8 * np.abs(theta).max())
    np.testing.assert_allclose((path.std**2 / path.r).ravel(), var, rtol=1e-7)


@pytest.mark.filterwarnings("ignore:smooth. .* leave no residual")
def test_every_prefix_of_the_filter_and_every_window_is_the_smoother(tmp_path):
    """Through collinear regressors at the start, missing values, uneven steps, weights, drifts and a restart."""
    phi, y = record(24)
    phi[:4], y[[2, 12]] = phi[0], np.nan
    dt, drift, w = known(24)
    time, tracker = np.cumsum(dt), FLS(3.0, theta0=[1.0, -2.0], differences=2)
    run = track(TWO, tracker, y, phi, time=time, drift=drift, weights=w)
    live = Live(TWO, tracker, lag=5)
    for t in range(24):
        live.update(y[t], phi[t], time[t], w[t], drift[t])
        if t == 14:
            live.save(tmp_path / "state")
            live = Live.load(tmp_path / "state")
        np.testing.assert_array_equal(live.theta, run.theta[t])
        np.testing.assert_array_equal(live.std, run.std[t])
        cut = slice(0, t + 1)
        part = track(TWO, tracker, y[cut], phi[cut], time=time[cut], drift=drift[cut], weights=w[cut]).smooth()
        # drift that differs between parameters also moves unobserved directions, which the filter leaves alone
        sure = np.isfinite(run.std[t])
        np.testing.assert_allclose(run.theta[t, sure], part.theta[-1, sure], rtol=1e-9, atol=1e-9)
        if np.isfinite(part.r):
            np.testing.assert_array_equal(np.isinf(run.std[t]), np.isinf(part.std[-1]))
        if t != 6:  # one sample more than unknowns, and y fits all but exactly
            window, k = live.smooth(), min(t, 5) + 1
            np.testing.assert_allclose(window.theta, part.theta[-k:], rtol=1e-7, atol=1e-7)
            np.testing.assert_allclose(window.std, part.std[-k:], rtol=1e-6)
    assert part.rank.tolist()[:6] == [1, 2, 2, 2, 3, 4]


def test_it_keeps_the_promises_of_every_tracker():
    assert check_tracker(FLS(1e4, differences=2)) == []


def test_straight_lines_cost_nothing():
    rng = np.random.default_rng(0)
    phi, t = rng.standard_normal((50, 2)), np.arange(50.0)
    theta = np.column_stack([2.0 - 0.1 * t, 1.0 + 0.3 * t])
    y = np.sum(phi * theta, axis=1)
    for mu in (1.0, np.inf):
        run = track(TWO, FLS(mu, differences=2), y, phi)
        np.testing.assert_allclose(run.theta[5:], theta[5:], atol=1e-9)
        ahead = run.forecast(3, np.ones((3, 2)))
        np.testing.assert_allclose(ahead.theta, theta[-1] + np.outer([1, 2, 3], [-0.1, 0.3]), atol=1e-8)
        np.testing.assert_allclose(ahead.y_hat, ahead.theta.sum(axis=1), rtol=1e-12)
    noisy = y + 0.1 * rng.standard_normal(50)
    line = np.linalg.lstsq(np.hstack([phi, phi * t[:, None]]), noisy, rcond=None)[0]
    steady = track(TWO, FLS(np.inf, differences=2), noisy, phi)
    np.testing.assert_allclose(steady.theta[-1], line[:2] + 49 * line[2:], rtol=1e-9)
    np.testing.assert_allclose(steady.smooth().slope, np.tile(line[2:], (50, 1)), rtol=1e-8)


def test_what_two_samples_a_direction_do_not_say_stays_where_theta0_put_it():
    y, phi, _ = bent(0, 20, 0.1)
    idle = phi * [1.0, 0.0]
    run = track(TWO, FLS(1.0, theta0=[0.0, 4.0], differences=2), y, idle)
    path = run.smooth()
    assert path.rank[-1] == 2
    np.testing.assert_allclose(path.theta[:, 1], 4.0, rtol=1e-12)
    np.testing.assert_allclose(run.theta[:, 1], 4.0, rtol=1e-12)
    assert np.isinf(path.std[:, 1]).all()
    assert np.isfinite(path.std[:, 0]).all()
    with pytest.raises(ValueError, match=r"does not determine theta2 \(rank 2 of 4\)"):
        run.smooth(undetermined="raise")
    assert np.isnan(run.smooth(undetermined="nan").theta[:, 1]).all()
    once = np.zeros((20, 2))
    once[4] = [1.0, 0.0]
    single = track(TWO, FLS(1.0, differences=2), y, once).smooth()
    assert np.isfinite(single.theta).all()
    assert single.theta[4, 0] == pytest.approx(y[4])
    assert np.isfinite(single.std).tolist() == [[t == 4, False] for t in range(20)]


@pytest.mark.filterwarnings("ignore:tune:UserWarning")
def test_likelihood_is_the_diffuse_one_of_the_stacked_system():
    phi, y = record(25)
    tuned = tune(TWO, FLS(differences=2), y, phi, bounds=(0.5, 2e3))
    mu, best, L, n = *tuned.table.row(0), 25, 2
    A, b = naive.second_differences(phi, y, mu)
    R = A.T @ A
    sigma2 = (b @ b - (A.T @ b) @ np.linalg.solve(R, A.T @ b)) / (L - 2 * n)
    logs = np.linalg.slogdet(R)[1] - (L - 2) * n * np.log(mu)
    assert tuned.tracker.differences == 2
    assert best == pytest.approx(-0.5 * ((L - 2 * n) * (np.log(2 * np.pi * sigma2) + 1) + logs), abs=1e-7)


def test_mu_is_found_and_the_path_is_better_than_with_first_differences():
    found, better = [], []
    for seed in range(8):
        y, phi, theta = bent(seed, 300, 0.01)
        smooth, walk = (tune(TWO, FLS(differences=d), y, phi).tracker for d in (2, 1))
        found.append(smooth.mu)
        errors = [np.mean((track(TWO, one, y, phi).smooth().theta - theta) ** 2) for one in (smooth, walk)]
        better.append(errors[0] / errors[1])
    assert np.median(found) == pytest.approx(962.1, rel=1e-3)  # 900 is the truth
    assert np.median(better) < 0.5


def test_order_frontier_huber_files_and_lags(tmp_path):
    y, phi, _ = bent(3, 80, 0.05)
    run = track(TWO, FLS(40.0, differences=2), y, phi)
    base, order = run.smooth(), np.random.default_rng(0).permutation(80)
    mixed = track(TWO, FLS(40.0, differences=2), y[order], phi[order]).smooth(order_by=order.astype(float))
    np.testing.assert_allclose(mixed.theta, base.theta[order], rtol=1e-9)
    np.testing.assert_allclose(mixed.slope, base.slope[order], rtol=1e-7, atol=1e-9)
    pair = frontier(TWO, y, phi, mu=[40.02, 39.98], differences=2)
    assert np.diff(pair.measurement) / np.diff(pair.dynamic) == pytest.approx(-40.0, rel=1e-3)
    spoiled = y.copy()
    spoiled[::9] += 4.0
    robust = huber(track(TWO, FLS(40.0, differences=2), spoiled, phi), 0.5, tol=0.0)
    assert robust.certificate < 1e-6
    assert (np.diff(robust.costs) <= 1e-12 * robust.costs[0]).all()
    run.save(tmp_path / "run")
    np.testing.assert_array_equal(Track.load(tmp_path / "run").smooth().theta, base.theta)
    rest = track(TWO, FLS(40.0, differences=2), y[40:], phi[40:], warm_start=track(
        TWO, FLS(40.0, differences=2), y[:40], phi[:40]))  # fmt: skip
    np.testing.assert_array_equal(rest.theta, run.theta[40:])
    u = np.random.default_rng(1).standard_normal(60)
    lagged = track(ARX(1, 1), FLS(1e3, differences=2), y[:60], u).smooth()
    assert lagged.walk.weight[0] == 0.0
    assert np.isfinite(lagged.std).all()


def test_a_long_record_without_excitation_stays_finite():
    y, phi, _ = bent(5, 20_000, 1e-4)
    phi[5000:15_000] = 0.0
    run = track(TWO, FLS(1e5, differences=2), y, phi)
    assert np.isfinite(run.theta).all()
    assert (run.std[10:] > 0.0).all()
    path = run.smooth()
    assert (path.std > 0.0).all()
    np.testing.assert_allclose(run.theta[-1], path.theta[-1], rtol=1e-6)
    np.testing.assert_allclose(run.std[-1], path.std[-1], rtol=1e-6)


def test_settings():
    with pytest.raises(ValueError, match="differences must be 1 or 2"):
        FLS(1.0, differences=3)
    with pytest.raises(ValueError, match="p0 does not describe the slope"):
        FLS(1.0, p0=1.0, differences=2)
    phi, y = record()
    bent_run = track(TWO, FLS(1.0, differences=2), y, phi)
    with pytest.raises(ValueError, match=r"use run\.forecast"):
        bent_run.ahead(2)
    with pytest.raises(ValueError, match="theta is a plain random walk here"):
        _ = track(TWO, FLS(1.0), y, phi).smooth().slope
