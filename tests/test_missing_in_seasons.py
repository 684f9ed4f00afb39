"""Missing samples do not blur the season of the noise, which would otherwise be said to be a drift."""

import numpy as np
from scipy import signal

from driftfit import RLS, Regression, track
from driftfit.judge.statistics.constancy import constancy
from driftfit.judge.statistics.noise import whitened

SEASON = np.convolve([1.0, -0.67], np.concatenate([[1.0], np.zeros(23), [-0.4]]))


def record(seed, T=600):
    """A regression with constant coefficients, in noise with a season of 24 samples."""
    rng = np.random.default_rng(seed)
    noise = signal.lfilter([1.0], SEASON, rng.normal(size=T + 400))[400:]
    X = np.column_stack([signal.lfilter([1.0], [1.0, -0.7], rng.normal(size=T)), np.ones(T)])
    return X, X @ [1.0, 2.0] + noise, rng.random(T) >= 0.1


def test_missing_samples_are_no_drift():
    found = np.zeros(3)
    for seed in range(60):
        X, y, there = record(seed)
        at = np.flatnonzero(there)
        found[0] += constancy(X, y).p_joint < 0.05
        found[1] += constancy(X[at], y[at], at=at).p_joint < 0.05
        found[2] += constancy(X[at], y[at]).p_joint < 0.05
    assert found[1] <= found[0] + 3
    assert found[2] >= found[0] + 6  # as it would be without their places


def test_the_verdict_knows_which_are_missing():
    X, y, there = record(1)
    verdict = track(Regression(2), RLS(1.0), np.where(there, y, np.nan), X).verdict()
    assert verdict.lags >= 25


def test_rows_after_a_gap_are_whitened_at_their_own_times():
    at, ar = np.array([0, 1, 3, 4]), np.array([0.5, 0.2])
    y = np.array([1.0, 2.0, 3.0, 4.0])
    X, w = whitened(y[:, None], y, ar, at)
    missing = 0.5 * 2.0 + 0.2 * 1.0
    np.testing.assert_allclose(w, [0.0, 0.0, 3.0 - 0.5 * missing - 0.2 * 2.0, 4.0 - 0.5 * 3.0 - 0.2 * missing])
    np.testing.assert_array_equal(X[:, 0], w)
    np.testing.assert_array_equal(y, [1.0, 2.0, 3.0, 4.0])
