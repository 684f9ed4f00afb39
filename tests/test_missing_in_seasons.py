"""Missing samples do not blur the season of the noise, which would otherwise be said to be a drift."""

import numpy as np
import pytest
from scipy import signal

from driftfit import RLS, Regression, track
from driftfit.judge.evidence import Evidence

SEASON = np.convolve([1.0, -0.67], np.concatenate([[1.0], np.zeros(23), [-0.4]]))


def record(seed, T=600):
    """A regression with constant coefficients, in noise with a season of 24 samples."""
    rng = np.random.default_rng(seed)
    noise = signal.lfilter([1.0], SEASON, rng.normal(size=T + 400))[400:]
    X = np.column_stack([signal.lfilter([1.0], [1.0, -0.7], rng.normal(size=T)), np.ones(T)])
    return X, X @ [1.0, 2.0] + noise, rng.random(T) >= 0.1


@pytest.mark.xfail(strict=True, reason="rows on both sides of a gap are whitened as neighbours")
def test_missing_samples_are_no_drift():
    found = np.zeros(2)
    for seed in range(12):
        X, y, there = record(seed)
        for k, own in enumerate((y, np.where(there, y, np.nan))):
            found[k] += Evidence(track(Regression(2), RLS(1.0), own, X)).p < 0.05
    assert found[0] <= 2
    assert found[1] <= found[0]


@pytest.mark.xfail(strict=True, reason="rows on both sides of a gap are whitened as neighbours")
def test_the_verdict_knows_which_are_missing():
    X, y, there = record(1)
    verdict = track(Regression(2), RLS(1.0), np.where(there, y, np.nan), X).verdict()
    assert verdict.lags >= 25
