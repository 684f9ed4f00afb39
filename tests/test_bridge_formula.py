"""Formulas and results in the manner of statsmodels: the same numbers as its recursive least squares."""

import numpy as np
import pandas as pd
import pytest
from scipy import signal, stats

from driftfit import RLS, AdaptiveKalman, DataWarning, Kalman, Regression, track

pytest.importorskip("formulaic", reason="formulaic is not installed")

from driftfit.bridges.formula import TimeVaryingRegression


def table(T=80, seed=0):
    rng = np.random.default_rng(seed)
    data = pd.DataFrame(
        rng.normal(size=(T, 2)), columns=["x1", "x2"], index=pd.date_range("2020-01-31", periods=T, freq="ME")
    )
    data["y"] = 1 + 2 * data.x1 - np.where(np.arange(T) < T // 2, 1.0, 3.0) * data.x2 + 0.1 * rng.normal(size=T)
    return data


def test_same_numbers_as_track():
    data = table()
    result = TimeVaryingRegression.from_formula("y ~ x1 + x2", data, Kalman(q=1e-3, r=0.01)).fit()
    run = track(
        Regression(["x1", "x2"], intercept=True),
        Kalman(q=1e-3, r=0.01),
        data.y.to_numpy(),
        data[["x1", "x2"]].to_numpy(),
    )
    np.testing.assert_array_equal(result.params, run.theta[-1])
    np.testing.assert_array_equal(result.bse_path, run.std)
    assert list(result.names) == ["x1", "x2", "Intercept"]
    assert result.params_path.index.equals(data.index)
    low, high = run.band(0.9)
    np.testing.assert_allclose(result.conf_int(0.1), np.c_[low[-1], high[-1]], rtol=1e-9)
    np.testing.assert_array_equal(result.smoothed_path, run.smooth().theta)
    with pytest.warns(DataWarning, match="not in the order of 'index', and are sorted by it"):
        same = TimeVaryingRegression.from_formula("y ~ x1 + x2", data[::-1], Kalman(q=1e-3, r=0.01)).fit()
    pd.testing.assert_frame_equal(same.params_path, result.params_path)


def test_same_numbers_as_statsmodels():
    api = pytest.importorskip("statsmodels.api", reason="statsmodels is not installed")
    data = table().iloc[:40]
    mine = TimeVaryingRegression.from_formula("y ~ x1 + x2", data, RLS(1.0)).fit()
    theirs = api.RecursiveLS.from_formula("y ~ x1 + x2", data).fit()
    order = list(theirs.model.exog_names)
    np.testing.assert_allclose(mine.params[order], theirs.params, rtol=1e-8)
    np.testing.assert_allclose(mine.bse[order], theirs.bse, rtol=1e-8)
    np.testing.assert_allclose(
        mine.params_path[order].iloc[5:], theirs.recursive_coefficients.filtered.T[5:], rtol=1e-6
    )
    np.testing.assert_allclose(mine.cusum[3:], theirs.cusum, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(mine.cusum_squares[3:], theirs.cusum_squares, rtol=1e-6, atol=1e-8)
    alphas = {
        "cusum": (0.01, 0.05),
        "cusum_squares": (0.01, 0.05, 0.10),
    }  # at 0.10 it has a = 0.950, which is misprinted
    for name, some in alphas.items():
        for alpha in some:
            ends = getattr(theirs, f"_{name}_significance_bounds")(alpha, points=np.array([4, 40]))
            found = getattr(mine, f"{name}_limits")(alpha)
            np.testing.assert_allclose(found.iloc[[3, 39]], np.transpose(ends), rtol=1e-6)


def test_formula_keeps_missing_rows_and_reads_transforms():
    data = table()
    data.loc[data.index[10], "x1"] = np.nan
    data.loc[data.index[20], "y"] = np.nan
    result = TimeVaryingRegression.from_formula("y ~ x1 + np.exp(x2) - 1", data, RLS(1.0)).fit()
    assert len(result.params_path) == 80
    assert result.nobs == 78
    assert list(result.names) == ["x1", "np.exp(x2)"]
    with pytest.raises(ValueError, match="no output"):
        TimeVaryingRegression.from_formula("x1 + x2", data)


@pytest.mark.parametrize("formula", ["y ~ x1 + C(g)", "y ~ x1 * C(g, contr.sum)", "y ~ x1 + C(year) - 1", "y ~ x1 + g"])
@pytest.mark.parametrize("dtype", ["object", "category"])
def test_a_missing_category_is_a_missing_row_as_in_least_squares(formula, dtype):
    smf = pytest.importorskip("statsmodels.formula.api", reason="statsmodels is not installed")
    data = table(120)
    rng = np.random.default_rng(1)
    data["g"], data["year"] = rng.choice(["a", "b", "c"], 120), rng.choice([2020.0, 2021.0], 120)
    data.loc[rng.choice(data.index, 40, replace=False), ["g", "year"]] = [None, np.nan]
    mine = TimeVaryingRegression.from_formula(formula, data.astype({"g": dtype}), RLS(1.0)).fit()
    theirs = smf.ols(formula.replace("contr.sum", "Sum"), data).fit()
    assert mine.nobs == theirs.nobs == 80
    assert np.sort(mine.params) == pytest.approx(np.sort(theirs.params), rel=1e-8)


@pytest.mark.parametrize("T", [5, 12, 40])
def test_intervals_and_p_values_are_students_where_the_noise_variance_is_estimated(T):
    smf = pytest.importorskip("statsmodels.formula.api", reason="statsmodels is not installed")
    mine = TimeVaryingRegression.from_formula("y ~ x1 + x2", table(T), RLS(1.0)).fit()
    theirs = smf.ols("y ~ x1 + x2", table(T)).fit()
    order = list(theirs.params.index)
    assert mine.df_resid == theirs.df_resid == T - 3
    assert mine.pvalues[order].to_numpy() == pytest.approx(theirs.pvalues.to_numpy(), rel=1e-6)
    for alpha in (0.05, 0.3):
        assert mine.conf_int(alpha).loc[order].to_numpy() == pytest.approx(theirs.conf_int(alpha).to_numpy(), rel=1e-8)
    given = TimeVaryingRegression.from_formula("y ~ x1 + x2", table(T), Kalman(q=0.0, r=0.3)).fit()
    assert 4.0 < given.tvalues.x1 < 30.0
    assert given.pvalues.x1 == pytest.approx(2.0 * stats.norm.sf(given.tvalues.x1), rel=1e-12)
    assert [one.summary().table.columns[3] for one in (mine, given)] == ["P>|t|", "P>|z|"]


@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_fitted_values_are_of_the_coefficients_before_and_forecasts_are_those_of_the_tracker(colour):
    data = table(200)
    noise = signal.lfilter([1.0], [1.0, -colour], np.random.default_rng(4).normal(size=200))
    data["y"] = 1 + 2 * data.x1 + 0.3 * noise
    for tracker in (RLS(1.0), AdaptiveKalman()):
        result = TimeVaryingRegression.from_formula("y ~ x1", data, tracker).fit()
        before = result.params_path.shift(fill_value=0.0)
        assert result.fittedvalues.to_numpy() == pytest.approx(before.x1 * data.x1 + before.Intercept, rel=1e-12)
        assert np.array_equal(result.resid, data.y - result.fittedvalues)
        assert np.array_equal(result.forecasts, result.run.prediction)
        assert result.forecasts_error.to_numpy() == pytest.approx(data.y - result.forecasts, abs=1e-12)
        apart = float(np.sqrt(np.mean((result.forecasts - result.fittedvalues) ** 2)))
        said = result.summary().facts.get("Forecasts", "")
        assert (f"{apart:.4g}" in said) == (tracker != RLS(1.0))
    assert (apart > 0.1) == (colour > 0.0)


def test_dates_of_the_index_are_those_of_the_verdict():
    result = TimeVaryingRegression.from_formula("y ~ x1 + x2", table(), RLS(0.95)).fit()
    (moved,) = (one for one in result.run.verdict().parameters if one.moves)
    assert moved.name == "x2"
    assert abs(pd.Timestamp(moved.when) - table().index[40]) < pd.Timedelta("120D")


def test_cusum_leaves_its_limits_when_a_coefficient_jumps():
    constant, jump = table(), table()
    constant["y"] = 1 + 2 * constant.x1 + 0.1 * np.random.default_rng(3).normal(size=80)
    jump["y"] = constant.y + np.where(np.arange(80) < 40, 0.0, 0.5)
    outside = []
    for data in (constant, jump):
        result = TimeVaryingRegression.from_formula("y ~ x1", data, RLS(1.0)).fit()
        limits = result.cusum_limits(0.05)
        outside.append(bool(((result.cusum > limits.upper) | (result.cusum < limits.lower)).any()))
    assert outside == [False, True]
    with pytest.raises(ValueError, match="tabulated"):
        result.cusum_limits(0.2)
    with pytest.raises(ValueError, match="tabulated"):
        result.cusum_squares_limits(0.3)
    drawn = [line.get_ydata() for line in result.plot_cusum().axes[0].lines]
    assert drawn[0] == pytest.approx(result.cusum, nan_ok=True)
    limits = result.cusum_limits(0.05)
    assert np.stack(drawn[1:3]) == pytest.approx(limits.to_numpy().T, nan_ok=True)


def test_cusum_of_squares_leaves_its_limits_when_the_noise_grows():
    """Of records with constant noise a tenth leaves the limits at 10 %; with nine times the variance it leaves them."""
    rng = np.random.default_rng(5)
    count = 0
    for seed in range(60):
        data = table(seed=seed)
        data["y"] = 1 + 2 * data.x1 + rng.normal(size=80)
        result = TimeVaryingRegression.from_formula("y ~ x1", data, RLS(1.0)).fit()
        limits = result.cusum_squares_limits(0.10)
        count += bool(((result.cusum_squares > limits.upper) | (result.cusum_squares < limits.lower)).any())
    assert 1 <= count <= 13  # 6 are expected; 14 and more have a probability of 0.001
    data["y"] = 1 + 2 * data.x1 + np.where(np.arange(80) < 50, 1.0, 3.0) * rng.normal(size=80)
    louder = TimeVaryingRegression.from_formula("y ~ x1", data, RLS(1.0)).fit()
    assert (louder.cusum_squares < louder.cusum_squares_limits(0.05).lower).any()
    assert len(louder.plot_cusum_squares().axes[0].lines) == 4


def test_summary_as_text_html_and_latex():
    summary = TimeVaryingRegression.from_formula("y ~ x1 + x2", table(), RLS(1.0)).fit().summary()
    row = summary.table.loc["x1"]
    for text in (summary.as_text(), summary.as_html(), summary.as_latex()):
        assert f"{row['coef']:.4f}" in text
        assert f"{row['0.975]']:.4f}" in text
    assert summary.as_latex().count(r"\\") == 7 + 1 + 3
    assert str(summary) == summary.as_text()
