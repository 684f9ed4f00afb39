"""Transfer functions in coloured noise: innovations, gradients, a slow twin, bias and coverage."""

import numpy as np
import pytest
from scipy import signal
from support import arx_record

from driftfit import (
    ARMAX,
    ARX,
    OE,
    RLS,
    AdaptiveKalman,
    Bank,
    BoxJenkins,
    Change,
    InstrumentalVariables,
    Kalman,
    Live,
    PolynomialModel,
    Sensor,
    track,
)
from driftfit.models.polynomial import FORGOTTEN
from driftfit.models.polynomials.steps import SETTLING
from driftfit.run.program import Program
from driftfit.smooth.problem import replay

BJ, PLAIN = BoxJenkins(2, 1, 1, 2, offset=True), BoxJenkins(2, 1, 1, 2)
THETA = np.array([1.0, 0.5, 0.5, 0.9, 1.5, -0.7, 3.0])


def plant(theta, T, seed, noise=0.5):
    """y, u, e of BJ at theta, from rest."""
    b1, b2, c, d, f1, f2, offset = theta
    rng = np.random.default_rng(seed)
    u, e = rng.normal(size=T), noise * rng.normal(size=T)
    response = signal.lfilter([0.0, b1, b2], [1.0, -f1, -f2], u)
    return response + offset + signal.lfilter([1.0, c], [1.0, -d], e), u, e


def held(model, theta, y, u):
    """The run with theta held constant."""
    return track(model, Kalman(q=0.0, r=1.0, p0=1e-20, theta0=tuple(theta)), y, u)


def test_the_innovations_at_the_true_parameters_are_the_noise():
    y, u, e = plant(THETA, 2000, 0)
    run = held(BJ, THETA, y, u)
    np.testing.assert_allclose(run.innovation[500:], e[500:], atol=1e-9)
    np.testing.assert_allclose(run.prediction[500:], (y - e)[500:], atol=1e-9)


def test_the_regressors_are_the_gradient_of_the_prediction():
    """Up to the damping of their filters, which is 1 - SETTLING n / N after N samples."""
    y, u, _ = plant(THETA, 12_000, 1)
    phi, step = replay(held(BJ, THETA, y, u))["phi"][..., 0], 1e-5
    for i, name in enumerate(BJ.names):
        away = step * np.eye(BJ.n)[i]
        up, down = (held(BJ, THETA + sign * away, y, u).prediction[11_000:] for sign in (1.0, -1.0))
        error = phi[11_000:, i] - (up - down) / (2.0 * step)
        assert np.sqrt(np.mean(error**2)) < 0.03 * np.sqrt(np.mean(phi[11_000:, i] ** 2)), name


def twin(y, u, p0, forgetting):
    """theta of ARMAX(1, 1, 1) under RLS, written from the equations."""
    n = 3
    theta, P, usable = np.zeros(n), p0 * np.eye(n), 0
    recent, least, quieter = 0.0, 0.0, 1.0
    old = {name: 0.0 for name in ("y", "u", "e", "yf", "uf", "ef")}
    rows = []
    for t in range(len(y)):
        c = theta[2]
        while abs(c) >= 0.9999:
            c *= 0.9
        inner = 1.0 - 1.0 / max(usable / (SETTLING * n), 1.0)
        uf = u[t] - inner * c * old["uf"]
        phi = np.array([old["y"], old["u"], old["e"]])
        psi = np.array([old["yf"], old["uf"], old["ef"]]) if usable >= SETTLING * n else phi
        if t > 0:
            e = y[t] - phi @ theta
            early = 1.0 - 1.0 / max(SETTLING * n, 0.25 * usable) if 0 < usable < FORGOTTEN * n else 1.0
            P = P / min(forgetting, early) * quieter
            k = P @ psi / (1.0 + psi @ P @ psi)
            theta, P, quieter = theta + k * e, P - np.outer(k, psi @ P), 1.0
            if usable + 1 < FORGOTTEN * n:
                before = recent if recent > 0.0 else e * e
                recent = before + (min(e * e, 25.0 * before) - before) / min(usable + 1, max(20.0, (usable + 1) / 8))
                quieter, least = (least / min(least, recent), min(least, recent)) if least > 0.0 else (1.0, recent)
                least = least if usable + 1 >= 20 else 0.0
        c = theta[2]
        while abs(c) >= 0.9999:
            c *= 0.9
        late = y[t] - phi @ np.array([*theta[:2], c]) if usable >= 0.5 * SETTLING * n else 0.0
        yf, ef = y[t] - inner * c * old["yf"], late - inner * c * old["ef"]
        old = {"y": y[t], "u": u[t], "e": late, "yf": yf, "uf": uf, "ef": ef}
        usable += t > 0
        rows.append(theta)
    return np.array(rows)


