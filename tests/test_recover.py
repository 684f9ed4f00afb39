"""What is recovered from paths: curves, constants, switches; and the warnings where that fails."""

import numpy as np
import pytest

from driftfit import FLS, Regression, track, tune
from driftfit.systems.time_varying import example, exp_ar, hammerstein, rational
from driftfit.use.system_from_path import (
    exp_autoregression,
    rational_constants,
    rational_model,
    static_curve,
    switching_times,
)

pytestmark = pytest.mark.filterwarnings("ignore:tune:UserWarning")


def off(curve, f):
    return np.sqrt(np.mean((curve.value - f(curve.input)) ** 2))


@pytest.mark.filterwarnings("ignore:static_curve. near:UserWarning")
@pytest.mark.parametrize(("f", "name"), [(lambda u: u + 0.5 * u**3, "cubic"), (np.square, "square")])
def test_a_static_curve_is_recovered_along_the_input_and_not_in_time(f, name):
    """White input: smoothing along u is several times closer, and smoothing in time says so."""
    rng = np.random.default_rng(5)
    d = hammerstein(rng.uniform(-1.5, 1.5, 300), f, rng=rng)
    lagged = d.phi[:, 1]
    along = tune(d.model, FLS(), d.y, d.u, method="loo", groups="each", order_by=lagged)
    curve = static_curve(track(d.model, along.tracker, d.y, d.u).smooth(order_by=lagged), "b1")
    assert off(curve, f) < 0.022
    assert (np.diff(curve.input) >= 0.0).all()
    inside = np.abs(curve.value - f(curve.input)) < 3.0 * curve.std
    assert inside[np.abs(curve.input) > 0.2].mean() > 0.97
    in_time = tune(d.model, FLS(), d.y, d.u, method="loo", groups="each")
    with pytest.warns(UserWarning, match=r"order_by"):
        rough = static_curve(track(d.model, in_time.tracker, d.y, d.u).smooth(), 1)
    assert off(rough, f) > 5.0 * off(curve, f)


def test_a_curve_that_misses_the_origin_is_reported():
    rng = np.random.default_rng(0)
    d = hammerstein(rng.uniform(-1.5, 1.5, 300), lambda u: 1.0 + u, rng=rng)
    lagged = d.phi[:, 1]
    tuned = tune(d.model, FLS(), d.y, d.u, method="loo", groups="each", order_by=lagged)
    with pytest.warns(UserWarning, match="intercept"):
        static_curve(track(d.model, tuned.tracker, d.y, d.u).smooth(order_by=lagged), "b1")


def test_static_curve_wants_a_regressor_of_the_model():
    d = example("switching")
    path = track(d.model, FLS(10.0), d.y, d.u).smooth()
    with pytest.raises(ValueError, match="there is no regressor 'b9'"):
        static_curve(path, "b9")


def test_rational_constants():
    """From the path they are poor, by least squares with g known they are right."""
    found = []
    for s in range(10):
        d = rational(500, rng=np.random.default_rng(s))
        path = track(d.model, tune(d.model, FLS(), d.y, d.u).tracker, d.y, d.u).smooth()
        with pytest.warns(UserWarning, match="correlation"):
            found.append(rational_constants(path, lambda phi: 1.0 + phi[:, 1] ** 2))
    np.testing.assert_allclose(np.median([f.least_squares for f in found], axis=0), [0.3, 0.7], atol=0.02)
    np.testing.assert_allclose(np.median([f.from_path for f in found], axis=0), [0.39, 0.47], atol=0.03)


@pytest.mark.filterwarnings("ignore:smooth:RuntimeWarning")
def test_rational_refuses_what_is_inconsistent():
    d = rational(100, rng=np.random.default_rng(0))
    path = track(d.model, FLS(10.0), d.y, d.u).smooth()
    with pytest.raises(ValueError, match="g must be a function of the regressors"):
        rational_constants(path, 1.0 + d.y**2)
    present = track(Regression(2), FLS(1.0), d.y, np.stack([d.y, d.u[:, 0]], axis=1)).smooth()
    with pytest.raises(ValueError, match="present output"):
        rational_constants(present, lambda phi: 1.0 + phi[:, 1] ** 2)


def test_switching_times():
    """Within two samples of the truth in most records with a tuned weight, in few with the published one."""
    hits = {"tuned": 0, "published": 0}
    for s in range(30):
        d = example("switching", s)
        for kind, tracker in (("tuned", tune(d.model, FLS(), d.y, d.u).tracker), ("published", FLS(0.1))):
            hits[kind] += abs(switching_times(track(d.model, tracker, d.y, d.u).smooth())[0] - 100) <= 2
    assert hits["tuned"] >= 22
    assert hits["published"] <= 3
    path = track(d.model, FLS(30.0), d.y, d.u).smooth()
    assert len(switching_times(path, 5)) == 5
    assert np.diff(switching_times(path, 5)).min() >= 10
    assert len(switching_times(path, 5, apart=300)) == 1
    with pytest.raises(ValueError, match="count"):
        switching_times(path, 0)


