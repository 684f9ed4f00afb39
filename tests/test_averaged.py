"""Settings averaged over their likelihood."""

import numpy as np
import pytest
from support import rows_of

from benchmarks.settings_coverage import scores
from driftfit import FLS, AugmentedFLS, Kalman, Regression, tune
from driftfit.tune.tuned import _mixed


def record(T=150, q=1e-3):
    rng = np.random.default_rng(3)
    u = rng.normal(size=T)
    return u * (1.0 + np.cumsum(np.sqrt(q) * rng.normal(size=T))) + rng.normal(size=T), u


def test_draws_have_the_posterior_of_a_fine_grid():
    """p(q) is proportional to the likelihood times q^(-1/2), the prior that is flat in sqrt(q)."""
    y, u = record()
    tuned = tune(Regression(1), Kalman(r=1.0), y, u)
    x = np.linspace(-9.0, 3.0, 2000)
    f = tuned._search.f.objective
    logs = 0.5 * np.log(10.0) * x - f(x[:, None])
    weights = np.exp(logs - logs.max()) / np.exp(logs - logs.max()).sum()
    log_q = np.log10([tuned._search.knobs.values(one)[0] for one in x[:, None]])
    inside = (x > tuned._search.knobs.low[0]) & (x < tuned._search.knobs.high[0])
    weights = np.where(inside, weights, 0.0) / weights[inside].sum()
    drawn = np.log10(tuned.average(draws=1000).settings["q[theta1]/r"])
    exact = weights @ log_q
    spread = np.sqrt(weights @ (log_q - exact) ** 2)
    assert abs(drawn.mean() - exact) < 0.2 * spread
    assert drawn.std() == pytest.approx(spread, rel=0.15)
    for p in (0.1, 0.5, 0.9):
        quantile = log_q[np.searchsorted(np.cumsum(weights), p)]
        assert np.mean(drawn < quantile) == pytest.approx(p, abs=0.05)


def test_bands_cover_where_those_of_the_best_settings_do_not():
    means = np.mean([scores(200, (1e-3, 1e-3), seed) for seed in range(8)], axis=0)
    plain, mean, _, smoothed, smoothed_mean = means[:, 0]
    assert plain < 0.9
    assert smoothed < 0.87
    assert 0.93 < mean < 0.99
    assert 0.9 < smoothed_mean < 0.98
    assert means[1, 1] < 1.1 * means[0, 1]


def test_a_mixture_has_the_variance_within_and_between():
    parts = [(np.full((1, 1), m), np.full((1, 1), s)) for m, s in ((1.0, 2.0), (3.0, 4.0))]
    theta, std = _mixed(parts)
    assert theta[0, 0] == 2.0
    assert std[0, 0] == pytest.approx(np.sqrt((4.0 + 16.0) / 2.0 + 1.0))


def test_other_trackers_and_units():
    y, u = record()
    plain = tune(Regression(1), Kalman(), y, u).average(draws=8)
    scaled = tune(Regression(1), Kalman(), 2.0**20 * y, 2.0**-10 * u).average(draws=8)  # exact: the same random walk
    np.testing.assert_allclose(scaled.smoothed_theta, 2.0**30 * plain.smoothed_theta, rtol=1e-6)
    np.testing.assert_array_equal(plain.theta, tune(Regression(1), Kalman(), y, u).average(draws=8).theta)
    low, high = plain.band(0.9, smoothed=True)
    np.testing.assert_allclose(high - low, 2.0 * 1.6448536 * plain.smoothed_std, rtol=1e-6)
    mu = tune(Regression(1), FLS(), y, u).average(draws=8)
    assert np.isfinite(mu.smoothed_std).all()
    assert mu.settings.keys() == {"mu", "r"}
    for name, draws in mu.settings.items():
        assert [name, *(f"{number:.4g}" for number in np.quantile(draws, [0.5, 0.025, 0.975]))] in rows_of(mu)


def test_what_cannot_be_averaged_is_refused():
    y, u = record()
    with pytest.raises(ValueError, match="likelihood"):
        tune(Regression(1), AugmentedFLS(), y, u, method="h-step").average()
    several = tune(Regression(1), Kalman(r=1.0), np.stack([y, y]), np.stack([u, u])[..., None], by="row")
    with pytest.raises(ValueError, match="several records"):
        several.average()


def test_one_fault_code_does_not_decide_the_settings():
    y, u = record(q=1e-2)
    clean = tune(Regression(1), Kalman(), y, u)
    y[100] = 9999.0
    found = tune(Regression(1), Kalman(), y, u, gate=True)
    assert found.left_out.sample.tolist() == [100]
    assert found.noise == pytest.approx(clean.noise, rel=0.05)
    averaged = found.average(draws=20)
    assert np.median(averaged.settings["r"]) == pytest.approx(clean.noise, rel=0.2)
    assert np.isfinite(averaged.theta[-1]).all()
