"""Directional forgetting. The members of the family as banks of one hypothesis are in test_bank_forgetting.py."""

import numpy as np
import pytest
from support import same
from test_bank import N, record

from driftfit import RLS, Regression, track

LAM = 0.9


def test_directional_forgetting_flattens_one_marginal_only():
    y, u = record(80, 3)
    run = track(Regression(N), RLS(LAM, p0=5.0, kind="directional"), y, u)
    theta, P = np.zeros(N), 5.0 * np.eye(N)
    for t in range(80):
        z = u[t]
        h = z @ P @ z
        e = LAM - (1.0 - LAM) / h  # the one-step form of Hagglund, r = 1
        gain = P @ z / (1.0 + h)
        plain = P - np.outer(gain, P @ z)
        theta = theta + gain * (y[t] - z @ theta)
        P = P - np.outer(P @ z, P @ z) * e / (1.0 + e * h)
        assert z @ P @ z == pytest.approx(z @ plain @ z / LAM)
        np.testing.assert_allclose(run.theta[t], theta, atol=1e-12)
    np.testing.assert_allclose(run.cov(-1) / run.state["scale"], P, atol=1e-12)


def test_directional_forgetting_of_one_is_least_squares_and_forgets_nothing_in_silence():
    y, u = record(200, 4)
    one = track(Regression(N), RLS(1.0, kind="directional"), y, u)
    np.testing.assert_allclose(one.theta[5:], track(Regression(N), RLS(1.0), y, u).theta[5:], atol=1e-12)
    u[50:] = 0.0
    run = track(Regression(N), RLS(LAM, kind="directional"), y, u)
    assert same(run.theta[50:], np.repeat(run.theta[49:50], 150, axis=0))
    P = run.state["P"]
    assert np.isfinite(P).all()
    y[60:], u[60:] = np.nan, 1.0
    missing = track(Regression(N), RLS(LAM, kind="directional"), y, u)
    assert same(missing.state["P"], P)
