"""The exact smoother against dense solutions. Tolerances are relative to the largest value."""

import naive_smoother as naive
import numpy as np
import pytest

from driftfit import ARX, FLS, RLS, AugmentedFLS, HammersteinWiener, Kalman, Regression, track
from driftfit.models.hammerstein_wiener.basis import Polynomial
from driftfit.smooth import exact
from driftfit.smooth.solvers.walk import DRIFT, WEIGHT, Walk, Y, room_for_signals

SIZES = [(1, 1), (1, 2), (1, 40), (2, 2), (2, 7), (2, 40), (4, 7), (4, 40)]
MU = [1e-3, 0.1, 1.0, 30.0, 1e4]


def record(L, n, seed=0):
    rng = np.random.default_rng([seed, L, n])
    return rng.standard_normal((L, n)), rng.standard_normal(L)


def walk(phi, y, mu=1.0, weight=None, drift=1.0, theta0=0.0, p0=None):
    """Flexible least squares as a problem."""
    L, n = phi.shape
    steps = np.zeros(L) + drift
    steps[0] = 0.0
    q = np.diag(np.zeros(n) + 1.0 / np.asarray(mu))
    signals = room_for_signals(L, n)
    signals[:, Y], signals[:, WEIGHT], signals[:, DRIFT] = y, 1.0 if weight is None else weight, steps
    return Walk(np.ascontiguousarray(phi), signals, q, np.zeros(n) + theta0, p0, None)


def close(a, b, tol):
    """Equal column by column, relative to the column's largest value."""
    a, b = np.asarray(a), np.asarray(b)
    scale = np.maximum(np.abs(b).max(axis=0), 1e-300)
    np.testing.assert_array_less(np.abs(a - b) / scale, tol)


@pytest.mark.parametrize(("n", "L"), SIZES)
@pytest.mark.parametrize("mu", MU)
def test_path_cost_and_covariances_are_those_of_the_dense_problem(n, L, mu):
    phi, y = record(L, n)
    found, quick = exact.smooth(walk(phi, y, mu), "cov"), exact.smooth(walk(phi, y, mu))
    theta, C, J = naive.dense(phi, y, [mu * np.eye(n)] * (L - 1))
    tol = 1e-8 if n + 2 >= L else 1e-9 if mu in (1e-3, 1e4) else 1e-10
    for path in (found, quick):
        close(path.theta, theta, tol)
        np.testing.assert_allclose(path.var, np.diag(C).reshape(L, n), rtol=1e-8)
        assert path.cost == pytest.approx(J, rel=1e-8, abs=1e-10 * y @ y)
    np.testing.assert_allclose(quick.c, found.c, rtol=1e-8, atol=1e-9)
    scale = np.abs(C).max()
    for k in range(L):
        block = slice(k * n, k * n + n)
        np.testing.assert_allclose(found.cov[k], C[block, block], rtol=0, atol=1e-9 * scale)
        if k < L - 1:
            after = slice((k + 1) * n, (k + 2) * n)
            np.testing.assert_allclose(found.lag_cov[k], C[block, after], rtol=0, atol=1e-9 * scale)


def test_steps_weights_and_prices_of_each_parameter():
    L, n = 40, 2
    phi, y = record(L, n)
    rng = np.random.default_rng(5)
    dt, w, mu, p0 = rng.uniform(0.2, 3.0, L), rng.uniform(0.1, 2.0, L), np.array([0.3, 20.0]), np.diag([0.5, 2.0])
    D = [np.diag(mu) / dt[k + 1] for k in range(L - 1)]
    for prior in (None, p0):
        found = exact.smooth(walk(phi, y, mu, w, dt, [1.0, -1.0], prior), "cov")
        lambda0 = None if prior is None else np.linalg.inv(prior)
        theta, C, J = naive.dense(phi, y, D, w, [1.0, -1.0], lambda0)
        close(found.theta, theta, 1e-11)
        close(found.var, np.diag(C).reshape(L, n), 1e-11)
        assert found.cost == pytest.approx(J, rel=1e-11)


