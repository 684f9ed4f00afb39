"""Tests of parameters and settings, information criteria, constants: the numbers of statsmodels and of chi-squares."""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

from driftfit import ARX, RLS, AugmentedFLS, Kalman, Regression, likelihood_ratio, track, tune

api = pytest.importorskip("statsmodels.api", reason="statsmodels is not installed")
MODEL = Regression(("income", "rate"), intercept=True)


def record(T=120):
    rng = np.random.default_rng(0)
    X = pd.DataFrame(rng.normal(size=(T, 2)), columns=["income", "rate"])
    return 1 + 0.9 * X.income - 0.1 * X.rate + rng.normal(size=T), X


def test_constants_have_the_f_tests_and_robust_errors_of_statsmodels():
    y, X = record()
    theirs = api.OLS(y, api.add_constant(X)).fit()
    run = track(MODEL, RLS(1.0), y, X)
    ours, expected = run.wald("income == 1", "rate == 0"), theirs.f_test("income = 1, rate = 0")
    assert (ours.statistic, ours.p) == pytest.approx((expected.fvalue, expected.pvalue))
    assert ours.df == (2, 117)
    assert f"F(2, 117)        {ours.statistic:.6g}" in str(ours)
    first = api.OLS(y[:80], api.add_constant(X)[:80]).fit().f_test("rate = 0")
    assert run.wald("rate == 0", at=79).p == pytest.approx(float(first.pvalue))
    units = track(MODEL, RLS(1.0), y, X * [1e-9, 1e9]).wald("income == 1e9", "rate == 0")
    assert units.statistic == pytest.approx(ours.statistic)
    robust = {"cov_type": "HAC", "cov_kwds": {"maxlags": 4}}
    hac = theirs.model.fit(**robust)
    np.testing.assert_allclose(run.constants(**robust).bse, hac.bse[["income", "rate", "const"]])
    given = track(MODEL, Kalman(q=0.0, r=theirs.scale), y, X).wald("income == 1", "rate == 0")
    assert given.statistic == pytest.approx(2 * expected.fvalue)
    assert given.p == pytest.approx(chi2.sf(given.statistic, 2))


def test_formulas_predict_forecast_and_weigh():
    pytest.importorskip("formulaic", reason="formulaic is not installed")
    from driftfit.bridges.formula import TimeVaryingRegression

    y, X = record()
    data, weights = X.assign(y=y), np.linspace(0.5, 2.0, len(y))
    result = TimeVaryingRegression.from_formula("y ~ income + rate", data, RLS(1.0), weights=weights).fit()
    theirs = api.WLS(y, api.add_constant(X), weights=weights).fit()
    np.testing.assert_allclose(result.params[["Intercept", "income", "rate"]], theirs.params)
    np.testing.assert_allclose(result.cov_params().to_numpy()[:2, :2], theirs.cov_params().to_numpy()[1:, 1:])
    tested = theirs.f_test("income = 1")
    assert result.f_test("income = 1").p == pytest.approx(float(tested.pvalue))
    later = pd.DataFrame({"income": [1.0, 2.0], "rate": [0.5, -1.0]}, pd.Index(["a", "b"]))
    expected = theirs.get_prediction(api.add_constant(later)).summary_frame()
    forecast = result.get_forecast(later)
    np.testing.assert_allclose(result.predict(later), expected["mean"])
    np.testing.assert_allclose(forecast["mean"], expected["mean"])
    np.testing.assert_allclose(forecast["mean_se"], np.hypot(expected["mean_se"], theirs.scale**0.5))
    assert list(forecast.index) == ["a", "b"]
    assert "AIC, BIC" in result.summary().as_text()


def test_criteria_are_those_of_statsmodels_but_for_a_constant_of_the_diffuse_likelihood():
    rng = np.random.default_rng(0)
    y = np.cumsum(0.5 * rng.normal(size=150)) + rng.normal(size=150)
    level = Regression(0, intercept=True)
    tuned = tune(level, Kalman(), y)
    theirs = api.tsa.UnobservedComponents(y, "llevel", use_exact_diffuse=True).fit(disp=0)
    constant = np.log(2 * np.pi)
    assert (tuned.aic, tuned.bic) == pytest.approx((theirs.aic - constant, theirs.bic - constant), abs=1e-4)
    run = track(level, tuned.tracker, y)
    assert (run.aic(2), run.bic(2)) == pytest.approx((tuned.aic, tuned.bic))
    still = tune(level, Kalman(q=0.0), y)
    tested = likelihood_ratio(still, tuned)
    assert tested.statistic == pytest.approx(2 * (tuned.loglik - still.loglik))
    assert tested.p == pytest.approx(0.5 * chi2.sf(tested.statistic, 1))
    assert likelihood_ratio(track(level, still.tracker, y), run, df=1).p == pytest.approx(tested.p)
    with pytest.raises(ValueError, match="restricted comes first"):
        likelihood_ratio(run, run)
    with pytest.raises(ValueError, match="samples have a likelihood; give both"):
        likelihood_ratio(tune(level, Kalman(q=0.0), y[1:]), tuned)


@pytest.mark.parametrize(
    ("equations", "said"),
    [((), "got none"), (("b1 >= 1",), "got 'b1 >= 1'"), (("b1 == 1", "2*b1 == 2"), "depend on each other"),
     (("wages == 1",), "is not linear in the parameters"), (("a1 == 0",), "does not determine a1 up to sample 0")],
)  # fmt: skip
def test_what_cannot_be_tested_is_refused(equations, said):
    y, X = record(30)
    run = track(ARX(1, 1), RLS(1.0), y, X.income.to_numpy())
    with pytest.raises(ValueError, match=said):
        run.wald(*equations, at=0 if "a1" in str(equations) else -1)
    with pytest.raises(ValueError, match="has no covariance"):
        track(ARX(1, 1), AugmentedFLS(1.0), y, X.income.to_numpy()).wald("b1 == 1")