def test_exponential_autoregression():
    """Constants and interval over twenty records; the interval covers."""
    found = [exp_autoregression(exp_ar(500, rng=np.random.default_rng(s)).y, 2) for s in range(20)]
    np.testing.assert_allclose(np.median([f.a for f in found], axis=0), [1.95, -0.96], atol=0.01)
    np.testing.assert_allclose(np.median([f.b for f in found], axis=0), [0.23, -0.24], atol=0.02)
    assert np.median([f.r for f in found]) == pytest.approx(1.0, abs=0.1)
    assert np.median([f.noise for f in found]) == pytest.approx(0.01, rel=0.02)
    assert sum(f.interval[0] <= 1.0 <= f.interval[1] for f in found) >= 18
    d = exp_ar(500, rng=np.random.default_rng(0))
    e = d.y[2:] - np.sum(found[0].theta(d.y)[2:] * np.stack([d.y[1:-1], d.y[:-2]], axis=1), axis=1)
    assert found[0].noise == pytest.approx(e @ e / (len(e) - 5))
    np.testing.assert_allclose(found[0].theta(d.y)[5:], d.theta[5:], atol=0.02)


def test_exponential_autoregression_with_holes_and_in_other_units():
    y = exp_ar(500, rng=np.random.default_rng(1)).y
    hole = y.copy()
    hole[[50, 200]] = np.nan
    whole, some, large = (exp_autoregression(v, 2) for v in (y, hole, 1e3 * y))
    assert some.r == pytest.approx(whole.r, rel=0.04)
    assert large.r == pytest.approx(1e-6 * whole.r, rel=1e-4)
    np.testing.assert_allclose(large.a, whole.a, rtol=1e-6)
    noise = np.random.default_rng(1).normal(size=60)
    with pytest.warns(UserWarning, match="does not bound r"):
        open_ended = exp_autoregression(noise, 1)
    assert open_ended.interval[0] == 0.0 or open_ended.interval[1] == np.inf
    assert open_ended.interval[0] <= open_ended.r <= open_ended.interval[1]
    with pytest.raises(ValueError, match="at least 6 usable samples"):
        exp_autoregression(y[:6], 2)
    with pytest.raises(ValueError, match="not all zero"):
        exp_autoregression(np.zeros(100), 2)


RATIONAL = np.array([0.3, 0.7, 0.8, 0.2])


def rational_record(seed, T, sigma=0.2):
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=T + 1), np.zeros(T + 1)
    for t in range(1, T + 1):
        y[t] = (0.3 * y[t - 1] + 0.7 * u[t - 1]) / (1.0 + 0.8 * u[t - 1] ** 2 + 0.2 * y[t - 1] ** 2)
        y[t] += sigma * rng.normal()
    return y[1:], np.column_stack([y[:-1], u[:-1]]), np.column_stack([u[:-1] ** 2, y[:-1] ** 2])


def test_standard_deviations_of_rational_models_are_those_of_the_errors():
    found = [rational_model(*rational_record(seed, 1000)) for seed in range(200)]
    z = np.array([(np.r_[one.a, one.b] - RATIONAL) / one.std for one in found])
    np.testing.assert_allclose(np.mean(z, axis=0), 0.0, atol=3.5 / np.sqrt(200))
    np.testing.assert_allclose(np.mean(z**2, axis=0), 1.0, atol=3.5 * np.sqrt(2.0 / 200))
    assert np.mean([one.sigma**2 for one in found]) == pytest.approx(0.04, rel=0.02)


def test_compensation_takes_the_bias_of_least_squares_away():
    """At little noise and a long record: least squares is off by ten times its compensation."""
    found = rational_model(*rational_record(0, 100_000, sigma=0.05))
    assert np.abs(found.least_squares - RATIONAL).max() > 0.1
    assert np.abs(found.compensated - RATIONAL).max() < 0.02
    assert np.abs(np.r_[found.a, found.b] - RATIONAL).max() < 3.5 * found.std.max()


def test_missing_samples_and_refusals_of_rational_models():
    y, phi, psi = rational_record(1, 300)
    y[10], phi[20, 0], psi[30, 1] = np.nan, np.inf, 1e200
    kept = np.delete(np.arange(300), [10, 20, 30])
    np.testing.assert_allclose(
        rational_model(y, phi, psi).a, rational_model(y[kept], phi[kept], psi[kept]).a, rtol=1e-12
    )
    with pytest.raises(ValueError, match="phi is y itself"):
        rational_model(y[:9], np.column_stack([y, phi[:, 1]])[:9], psi[:9])
    with pytest.raises(ValueError, match="4 usable samples cannot determine 4"):
        rational_model(y[:4], phi[:4], psi[:4])