def test_drift_covariance_as_a_matrix_with_and_without_full_rank():
    L, n = 30, 2
    phi, y = record(L, n)
    Q = np.array([[0.4, 0.3], [0.3, 0.5]])
    found = exact.smooth(walk(phi, y)._replace(q=Q))
    theta, C, _ = naive.dense(phi, y, [np.linalg.inv(Q)] * (L - 1))
    close(found.theta, theta, 1e-11)
    close(found.var, np.diag(C).reshape(L, n), 1e-11)
    a = np.array([2.0, -1.0])  # one scalar walk along a: theta_k = theta_1 + a x_k
    singular = exact.smooth(walk(phi, y)._replace(q=np.outer(a, a)), "cov")
    steps = np.diff(singular.theta, axis=0)
    np.testing.assert_allclose(steps[:, 0] * a[1], steps[:, 1] * a[0], atol=1e-13)
    A = np.zeros((2 * L - 1, n + L - 1))  # unknown: theta_1 and the steps of x
    A[:L, :n] = phi
    A[:L, n:] = (phi @ a)[:, None] * (np.arange(L)[:, None] > np.arange(L - 1))
    A[L:, n:] = np.eye(L - 1)
    solved = np.linalg.lstsq(A, np.append(y, np.zeros(L - 1)), rcond=None)[0]
    path = solved[:n] + np.outer(np.append(0.0, np.cumsum(solved[n:])), a)
    close(singular.theta, path, 1e-11)
    last = np.hstack([np.eye(n), np.outer(a, np.ones(L - 1))])
    close(singular.cov[-1], last @ np.linalg.inv(A.T @ A) @ last.T, 1e-10)


@pytest.mark.parametrize("scale", [(1.0, 1.0), (1e-4, 1e4)])
@pytest.mark.parametrize("collinear", [False, True])
@pytest.mark.parametrize("ratio", [1e-12, 1e-6, 1.0, 1e6, 1e12])
def test_accuracy_against_eighty_digits(ratio, collinear, scale):
    rng = np.random.default_rng(3)
    phi = rng.standard_normal((40, 2))
    if collinear:
        phi[:, 1] = phi[:, 0] + 1e-4 * phi[:, 1]
    phi *= scale
    y = rng.standard_normal(40)
    mu = ratio * np.mean(np.sum(phi**2, axis=1))
    theta, var = naive.precise(phi, y, mu)
    found = exact.smooth(walk(phi, y, mu))
    easy = not collinear and scale == (1.0, 1.0)
    close(found.theta, theta, 1e-10 if easy else 1e-8)
    np.testing.assert_allclose(found.var, var, rtol=1e-10 if easy else 1e-8)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_path_is_chosen_by_a_test_of_the_result(n):
    """Ordinary problems pass it; drift far above the noise and collinear regressors do not. Both paths agree."""
    phi, y = record(200, n, 3)
    ordinary = exact.smooth(walk(phi, y, 30.0))
    assert ordinary.method == "fast"
    safe = exact.smooth(walk(phi, y, 30.0), "cov")
    assert safe.method == "safe"
    close(ordinary.theta, safe.theta, 1e-11)
    close(ordinary.var, safe.var, 1e-11)
    assert exact.smooth(walk(phi, y, 1e-12)).method == "safe"
    assert exact.smooth(walk(phi, y, 1.0, p0=1e-9 * np.eye(n))).method == "safe"
    if n > 1:
        assert exact.smooth(walk(phi, y, 1.0, p0=np.ones((n, n)) + 1e-6 * np.eye(n))).method == "safe"
        phi[:, 0] = phi[:, 1] + 1e-7 * phi[:, 0]
        assert exact.smooth(walk(phi, y, 1.0)).method == "safe"


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("size", [1e-3, 1.0, 1e6])
def test_a_proper_prior_is_information_before_the_first_sample(n, size):
    """Both methods agree, with drift between the prior and the first sample, which the prior may have to bridge."""
    phi, y = record(65, n, 4)
    root = np.random.default_rng(n).standard_normal((n, n)) + 2.0 * np.eye(n)
    problem = walk(phi, y, 30.0, theta0=[1.0, -2.0, 3.0, 0.5][:n], p0=size * root @ root.T)
    problem.drift[0] = 5.0
    problem.weight[:3] = 0.0
    quick, safe = (exact.smooth(problem, keep) for keep in ("fit", "cov"))
    assert (quick.method, safe.method) == ("fast", "safe")
    close(quick.theta, safe.theta, 1e-11)
    close(quick.var, safe.var, 1e-11)
    close(quick.rho[3:], safe.rho[3:], 1e-9)
    for name in ("cost", "measurement_cost", "spread"):
        assert getattr(quick, name) == pytest.approx(getattr(safe, name), rel=1e-10)


