"""Where the noise variance is estimated, the density of a sample is Student's: against the exact evidence of Bayes."""

import math

import numpy as np
import pytest
from scipy.integrate import quad

from driftfit import FLS, RLS, AdaptiveKalman, Bank, Change, InstrumentalVariables, Regression, Sensor, track
from driftfit.trackers.student import log_student

N = 2
"""Parameters; Regression(2) is compiled for all trackers by other tests too."""


def record(T=40, seed=0):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((T, N))
    return 3.0 * (u @ [1.0, -2.0] + 0.5 * rng.standard_normal(T)), u


def log_evidence(y, u, precision=0.0):
    """Of the whole sample, for the prior 1 / sigma^2 and theta | sigma^2 ~ N(0, sigma^2 / precision), up to a constant
    that no sample changes.
    """
    information = u.T @ u + precision * np.eye(N)
    rss = y @ y - u.T @ y @ np.linalg.solve(information, u.T @ y)
    nu = len(y) - (N if precision == 0.0 else 0)
    return (
        math.lgamma(nu / 2.0) - nu / 2.0 * math.log(math.pi * rss) - 0.5 * np.linalg.slogdet(information)[1]
    )  # fmt: skip


@pytest.mark.parametrize("nu", [1.0, 2.0, 3.0, 10.0, 1e6])
def test_the_density_integrates_to_one(nu):
    density = lambda e: math.exp(log_student(*np.array([e, 4.0, nu])))  # noqa: E731
    assert 2.0 * quad(density, 0.0, np.inf, epsabs=1e-12)[0] == pytest.approx(1.0, abs=1e-9)
    gaussian = math.exp(-(3.0**2) / 8.0) / math.sqrt(8.0 * math.pi)
    assert (density(3.0) == pytest.approx(gaussian, rel=1e-5)) == (nu == 1e6)


@pytest.mark.parametrize(
    "tracker", [RLS(1.0), RLS(1.0, kind="directional"), FLS(np.inf), FLS(np.inf, differences=1, theta0=7.0)], ids=repr
)
def test_least_squares_has_the_exact_evidence(tracker):
    """What the first n + 1 samples are worth is improper, so it is taken off; the diffuse terms are |X' X| of n."""
    y, u = record()
    run = track(Regression(N), tracker, y, u)
    exact = log_evidence(y, u) - log_evidence(y[: N + 1], u[: N + 1])
    assert run.loglik == pytest.approx(exact - np.linalg.slogdet(u[:N])[1], abs=1e-9)
    assert np.isnan(run.log_density[: N + 1]).all()


def test_so_it_has_from_a_given_prior_and_after_an_interruption():
    y, u = record()
    y[[5, 6, 20]] = np.nan
    seen = ~np.isnan(y)
    run = track(Regression(N), RLS(1.0, p0=4.0), y, u)
    exact = log_evidence(y[seen], u[seen], 0.25) - log_evidence(y[:1], u[:1], 0.25)
    assert run.loglik == pytest.approx(exact, abs=1e-9)
    later = track(
        Regression(N),
        RLS(1.0, p0=4.0),
        y[30:],
        u[30:],
        warm_start=track(Regression(N), RLS(1.0, p0=4.0), y[:30], u[:30]),
    )
    np.testing.assert_allclose(later.log_density, run.log_density[30:], rtol=1e-12)


def test_a_bank_of_one_hypothesis_has_it_from_its_start_on():
    y, u = record()
    bank = Bank([Change(0.0)], [Sensor.nominal(memory=None)])
    run, plain = track(Regression(N), bank, y, u), track(Regression(N), RLS(1.0), y, u)
    np.testing.assert_allclose(run.log_density[N + 1 :], plain.log_density[N + 1 :], atol=1e-9)


def test_other_trackers_have_it_while_they_start():
    y, u = record()
    plain = track(Regression(N), RLS(1.0), y, u).log_density
    adaptive = track(Regression(N), AdaptiveKalman(), y, u).log_density
    np.testing.assert_allclose(adaptive[N + 1 : N + 4], plain[N + 1 : N + 4], atol=1e-9)
    instrumental = track(Regression(N), InstrumentalVariables(1.0), y, u).log_density
    np.testing.assert_allclose(instrumental, plain, atol=1e-9)


@pytest.mark.parametrize("tracker", [AdaptiveKalman(), Bank(), RLS(1.0), FLS(1e9)], ids=repr)
def test_bands_contain_the_truth_from_the_first_residual_on(tracker):
    """A normal quantile of a variance that one residual determines held .7 of them."""
    rng = np.random.default_rng(1)
    u = rng.normal(size=(500, N + 5, N))
    truth = np.array([1e3, 5e4])
    y = u @ truth + 300.0 * rng.normal(size=u.shape[:2])
    y[:, 1] = np.nan
    fleet = track(Regression(N), tracker, y, u, by="row")
    found = []
    for key, values in zip(fleet, y, strict=True):
        (low, high), (least, most) = fleet[key].band(), fleet[key].output_band()
        found.append([np.mean((low <= truth) & (high >= truth), axis=1), (least <= values) & (values <= most)])
    of_theta, of_y = np.mean(found, axis=0)
    for shares in (of_theta[N + 1 :], of_y[N + 2 :]):
        assert (shares > 0.92).all()
        assert (shares[:3] < 0.98).all()
