"""Constant least squares as the samples arrive: the rival that every comparison runs."""

import numpy as np
import pytest
from support import arx_record, damaged

from driftfit import ARX, RLS, Kalman, Regression, track
from driftfit.data.record import Known
from driftfit.judge.compare import compare
from driftfit.judge.constant_fit import constant_errors, constant_least_squares


def test_constants_are_those_of_rls_from_a_diffuse_start():
    """Also with gaps that are filled, samples of other weights, and a regressor that starts late."""
    y, u = damaged(*arx_record(300, 7))
    u[:40] = 0.0
    weights = np.where(np.arange(300) % 3 == 0, 0.2, 1.0)
    steady = track(ARX(2, 2), RLS(1.0), y, u, weights=weights)
    got = constant_least_squares(steady.model, steady.record)
    later = slice(60, None)
    assert got["theta"][later, :, 0] == pytest.approx(steady.theta[later], rel=1e-6, abs=1e-9)
    assert got["e"][later, 0] == pytest.approx(steady.innovation[later], rel=1e-6, abs=1e-8, nan_ok=True)
    assert np.isfinite(got["theta"]).all()


def test_constants_of_regressors_that_are_the_same():
    """A column that occurs three times is not divided by its rounding error."""
    y, u = arx_record(300, 8)
    lag = np.concatenate([[0.0], u[:-1]])
    run = track(Regression(4), Kalman(q=1e-4, r=0.01), y, np.column_stack([lag, u, lag, 0.5 * lag]))
    got = constant_least_squares(run.model, run.record)
    twin = track(Regression(2), RLS(1.0), y, np.column_stack([lag, u]))
    assert got["e"][20:, 0] == pytest.approx(twin.innovation[20:], rel=1e-6, abs=1e-8)
    assert np.abs(got["theta"]).max() < 100.0
    assert compare(run).constant_arx < 2.0 * np.std(y)


def test_collinear_regressors_lose_nothing():
    """An intercept that occurs three times, as with its lags: errors of least squares on the past of each sample."""
    u = np.random.default_rng(3).normal(size=(120, 3))
    phi, y = (
        np.column_stack([np.ones((120, 3)), u]),
        1.0 + u @ [1.0, 0.5, -0.5] + np.random.default_rng(4).normal(size=120),
    )
    past = [np.linalg.lstsq(phi[:t], y[:t], rcond=1e-9)[0] for t in range(10, 120)]
    expected = y[10:] - np.sum(phi[10:] * past, axis=1)
    for order in (range(6), (3, 0, 4, 1, 5, 2)):
        got = constant_errors(phi[:, order], y, Known.of())
        assert got[10:] == pytest.approx(expected, abs=1e-10)