@pytest.mark.parametrize("columns", ["plain", "collinear", "collinear at first", "offset", "units"])
def test_the_fast_path_knows_its_own_error(columns):
    """What it accepts agrees with the safe path, and what is far from it is rejected."""
    rng = np.random.default_rng(7)
    accepted = 0
    for mu in 10.0 ** np.arange(-4.0, 9.0, 2.0):
        phi, y = record(150, 2, 5)
        close_to = {"collinear": slice(None), "collinear at first": slice(75)}.get(columns, slice(0))
        phi[close_to, 0] = phi[close_to, 1] + 10.0 ** rng.uniform(-5.0, -1.0) * phi[close_to, 0]
        phi = (phi + (30.0 if columns == "offset" else 0.0)) * ([1e-6, 1e5] if columns == "units" else 1.0)
        size = np.sqrt(np.mean(phi**2, axis=0))
        quick, safe = (exact.smooth(walk(phi, 1e3 * y, mu * size**2), keep) for keep in ("std", "cov"))
        accepted += quick.method == "fast"
        close(quick.theta, safe.theta, 1e-9)
        np.testing.assert_allclose(quick.var, safe.var, rtol=1e-9)
    assert accepted >= (1 if "collinear" in columns else 3)


@pytest.mark.parametrize("L", [1, 2, 3, 63, 64, 65, 126, 127, 128, 129, 130, 257])
def test_records_of_every_length_are_eliminated_from_both_ends(L):
    """Blocks that are full, begun or empty, and a middle sample on either side."""
    phi, y = record(L, 1, 8)
    w, drift = np.random.default_rng(3).uniform(0.5, 2.0, (2, L))
    quick, safe = (exact.smooth(walk(phi, y, 3.0, w, drift), keep) for keep in ("fit", "cov"))
    if L > 3:
        assert quick.method == "fast"
    close(quick.theta, safe.theta, 1e-11)
    close(quick.var, safe.var, 1e-11)
    close(quick.rho, safe.rho, 1e-9)
    assert quick.cost == pytest.approx(safe.cost, rel=1e-10, abs=1e-20)


def test_leverage_and_leave_one_out_are_those_of_the_record_without_the_sample():
    phi, y = record(12, 2)
    y[3] = np.nan
    run = track(Regression(2), FLS(mu=2.0), y, phi)
    smoothed = run.smooth("cov")
    assert np.isnan(smoothed.loo[3])
    assert np.isnan(smoothed.residual[3])
    for k in (0, 1, 7, 11):
        gone = y.copy()
        gone[k] = np.nan
        without = track(Regression(2), FLS(mu=2.0), gone, phi).smooth()
        assert smoothed.loo[k] == pytest.approx(y[k] - phi[k] @ without.theta[k], abs=1e-9)
        assert smoothed.leverage[k] == pytest.approx(phi[k] @ smoothed.cov(k) @ phi[k] / smoothed.r, abs=1e-10)
    seen = np.isfinite(y)
    assert ((smoothed.leverage[seen] >= 0.0) & (smoothed.leverage[seen] <= 1.0)).all()
    np.testing.assert_allclose(smoothed.residual[seen], (y - np.sum(phi * smoothed.theta, axis=1))[seen], atol=1e-12)