def armax_record(T, seed, c=0.7):
    rng = np.random.default_rng(seed)
    u, e = rng.normal(size=T), 0.3 * rng.normal(size=T)
    y = signal.lfilter([0.0, 1.0], [1.0, -0.8], u) + signal.lfilter([1.0, c], [1.0, -0.8], e)
    return y, u


def test_recursive_maximum_likelihood_is_its_slow_twin():
    """While C is stable, which it is here, the prediction is linear at theta itself."""
    y, u = armax_record(600, 21)
    run = track(ARMAX(1), RLS(0.995, p0=100.0), y, u)
    np.testing.assert_allclose(run.theta[1:], twin(y, u, 100.0, 0.995)[1:], rtol=1e-6, atol=1e-8)


def test_no_bias_in_coloured_noise_and_bands_that_cover():
    """Least squares in ARX is wrong by many of its deviations where the measurement is noisy."""
    errors, inside, biased = [], [], []
    for seed in range(40):
        y, u, e = plant(THETA, 1000, 200 + seed)
        run = track(PLAIN, AdaptiveKalman(), y - THETA[6], u)
        errors.append((run.theta[-1] - THETA[:6])[[0, 1, 4, 5]])
        inside.append(np.abs(errors[-1]) < 1.96 * run.std[-1][[0, 1, 4, 5]])
        noisy = signal.lfilter([0.0, 1.0, 0.5], [1.0, -1.5, 0.7], u) + e
        least = track(ARX(2, 2), RLS(1.0), noisy, u)
        biased.append(abs(least.theta[-1][0] - 1.5) / least.std[-1][0])
    assert np.abs(np.median(errors, axis=0)).max() < 0.01
    assert np.mean(inside) >= 0.93
    assert np.median(biased) > 5.0


def test_a_gain_that_jumps_is_followed():
    rng = np.random.default_rng(3)
    T = 2000
    u = rng.normal(size=T)
    gain = np.where(np.arange(T) < 1000, 1.0, 1.6)
    y = signal.lfilter([1.0], [1.0, -0.8], np.r_[0.0, (gain * u)[:-1]]) + 0.2 * rng.normal(size=T)
    run = track(OE(1, 1), AdaptiveKalman(), y, u)
    for t, b in ((999, 1.0), (1199, 1.6), (1999, 1.6)):
        assert abs(run.theta[t, 0] - b) < min(0.15, 4.0 * run.std[t, 0])
        assert abs(run.theta[t, 1] - 0.8) < 0.05


def test_missing_data_and_gaps_do_no_harm():
    y, u, _ = plant(THETA, 1500, 4)
    rng = np.random.default_rng(5)
    y[rng.random(1500) < 0.1], u[rng.random(1500) < 0.05] = np.nan, np.nan
    y[700:760] = np.nan
    time = np.arange(1500.0) + np.where(np.arange(1500) >= 900, 50.0, 0.0)
    run = track(PLAIN, AdaptiveKalman(), y - THETA[6], u, time=time)
    assert np.isfinite(run.theta[100:]).all()
    assert np.abs(run.theta[-1] - THETA[:6])[[0, 1, 4, 5]].max() < 0.25


def test_the_noise_model_is_uncertain_in_forecasts_too():
    """As the lags of an ARX are; and if the noise model is hardly known .90 of the outputs are within 95 % bands, .71
    within those of the estimate of C and D."""
    y, u = arx_record(200, 5)
    as_arx, other = (track(one, Kalman(q=0.0, r=0.01), y, u) for one in (ARX(2, 2), PolynomialModel(na=2, nb=2, nc=0)))
    ahead, by_response = as_arx.forecast(12, np.ones(12)), other.forecast(12, np.ones(12))
    np.testing.assert_allclose(by_response.y_std, ahead.y_std, rtol=2e-4)
    rng = np.random.default_rng(3)
    inside = []
    for _ in range(100):
        u, e = rng.normal(size=25), 0.3 * rng.normal(size=25)
        y = signal.lfilter([0.0, 1.0], [1.0, -0.7], u) + signal.lfilter([1.0, 0.5], [1.0, -0.8], e)
        ahead = track(BoxJenkins(), RLS(1.0), y[:15], u[:15]).forecast(10, u[15:])
        inside.append(np.abs(y[15:] - ahead.y_hat) < 1.96 * ahead.y_std)
    assert np.mean(inside) > 0.87


