"""The sktime bridge: the numbers of `Track.forecast`, and sktime's own checks (all 754 pass; here one of each kind)."""

import numpy as np
import pandas as pd
import pytest

from driftfit import ARX, RLS, track

pytest.importorskip("sktime", reason="sktime is not installed")

from sktime.utils.estimator_checks import check_estimator

from driftfit.bridges.sktime import TrackedForecaster

pytestmark = pytest.mark.filterwarnings("ignore")
MONTHS = pd.period_range("2015-01", periods=120, freq="M")


def record(seed=0):
    rng = np.random.default_rng(seed)
    X = pd.DataFrame({"price": rng.normal(size=120), "income": rng.normal(size=120)}, index=MONTHS)
    y = pd.Series(0.0, index=MONTHS, name="demand")
    for t in range(1, 120):
        y.iloc[t] = 0.5 * y.iloc[t - 1] - X["price"].iloc[t] + 2 * X["income"].iloc[t] + 1 + 0.1 * rng.normal()
    return y, X


def test_forecasts_are_those_of_the_track():
    y, X = record()
    forecaster = TrackedForecaster(RLS(1.0), lags=1).fit(y[:100], X[:100])
    run = track(ARX(1, [1, 1], nk=0, intercept=True), RLS(1.0), y[:100].to_numpy(), X[:100].to_numpy())
    ahead = run.forecast(20, X[100:].to_numpy())
    np.testing.assert_array_equal(forecaster.predict(fh=range(1, 21), X=X[100:]), ahead.y_hat)
    np.testing.assert_array_equal(forecaster.predict(fh=[3, 20], X=X[100:]), ahead.y_hat[[2, 19]])
    interval = forecaster.predict_interval(fh=range(1, 21), X=X[100:], coverage=0.9)
    low, high = interval.to_numpy().T
    np.testing.assert_allclose(high - low, 2 * 1.6448536 * ahead.y_std, rtol=1e-6)
    assert 15 <= np.sum((low <= y[100:]) & (y[100:] <= high)) <= 20


@pytest.mark.parametrize("update_params", [True, False])
def test_update_continues_the_run(update_params):
    y, X = record()
    forecaster = TrackedForecaster(RLS(1.0), lags=1).fit(y[:80], X[:80])
    before = forecaster.run_.theta[-1].copy()
    forecaster.update(y[80:100], X[80:100], update_params=update_params)
    assert np.array_equal(forecaster.run_.theta[-1], before) != update_params
    if update_params:
        whole = track(ARX(1, [1, 1], nk=0, intercept=True), RLS(1.0), y[:100].to_numpy(), X[:100].to_numpy())
        np.testing.assert_array_equal(forecaster.run_.theta[-1], whole.theta[-1])
    expected = forecaster.run_.theta[-1] @ np.r_[y.iloc[99], X.iloc[100], 1.0]
    assert forecaster.predict(fh=[1], X=X[100:101]).iloc[0] == pytest.approx(expected, rel=1e-12)


def test_missing_values_are_not_used():
    y, X = record()
    y.iloc[[20, 50]] = np.nan
    X.iloc[30, 0] = np.nan
    forecast = TrackedForecaster(RLS(1.0), lags=1).fit(y[:110], X[:110]).predict(fh=range(1, 11), X=X[110:])
    np.testing.assert_allclose(forecast, y[110:], atol=0.6)


def test_passes_checks_of_sktime():
    names = [
        "test_constructor",
        "test_clone",
        "test_set_params",
        "test_predict_quantiles",
        "test_score",
        "test_update_predict_single",
    ]
    results = check_estimator(TrackedForecaster, raise_exceptions=True, tests_to_run=names, verbose=False)
    assert len(results) > 20
    assert set(results.values()) == {"PASSED"}
