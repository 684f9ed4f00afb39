"""Models run forward: outputs of constant systems, bands by drawing, and what cannot be run forward."""

import numpy as np
import pytest
from support import arx_record

from driftfit import ARX, ExtendedKalman, Kalman, Regression, track
from driftfit.models.base import Model
from driftfit.models.hammerstein_wiener.basis import Legendre, Polynomial
from driftfit.models.hammerstein_wiener.model import HammersteinWiener
from driftfit.models.hammerstein_wiener.thresholds import DeadZone
from driftfit.systems.hammerstein_wiener import simulate
from driftfit.use.simulate import DRAWS, ahead_by_draws, drawn, simulate_by_draws

CURVED = HammersteinWiener(2, 2, input=Polynomial(2), output=Polynomial(3))
A, B, C, D = [-1.2, 0.5], [0.6, 0.3], [0.4], [0.1, 0.2]
SMALL = HammersteinWiener(1, 1, input=Polynomial(2), output=Polynomial(2))


def constants(model, a, b, c, d):
    groups = [np.array(part, float)[None] for part in (a, b, [1.0, *c], [1.0, *d])]
    return model.structure.products(model.structure.minimal(*groups))


def curved_record(T=400, noise=0.0, seed=2):
    rng = np.random.default_rng(seed)
    made = simulate(SMALL, [-0.6], [0.5], [0.3], [0.2], T=T, rng=rng, u=rng.uniform(-1, 1, T), equation_noise=noise)
    return made.y, made.u


@pytest.mark.parametrize("model", [CURVED, HammersteinWiener(2, 2, nk=0, input=Legendre(2, (-3.0, 3.0)))])
def test_played_outputs_are_those_of_the_system(model):
    """Against the simulation of systems, which solves the output block by itself."""
    rng = np.random.default_rng(0)
    c, d = [0.4][: model.into.n - 1], D[: model.out.n - 1]
    made = simulate(model, A, B, c, d, T=200, rng=rng, u=rng.uniform(-1.0, 1.0, 200))
    theta, p = constants(model, A, B, c, d), 20
    span = (float(made.y.min()), float(made.y.max()))
    got = model.play(theta, made.y[None, :p], made.u[None, :, None], np.zeros((1, 200 - p)), span)
    assert got[0] == pytest.approx(made.y[p:], abs=1e-6)


def test_dead_zone_is_played_with_its_thresholds():
    model = HammersteinWiener(1, 1, input=DeadZone(2.0))
    u = np.linspace(-2.0, 2.0, 41)
    v = np.where(u >= 0.5, u - 0.5, np.where(u <= -0.25, u + 0.25, 0.0))
    y = np.zeros(42)
    for t in range(1, 42):
        y[t] = 0.5 * y[t - 1] + 2.0 * v[t - 1]
    theta = np.array([[-0.5, 2.0, 2.0 * 0.5, 2.0 * -0.25]])
    for played in (model, HammersteinWiener(1, 1, input=DeadZone(2.0, fed="average"))):
        got = played.play(theta, np.zeros((1, 1)), np.append(u, 0.0)[None, :, None], np.zeros((1, 41)), (-1.0, 1.0))
        assert got[0] == pytest.approx(y[1:], abs=1e-12)


def test_drawn_bands_are_the_delta_method_where_that_is_exact_enough():
    y, u = arx_record(600, 3)
    run = track(ARX(2, 2), Kalman(q=1e-6, r=0.01), y, u)
    future = np.random.default_rng(1).normal(size=12)
    exact, got = run.simulate(future), simulate_by_draws(run, future[:, None], -1, np.zeros(0))
    assert got.y_hat == pytest.approx(exact.y_hat, abs=1e-9)
    error = 1.0 / np.sqrt(2.0 * DRAWS)  # relative, of the standard deviation of Gaussian draws
    assert got.theta_std[1:] == pytest.approx(exact.theta_std[1:], rel=2.5 * error)
    assert got.y_std == pytest.approx(exact.y_std, rel=2.5 * error)
    exact, got = run.ahead(5), ahead_by_draws(run, 5)
    later = slice(200, None)
    assert got.y_hat[later] == pytest.approx(exact.y_hat[later], abs=1e-9)
    assert got.y_std[later] == pytest.approx(exact.y_std[later], rel=4.0 * error)  # the most of 400
    assert np.mean(got.y_std[later] / exact.y_std[later]) == pytest.approx(1.0, abs=0.02)
    low, high = got.band(0.95)
    assert 0.93 < np.mean((y[later] > low[later]) & (y[later] < high[later])) < 0.98


