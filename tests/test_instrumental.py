"""Instrumental variables: least squares as a special case, and no bias in coloured noise."""

import numpy as np
import pytest
from support import arx_record

from driftfit import ARX, RLS, HammersteinWiener, InstrumentalVariables, Live, Regression, track

LAMBDA = 0.97


def test_regressors_that_are_their_own_instruments_are_least_squares():
    rng = np.random.default_rng(0)
    u = rng.standard_normal((150, 2))
    y = u @ [1.0, -0.5] + 0.1 * rng.standard_normal(150)
    y[60] = np.nan
    own, least_squares = (track(Regression(2), kind(0.95), y, u) for kind in (InstrumentalVariables, RLS))
    for name in ("theta", "std", "prediction", "innovation_std"):
        np.testing.assert_allclose(getattr(own, name), getattr(least_squares, name), rtol=1e-9, err_msg=name)


def test_coloured_noise_does_not_bias_it():
    """Ten records of v_t = w_t + 0.9 w_(t-1): least squares errs by 0.1, the instruments by a tenth of that."""
    truth, wrong = np.array([1.2, -0.5, 1.0, 0.4]), {InstrumentalVariables: [], RLS: []}
    for seed in range(10):
        rng = np.random.default_rng(seed)
        u, w, y = rng.standard_normal(3000), 0.5 * rng.standard_normal(3001), np.zeros(3000)
        for t in range(2, 3000):
            phi = [y[t - 1], y[t - 2], u[t - 1], u[t - 2]]
            y[t] = truth @ phi + w[t] + 0.9 * w[t - 1]
        for kind, errors in wrong.items():
            errors.append(track(ARX(2, 2), kind(0.999), y, u).theta[-1] - truth)
    bias = {kind: np.abs(np.mean(errors, axis=0)) for kind, errors in wrong.items()}
    assert bias[RLS][[0, 1, 3]].min() > 0.08
    assert bias[InstrumentalVariables].max() < 0.02


def test_instruments_without_anything_in_common_with_the_regressors_do_no_harm():
    """No input: the auxiliary model dies out, and nothing is learned from what it cannot explain."""
    rng = np.random.default_rng(3)
    y, u = arx_record(2000, 4)
    u[200:] = 0.0
    for t in range(202, 2000):
        y[t] = 1.2 * y[t - 1] - 0.5 * y[t - 2] + 0.1 * rng.standard_normal()
    run = track(ARX(2, 2), InstrumentalVariables(LAMBDA), y, u)
    assert np.isfinite(run.theta).all()
    assert np.isfinite(run.std[-1]).all()
    assert np.abs(run.theta[-1]).max() < 10.0


def test_a_widened_parameter_is_learned_again():
    y, u = arx_record(300, 5)
    live = Live(ARX(2, 2), InstrumentalVariables(1.0))
    for t in range(300):
        live.update(float(y[t]), float(u[t]))
    before = live.theta
    live.reset("b1", p=1.0)
    live.update(float(y[-1]) + 1.0, 0.0)
    moved = live.theta - before
    assert abs(moved[2]) > 0.1
    assert abs(moved[2]) > 20.0 * np.abs(np.delete(moved, 2)).max()


def test_models_that_do_not_say_where_past_outputs_are_get_refused():
    with pytest.raises(ValueError, match="HammersteinWiener does not say which of its regressors are past outputs"):
        Live(HammersteinWiener(1, 1), InstrumentalVariables(LAMBDA))


def test_the_start_is_forgotten_without_forgetting():
    """The first samples are least squares, whose bias in strong white noise would last for thousands of samples."""
    theta = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        u, x = rng.normal(size=1500), np.zeros(1500)
        for t in range(2, 1500):
            x[t] = 1.5 * x[t - 1] - 0.7 * x[t - 2] + u[t - 1] + 0.5 * u[t - 2]
        y = x + 2.0 * rng.normal(size=1500)
        theta.append(track(ARX(2, 2), InstrumentalVariables(1.0), y, u).theta[-1])
    assert np.abs(np.median(theta, axis=0) - [1.5, -0.7, 1.0, 0.5]).max() < 0.08
