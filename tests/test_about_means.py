"""`AdaptiveKalman` beside an intercept: an offset of the inputs changes neither predictions nor gains."""

import warnings

import numpy as np
import pytest
from scipy.signal import lfilter

from driftfit import ARX, AdaptiveKalman, Regression, track

T, AT = 500, 250


def regression(seed, offset):
    """A gain that changes at the operating point, y and u, and the gain."""
    rng = np.random.default_rng(seed)
    gain, away = np.where(np.arange(T) < AT, 1.0, 1.5), rng.normal(size=T)
    return 20.0 + gain * away + 0.1 * rng.normal(size=T), offset + away, gain


def test_a_gain_that_changes_is_followed_in_raw_units():
    """Its drift was smaller by 1 + (offset / deviation)^2, so that it took 700 samples at 60 deviations, and bands of
    the gain covered 40 % of the truth, those of the smoother nothing."""
    errors = []
    for offset in (0.0, 60.0, 1e11):
        inside, smoothed, squares = [], [], []
        for seed in range(3):
            y, u, gain = regression(seed, offset)
            run = track(Regression(["u"], intercept=True), AdaptiveKalman(), y, u)
            path = run.smooth()
            inside.append(np.mean(np.abs(run.theta[50:, 0] - gain[50:]) < 1.96 * run.std[50:, 0]))
            smoothed.append(np.mean(np.abs(path.theta[:, 0] - gain) < 1.96 * path.std[:, 0]))
            squares.append(run.innovation[50:] ** 2)
        assert np.median(inside) > 0.93
        assert np.median(smoothed) > 0.93
        errors.append(np.sqrt(np.mean(squares)))
    assert errors[1] < 1.06 * errors[0]
    assert errors[2] == pytest.approx(errors[1], rel=2e-3)


def test_walks_of_all_gains_of_an_autoregression_in_raw_units():
    rng = np.random.default_rng(1)
    away, noise = rng.normal(size=T), 0.1 * rng.normal(size=T)
    b = 1.0 + np.cumsum(0.03 * rng.normal(size=T))
    z = np.zeros(T)
    for t in range(1, T):
        z[t] = 0.6 * z[t - 1] + b[t] * away[t - 1] + noise[t]
    runs = [track(ARX(1, 1, intercept=True), AdaptiveKalman(), z + level, away + level) for level in (0.0, 50.0)]
    plain, raw = (np.sqrt(np.nanmean(run.innovation[50:] ** 2)) for run in runs)
    assert raw < 1.15 * plain  # 2.1 times without drifts about the means


def test_the_smoother_is_one_in_the_models_regressors_whatever_the_size_of_the_constant():
    """The constant column may have any value, and need not be the model's own."""
    y, u, _ = regression(0, 30.0)
    one = track(Regression(["u"], intercept=True), AdaptiveKalman(), y, u)
    path = one.smooth(keep="cov")
    np.testing.assert_array_equal(path.walk.phi, np.column_stack([u, np.ones(T)]))
    np.testing.assert_allclose(path.walk.residual(path.theta), path.residual, atol=1e-9)
    phi = np.array([u[100], 1.0])
    np.testing.assert_allclose(np.sqrt(np.diag(path.cov(100))), path.std[100], rtol=1e-12)
    assert path.std[100, 1] > 10.0 * np.sqrt(phi @ path.cov(100) @ phi)  # far from u = 0 the fit is known best
    np.testing.assert_allclose(one.smooth().std, path.std, rtol=1e-12)
    other = track(Regression(["u", "one"]), AdaptiveKalman(), y, np.column_stack([u, np.full(T, 250.0)]))
    np.testing.assert_allclose(other.theta[20:, 0], one.theta[20:, 0], rtol=1e-6)
    np.testing.assert_allclose(other.smooth().theta[:, 1] * 250.0, path.theta[:, 1], rtol=1e-5)


def test_the_smoother_of_inputs_far_from_zero_does_not_follow_the_noise_without_an_intercept():
    rng = np.random.default_rng(0)
    u = 1e4 + rng.normal(size=(T, 2))
    run = track(Regression(2), AdaptiveKalman(), u @ [1.0, 0.5] + 0.1 * rng.normal(size=T), u)
    path = run.smooth()
    assert (path.std[T // 2] < run.std[-1]).all()  # was nine times as large
    assert (np.abs(path.theta - [1.0, 0.5]) < 3.0 * path.std).all()


def test_a_second_constant_column_is_not_determined():
    """Less its mean it is nothing but rounding, in coloured noise too."""
    rng = np.random.default_rng(2)
    u, noise = rng.normal(size=T), lfilter([1.0], [1.0, -0.7], 0.1 * rng.normal(size=T))
    phi = np.column_stack([np.full(T, 7.3), u, np.ones(T)])
    with pytest.warns(UserWarning, match="could not be learned"):
        path = track(Regression(3), AdaptiveKalman(), 8.3 + u + noise, phi).smooth()
    assert path.rank[-1] == 2
    assert np.isinf(path.std[:, [0, 2]]).all()
    assert (path.std[:, 1] < 0.1).all()
    assert path.theta[0] @ [1.0, 0.0, -7.3] == pytest.approx(0.0, abs=1e-9)  # nearest to 0


def test_the_smoother_averages_the_drifts_beside_an_idle_column():
    """Its likelihood, in which that column has no part, was given up: errors of the gain were three times as large."""
    rng = np.random.default_rng(0)
    u, gain = rng.normal(size=T), np.linspace(1.0, 3.0, T)
    y = 20.0 + gain * u + 0.1 * rng.normal(size=T)
    paths = []
    for idle in (rng.normal(size=T), np.zeros(T)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # nothing can be learned of the idle column
            paths.append(track(Regression(3), AdaptiveKalman(), y, np.column_stack([u, idle, np.ones(T)])).smooth())
    other, path = (np.sqrt(np.mean((path.theta[:, 0] - gain) ** 2)) for path in paths)
    assert path < 1.5 * other
