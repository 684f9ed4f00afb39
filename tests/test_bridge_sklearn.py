"""The scikit-learn estimator keeps that package's promises, and agrees with `track`."""

import pickle

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("sklearn", reason="there is no scikit-learn")

from sklearn.base import clone
from sklearn.model_selection import GridSearchCV, TimeSeriesSplit, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import check_estimator

from driftfit import RLS, DataWarning, Kalman, Regression, track
from driftfit.bridges.sklearn import TrackedRegressor


@pytest.fixture(scope="module")
def rows():
    """X (400, 2) whose first coefficient rises from 1 to 3, and y."""
    rng = np.random.default_rng(5)
    X = rng.normal(size=(400, 2))
    return X, np.linspace(1.0, 3.0, 400) * X[:, 0] - X[:, 1] + 0.5 + 0.1 * rng.normal(size=400)


def test_every_check_of_scikit_learn_passes():
    found = check_estimator(TrackedRegressor(RLS(1.0)), on_fail=None, on_skip=None)
    failed = {one["check_name"]: one["exception"] for one in found if one["status"] == "failed"}
    assert not failed
    assert sum(one["status"] == "passed" for one in found) > 40


def test_it_is_a_track_of_the_rows(rows):
    X, y = rows
    fitted = TrackedRegressor(Kalman(q=1e-4, r=0.01)).fit(X, y)
    run = track(Regression(2, intercept=True), Kalman(q=1e-4, r=0.01), y, X)
    np.testing.assert_array_equal(fitted.coef_path_, run.theta[:, :2])
    np.testing.assert_array_equal(fitted.coef_, run.theta[-1, :2])
    assert fitted.coef_[0] == pytest.approx(3.0, abs=0.1)
    np.testing.assert_allclose(fitted.predict(X[:3]), X[:3] @ run.theta[-1, :2] + run.theta[-1, 2])
    mean, std = fitted.predict(X[:3], return_std=True)
    np.testing.assert_allclose(mean, fitted.predict(X[:3]))
    assert np.all((std > 0.1) & (std < 0.2))


def test_partial_fit_continues(rows):
    X, y = rows
    whole = TrackedRegressor(RLS(0.98)).fit(X, y)
    parts = TrackedRegressor(RLS(0.98)).partial_fit(X[:150], y[:150]).partial_fit(X[150:], y[150:])
    np.testing.assert_array_equal(parts.coef_, whole.coef_)
    np.testing.assert_array_equal(parts.coef_path_, whole.coef_path_[150:])


def test_missing_values_are_missing(rows):
    X, y = (values.copy() for values in rows)
    X[10, 0], y[20:25] = np.nan, np.nan
    fitted = TrackedRegressor(RLS(0.98)).fit(X, y)
    assert fitted.run_.ok.sum() == 400 - 6
    assert np.isfinite(fitted.coef_).all()
    with pytest.raises(ValueError, match="every output is NaN"):
        TrackedRegressor(RLS(0.98)).fit(X, np.full(400, np.nan))


def test_settings_of_the_tracker_are_searched_in_time(rows):
    X, y = rows
    search = GridSearchCV(TrackedRegressor(RLS(0.5)), {"tracker__forgetting": [0.97, 1.0]}, cv=TimeSeriesSplit(4)).fit(
        X, y
    )
    assert search.best_params_ == {"tracker__forgetting": 0.97}
    assert search.best_estimator_.tracker == RLS(0.97)
    several = GridSearchCV(TrackedRegressor(), {"tracker": [RLS(0.97), RLS(1.0)]}, cv=TimeSeriesSplit(4))
    assert several.fit(X, y, sample_weight=np.ones(400)).best_params_ == {"tracker": RLS(0.97)}
    with pytest.raises(ValueError, match="Invalid parameter 'memory'"):
        TrackedRegressor(RLS(0.5)).set_params(tracker__memory=3)
    with pytest.raises(ValueError, match="there is no tracker"):
        TrackedRegressor().set_params(tracker__q=3)