def test_bands_of_a_hammerstein_wiener_model_cover():
    y, u = curved_record(noise=0.03)
    run = track(SMALL, Kalman(q=0.0, r=9e-4, p0=1.0), y, u)
    result = run.ahead(4)
    later = slice(150, None)
    low, high = (end[later] for end in result.band(0.9))
    assert 0.87 < np.mean((y[later] > low) & (y[later] < high)) < 0.94
    assert np.isnan(result.y_hat[:4]).all()
    once = run.ahead(1)
    # the filter widens its grid only when an output leaves it, and predicts within the grid
    assert np.mean(np.abs(once.y_hat - run.prediction)[later] < 1e-4) > 0.98


def test_free_simulation_of_a_hammerstein_wiener_model():
    y, u = curved_record(noise=0.01)
    run = track(SMALL, Kalman(q=0.0, r=1e-4, p0=1.0), y, u)
    fresh = np.random.default_rng(9).uniform(-1.0, 1.0, 60)
    truth = simulate(SMALL, [-0.6], [0.5], [0.3], [0.2], T=60, rng=np.random.default_rng(0), u=fresh).y
    result = run.simulate(fresh)
    assert np.abs(result.y_hat - truth)[5:].max() < 0.006
    assert (result.theta_std[5:] <= result.y_std[5:] + 1e-3).all()
    again = run.simulate(fresh)
    assert np.array_equal(again.paths, result.paths)
    begun = run.simulate(fresh, y=truth[:10])
    assert np.array_equal(begun.y_hat[:10], truth[:10])
    assert begun.y_std[:10].max() < 1e-12


def test_a_tracker_of_the_free_parameters():
    y, u = curved_record(noise=0.01)
    run = track(SMALL, ExtendedKalman(q=0.0, r=1e-4, p0=1.0, theta0=0.1), y, u)
    result = run.simulate(u[:50])
    assert np.abs(result.y_hat - y[:50])[5:].max() < 0.06
    assert np.isfinite(result.y_std[5:]).all()


def test_draws_have_the_covariance_that_is_asked_for():
    cov = np.array([[2.0, 0.6], [0.6, 0.5]])
    draws = drawn(np.array([[1.0, -1.0]]), cov[None], 20_000, 0)[:, 0]
    assert np.cov(draws.T) == pytest.approx(cov, abs=0.05)
    assert np.isnan(drawn(np.zeros((1, 2)), np.full((1, 2, 2), np.nan), 3, 0)).all()


def test_regressions_are_played_without_memory():
    rng = np.random.default_rng(0)
    theta, u, noise = rng.normal(size=(3, 3)), rng.normal(size=(3, 6, 2)), rng.normal(size=(3, 4))
    got = Regression(2, intercept=True).play(theta, np.zeros((3, 2)), u, noise, (0.0, 0.0))
    for d in range(3):
        assert got[d] == pytest.approx(u[d, 2:] @ theta[d, :2] + theta[d, 2] + noise[d])


def test_a_model_that_cannot_be_run_forward_says_so():
    with pytest.raises(ValueError, match="Regression cannot be run forward"):
        Model.play(Regression(1), np.zeros((1, 1)), np.zeros((1, 0)), np.zeros((1, 3, 1)), np.zeros((1, 3)), (0.0, 1.0))
    y, u = arx_record(200, 3)
    joint = track(ARX(1, 1, ny=2), Kalman(q=0.0, r=0.01), np.column_stack([y, y]), u)
    with pytest.raises(ValueError, match="feed each other"):
        joint.model.play(np.zeros((1, 3)), np.zeros((1, 1)), np.zeros((1, 3, 1)), np.zeros((1, 2)), (0.0, 1.0))
