"""Continuous time: process models that are exact at uneven times, conversions there and back with their bands."""

import numpy as np
import pytest
from scipy import linalg, signal

from driftfit import ARX, OE, RLS, JointKalman, Kalman, process_model, track

PLANTS = {
    "P1": ({"K": 2.0, "T": 5.0}, [[-0.2]], [0.2], [2.0]),
    "P2": ({"K": 2.0, "T1": 6.0, "T2": 2.0}, [[-1 / 6, 0.0], [0.5, -0.5]], [1 / 6, 0.0], [0.0, 2.0]),
    "P2U": ({"K": 2.0, "wn": 0.5, "zeta": 0.3}, [[0.0, 1.0], [-0.25, -0.3]], [0.0, 0.25], [2.0, 0.0]),
    "PI": ({"K": 0.1}, [[0.0]], [1.0], [0.1]),
}


def responses(kind, u, t):
    """The output of a plant for inputs that are held, by matrix exponentials."""
    _, A, B, C = (np.array(part) if not isinstance(part, dict) else part for part in PLANTS[kind])
    n, x, y = len(A), np.zeros(len(A)), np.zeros(len(t))
    for k in range(1, len(t)):
        whole = np.zeros((n + 1, n + 1))
        whole[:n, :n], whole[:n, n] = A, B
        moved = linalg.expm(whole * (t[k] - t[k - 1]))
        x = moved[:n, :n] @ x + moved[:n, n] * u[k - 1]
        y[k] = C @ x
    return y


def signals(T=400, seed=0):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.normal(size=T // 8), 8), np.cumsum(rng.uniform(0.3, 2.0, T)), rng


@pytest.mark.parametrize("kind", PLANTS)
def test_process_models_are_exact_at_uneven_times(kind):
    u, t, rng = signals()
    truth = PLANTS[kind][0]
    y = responses(kind, u, t)
    still = track(process_model(kind, start=truth), JointKalman(q=0.0, r=1.0, p0=0.0), y, u, time=t, dt=1.0)
    assert np.nanmax(np.abs(still.innovation)) < 1e-12
    model = process_model(kind)
    p0 = {name: 0.5 if name[0] == "l" else 1.0 for name in model.system.parameters}
    run = track(model, JointKalman(q=0.0, r=0.01, p0=p0), y + 0.3 + 0.1 * rng.normal(size=400), u, time=t, dt=1.0)
    found = dict(zip(run.names, zip(run.theta[-1], run.std[-1], strict=True), strict=True))
    for name, value in truth.items():
        own = {"K": "K", "zeta": "logit_zeta"}.get(name, f"log_{name}")
        expected = value if name == "K" else np.log(value / (1 - value)) if name == "zeta" else np.log(value)
        assert abs(found[own][0] - expected) < 4.0 * found[own][1], (name, found[own])
        assert found[own][1] < 0.1


def test_a_delay_between_two_samples_is_found():
    u = np.repeat(np.random.default_rng(0).normal(size=60), 10)
    fine, x, y = np.repeat(u, 10), 0.0, np.zeros(600)
    for k in range(6000):  # a delay of 1.4 samples, ten steps for each sample
        y[k // 10] = x if k % 10 == 0 else y[k // 10]
        drive = fine[k - 14] if k >= 14 else 0.0
        x = drive + (x - drive) * np.exp(-0.1 / 5.0)
    y += 0.05 * np.random.default_rng(1).normal(size=600)
    model = process_model("P1", delay=1, fraction=True, offset=False)
    run = track(model, JointKalman(q=0.0, r=0.0025, p0={"log_T": 0.5, "rest": 0.1, "K": 1.0}), y, u)
    assert run.names == ("log_T", "rest", "K", "z")
    np.testing.assert_allclose(run.theta[-1, :3], [np.log(5.0), 0.4, 1.0], atol=0.05)


def test_what_is_no_process_model_is_refused():
    for make, message in (
        (lambda: process_model("P3"), "must be one of"), (lambda: process_model("P2", fraction=True), 'is for "P1"'),
        (lambda: process_model(start={"T": -1.0}), "T must be positive"),
        (lambda: process_model(start={"tau": 1.0}), "start names tau"),
        (lambda: process_model("P2U", start={"zeta": 1.5}), "zeta below 1"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            make()


def test_conversion_is_that_of_scipy_and_can_be_inverted():
    rng = np.random.default_rng(0)
    u = rng.normal(size=400)
    y = signal.lfilter([0.0, 0.3, 0.1], [1.0, -1.2, 0.5], u) + 0.1 * rng.normal(size=400)
    run = track(ARX(2, 2, nk=2), RLS(1.0), np.r_[0.0, y[:-1]], u)
    discrete = run.transfer(dt=0.1)
    assert discrete.delay == pytest.approx(0.1)
    A, (B,) = ARX(2, 2).bind(1).polynomials(run.theta[-1])
    np.testing.assert_allclose(discrete.a, A[1:])
    np.testing.assert_allclose(discrete.b, B[1:])
    np.testing.assert_allclose(np.r_[discrete.a_std, discrete.b_std], run.std[-1], rtol=1e-6)
    continuous = discrete.continuous()
    num, den, _ = signal.cont2discrete((continuous.b, np.r_[1.0, continuous.a]), 0.1)
    np.testing.assert_allclose(den[1:], discrete.a, rtol=1e-9)
    np.testing.assert_allclose(num[0, 1:], discrete.b, rtol=1e-8)
    back = continuous.discrete(0.1)
    np.testing.assert_allclose(back.a, discrete.a, rtol=1e-9)
    np.testing.assert_allclose(back.cov, discrete.cov, rtol=1e-3, atol=1e-9)
    assert back.delay == pytest.approx(discrete.delay)


def test_time_constants_cover_and_what_has_none_is_refused():
    inside = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        u = rng.normal(size=300)
        y = signal.lfilter([0.0, 1.0 - np.exp(-0.5 / 4.0)], [1.0, -np.exp(-0.5 / 4.0)], u)
        run = track(OE(1, 1), Kalman(q=0.0, r=0.01, p0=1.0, theta0=[0.1, 0.8]), y + 0.1 * rng.normal(size=300), u)
        low, high = run.transfer(dt=0.5).continuous().time_constants().band()
        inside.append(low[0] < 4.0 < high[0])
    assert np.mean(inside) > 0.85
    run = track(ARX(1, 1), RLS(1.0), signal.lfilter([0.0, 1.0], [1.0, 0.8], u) + 0.1 * rng.normal(size=300), u)
    with pytest.raises(ValueError, match="no continuous system has a pole"):
        run.transfer().continuous()
    with pytest.raises(ValueError, match="nk of at least 1"):
        track(ARX(1, 1, nk=0), RLS(1.0), y, u).transfer()
    for verb in (run.transfer().time_constants, lambda: run.transfer().discrete(1.0)):
        with pytest.raises(ValueError, match=r"continuous time|discrete time"):
            verb()