def test_leave_one_out_is_exact_where_leverage_is_all_but_one():
    """1 - h = 1e-10: h itself, in double precision, could not tell."""
    phi, y = record(12, 1)
    found = exact.smooth(walk(phi, y, 1e-10))
    gone = np.ones(12)
    gone[5] = 0.0
    without = exact.smooth(walk(phi, y, 1e-10, gone))
    expected = y[5] - phi[5] @ without.theta[5]
    assert found.rho[5] / found.c[5] == pytest.approx(expected, rel=1e-9)
    assert 0.0 < found.c[5] ** 2 < 1e-8


def test_a_sample_that_alone_excites_a_direction_cannot_be_left_out():
    phi = np.tile([1.0, 2.0], (12, 1))
    phi[6] = [0.0, 1.0]
    run = track(Regression(2), FLS(mu=1.0), record(12, 2)[1], phi)
    path = run.smooth()
    assert np.isnan(path.loo[6])
    assert np.isfinite(np.delete(path.loo, 6)).all()
    assert path.alone == 1
    assert path.press == pytest.approx(np.mean(np.delete(path.loo, 6) ** 2))


def test_a_missing_sample_is_a_doubled_step():
    phi, y = record(40, 2)
    w = np.ones(40)
    w[17] = 0.0
    found = exact.smooth(walk(phi, y, 2.0, w)).theta
    keep = np.delete(np.arange(40), 17)
    dt = np.ones(39)
    dt[17] = 2.0
    close(found[keep], exact.smooth(walk(phi[keep], y[keep], 2.0, drift=dt)).theta, 1e-10)
    close(found[17], (found[16] + found[18]) / 2.0, 1e-10)
    w[:5] = w[-5:] = 0.0
    ends = exact.smooth(walk(phi, y, 2.0, w)).theta
    np.testing.assert_allclose(ends[:5], ends[[5] * 5], atol=1e-13)
    np.testing.assert_allclose(ends[-5:], ends[[-6] * 5], atol=1e-13)


def test_limits():
    phi, y = record(40, 2)
    constant = np.linalg.lstsq(phi, y, rcond=None)[0]
    close(exact.smooth(walk(phi, y, 4e10)).theta, np.tile(constant, (40, 1)), 1e-6)
    tiny = walk(phi, y, 1e-9)
    assert np.sum(tiny.residual(exact.smooth(tiny).theta) ** 2) < 1e-9 * y @ y
    fixed = exact.smooth(walk(phi, y, [np.inf, 1.0])).theta
    assert np.ptp(fixed[:, 0]) < 1e-14
    close(fixed, exact.smooth(walk(phi, y, [1e13, 1.0])).theta, 1e-9)


@pytest.mark.parametrize("mu", [1e-10, 1.0])
def test_directions_that_are_never_excited_keep_theta0(mu):
    rng = np.random.default_rng(2)
    direction, theta0 = np.array([0.6, 0.8]), np.array([3.0, -1.0])
    phi = np.outer(rng.standard_normal(30), direction)
    phi[:4], phi[10] = 0.0, 0.0
    y = rng.standard_normal(30)
    found = exact.smooth(walk(phi, y, mu, theta0=theta0))
    assert found.rank.tolist() == [0] * 4 + [1] * 26
    assert np.isinf(found.var).all()
    across = np.array([-0.8, 0.6])
    np.testing.assert_allclose(found.theta @ across, theta0 @ across, rtol=1e-10 if mu == 1.0 else 1e-7)
    along = exact.smooth(walk(phi @ direction[:, None], y, mu)).theta[:, 0]
    close(found.theta @ direction, along, 1e-10 if mu == 1.0 else 1e-7)