IN_COLOURED_NOISE = pytest.mark.parametrize(
    ("model", "tracker"),
    [(ARMAX(1), RLS(1.0)), (BoxJenkins(), RLS(1.0)), (BoxJenkins(), InstrumentalVariables(1.0))],
    ids=["ARMAX", "Box-Jenkins", "instruments"],
)


@IN_COLOURED_NOISE
def test_the_noise_variance_is_not_that_of_the_quietest_samples(model, tracker):
    """A start that is forgotten leaves P in units of the least of many estimates, which is .7 of the variance; taken as
    the scale it let .85 of the outputs into their bands."""
    scale, inside = [], []
    for seed in range(50):
        y, u = armax_record(200, seed, c=0.5)
        run = track(model, tracker, y, u)
        scale.append(run.state["scale"] / 0.09)
        inside.append(np.abs(run.innovation[120:]) < 1.96 * run.innovation_std[120:])
    assert 0.9 < np.median(scale) < 1.15
    assert 0.92 < np.mean(inside) < 0.98


@IN_COLOURED_NOISE
@pytest.mark.parametrize(("quiet", "loudness"), [(20, 1e-6), (50, 1e-3)])
def test_noise_that_begins_late_is_soon_within_the_bands(model, tracker, quiet, loudness):
    """A square that counted as at most 25 times the mean let none of the outputs into their bands for 40 samples."""
    inside = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        u, e = rng.normal(size=200), 0.3 * rng.normal(size=200)
        e[:quiet] *= loudness
        y = signal.lfilter([0.0, 1.0], [1.0, -0.8], u) + signal.lfilter([1.0, 0.5], [1.0, -0.8], e)
        run = track(model, tracker, y, u)
        later = slice(quiet + 30, quiet + 60)
        inside.append((np.abs(run.innovation) < 1.96 * run.innovation_std)[later][run.ok[later]])
    assert np.mean(np.concatenate(inside)) > 0.85


def test_the_forecast_of_coloured_noise_decays():
    y, u, _ = plant(THETA, 1000, 6)
    live = Live(BJ, Kalman(q=0.0, r=0.25, p0=1e-20, theta0=tuple(THETA)))
    for t in range(1000):
        live.update(y[t], u[t])
    future = np.random.default_rng(7).normal(size=30)
    forecast = live.forecast(30, future)
    whole_u = np.r_[u, future]
    quiet = signal.lfilter([0.0, 1.0, 0.5], [1.0, -1.5, 0.7], whole_u)[1000:] + 3.0
    e = held(BJ, THETA, y, u).innovation[-1]
    noise = y[-1] - signal.lfilter([0.0, 1.0, 0.5], [1.0, -1.5, 0.7], u)[-1] - 3.0
    expected = quiet + (0.9 * noise + 0.5 * e) * 0.9 ** np.arange(30)
    np.testing.assert_allclose(forecast.y_hat, expected, atol=1e-8)
    response = np.r_[1.0, (0.9 + 0.5) * 0.9 ** np.arange(29)]
    np.testing.assert_allclose(forecast.y_std, 0.5 * np.sqrt(np.cumsum(response**2)), rtol=1e-6)


def test_orders_and_names():
    assert BoxJenkins([1, 2], 1, 1, [1, 0], [1, 2]).names == ("b1[u1]", "b1[u2]", "b2[u2]", "c1", "d1", "f1[u1]")
    assert ARMAX(2, 1, 1, inputs=["heat"]).names == ("a1", "a2", "b1[heat]", "c1")
    assert OE(1, 2, offset=True).bind(1).dimensions == ((1, 0), (0, None), (0, None), (1, None))
    parts = BJ.parts(THETA)
    assert [parts[name].tolist() for name in "ACD"] == [[1.0], [1.0, 0.5], [1.0, -0.9]]
    assert parts["B"][0].tolist() == [0.0, 1.0, 0.5]
    assert parts["F"][0].tolist() == [1.0, -1.5, 0.7]
    with pytest.raises(ValueError, match="different numbers of inputs"):
        OE([1, 1], [1, 1, 1])
    with pytest.raises(ValueError, match="needs at least 1 input"):
        OE(1, 1).bind(0)
    with pytest.raises(ValueError, match="nothing to estimate"):
        OE(0, 0)


