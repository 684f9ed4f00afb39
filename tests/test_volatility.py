"""Noise whose variance moves: against a slow twin, and what it is worth."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from driftfit import AdaptiveKalman, Kalman, Live, Regression, track, tune

N = 2


def record(seed, T=60, volatility=0.05):
    rng = np.random.default_rng(seed)
    u, r = rng.normal(size=(T, N)), np.exp(np.cumsum(np.sqrt(volatility) * rng.normal(size=T)))
    return u @ [1.0, -2.0] + np.sqrt(r) * rng.normal(size=T), u, r


def twin(y, u, tracker, dt, weights):
    """theta (T, n), P (T, n, n), v (T,), nu (T,) and log densities (T,) before, and r (T,) given all samples."""
    theta, P, r, P_log = np.zeros(N), tracker.p0 * np.eye(N), tracker.r, 0.0
    kept = []
    for t in range(len(y)):
        P, P_log = P + tracker.q * dt[t] * np.eye(N), P_log + tracker.volatility * dt[t]
        before, nu = P_log, 2.0 / P_log
        v = u[t] @ P @ u[t] + r / weights[t]
        density = stats.t(nu, u[t] @ theta, np.sqrt(v)).logpdf(y[t])
        if np.isfinite(y[t]):
            e, k = y[t] - u[t] @ theta, r / weights[t] / v
            theta, P = theta + P @ u[t] * e / v, P - np.outer(P @ u[t], P @ u[t]) / v
            r, P_log = r * (nu + k * e**2 / v) / (nu + k), 2.0 / (nu + k)
        kept.append((theta, P, v, nu, density, r, P_log, before))
    theta, P, v, nu, density, r, after, before = (np.array(part) for part in zip(*kept, strict=True))
    for t in range(len(y) - 2, -1, -1):
        r[t] = 1.0 / (1.0 / r[t] + after[t] / before[t + 1] * (1.0 / r[t + 1] - 1.0 / r[t]))
    return theta, P, v, nu, density, r


@given(
    seed=st.integers(0, 99), volatility=st.floats(1e-4, 1.0), q=st.sampled_from([0.0, 0.01]),
    gaps=st.sets(st.integers(0, 59), max_size=20), uneven=st.booleans(),
)  # fmt: skip
def test_filter_density_and_smoother_are_those_of_a_slow_twin(seed, volatility, q, gaps, uneven):
    y, u, _ = record(seed)
    y[list(gaps)] = np.nan
    rng = np.random.default_rng(seed)
    dt, weights = rng.uniform(0.2, 3.0, size=(2, len(y))) if uneven else np.ones((2, len(y)))
    dt[0] = 1.0
    tracker = Kalman(q=q, r=0.7, p0=4.0, volatility=volatility)
    run = track(Regression(N), tracker, y, u, time=np.cumsum(dt), dt=1.0, weights=weights)
    theta, P, v, nu, density, r = twin(y, u, tracker, dt, weights)
    np.testing.assert_allclose(run.theta, theta, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(run.std**2, np.einsum("tii->ti", P), rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(run.log_density, np.where(np.isnan(y), np.nan, density), rtol=1e-7, atol=1e-9)
    given_r = track(
        Regression(N), Kalman(q=q, r=0.7, p0=4.0), y, u, time=np.cumsum(dt), dt=1.0, weights=weights * 0.7 / r
    )
    np.testing.assert_allclose(run.smooth().theta, given_r.smooth().theta, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(run.smooth().std, given_r.smooth().std, rtol=1e-7)
    half = run.innovation_std / np.sqrt(v)
    np.testing.assert_allclose(half[nu > 4.0], (stats.t.ppf(0.975, nu) / stats.norm.ppf(0.975))[nu > 4.0], rtol=0.005)


def test_a_variance_that_hardly_moves_is_constant_and_every_form_is_one_filter():
    y, u, _ = record(0)
    still = track(Regression(N), Kalman(q=0.01, r=0.7), y, u)
    slow = track(Regression(N), Kalman(q=0.01, r=0.7, volatility=1e-9), y, u)
    np.testing.assert_allclose(slow.theta, still.theta, rtol=1e-5)
    assert slow.loglik == pytest.approx(still.loglik, abs=1e-4)
    moving = track(Regression(N), Kalman(q=0.01, r=0.7, volatility=0.05), y, u)
    root = track(Regression(N), Kalman(q=0.01, r=0.7, volatility=0.05, form="sqrt"), y, u)
    np.testing.assert_allclose(root.theta, moving.theta, rtol=1e-9)
    assert root.loglik == pytest.approx(moving.loglik, abs=1e-9)
    larger = track(Regression(N), Kalman(q=1.0, r=70.0, volatility=0.05), 10.0 * y, u)
    np.testing.assert_allclose(larger.theta, 10.0 * moving.theta, rtol=1e-9)


def test_a_stream_is_its_record_and_smooths_its_last_samples(tmp_path):
    y, u, _ = record(1)
    tracker = Kalman(q=0.01, r=0.7, volatility=0.05)
    run, live = track(Regression(N), tracker, y, u), Live(Regression(N), tracker, lag=5)
    for t in range(30):
        live.update(y[t], u[t])
    live.save(tmp_path / "live.npz")
    live = Live.load(tmp_path / "live.npz")
    for t in range(30, 60):
        live.update(y[t], u[t])
    assert np.array_equal(live.theta, run.theta[-1])
    whole = run.smooth()
    np.testing.assert_allclose(live.smooth().theta, whole.theta[-6:], atol=0.3 * whole.std.max())


def test_bands_hold_likelihood_gains_and_weights_follow_the_noise():
    inside, gain, errors = [], [], []
    for seed in range(8):
        y, u, _ = record(seed, T=400, volatility=0.04)
        tuned = [tune(Regression(N), Kalman(q=0.0, volatility=v), y, u, intervals=False) for v in (None, 0.04)]
        still, moving = (track(Regression(N), one.tracker, y, u) for one in tuned)
        assert moving.loglik == pytest.approx(tuned[1].loglik)
        inside.append(np.abs(moving.innovation[50:]) < 1.96 * moving.innovation_std[50:])
        gain.append(moving.loglik - still.loglik)
        errors.append([np.square(run.theta[-1] - [1.0, -2.0]).sum() for run in (still, moving)])
    assert 0.94 < np.mean(inside) < 0.97
    assert np.min(gain) > 20.0
    assert np.divide(*np.mean(errors, axis=0)) > 1.5


def test_the_default_follows_a_variance_that_moves_as_its_stream_does():
    inside, gain = [], []
    for seed in range(8):
        y, u, _ = record(seed, T=400, volatility=0.04)
        runs = [track(Regression(N), AdaptiveKalman(volatility=v), y, u, gate=False) for v in (None, 0.04)]
        inside.append(np.abs(runs[1].innovation[50:]) < 1.96 * runs[1].innovation_std[50:])
        gain.append(runs[1].loglik - runs[0].loglik)
    live = Live(Regression(N), runs[1].tracker, gate=False)
    for t in range(len(y)):
        live.update(y[t], u[t])
    assert np.array_equal(live.theta, runs[1].theta[-1])
    assert 0.94 < np.mean(inside) < 0.97
    assert np.mean(gain) > 20.0


@pytest.mark.parametrize("tracker", [partial(Kalman, q=0.0, r=1.0), AdaptiveKalman])
def test_what_is_refused(tracker):
    with pytest.raises(ValueError, match="volatility"):
        tracker(volatility=0.0)