def test_fewer_samples_than_parameters():
    phi, y = record(2, 4)
    theta0 = np.array([1.0, -1.0, 2.0, 0.5])
    found = exact.smooth(walk(phi, y, 0.7, theta0=theta0))
    assert found.rank.tolist() == [1, 2]
    assert np.isinf(found.var).all()
    hidden = np.linalg.svd(phi)[2][2:]
    np.testing.assert_allclose(found.theta @ hidden.T, np.tile(hidden @ theta0, (2, 1)), atol=1e-12)
    np.testing.assert_allclose(np.sum(phi * found.theta, axis=1), y, atol=1e-12)


def test_regressors_of_zero_no_sample_and_one_sample():
    phi, y = record(5, 2)
    nothing = exact.smooth(walk(0.0 * phi, y, theta0=[1.0, -2.0]))
    assert nothing.rank[-1] == 0
    np.testing.assert_array_equal(nothing.theta, np.tile([1.0, -2.0], (5, 1)))
    unused = exact.smooth(walk(phi, y, weight=np.zeros(5)))
    assert (unused.theta == 0.0).all()
    assert np.isnan(unused.rho).all()
    one = exact.smooth(walk(phi[:1], y[:1]))
    np.testing.assert_allclose(one.theta[0], phi[0] * y[0] / (phi[0] @ phi[0]), rtol=1e-12)


def test_one_known_parameter_stays_where_the_prior_put_it():
    phi, y = record(40, 2)
    run = track(Regression(2), Kalman(q=[0.0, 0.1], r=1.0, p0=[0.0, 1.0], theta0=[2.0, 0.0]), y, phi)
    smoothed = run.smooth()
    np.testing.assert_allclose(smoothed.theta[:, 0], 2.0, rtol=1e-12)
    assert (smoothed.std[:, 0] < 1e-7).all()


def test_undetermined_parameters_have_infinite_bands_and_no_noise_estimate_is_a_warning():
    phi, y = record(12, 2)
    phi[:, 1] = 0.0
    smoothed = track(Regression(2), Kalman(q=0.1, r=1.0), y, phi).smooth()
    assert np.isinf(smoothed.std[:, 1]).all()
    assert np.isfinite(smoothed.std[:, 0]).all()
    with pytest.warns(RuntimeWarning, match="no residual from which to estimate"):
        short = track(Regression(2), FLS(1.0), y[:1], phi[:1]).smooth()
    assert np.isnan(short.r)
    assert np.isfinite(short.theta).all()


def test_lags_that_the_filter_filled_are_held_fixed():
    rng = np.random.default_rng(4)
    u, y = rng.standard_normal(60), np.zeros(60)
    for t in range(1, 60):
        y[t] = 0.7 * y[t - 1] + u[t - 1] + 0.1 * rng.standard_normal()
    y[20] = np.nan
    run = track(ARX(1, 1), Kalman(q=1e-3, r=0.01), y, u)
    smoothed = run.smooth()
    assert smoothed.walk.phi[21, 0] == run.prediction[20]
    assert smoothed.walk.weight[20] == 0.0
    assert smoothed.walk.weight[0] == 0.0


def test_who_cannot_be_smoothed_says_so():
    phi, y = record(12, 2)
    for tracker in (RLS(0.9), AugmentedFLS(1.0)):
        with pytest.raises(ValueError, match="track with FLS or Kalman"):
            track(Regression(2), tracker, y, phi).smooth()
    with pytest.raises(ValueError, match="keep must be one of"):
        track(Regression(2), FLS(1.0), y, phi).smooth(keep="all")