def test_instruments_are_for_lags_that_are_outputs():
    with pytest.raises(ValueError, match="does not say which of its regressors"):
        track(ARMAX(1), InstrumentalVariables(0.99), *armax_record(50, 8))


def test_a_field_of_two_owners_is_refused():
    """State of model and tracker is one record, in which a name means one thing."""

    class Careless(RLS):
        def state(self, n):
            return {**super().state(n), "signals": 0.0}

    with pytest.raises(ValueError, match="both have a field signals"):
        Program(ARMAX(1).bind(1), Careless(0.99)).tile()


def test_units_are_those_of_the_signals_and_fault_codes_leave_no_trace():
    rng = np.random.default_rng(3)
    u = rng.normal(size=600)
    y = signal.lfilter([0.0, 1.0], [1.0, -0.7], u) + 0.3 * rng.normal(size=600)
    plain = track(OE(1, 1), AdaptiveKalman(), y, u)
    np.testing.assert_allclose(plain.theta[-1], [1.0, 0.7], atol=0.03)
    for of_y, of_u in ((1e-6, 1e-6), (1e6, 1e6), (1e-9, 1e3)):
        other = track(OE(1, 1), AdaptiveKalman(), of_y * y, of_u * u)
        np.testing.assert_allclose(other.theta[-1] / [of_y / of_u, 1.0], plain.theta[-1], rtol=1e-9)
    for code, rows, signal_of in ((9999.0, [300], y), (-999.0, range(300, 305), y), (9999.0, [300], u)):
        kept = signal_of[rows].copy()
        signal_of[rows] = code
        run = track(OE(1, 1), AdaptiveKalman(), y, u)
        np.testing.assert_allclose(run.theta[-1], [1.0, 0.7], atol=0.03)
        assert run.ok[-100:].all()
        signal_of[rows] = kept


def test_least_squares_forgets_its_start():
    """With an offset and two inputs the first regressors are poor, and RLS(1.0) used to keep the estimate from them."""
    truth, inside, off = np.array([1.0, 0.5, 0.3, 0.5, 0.8, 1.5, -0.7, 0.9, 2.0]), [], []
    model = BoxJenkins([2, 1], 1, 1, [2, 1], nk=[1, 2], offset=True)
    for seed in range(12):
        rng = np.random.default_rng(seed)
        u = rng.normal(size=(1500, 2))
        y = signal.lfilter([0.0, 1.0, 0.5], [1.0, -1.5, 0.7], u[:, 0]) + signal.lfilter([0, 0, 0.3], [1, -0.9], u[:, 1])
        y += signal.lfilter([1.0, 0.5], [1.0, -0.8], 0.3 * rng.normal(size=1500)) + 2.0
        run = track(model, RLS(1.0), y, u)
        miss = run.theta[-1] - truth
        inside.append(np.abs(miss) < 1.96 * run.std[-1])
        off.append(miss[-1])
    assert np.mean(inside) > 0.9  # it was .57
    assert np.sqrt(np.mean(np.square(off))) < 0.15  # it was 1.1


def test_gains_and_responses_of_transfer_functions():
    y, u, _ = plant(THETA, 1500, 3)
    run = track(PLAIN, RLS(1.0), y - THETA[6], u)
    parts = PLAIN.bind(1).parts(run.theta[-1])
    B, F = parts["B"][0], parts["F"][0]
    step = signal.lfilter(B, F, np.ones(30))
    np.testing.assert_allclose(run.step_response(30).value[0], step, rtol=1e-9)
    np.testing.assert_allclose(run.dc_gain(-1).value[0, 0], B.sum() / F.sum(), rtol=1e-12)
    np.testing.assert_allclose(np.sort_complex(run.poles(-1)[0]), np.sort_complex(np.roots(F)), rtol=1e-9)
    played = run.simulate(u[:40])
    np.testing.assert_allclose(played.y_hat, signal.lfilter(B, F, u[:40]), rtol=1e-8, atol=1e-10)
    assert (played.y_std > played.theta_std).all()
    assert run.largest_pole(-1).value[0] == pytest.approx(np.abs(np.roots(F)).max())
    for verb in (lambda: run.simulate(u[:5], y=y[:2]), run.long_run):
        with pytest.raises(ValueError, match=r"from rest|is for ARX"):
            verb()


