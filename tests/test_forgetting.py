"""The forgetting family: directional forgetting, and its members as banks of one hypothesis."""

import numpy as np
import pytest
from support import same
from test_bank import N, R, record

from driftfit import RLS, Bank, Kalman, Regression, track
from driftfit.trackers.bank.change import Change
from driftfit.trackers.bank.sensor import Sensor

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


def test_members_of_the_family_are_banks_of_one_hypothesis():
    y, u = record(100, 5)
    known = [Sensor.nominal(R)]
    walk = track(Regression(N), Bank([Change(0.01)], known, p0=2.0), y, u)
    assert same(walk.theta, track(Regression(N), Kalman(0.01, R, p0=2.0), y, u).theta)
    constant = track(Regression(N), Bank([Change()], known, p0=2.0), y, u)
    assert same(constant.theta, track(Regression(N), Kalman(0.0, R, p0=2.0), y, u).theta)
    exponential = track(Regression(N), Bank([Change(forget=LAM)], known, p0=2.0), y, u)
    rls = track(Regression(N), RLS(LAM, p0=2.0 / R), y, u)
    np.testing.assert_allclose(exponential.theta, rls.theta, atol=1e-10)


def test_a_reset_starts_again():
    """A change that resets, certain at one sample, forgets what was before it."""
    y, u = record(60, 6, ())
    bank = Bank([Change(), Change(2.0, reset=True, prob=0.01)], [Sensor.nominal(R)], p0=2.0)
    prob = np.tile([1.0, 0.0], (60, 1))
    prob[30] = 0.0, 1.0
    run = track(Regression(N), bank, y, u, prob=prob)
    fresh = track(Regression(N), Kalman(0.0, R, p0=2.0), y[30:], u[30:])
    np.testing.assert_allclose(run.theta[30:], fresh.theta, atol=1e-12)
    np.testing.assert_allclose(run.std[30:], fresh.std, atol=1e-12)