@pytest.mark.parametrize(("differences", "step", "noise"), [(1, 0.1, 0.5), (2, 0.02, 0.3)])
def test_bands_cover_when_the_model_is_true(differences, step, noise):
    rng = np.random.default_rng(11)
    L, hits = 200, []
    for _ in range(30):
        theta = step * rng.standard_normal((L, 2))
        for _ in range(differences):
            theta = np.cumsum(theta, axis=0)
        phi = rng.standard_normal((L, 2))
        y = np.sum(phi * theta, axis=1) + noise * rng.standard_normal(L)
        run = track(Regression(2), FLS(mu=(noise / step) ** 2, differences=differences), y, phi)
        low, high = run.smooth().band(0.95)
        hits.append((low <= theta) & (theta <= high))
    assert 0.93 <= np.mean(hits) <= 0.97


def test_picture_shows_every_parameter():
    phi, y = record(40, 2)
    path = track(Regression(["gain", "offset"]), FLS(mu=3.0), y, phi).smooth()
    figure = path.plot()
    assert [axis.get_ylabel() for axis in figure.axes] == ["gain", "offset"]
    for i, axis in enumerate(figure.axes):
        np.testing.assert_array_equal(
            [line.get_ydata() for line in axis.lines], [path.theta[:, i], path.run.theta[:, i]]
        )
    with pytest.raises(ValueError, match="level must be between"):
        track(Regression(2), FLS(mu=3.0), y, phi).smooth().band(95)


def test_what_the_record_does_not_determine_is_as_asked():
    phi, y = record(30, 2)
    phi[:, 1] = 0.0
    run = track(Regression(["gain", "idle"]), FLS(mu=1.0, theta0=[0.0, 5.0]), y, phi)
    np.testing.assert_allclose(run.smooth().theta[:, 1], 5.0, rtol=1e-14)
    nan = run.smooth(undetermined="nan").theta
    assert np.isfinite(nan[:, 0]).all()
    assert np.isnan(nan[:, 1]).all()
    with pytest.raises(ValueError, match=r"does not determine idle \(rank 1 of 2\)"):
        run.smooth(undetermined="raise")
    with pytest.raises(ValueError, match="undetermined"):
        run.smooth(undetermined="zero")


def test_noise_that_the_model_adds_is_the_noise_of_the_smoother():
    """Measurement noise that enters through a curve, in addition to the user's weights: the last point is the
    filter's.
    """
    s = linear_record()
    weights = np.random.default_rng(2).uniform(0.3, 2.0, len(s[0]))
    model = HammersteinWiener(1, 1, input=Polynomial(2), output=Polynomial(2), output_noise=0.05)
    run = track(model, Kalman(q=1e-5, r=0.02, p0=1.0), *s, weights=weights)
    path = run.smooth("cov")
    np.testing.assert_allclose(path.theta[-1], run.theta[-1], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(path.cov(-1), run.cov(-1), rtol=1e-8)
    used = path.walk.weight > 0.0
    assert np.ptp(path.walk.weight[used] / weights[used]) > 0.1


def linear_record():
    rng = np.random.default_rng(1)
    u, y = rng.uniform(-1.0, 1.0, 150), np.zeros(150)
    for t in range(1, 150):
        y[t] = 0.5 * y[t - 1] + u[t - 1] + 0.02 * rng.standard_normal()
    return y + 0.05 * rng.standard_normal(150), u


def test_lag_covariances_keep_their_digits_at_tiny_weights():
    """Against exact fractions: with M'M and a gain of 1 less something they were off by 5e-4 at mu = 1e-12."""
    phi = np.round(np.random.default_rng(0).normal(size=(7, 2)), 3)
    y = np.random.default_rng(1).normal(size=7)
    for mu in (1e-12, 1e-9, 1e-3, 1.0):
        C = naive.inverse_of_normal(phi, mu)
        found = exact.smooth(walk(phi, y, mu), "cov")
        for t in range(6):
            lag = C[2 * t : 2 * t + 2, 2 * t + 2 : 2 * t + 4]
            np.testing.assert_allclose(found.lag_cov[t], lag, atol=1e-12 * np.abs(lag).max(), rtol=1e-7)