def test_readings_are_judged_and_not_what_a_shift_leaves_of_them():
    """The step of a coarse meter, a spike and a frozen sensor are found where the regression has another output."""
    rng = np.random.default_rng(3)
    u = rng.normal(size=600)
    y = 20.0 + signal.lfilter([0.0, 0.5], [1.0, -0.8], u) + 0.05 * rng.normal(size=600)
    coarse = track(BoxJenkins(offset=True), AdaptiveKalman(), 0.5 * np.round(y / 0.5), u).state
    assert coarse["floor"] == pytest.approx(0.5**2 / 12.0)
    y[500:520] = y[499]
    sensors = [Sensor.nominal(r=0.0025), Sensor.frozen(0.01)]
    bank = Bank([Change(q=1e-6)], sensors, (None, [[0.98, 0.02], [0.05, 0.95]]), p0=10.0)
    found = track(OE(1, 1, offset=True), bank, y, u).hypotheses.found()
    assert [(event.span.first, event.span.last) for event in found if event.span.first > 180] == [(500, 519)]
    y[400] = 40.0
    run = track(BoxJenkins(offset=True), AdaptiveKalman(), y, u)
    assert run.left_out.counts["Left out"] == 1
    assert run.left_out.counts["Frozen"] >= 19
    left_out = np.flatnonzero(~run.ok)
    assert {400, *range(501, 520)} <= set(left_out[left_out > 20]) <= {400, 401, *range(500, 521)}


@pytest.mark.parametrize("level", [20.0, 1000.0])
@pytest.mark.parametrize("order", [1, 2])
def test_a_level_without_an_offset_is_what_an_integrating_noise_predicts(order, level):
    """D was drawn far from an unstable one, and then predicted nine tenths of the level."""
    errors = []
    for seed in range(3, 6):
        rng = np.random.default_rng(seed)
        u = rng.normal(size=600)
        y = level + signal.lfilter([0.0, 0.5], [1.0, -0.8], u) + 0.05 * rng.normal(size=600)
        run = track(BoxJenkins(nc=order, nd=order), AdaptiveKalman(), y, u)
        errors.append(np.sqrt(np.mean(run.innovation[100:] ** 2)))
    assert np.median(errors) < 0.3  # with two zeros and a level of 1000 one record in six is lost


def test_inputs_far_from_zero_cause_a_warning():
    """The response to a mean of five deviations makes the pole .5 instead of .8, also with an offset."""
    rng = np.random.default_rng(0)
    u, e = 5.0 * rng.normal(size=1000), rng.normal(size=1000)
    y = 20.0 + signal.lfilter([0.0, 0.5], [1.0, -0.8], u) + e
    assert track(OE(1, 1, offset=True), RLS(1.0), y, u).theta[-1, 1] == pytest.approx(0.8, abs=0.02)
    with pytest.warns(UserWarning, match="steam varies by .* Subtract an operating point"):
        track(OE(1, 1, offset=True, inputs=["steam"]), RLS(1.0), y + 62.5, u + 25.0)
    track(ARMAX(1, 1, 1, offset=True), RLS(1.0), y + 62.5, u + 25.0)  # has no response that is simulated


@pytest.mark.parametrize(("level", "mean"), [(293.15, 0.0), (0.0, 300.0)])
def test_beside_an_offset_other_parameters_do_not_depend_on_levels(level, mean):
    """Filters of the gradient that change while they learn made a large level look like a signal."""
    y, u = armax_record(400, 21, 0.5)
    here, there = (track(ARMAX(1, 1, 1, offset=True), RLS(1.0), y + a, u + b) for a, b in ((0, 0), (level, mean)))
    np.testing.assert_allclose(there.theta[20:, :3], here.theta[20:, :3], rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(there.std[20:, :3], here.std[20:, :3], rtol=1e-3)
