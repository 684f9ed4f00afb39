"""Simulated systems: their truth is true, and the drift laws follow their formulas."""

import numpy as np
import pytest

from driftfit import FLS, track
from driftfit.smooth.problem import walk_of
from driftfit.systems.drift import Jump, Ramp, RandomWalk, SineIncrement, SineOffset, paths, reflect
from driftfit.systems.time_varying import EXAMPLES, example, exp_ar, hammerstein, rational, switching


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_is_its_regression_and_the_model_sees_it(name):
    d = example(name, 3)
    again = example(name, 3)
    np.testing.assert_array_equal(d.y, again.y)
    noise = d.y - np.sum(d.phi * d.theta, axis=1)
    sigma = {"sinusoids": 0.1, "rational": 0.2, "switching": 0.2, "exp-ar": 0.1}[name]
    assert noise.std() == pytest.approx(sigma, rel=3.5 / np.sqrt(2.0 * len(noise)))
    np.testing.assert_array_equal(walk_of(track(d.model, FLS(1.0), d.y, d.u)).phi, d.phi)


def test_examples_have_the_truth_of_the_paper():
    np.testing.assert_allclose(example("sinusoids").theta[14], [0.0, -1.0], atol=1e-12)
    g = 1.0 + np.sin(16 * np.pi / 30) ** 2
    np.testing.assert_allclose(example("rational").theta[16], [0.3 / g, 0.7 / g])
    np.testing.assert_array_equal(example("switching").theta[[0, 99, 100, 199]], [[0.3, 0.7]] * 2 + [[0.8, 1.0]] * 2)
    d = example("exp-ar")
    np.testing.assert_allclose(d.theta[40], np.array([1.95, -0.96]) + np.array([0.23, -0.24]) * np.exp(-(d.y[39] ** 2)))
    with pytest.raises(ValueError, match="must be one of"):
        example("nothing")


def test_simulators_take_settings():
    rng = np.random.default_rng(0)
    assert len(rational(rng=rng, u=np.ones(7)).y) == 7
    modes = switching(30, rng=rng, at=(10, 20), modes=[(0, 0), (0, 1), (0, 2)]).theta
    np.testing.assert_array_equal(modes[[9, 10, 20], 1], [0, 1, 2])
    d = exp_ar(50, 0.0, rng=rng, a=[0.5], b=[0.1], delay=2)
    np.testing.assert_array_equal(d.y, np.zeros(50))
    h = hammerstein(rng.normal(size=40), np.square, 0.0, rng=rng, a=(0.5, -0.2), b=(1.0, 0.5))
    np.testing.assert_allclose(np.sum(h.phi * h.theta, axis=1), h.y, atol=1e-12)


def test_drift_laws():
    rng = np.random.default_rng(1)
    t = np.arange(50)
    laws = [2.0, Ramp(1.0, 0.1), SineIncrement(0.0, 0.3, 0.2), SineOffset(1.0, 0.5, 0.1), Jump(1.0, -2.0, 20), np.sqrt]
    path = paths([*laws, RandomWalk(0.0, 1.0)], 50, rng)
    assert path.shape == (50, 7)
    np.testing.assert_array_equal(path[:, 0], 2.0)
    np.testing.assert_allclose(path[:, 1], 1.0 + 0.1 * t)
    np.testing.assert_allclose(np.diff(path[:, 2]), 0.3 * np.cos(0.2 * t[:-1]))
    np.testing.assert_allclose(path[:, 3], 1.0 + 0.5 * np.sin(0.1 * t))
    np.testing.assert_array_equal(path[[19, 20], 4], [1.0, -1.0])
    np.testing.assert_allclose(path[:, 5], np.sqrt(t))
    assert path[0, 6] == 0.0
    assert RandomWalk(0.0, 2.0).path(20_001, rng).std() > 10.0
    np.testing.assert_allclose(np.diff(RandomWalk(0.0, 2.0).path(20_001, rng)).std(), 2.0, rtol=0.02)
    assert len(paths([], 5, rng)) == 5


def test_reflection_stays_within_its_limits():
    rng = np.random.default_rng(2)
    path = RandomWalk(0.5, 1.0, limits=(0.0, 1.0)).path(1000, rng)
    assert path.min() >= 0.0
    assert path.max() <= 1.0
    np.testing.assert_allclose(reflect(np.array([0.2, 1.3, -0.4, 2.1]), (0.0, 1.0)), [0.2, 0.7, 0.4, 0.1])
    with pytest.raises(ValueError, match="within the limits"):
        RandomWalk(2.0, 1.0, limits=(0.0, 1.0))
    with pytest.raises(ValueError, match="not be negative"):
        RandomWalk(2.0, -1.0)
    with pytest.raises(ValueError, match="low below high"):
        reflect(np.zeros(1), (1.0, 1.0))
