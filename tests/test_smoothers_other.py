"""Robust, piecewise constant, augmented and fixed-lag smoothing; forecasts; the square-root filter."""

import naive_smoother as naive
import numpy as np
import pytest
from scipy.optimize import minimize

from driftfit import ARX, FLS, RLS, AugmentedFLS, HammersteinWiener, Kalman, Live, Regression, track
from driftfit.models.hammerstein_wiener.basis import Polynomial
from driftfit.smooth.augmented import augmented
from driftfit.smooth.huber import huber
from driftfit.smooth.total_variation import total_variation


def record(L=40, n=2, seed=0):
    rng = np.random.default_rng([seed, L, n])
    return rng.standard_normal((L, n)), rng.standard_normal(L)


def switching(seed=0, L=120):
    rng = np.random.default_rng(seed)
    phi = rng.standard_normal((L, 2))
    theta = np.where(np.arange(L)[:, None] < L // 2, [0.3, 0.7], [0.8, 1.0])
    return phi, np.sum(phi * theta, axis=1) + 0.2 * rng.standard_normal(L), theta


def first_example():
    """theta = (sin, cos) at 30 samples, as in the paper's first example."""
    k = np.arange(1, 31)
    theta = np.column_stack([np.sin(2 * np.pi * k / 15), np.cos(np.pi * k / 15)])
    phi = np.column_stack([np.sin(10 + k) + 0.01, np.cos(10 + k)])
    return phi, np.sum(phi * theta, axis=1) + np.random.default_rng(1000).normal(0, 0.1, 30)


def rms(a):
    return float(np.sqrt(np.mean(np.square(a))))


class TestHuber:
    def test_without_a_bound_it_is_the_quadratic_smoother(self):
        phi, y, _ = switching()
        run = track(Regression(2), FLS(30.0), y, phi)
        np.testing.assert_allclose(huber(run, np.inf).path.theta, run.smooth().theta, rtol=1e-12)

    def test_cost_falls_and_the_gradient_vanishes(self):
        phi, y, _ = switching()
        y[::17] += 5.0
        found = huber(track(Regression(2), FLS(30.0), y, phi), 0.3, tol=0.0)
        assert (np.diff(found.costs) <= 1e-12 * found.costs[0]).all()
        assert found.certificate < 1e-6
        assert (found.weights[::17] < 0.2).all()

    def test_no_path_costs_less(self):
        phi, y = record(12)
        y[4] += 8.0
        found = huber(track(Regression(2), FLS(2.0), y, phi), 0.5, tol=0.0)

        def cost(flat):
            theta = flat.reshape(12, 2)
            a = np.abs(y - np.sum(phi * theta, axis=1))
            return np.sum(np.where(a <= 0.5, a**2, a - 0.25)) + 2.0 * np.sum(np.diff(theta, axis=0) ** 2)

        other = minimize(cost, np.zeros(24), method="BFGS", options={"gtol": 1e-9})
        assert found.costs[-1] == pytest.approx(cost(found.path.theta.ravel()), rel=1e-10)
        assert found.costs[-1] <= other.fun + 1e-9

    def test_outliers_hardly_matter(self):
        phi, y, theta = switching()
        bad = y.copy()
        bad[np.random.default_rng(1).random(120) < 0.05] += 4.0
        run, clean = track(Regression(2), FLS(30.0), bad, phi), track(Regression(2), FLS(30.0), y, phi)
        robust = rms(huber(run).path.theta - theta)
        assert robust < 1.3 * rms(clean.smooth().theta - theta)
        assert robust < 0.6 * rms(run.smooth().theta - theta)

    def test_settings(self):
        phi, y = record()
        run = track(Regression(2), FLS(2.0), y, phi)
        with pytest.raises(ValueError, match="delta must be finite and above 0"):
            huber(run, 0.0)
        with pytest.raises(ValueError, match="track with FLS or Kalman"):
            huber(track(Regression(2), RLS(0.9), y, phi))


class TestTotalVariation:
    @pytest.mark.parametrize("penalty", [3.0, 10.0])
    def test_certificate(self, penalty):
        phi, y, theta = switching()
        found = total_variation(track(Regression(2), FLS(30.0), y, phi), penalty)
        assert found.pull <= 1.001
        assert found.gap <= 1e-4
        assert (np.diff(found.costs) <= 1e-9 * found.costs[0]).all()
        cost = np.sum((y - np.sum(phi * found.theta, axis=1)) ** 2)
        cost += penalty * np.sum(np.linalg.norm(np.diff(found.theta, axis=0), axis=1))
        shaken = np.random.default_rng(0).standard_normal((50, 120, 2)) * 1e-3
        for other in (theta, *(found.theta + shake for shake in shaken)):
            other_cost = np.sum((y - np.sum(phi * other, axis=1)) ** 2)
            other_cost += penalty * np.sum(np.linalg.norm(np.diff(other, axis=0), axis=1))
            assert cost <= other_cost * (1.0 + 1e-4)

    def test_from_the_largest_penalty_on_the_path_is_constant(self):
        phi, y, _ = switching()
        run = track(Regression(2), FLS(30.0), y, phi)
        largest = total_variation(run, 1.0, max_steps=1).penalty_max
        constant = np.linalg.lstsq(phi, y, rcond=None)[0]
        found = total_variation(run, 1.05 * largest)
        np.testing.assert_allclose(found.theta, np.tile(constant, (120, 1)), atol=1e-3 * np.abs(constant).max())
        assert found.jumps.size == 0
        assert total_variation(run, 0.8 * largest).jumps.size > 0

    def test_a_jump_is_found_and_refitted(self):
        phi, y, theta = switching(3)
        found = total_variation(track(Regression(2), FLS(30.0), y, phi), 8.0)
        assert np.abs(found.jumps - 60).min() <= 2
        for a, b in zip([0, *found.jumps], [*found.jumps, 120], strict=True):
            np.testing.assert_allclose(found.refit[a:b], found.refit[[a] * (b - a)], atol=1e-12)
        assert rms(found.theta - theta) < 0.1

    def test_a_level_far_from_zero_hides_no_jump(self):
        phi, y, _ = switching(3)
        phi[:, 0] = 1.0
        y = y + np.where(np.arange(120) < 60, 0.0, 2.0)
        plain, far = (total_variation(track(Regression(2), FLS(30.0), y + c, phi), 8.0) for c in (0.0, 1e5))
        assert plain.jumps.size > 0
        assert far.jumps.tolist() == plain.jumps.tolist()
        np.testing.assert_allclose(far.theta, plain.theta + np.array([1e5, 0.0]), atol=1e-3)

    def test_settings(self):
        phi, y = record()
        with pytest.raises(ValueError, match="penalty must be finite and above 0"):
            total_variation(track(Regression(2), FLS(2.0), y, phi), -1.0)


class TestAugmented:
    @pytest.mark.parametrize("mu", [0.1, 1.0])
    def test_half_and_corrected_ends_converge_to_the_exact_path(self, mu):
        phi, y = record()
        y[[0, 7, 39]] = np.nan if mu == 1.0 else y[[0, 7, 39]]
        found = augmented(track(Regression(2), AugmentedFLS(mu), y, phi), "constant", tol=1e-12)
        exact = track(Regression(2), FLS(mu), y, phi).smooth().theta
        np.testing.assert_allclose(found.theta, exact, atol=1e-8 * np.abs(exact).max())

    def test_power_schedule_ends_in_backward_nlms(self):
        phi, y = record()
        found = augmented(track(Regression(2), AugmentedFLS(1.0), y, phi), tol=1e-12)
        for k in range(39):
            b = found.theta[k + 1]
            step = b + phi[k] * (y[k] - phi[k] @ b) / (2.0 + phi[k] @ phi[k])
            np.testing.assert_allclose(found.theta[k], step, atol=1e-8)

    @pytest.mark.parametrize(("lam", "tol", "sweeps"), [(0.8, 0.01, 20), (0.5, 0.5, 1), (0.5, 0.25, 2), (0.9, 0.95, 0)])
    def test_number_of_sweeps(self, lam, tol, sweeps):
        phi, y = record()
        assert augmented(track(Regression(2), AugmentedFLS(1.0), y, phi), lam=lam, tol=tol).sweeps == sweeps

    def test_a_path_of_ones_own_is_where_the_sweeps_start(self):
        phi, y = record()
        run = track(Regression(2), AugmentedFLS(1.0), y, phi)
        exact = track(Regression(2), FLS(1.0), y, phi).smooth().theta
        given = exact.copy()
        found = augmented(run, "constant", start=given, max_sweeps=1)
        np.testing.assert_allclose(found.theta, exact, atol=1e-10)
        np.testing.assert_array_equal(given, exact)

    def test_one_sweep_by_hand(self):
        phi, y = record(3)
        found = augmented(
            track(Regression(2), AugmentedFLS(1.5), y, phi), lam=0.8, tol=0.7, start=np.arange(6.0).reshape(3, 2)
        )
        path, past = np.arange(6.0).reshape(3, 2), np.full(2, 1e-6)
        expected = []
        for k in range(3):
            b = past if k == 2 else 0.8 * past + 0.2 * path[k + 1]
            new = b + phi[k] * (y[k] - phi[k] @ b) / (3.0 + phi[k] @ phi[k])
            past = 0.8 * new + 0.2 * path[2] if k == 2 else new
            expected.append(past)
        assert found.sweeps == 1
        np.testing.assert_allclose(found.theta, expected, rtol=1e-12)

    def test_the_first_example_needs_more_sweeps_as_mu_grows(self):
        phi, y = first_example()
        sweeps = [
            augmented(track(Regression(2), AugmentedFLS(mu), y, phi), "constant", tol=1e-10).sweeps
            for mu in (1.0, 10.0)
        ]
        assert sweeps == pytest.approx([61, 345], abs=1)

    def test_one_sample(self):
        phi, y = record(1)
        found = augmented(track(Regression(2), AugmentedFLS(1.0, theta0=0.0), y, phi), "constant")
        np.testing.assert_allclose(found.theta[0], phi[0] * y[0] / (phi[0] @ phi[0]), rtol=1e-12)

    def test_settings(self):
        phi, y = record()
        run = track(Regression(2), AugmentedFLS(1.0), y, phi)
        for wrong in ({"lam": 1.0}, {"schedule": "none"}, {"ends": "open"}, {"tol": -1.0}, {"max_sweeps": 0}):
            with pytest.raises(ValueError, match=f"augmented: {next(iter(wrong))}"):
                augmented(run, **wrong)
        with pytest.raises(ValueError, match="must be one of AugmentedFLS"):
            augmented(track(Regression(2), FLS(1.0), y, phi))
        uneven = track(Regression(2), AugmentedFLS(1.0), y, phi, time=np.arange(40.0) ** 2)
        with pytest.raises(ValueError, match="even steps"):
            augmented(uneven)


class TestFixedLag:
    trackers = (
        FLS(3.0, theta0=0.3), FLS(3.0, p0=2.0, theta0=1.0), Kalman((0.1, 0.0), 0.4),
        Kalman(0.1, 0.4, p0=1.0), Kalman(0.1, 0.4, p0=[0.0, 1.0], theta0=1.0),
    )  # fmt: skip

    @pytest.mark.parametrize("model", [Regression(2), ARX(1, 1)])
    @pytest.mark.parametrize("tracker", trackers)
    @pytest.mark.filterwarnings("ignore:smooth. .* leave no residual")
    def test_it_is_the_smoother_of_the_record_that_ends_now(self, model, tracker, tmp_path):
        """Through a start of collinear regressors, missing values, uneven steps, weights and a restart."""
        T, lag = 40, 5
        phi, y = record(T)
        rng = np.random.default_rng(1)
        phi[:4] = phi[0]
        y[[3, 20]] = np.nan
        u = phi if model.m == 2 and isinstance(model, Regression) else phi[:, 0]
        time, weights, drift = np.cumsum(rng.uniform(0.5, 1.4, T)), rng.uniform(0.5, 2.0, T), rng.uniform(0.5, 2.0, T)
        live = Live(model, tracker, lag=lag)
        for t in range(T):
            live.update(y[t], u[t], time[t], weights[t], drift[t])
            if t == 25:
                live.save(tmp_path / "state")
                live = Live.load(tmp_path / "state")
            if t in (0, 1, 2, 4, 5, 6, 20, 26, 39):
                window, k = live.smooth(), min(lag, t) + 1
                cut = slice(0, t + 1)
                whole = track(
                    model, tracker, y[cut], u[cut], time=time[cut], weights=weights[cut], drift=drift[cut]
                ).smooth()
                np.testing.assert_allclose(window.theta, whole.theta[-k:], rtol=1e-9, atol=1e-9)
                np.testing.assert_allclose(window.std, whole.std[-k:], rtol=1e-9, atol=1e-7)

    def test_a_sample_that_is_not_after_the_last_leaves_the_window_alone(self):
        live = Live(Regression(2), FLS(1.0), lag=3)
        for t in (0.0, 1.0, 2.0):
            live.update(1.0, [1.0, t], time=t)
        before = live.smooth().theta
        live.update(9.0, [1.0, 1.0], time=1.0)
        np.testing.assert_array_equal(live.smooth().theta, before)

    def test_what_cannot_be_smoothed_says_so(self):
        with pytest.raises(ValueError, match="no samples are kept"):
            Live(Regression(2), FLS(1.0)).smooth()
        noisy = HammersteinWiener(1, 1, output=Polynomial(2), output_noise=0.1)
        with pytest.raises(ValueError, match="does not support the output_noise"):
            Live(noisy, Kalman(0.1, 0.4, p0=1.0), lag=3)
        with pytest.raises(ValueError, match="lag must be a whole number"):
            Live(Regression(2), FLS(1.0), lag=-1)
        with pytest.raises(ValueError, match="track with FLS or Kalman"):
            Live(Regression(2), RLS(0.9), lag=3)


class TestForecast:
    def test_theta_stays_and_its_variance_grows_by_q(self):
        phi, y = record()
        run = track(Regression(2), Kalman(q=0.1, r=0.5), y, phi)
        found = run.forecast(3, phi[:3])
        for h in range(3):
            P = run.cov(-1) + (h + 1) * 0.1 * np.eye(2)
            np.testing.assert_allclose(found.theta[h], run.theta[-1])
            np.testing.assert_allclose(found.std[h] ** 2, np.diag(P), rtol=1e-12)
            assert found.y_hat[h] == pytest.approx(phi[h] @ run.theta[-1])
            assert found.y_std[h] ** 2 == pytest.approx(phi[h] @ P @ phi[h] + 0.5)

    def test_fls_takes_its_estimated_scale(self):
        phi, y = record()
        run = track(Regression(2), FLS(10.0), y, phi)
        scale = run.state["scale"]
        P = run.cov(-1) + 2 * scale / 10.0 * np.eye(2)
        assert run.forecast(2, phi[:2]).y_std[1] ** 2 == pytest.approx(phi[1] @ P @ phi[1] + scale)


class TestSquareRoot:
    @pytest.mark.parametrize("mu", [1e-12, 1.0, 1e6])
    def test_both_forms_hold_where_a_covariance_would_lose_digits(self, mu):
        """Regressors that differ by 1e-6, against eighty digits."""
        phi, y = record()
        phi[:, 1] = phi[:, 0] + 1e-6 * phi[:, 1]
        theta, var = naive.precise(phi, y, mu)
        for form in ("covariance", "sqrt"):  # the former keeps the square root by itself
            run = track(Regression(2), Kalman(q=1.0 / mu, r=1.0, form=form), y, phi)
            assert np.abs(run.std[-1] ** 2 / var[-1] - 1.0).max() < 1e-7
            assert np.abs(run.theta[-1] / theta[-1] - 1.0).max() < 1e-7

    def test_a_known_parameter_needs_the_covariance_form(self):
        with pytest.raises(ValueError, match="p0 must be positive definite"):
            Kalman(0.1, 1.0, p0=[0.0, 1.0], form="sqrt")
        with pytest.raises(ValueError, match="form must be one of"):
            Kalman(0.1, 1.0, form="root")