def test_pipelines_clones_names_and_pickles(rows):
    X, y = rows
    frame = pd.DataFrame(X, columns=["income", "rate"])
    scores = cross_val_score(make_pipeline(StandardScaler(), TrackedRegressor(RLS(0.97))), X, y, cv=TimeSeriesSplit(3))
    assert scores.min() > 0.9
    fitted = TrackedRegressor(RLS(0.97)).fit(frame, y)
    assert list(fitted.feature_names_in_) == ["income", "rate"]
    assert fitted.run_.names == ("income", "rate", "intercept")
    again = pickle.loads(pickle.dumps(fitted))
    np.testing.assert_array_equal(again.predict(frame), fitted.predict(frame))
    np.testing.assert_array_equal(again.partial_fit(frame, y).coef_, fitted.partial_fit(frame, y).coef_)
    assert clone(fitted).tracker == RLS(0.97)


def test_a_weight_divides_the_variance_of_the_noise(rows):
    X, y = rows
    weights = np.repeat([1.0, 0.0, 4.0, 1.0], 100)
    fitted = TrackedRegressor(RLS(1.0)).fit(X, y, sample_weight=weights)
    ones, root = np.ones((400, 1)), np.sqrt(weights)
    exact = np.linalg.lstsq(np.hstack([X, ones]) * root[:, None], root * y, rcond=None)[0]
    np.testing.assert_allclose([*fitted.coef_, fitted.intercept_], exact, rtol=1e-9)
    parts = TrackedRegressor(RLS(1.0)).partial_fit(X[:250], y[:250], weights[:250])
    np.testing.assert_allclose(parts.partial_fit(X[250:], y[250:], weights[250:]).coef_, exact[:2], rtol=1e-9)


def test_a_cell_that_is_no_number_is_named(rows):
    frame = pd.DataFrame({"income": rows[0][:, 0], "region": ["north", "south"] * 200})
    with pytest.raises(ValueError, match="row 0 of column 'region' holds 'north', which is not a number"):
        TrackedRegressor(RLS(1.0)).fit(frame, rows[1])


def test_lags_use_own_predictions(rows):
    X, _ = rows
    y = np.zeros(400)
    for t in range(1, 400):
        y[t] = 0.7 * y[t - 1] + X[t, 0] + 0.5
    fitted = TrackedRegressor(RLS(1.0), lags=1).fit(X[:300, :1], y[:300])
    assert fitted.lag_coef_[0] == pytest.approx(0.7)
    np.testing.assert_allclose(fitted.predict(X[300:, :1]), y[300:], atol=1e-6)


@pytest.mark.parametrize("lags", [0, 1])
def test_rows_in_another_order_than_their_dates_are_sorted(rows, lags):
    values, y = rows
    days = pd.date_range("2024-01-01", periods=len(y), name="day")
    X, y = pd.DataFrame(values, days, [f"x{j}" for j in range(values.shape[1])]), pd.Series(y, days)
    ahead = X.tail(5).set_axis(days[-5:] + pd.Timedelta(days=5))
    one = TrackedRegressor(RLS(0.98), lags=lags).fit(X, y)
    with pytest.warns(DataWarning, match="not in the order of 'day', and are sorted by it"):
        two = TrackedRegressor(RLS(0.98), lags=lags).fit(X[::-1], y[::-1])
    np.testing.assert_array_equal(one.coef_path_, two.coef_path_)
    for mine, same in zip(one.predict(ahead, return_std=True), two.predict(ahead[::-1], return_std=True), strict=True):
        np.testing.assert_allclose(mine, same[::-1], rtol=1e-14)
    with pytest.warns(DataWarning, match=f"1 of {len(y) + 1} rows repeat the time"):
        twice = TrackedRegressor(RLS(0.98), lags=lags).fit(pd.concat([X, X.tail(1)]), pd.concat([y, y.tail(1)]))
    np.testing.assert_array_equal(one.coef_path_, twice.coef_path_)
