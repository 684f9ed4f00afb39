"""Adaptive conformal factors of bands: any noise, streams and records alike, and NaN changes nothing."""

import numpy as np
import pytest

from driftfit import ARX, ConformalFactor, Kalman, Live, Regression, track


def record(noise, T=1500, seed=0):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(T, 1))
    path = 1.0 + np.cumsum(0.02 * rng.normal(size=T))
    v = {
        "as assumed": 0.3 * rng.normal(size=T),
        "larger": 0.9 * rng.normal(size=T),
        "smaller": 0.1 * rng.normal(size=T),
        "t2": 0.3 * rng.standard_t(2, T),
        "seasons": 0.3 * (1.0 + 2.0 * (np.arange(T) % 500 > 250)) * rng.normal(size=T),
    }[noise]
    return u[:, 0] * path + v, u


def share(run, level, conformal):
    low, high = run.output_band(level, conformal)
    return np.mean((low < run.y)[50:] & (run.y < high)[50:])


@pytest.mark.filterwarnings("ignore:output_band")
@pytest.mark.parametrize("level", [0.95, 0.8])
@pytest.mark.parametrize("noise", ["as assumed", "larger", "smaller", "t2", "seasons"])
def test_outputs_are_within_as_often_as_promised(noise, level):
    run = track(Regression(1), Kalman(q=4e-4, r=0.09), *record(noise))
    assert abs(share(run, level, True) - level) < 0.02
    assert (abs(share(run, level, False) - level) > 0.03) == (noise != "as assumed")


def test_a_stream_has_the_factors_of_the_record_and_gaps_change_nothing():
    y, u = record("larger", 400)
    y[100:120], u[200, 0], y[300] = np.nan, np.nan, np.inf
    model, tracker = Regression(1), Kalman(q=4e-4, r=0.09)
    run, live, factor = track(model, tracker, y, u), Live(model, tracker), ConformalFactor(0.9)
    with pytest.warns(UserWarning, match="widened by a factor above 2"):
        low, high = run.output_band(0.9, conformal=True)
    with pytest.warns(UserWarning, match="run.diagnose"):
        bands = run.band(0.9, conformal=True)
    plain = run.band(0.9)
    for t in range(400):
        half = factor.z * run.innovation_std[t] * factor.value
        np.testing.assert_array_equal([low[t], high[t]], [run.prediction[t] - half, run.prediction[t] + half])
        before = factor.square
        _, e, s, ok = live.update(y[t], u[t])
        factor.update(e, s)
        assert ok or factor.square == before
        if np.isfinite(run.std[t, 0]):
            assert bands[1][t, 0] - bands[0][t, 0] == pytest.approx((plain[1] - plain[0])[t, 0] * factor.value)
    assert np.isfinite(factor.value)


def test_levels_and_models_without_such_bands_are_refused():
    for call in (lambda: ConformalFactor(1.0), lambda: track(ARX(1), Kalman(1.0, 1.0), *record("t2", 60)).band(0.0)):
        with pytest.raises(ValueError, match="level must be between 0 and 1"):
            call()
