"""Hidden states: the linear filter, streams and forecasts, and what is refused."""

import json

import numpy as np
import pytest
from support import same

from driftfit import ARX, RLS, JointKalman, Kalman, Live, StateSpace, track

TEXT = """
    x = x[-1] + dt * (theta.a * tanh(u) - theta.b * x[-1])
    y = sqrt(1 + x * x) + 0.1 * u[-1]
"""
MODEL = StateSpace(TEXT, start={"a": 0.5, "b": 0.3, "x": 0.2})
LINEAR = "x = 0.9 * x[-1] + theta.b * u \n y = x + theta.c"
Q, R, P0 = {"a": 1e-4, "x": 1e-3}, 0.01, {"a": 0.04, "b": 0.01, "x": 1.0}


def data(T=120, seed=0):
    rng = np.random.default_rng(seed)
    u, x, y = rng.normal(size=T), 0.0, np.zeros(T)
    for t in range(T):
        x += 0.8 * np.tanh(u[t]) - 0.2 * x + 0.03 * rng.normal()
        y[t] = np.sqrt(1.0 + x * x) + 0.1 * u[max(t - 1, 0)] + 0.1 * rng.normal()
    return y, u


def f(z, u, dt):
    return np.array([z[0], z[1], z[2] + dt * (z[0] * np.tanh(u) - z[1] * z[2])])


def h(z, before):
    return np.sqrt(1.0 + z[2] ** 2) + 0.1 * before


def test_both_are_the_kalman_filter_where_equations_are_linear():
    rng = np.random.default_rng(0)
    model = StateSpace(LINEAR)
    u, F = rng.normal(size=80), np.eye(3)
    y, z, P = rng.normal(size=80), np.array([1.0, 1.0, 0.0]), np.diag([1.0, 2.0, 3.0])
    runs = [
        track(model, JointKalman(q=1e-3, r=0.5, p0=[1.0, 2.0, 3.0], method=m), y, u) for m in ("extended", "unscented")
    ]
    g = np.array([0.0, 1.0, 1.0])
    for t in range(80):
        F[2] = [u[t], 0.0, 0.9]
        z, P = F @ z, F @ P @ F.T + 1e-3 * np.eye(3)
        k = P @ g / (g @ P @ g + 0.5)
        z, P = z + k * (y[t] - g @ z), P - np.outer(k, g @ P)
        for run in runs:
            np.testing.assert_allclose(run.theta[t], z, rtol=1e-9, atol=1e-10)
            np.testing.assert_allclose(run.std[t], np.sqrt(np.diag(P)), rtol=1e-9)
    assert runs[0].names == ("b", "c", "x")


def test_streams_lanes_files_and_forecasts():
    y, u = data()
    tracker = JointKalman(q=Q, r=R, p0=P0, method="unscented")
    run, live = track(MODEL, tracker, y, u), Live(MODEL, tracker)
    for t in range(120):
        live = Live.from_bytes(live.to_bytes()) if t == 60 else live
        live.update(y[t], u[t])
    assert same(live.theta, run.theta[-1])
    fleet = track(MODEL, tracker, np.stack([y] * 33), np.stack([u] * 33), by="row")
    assert all(same(fleet[k].theta, run.theta) and same(fleet[k].std, run.std) for k in (0, 32))
    ahead = run.forecast(2, u[:2])
    expected = f(run.theta[-1], u[0], 1.0)
    np.testing.assert_allclose(ahead.theta[0], expected, atol=2e-2)
    assert ahead.y_hat[0] == pytest.approx(h(expected, u[-1]), abs=2e-2)


@pytest.mark.parametrize("method", ["extended", "unscented"])
def test_bands_of_forecasts_with_output_lags_are_those_of_an_arx_model(method):
    """Beyond one step they were NaN."""
    rng = np.random.default_rng(4)
    u, y = rng.normal(size=40), np.zeros(40)
    for t in range(1, 40):
        y[t] = 0.8 * y[t - 1] + u[t - 1] + 0.3 * rng.normal()
    known = {"q": 1e-4, "r": 0.09, "p0": 1.0}
    equations = StateSpace("y = theta.a * y[-1] + theta.b * u[-1]", start=0.0)
    run = track(equations, JointKalman(**known, method=method), y[:25], u[:25])
    same = track(ARX(1, 1), Kalman(**known), y[:25], u[:25])
    expected = same.forecast(15, u[25:])
    for found in (run.forecast(15, u[25:]), Live(equations, run.tracker, warm_start=run).forecast(15, u[25:])):
        np.testing.assert_allclose(found.y_hat, expected.y_hat, atol=0.02)
        np.testing.assert_allclose(found.y_std, expected.y_std, rtol=0.06)


def test_in_other_units_and_where_there_is_no_value():
    y, u = data()
    base = track(MODEL, JointKalman(q=Q, r=R, p0=P0), y, u)
    scaled = StateSpace(
        "x = x[-1] + dt * (theta.a * tanh(u / 1e6) - theta.b * x[-1]) \n"
        "y = 1e9 * sqrt(1 + x * x / 1e-6) + 1e8 * u[-1] / 1e6",
        start={"a": 0.5e-3, "b": 0.3, "x": 0.2e-3},
    )  # fmt: skip
    other = track(
        scaled, JointKalman(q={"a": 1e-10, "x": 1e-9}, r=1e16, p0={"a": 4e-8, "b": 0.01, "x": 1e-6}), 1e9 * y, 1e6 * u
    )
    np.testing.assert_allclose(other.theta * [1e3, 1.0, 1e3], base.theta, rtol=1e-6, atol=1e-8)
    root = StateSpace("x = x[-1] + theta.a * u \n y = sqrt(x)", start={"x": 4.0})
    drive = np.r_[np.zeros(20), -9.0, np.zeros(20), 9.0, np.zeros(60)]
    run = track(root, JointKalman(q={"x": 1e-4}, r=0.01, p0={"x": 0.1}), np.full(102, 2.0), drive)
    assert np.isfinite(run.theta).all()
    assert not run.ok[25]
    assert run.ok[-1]
    assert run.theta[-1, 1] == pytest.approx(4.0, abs=0.2)


