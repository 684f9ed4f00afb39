"""The verdict: distribution of the test, its error rate, what it names, and the comparison that it carries."""

import numpy as np
import pytest
from scipy import signal
from support import THETA, arx_record

from driftfit import ARX, RLS, AdaptiveKalman, Kalman, Regression, track
from driftfit.judge.evidence import judged_rows
from driftfit.judge.regressors import Rows
from driftfit.judge.statistics.robust import robust_fit
from driftfit.judge.statistics.whiteness import crossing, whiteness


def judged(phi, y, order=None):
    """The changes of a regression."""
    return judged_rows(Rows(np.arange(len(y)), phi, y), 0.05, order)


def p_of(phi, y, order=None):
    return judged(phi, y, order).test.p


def record(T, seed, noise="steady", n=3):
    """A regression with constant coefficients in noise of some kind."""
    rng = np.random.default_rng(seed)
    phi, e = rng.normal(size=(T, n)), rng.normal(size=T)
    if noise == "outliers":
        e *= np.where(rng.random(T) < 0.05, 10.0, 1.0)
    if noise == "changing":
        e *= np.where(np.arange(T) > 0.7 * T, 4.0, 1.0)
        phi[T // 2 :] *= 3.0
    return phi, phi @ np.arange(1.0, n + 1.0) + e


def fault(size, seed=0, to=860):
    rng, t = np.random.default_rng(seed), np.arange(1000)
    u = rng.normal(size=1000)
    y = 32.0 - size * ((t >= 560) & (t < to)) + 0.2 * u + 0.5 * rng.normal(size=1000)
    return np.column_stack([u, np.ones(1000)]), y


def test_the_larger_a_fault_the_surer():
    """A passing fault is not counted as noise: not one of 60 standard deviations, nor one of a thousand."""
    for to in (860, 620):
        p = np.array([[p_of(*fault(size, seed, to)) for size in (0.3, 1, 3, 30, 1000)] for seed in (0, 1)])
        assert (p[:, 1:] < 1e-4).all()
        assert (np.diff(p, axis=1) <= 1e-6).all()
    phi, y = fault(0.0)
    for size in (1.0, 10.0):  # 200 deviations of the noise within 60 samples look like a random walk
        assert p_of(phi, y + size * np.clip((np.arange(1000) - 700) / 60.0, 0.0, 1.0)) < 1e-4


def test_a_temporary_fault_is_reported_as_such():
    phi, y = fault(30.0)
    run = track(Regression(1, intercept=True), Kalman(q=1e-3, r=0.25), y, phi[:, 0], gate=True)
    result = run.verdict()
    assert len(run.left_out) <= 2  # the price of a jump
    assert result.moving == ("intercept",)
    moved = result.parameters[1]
    assert (moved.before, moved.after, moved.last) == pytest.approx((32.0, 2.0, 32.0), abs=0.2)
    assert moved.at == pytest.approx(560, abs=5)
    assert "from 32" in result.sentences[1]
    assert result.sentences[1].endswith(", then back.")


def test_the_headline_is_one_statement_of_both_answers():
    """A gain that swings fast leaves no trace in a cumulated score, but following it pays: nothing denies that."""
    rng = np.random.default_rng(3)
    u = rng.normal(size=600)
    y = np.sin(2.0 * np.pi * np.arange(600) / 28.0) * u + 0.2 * rng.normal(size=600)
    result = track(Regression(1, intercept=True), Kalman(q=0.1, r=0.04), y, u).verdict()
    assert result.drifts is False
    assert result.pays
    assert "No drift" not in str(result)
    assert result.sentences[0].startswith("Tracking reduces the error")
    assert "smaller than that of constants" in result.sentences[0]


def correlated(seed, T=300, rho=0.6, jump=0.0):
    """A regression whose inputs and noise are autoregressions."""
    rng = np.random.default_rng(seed)
    slow = signal.lfilter([1.0], [1.0, -0.8], rng.normal(size=T))
    e = signal.lfilter([np.sqrt(1.0 - rho * rho)], [1.0, -rho], rng.normal(size=T))
    phi = np.column_stack([slow, np.ones(T)])
    return phi, phi @ [1.0, 2.0] + jump * slow * (np.arange(T) >= T // 2) + e


def test_correlated_noise_does_not_pass_for_drift():
    """Without lags constants in correlated noise are rejected half of the time; lags are found, and drift still is."""
    plain, allowed, found = (
        np.mean([p_of(*correlated(seed, jump=jump), lags) < 0.05 for seed in range(16)])
        for jump, lags in ((0.0, 0), (0.0, None), (0.8, None))
    )
    assert plain > 0.3
    assert allowed <= 0.125
    assert found > 0.6


def test_the_parameter_that_moves_is_named_where_regressors_are_correlated():
    rng = np.random.default_rng(5)
    T = 600
    common = rng.normal(size=(T, 1))
    phi = 0.8 * common + 0.6 * rng.normal(size=(T, 3))
    theta = np.tile([1.0, 2.0, -1.0], (T, 1))
    theta[350:, 1] = 2.6
    y = np.sum(phi * theta, axis=1) + 0.5 * rng.normal(size=T)
    result = track(Regression(3), Kalman(q=1e-3, r=0.25), y, phi).verdict()
    assert result.drifts
    assert result.moving == ("theta2",)
    moved = result.parameters[1]
    assert abs(moved.at - 350) < 15
    assert moved.before == pytest.approx(2.0, abs=0.1)
    assert moved.after == pytest.approx(2.6, abs=0.1)
    assert 0.6 / moved.std > 5.0


@pytest.mark.parametrize("seed", range(3))
def test_parameters_that_cannot_be_distinguished_are_named_as_a_group(seed):
    """Regressors with correlation 0.999: one of the two moves, and the record does not tell which."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(400, 3)) @ [[1.0, 0.999, 0.0], [0.0, 0.045, 0.0], [0.0, 0.0, 1.0]]
    y = u.sum(axis=1) + 0.5 * u[:, 0] * (np.arange(400) >= 250) + 0.5 * rng.normal(size=400)
    result = track(Regression(3), Kalman(q=1e-3, r=0.25), y, u).verdict()
    assert result.drifts
    (moved,) = (one for one in result.parameters if one.moves)
    assert {moved.name, *moved.instead} == {"theta1", "theta2"}
    assert abs(moved.at - 250) < 15
    assert f"(or {moved.instead[0]}: a change of it explains the record as well)" in result.sentences[1]


def test_robust_fit_is_the_minimum_of_hubers_loss():
    phi, y = record(200, 9, "outliers")
    fit = robust_fit(phi, y)
    psi = np.clip(fit.residual, -1.5 * fit.scale, 1.5 * fit.scale)
    assert np.abs(phi.T @ psi).max() < 1e-6 * np.abs(phi * psi[:, None]).sum()
    clean, truth = np.linalg.lstsq(phi, y)[0], np.arange(1.0, 4.0)
    assert np.abs(fit.theta - truth).max() < np.abs(clean - truth).max()


def test_verdict_of_constants_and_of_a_jump():
    y, u = arx_record(500, 2)
    steady = track(ARX(2, 2), Kalman(q=1e-4, r=0.01), y, u).verdict()
    assert steady.drifts is False
    assert steady.pays is False
    assert steady.moving == ()
    assert "No drift found" in str(steady)
    path = np.where(np.arange(500)[:, None] < 250, THETA, THETA + np.array([0.0, 0.0, 0.5, 0.0]))
    moved = track(ARX(2, 2), Kalman(q=1e-3, r=0.01), *arx_record(500, 2, theta=path)).verdict()
    assert moved.drifts
    assert moved.pays
    assert "b1" in moved.moving
    assert moved.p < 1e-4
    assert "b1 from" in str(moved)


def test_following_correlated_noise_does_not_pay():
    """An intercept that follows noise predicts it, but so do constants with lags."""
    pays = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        e, u = signal.lfilter([1.0], [1.0, -0.9], rng.normal(size=(2, 600)))[:, 300:]
        run = track(Regression(1, intercept=True), Kalman(q=0.5, r=0.5), 0.5 * u + e, u)
        result = run.verdict()
        assert result.rms < result.rivals[1].rms
        assert result.constants.name == "LS with lags"
        pays.append(result.pays)
    assert sum(pays) <= 2
    b = np.where(np.arange(300) < 150, 0.5, 2.0)
    moved = track(Regression(1, intercept=True), Kalman(q=0.01, r=1.0), b * u + rng.normal(size=300), u).verdict()
    assert moved.pays


def test_records_that_can_tell_nothing():
    y, u = arx_record(20, 1)
    result = track(ARX(2, 2), Kalman(q=1e-3, r=0.1), y, u).verdict()
    assert np.isnan(result.p)
    assert result.drifts is None
    assert result.scored == 16
    assert "18 samples can be used, and at least 24 are needed" in result.sentences[0]
    late = track(ARX(2, 2), Kalman(q=1e-3, r=0.1), y, u).verdict(burn=15)
    assert late.pays is None
    assert "5 samples remain after the first 15" in late.sentences[0]
    idle = track(ARX(2, 2), Kalman(q=1e-3, r=0.1), *arx_record(200, 1)[:1], np.zeros(200)).verdict()
    assert np.isfinite(idle.p)
    assert (
        "Nothing shows whether b1 and b2 moved: their regressors are 0 in every sample but one at most."
        in idle.sentences
    )
    none = track(ARX(2, 2), Kalman(q=1e-3, r=0.1), np.full(100, np.nan), np.ones(100)).verdict()
    assert none.samples == 0


def test_weights_are_the_noise_that_the_test_takes_out():
    phi, y = record(300, 12)
    weights = np.where(np.arange(300) < 200, 1.0, 0.04)
    y = phi @ np.arange(1.0, 4.0) + (y - phi @ np.arange(1.0, 4.0)) / np.sqrt(weights)
    root = np.sqrt(weights)
    result = track(Regression(3), Kalman(q=1e-3, r=0.25), y, phi, weights=weights).verdict()
    assert result.p == pytest.approx(p_of(phi * root[:, None], y * root), rel=1e-9)


@pytest.mark.parametrize("wrong", [{"level": 0.0}, {"level": 5}, {"lags": -1}, {"burn": -1}])
def test_wrong_settings(wrong):
    y, u = arx_record(60, 1)
    with pytest.raises(ValueError, match="verdict"):
        track(ARX(2, 2), RLS(1.0), y, u).verdict(**wrong)


def test_whiteness_does_not_mistake_changing_variance_for_correlation():
    """p-values of uncorrelated noise whose variance moves stay uniform; correlated noise is found."""
    p = []
    for seed in range(1000):
        z = np.random.default_rng(seed).normal(size=300) * np.where(np.arange(300) % 100 < 50, 1.0, 4.0)
        p.append(whiteness(z).p)
    assert np.mean(np.array(p) < 0.1) == pytest.approx(0.1, abs=3.0 * np.sqrt(0.09 / 1000))
    assert np.mean(np.array(p) < 0.5) == pytest.approx(0.5, abs=3.0 * np.sqrt(0.25 / 1000))
    z = np.random.default_rng(0).normal(size=300)
    assert whiteness(z[1:] + 0.5 * z[:-1]).p < 1e-4
    assert crossing(z[1:], z[:-1]).p > 0.001
    assert crossing(z[1:] + 0.5 * z[:-1], z[1:]).p < 1e-6


@pytest.mark.parametrize(("mean", "decided"), [(0.0, True), (2.0, False)])
def test_a_change_that_lags_far_from_zero_explain_too_names_all_of_them(mean, decided):
    """An intercept that moves: with an output far from zero a change of its lag looks the same."""
    named, instead = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        u, v, y = rng.normal(size=500), 0.3 * rng.normal(size=500), np.full(500, mean / 0.3)
        for t in range(1, 500):
            y[t] = 0.7 * y[t - 1] + 0.5 * u[t - 1] + mean + 0.6 * (t >= 250) + v[t]
        moved = [m for m in track(ARX(1, 1, intercept=True), RLS(0.99), y, u).verdict().parameters if m.moves]
        named += [{m.name, *m.instead} for m in moved]
        instead += [m.instead for m in moved]
    assert len(named) >= 4, named
    assert sum("intercept" in names for names in named) >= len(named) - 1
    assert any(instead) is not decided


def test_readings_of_a_coarse_meter_that_mostly_repeat_still_have_a_noise_level():
    """A flow meter in steps of one, whose readings are interpolated now and then; the median residual is next to 0."""
    accused, found = 0, 0
    for seed in range(14):
        rng = np.random.default_rng(seed)
        u, T = rng.standard_normal(1000), 1000
        v = signal.lfilter([0.8], [1.0, -0.6], rng.standard_normal(T))
        flow, closed = 32.0 + 0.12 * u + 0.4 * v, (np.arange(T) >= 577) & (np.arange(T) < 979)
        held = 0.01 * np.where(rng.random(T) < 0.5, rng.random(T), 0.0)
        X = np.column_stack([u, np.ones(T)])
        accused += p_of(X, np.round(flow) + held) < 0.05
        found += p_of(X, np.round(flow - closed) + held) < 1e-4 if seed < 5 else 0
    assert accused <= 3
    assert found == 5


def test_a_record_without_outputs_gives_that_as_the_reason():
    """Not that regressors never varied, nor that a smaller burn would help, which it does not."""
    run = track(Regression(1), AdaptiveKalman(), np.full(80, np.nan), np.arange(80.0))
    assert "every sample has a missing output or regressor" in run.verdict().sentences[0]
    assert "no sample could be used" in str(run.summary())


@pytest.mark.parametrize("y", [7.0, -273.15, 1e-9])
def test_a_constant_output_leaves_nothing_to_compare_a_change_with(y):
    result = track(Regression(1), Kalman(q=1e-4, r=1.0), np.full(80, y), np.ones(80)).verdict(burn=0)
    assert "constant parameters explain every output without error" in result.sentences[0]
