"""Counts and yes or no: the integrals against dense grids, statsmodels, simulated bands, what is not used."""

import numpy as np
import pytest
import statsmodels.api as sm
from scipy import special, stats

from driftfit import DynamicGLM, Kalman, Live, Regression, track

POISSON, NEGATIVE, LOGISTIC = "poisson", "negative binomial", "logistic"
MODEL = Regression(1)


def density(family, y, eta, alpha=0.5):
    if family == POISSON:
        return stats.poisson.pmf(y, np.exp(eta))
    if family == NEGATIVE:
        return stats.nbinom.pmf(y, 1.0 / alpha, 1.0 / (1.0 + alpha * np.exp(eta)))
    return np.exp(y * eta - np.logaddexp(0.0, eta))


CASES = [
    (family, y, m, v)
    for family in (POISSON, NEGATIVE, LOGISTIC)
    for y in ((0, 1, 5, 40) if family != LOGISTIC else (0, 1))
    for m, v in ((-3.0, 0.5), (0.0, 1.0), (3.0, 0.05), (2.0, 4.0))
]


@pytest.mark.parametrize("family", [POISSON, NEGATIVE, LOGISTIC])
def test_one_sample_against_a_dense_grid(family):
    """theta of one regressor: prior, predictive distribution and posterior by summing over 200,000 points."""
    for _, y, m, v in [case for case in CASES if case[0] == family]:
        run = track(MODEL, DynamicGLM(family, q=0.0, p0=v / 4.0, theta0=m / 2.0, alpha=0.5), [y], [2.0])
        x = np.linspace(m - 10.0 * np.sqrt(v), m + 10.0 * np.sqrt(v), 200_001)
        prior = stats.norm.pdf(x, m, np.sqrt(v)) * (x[1] - x[0])
        mu = special.expit(x) if family == LOGISTIC else np.exp(x)
        own = mu * (1.0 - mu) if family == LOGISTIC else mu + (0.5 * mu**2 if family == NEGATIVE else 0.0)
        mean = np.sum(mu * prior)
        assert run.prediction[0] == pytest.approx(mean, rel=1e-4)
        assert run.innovation_var[0] == pytest.approx(np.sum((own + (mu - mean) ** 2) * prior), rel=1e-3)
        joint = prior * density(family, y, x)
        total = joint.sum()
        after = np.sum(x * joint) / total
        assert run.loglik == pytest.approx(np.log(total), abs=2e-3)
        spread = np.sqrt(np.sum((x - after) ** 2 * joint) / total)
        assert 2.0 * run.theta[0, 0] == pytest.approx(after, abs=2e-3 * spread)
        assert 2.0 * run.std[0, 0] == pytest.approx(spread, rel=2e-3)


def drawn(family, eta, rng):
    mu = np.exp(eta)
    if family == LOGISTIC:
        return (rng.random(len(eta)) < special.expit(eta)).astype(float)
    return rng.poisson(mu * (rng.gamma(2.0, 0.5, len(mu)) if family == NEGATIVE else 1.0)).astype(float)


@pytest.mark.parametrize(
    ("family", "theirs"),
    [
        (POISSON, sm.families.Poisson()),
        (NEGATIVE, sm.families.NegativeBinomial(alpha=0.5)),
        (LOGISTIC, sm.families.Binomial()),
    ],
)
def test_constants_are_those_of_a_generalised_linear_model(family, theirs):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2000, 2))
    y = drawn(family, x @ [0.6, -0.3], rng)
    fit = sm.GLM(y, x, family=theirs).fit()
    run = track(Regression(2), DynamicGLM(family, q=0.0, p0=10.0, alpha=0.5), y, x)
    assert (np.abs(run.theta[-1] - fit.params) < 0.3 * fit.bse).all()
    np.testing.assert_allclose(run.std[-1], fit.bse, rtol=0.05)