def test_gaps_repeat_equations_without_dt():
    model = StateSpace(LINEAR, start={"x": 1.0, "b": 0.0})
    run = track(model, JointKalman(q={"x": 1.0}, r=1.0, p0=0.0), [np.nan] * 3, np.zeros(3), time=[0, 3, 4], dt=1.0)
    np.testing.assert_allclose(run.theta[:, 2], [0.9, 0.9**4, 0.9**5], rtol=1e-12)
    np.testing.assert_allclose(run.std[0, 2], 1.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "a line for each"), ("x = x[-1] + theta.a \n x = x[-1]", "must differ"), ("y = u", "no parameter"),
        ("x = x[-2] * theta.a \n y = x", r"may use x\[-1\]"), ("x = y * theta.a \n y = x", "must have a lag"),
        ("x = v * theta.a \n v = x \n y = v", r"may use v\[-1\]"), ("x = theta.x \n y = x", "parameter and of a state"),
        ("x = theta.a * open('f') \n y = x", "is not understood"), ("dt = theta.a \n y = dt", "must differ"),
    ],
)  # fmt: skip
def test_what_is_no_system_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        StateSpace(text)


def test_what_does_not_fit_is_refused():
    for make, message in (
        (lambda: StateSpace(TEXT, start={"c": 1.0}), "start names c"),
        (lambda: StateSpace(TEXT, inputs=["v"]), "must hold u"),
        (lambda: track(MODEL, RLS(1.0), *data()), "followed by JointKalman"),
        (lambda: Live(ARX(1, 1), JointKalman(q=0.0, r=1.0, p0=1.0)), "followed by JointKalman"),
        (lambda: track(MODEL, JointKalman(q={"c": 1.0}, r=1.0, p0=1.0), *data()), "q names 'c'"),
        (lambda: JointKalman(q=-1.0, r=1.0, p0=1.0), "at least 0"),
        (lambda: JointKalman(method="cubature"), "must be one of"),
        (lambda: track(MODEL, Kalman(q=0.0, r=1.0), *data()), "followed by JointKalman"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
    tracker = JointKalman(q=Q, r=R, p0=P0)
    assert JointKalman.from_settings(json.loads(json.dumps(tracker.settings()))) == tracker == eval(repr(tracker))
    assert eval(repr(MODEL)) == MODEL


def test_a_forecast_has_the_variance_of_the_kalman_filter_and_samples_are_no_regression(tmp_path):
    rng = np.random.default_rng(2)
    u, y = rng.normal(size=80), rng.normal(size=80)
    run = track(StateSpace(LINEAR), JointKalman(q=1e-3, r=0.5, p0=[1.0, 2.0, 3.0], method="extended"), y, u)
    z, P, F, g = run.theta[-1], run.cov(-1), np.eye(3), np.array([0.0, 1.0, 1.0])
    ahead = run.forecast(4, u[:4])
    for k in range(4):
        F[2] = [u[k], 0.0, 0.9]
        z, P = F @ z, F @ P @ F.T + 1e-3 * np.eye(3)
        assert ahead.y_hat[k] == pytest.approx(g @ z, rel=1e-9)
        assert ahead.y_std[k] == pytest.approx(np.sqrt(g @ P @ g + 0.5), rel=1e-9)
    compared = run.summary().comparison
    assert np.isnan(compared.constant_ls)
    assert compared.samples == 72  # after a tenth
    assert "all three" in str(run.summary())
    health, truth = run.diagnose(), run.verdict()
    assert np.isnan([health["excitation"].value, health["constancy (p)"].value]).all()
    assert (truth.drifts, truth.pays, truth.samples, truth.scored) == (None, None, 0, 72)
    assert np.isnan(truth.rivals[1].p)
    assert "hidden states" in truth.sentences[0]
    assert "constant ARX (p = " in truth.sentences[0]
    run.report(tmp_path / "page.html")
    with pytest.raises(ValueError, match="moves hidden states"):
        run.segment()
    assert run.detect("band", reference=75).rule.names == ("b", "c")


@pytest.mark.parametrize("method", ["extended", "unscented"])
def test_a_state_that_grows_beyond_all_numbers_stays(method):
    """x grows by exp(50) at every sample, and its variance by exp(100): the state was NaN from the tenth on."""
    y, u = np.random.default_rng(0).normal(size=(2, 200))
    model = StateSpace("x = x[-1] * exp(theta.k) + u \n y = x", start=50.0)
    run = track(model, JointKalman(q=1e-6, r=0.01, p0=1.0, method=method), y, u)
    assert np.isfinite(run.theta).all()
    assert np.isfinite(run.cov(-1)).all()


def test_samples_without_a_value_are_counted_in_the_summary():
    y, u = np.random.default_rng(0).normal(size=(2, 200))
    y[50] = np.nan
    model = StateSpace("x = x[-1] + u \n y = exp(theta.k * x)", start=50.0)
    run = track(model, JointKalman(q=1e-6, r=0.01, p0=1.0), y, u)
    assert not run.ok.any()
    (remark,) = [text for name, text in run.summary().remarks if name == "No value"]
    assert remark.startswith("199 samples at which the equation is not finite")