@pytest.mark.filterwarnings("ignore:.*1 value looks like a fault code")  # one count of 9000, whose tails are long
@pytest.mark.parametrize("family", [POISSON, NEGATIVE, LOGISTIC])
def test_bands_of_drifting_parameters_cover(family):
    inside, z = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        theta = 0.5 * rng.normal(size=2) + np.cumsum(0.05 * rng.normal(size=(300, 2)), axis=0)
        x = rng.normal(size=(300, 2))
        y = drawn(family, np.sum(theta * x, axis=1), rng)
        run = track(Regression(2), DynamicGLM(family, q=0.0025, p0=0.25, alpha=0.5), y, x)
        inside.append(np.abs(run.theta - theta) < 1.96 * run.std)
        z.append(np.mean(run.innovation**2 / run.innovation_var))
    assert 0.92 < np.mean(inside) < 0.975
    assert np.mean(z) == pytest.approx(1.0, abs=3.3 * np.std(z) / np.sqrt(len(z)))


def test_the_gaussian_family_is_the_kalman_filter():
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(50, 2)), rng.normal(size=50)
    own = track(Regression(2), DynamicGLM(q=1e-2, p0=2.0, r=0.3), y, x)
    other = track(Regression(2), Kalman(q=1e-2, p0=2.0, r=0.3), y, x)
    np.testing.assert_allclose(own.theta, other.theta, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(own.std, other.std, rtol=1e-9)
    assert own.loglik == pytest.approx(other.loglik, rel=1e-12)


def test_impossible_and_extreme_readings():
    x = np.ones(30)
    y = np.full(30, 3.0)
    y[[4, 5, 6]] = -1.0, np.nan, 1e12
    run = track(MODEL, DynamicGLM(POISSON, q=1e-4, p0=1.0), y, x)
    assert run.ok.tolist() == [t not in (4, 5) for t in range(30)]
    assert np.isfinite(run.theta).all()
    assert np.isfinite(run.std).all()
    spoilt = track(MODEL, DynamicGLM(LOGISTIC, q=0.0, p0=1.0), [0.0, 1.0, 2.0, 0.5], np.ones(4))
    assert spoilt.ok.tolist() == [True, True, False, True]
    silent = track(MODEL, DynamicGLM(LOGISTIC, q=0.0, p0=4.0), np.ones(500), np.ones(500))  # yes without exception
    assert (np.diff(silent.theta[:, 0]) > 0.0).all()
    assert silent.std[-1, 0] < 2.0
    wild = track(MODEL, DynamicGLM(POISSON, q=0.0, p0=100.0), [0.0, 1e6], [50.0, -50.0])
    assert np.isfinite([*wild.theta[:, 0], *wild.prediction, *wild.std[:, 0]]).all()
    with pytest.raises(ValueError, match="family must be one of"):
        DynamicGLM("binomial")
    with pytest.raises(ValueError, match="alpha must be"):
        DynamicGLM(NEGATIVE, alpha=0.0)


def test_what_assumes_a_linear_output_is_refused_and_forecasts_are_counts():
    run = track(MODEL, DynamicGLM(POISSON, q=0.0, p0=1.0), np.full(60, 3.0), np.ones(60))
    for verb in (lambda: run.simulate(np.ones(3)), lambda: run.ahead(2), lambda: run.crossing("y", above=5.0)):
        with pytest.raises(ValueError, match="curved function"):
            verb()
    assert run.forecast(2, np.ones(2)).y_hat == pytest.approx([3.0, 3.0], abs=0.1)


def test_dispersion_exposure_and_streams():
    rng = np.random.default_rng(2)
    exposure = rng.uniform(1.0, 1000.0, 400)
    y = rng.poisson(0.02 * exposure).astype(float)
    u = np.c_[np.ones(400), np.log(exposure)]
    held = {"q": 0.0, "p0": [10.0, 0.0], "theta0": [0.0, 1.0]}
    run = track(Regression(2), DynamicGLM(POISSON, **held), y, u)
    assert run.theta[-1, 0] == pytest.approx(np.log(y.sum() / exposure.sum()), abs=0.01)
    assert run.theta[-1, 1] == 1.0
    wide = track(Regression(2), DynamicGLM(POISSON, r=4.0, **held), y, u)
    assert wide.std[-1, 0] == pytest.approx(2.0 * run.std[-1, 0], rel=0.02)
    live = Live(Regression(2), DynamicGLM(POISSON, **held))
    for one, row in zip(y, u, strict=True):
        live.update(one, row)
    assert (live.theta == run.theta[-1]).all()
