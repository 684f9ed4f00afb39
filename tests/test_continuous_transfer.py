"""Transfer functions in continuous time: exact filters and gradients at uneven times, bounds, drift, conversions."""

import numpy as np
import pytest
from scipy import linalg
from scipy.signal import lfilter
from support import same

from driftfit import RLS, ContinuousTransfer, InstrumentalVariables, Live, track
from driftfit.smooth.problem import replay

A, B, H = np.array([2.8, 4.0]), np.array([-2.0, 5.0]), 0.05
TRUTH = np.r_[A, B]
MODEL = ContinuousTransfer(2, 1, dt=H, cutoff=3.0)


def plant(theta, time, u):
    """Exact responses to inputs that are held; theta (4,), or one for each sample."""
    theta = np.broadcast_to(theta, (len(time), 4))
    x, y = np.zeros(2), np.zeros(len(time))
    for k in range(1, len(time)):
        a1, a2, b1, b2 = theta[k]
        whole = np.array([[-a1, 1.0, b1], [-a2, 0.0, b2], [0.0, 0.0, 0.0]]) * (time[k] - time[k - 1])
        moved = linalg.expm(whole)
        x = moved[:2, :2] @ x + moved[:2, 2] * u[k - 1]
        y[k] = x[0]
    return y


def record(T, seed, noise=0.2, theta=TRUTH):
    """y, u and jittered times."""
    rng = np.random.default_rng(seed)
    time, u = np.cumsum(rng.uniform(0.2, 1.8, T) * H), np.repeat(rng.choice([-1.0, 1.0], T // 10), 10)
    return plant(theta, time, u) + noise * rng.normal(size=T), u, time


def held(theta, y, u, time):
    still = RLS(1.0, p0=1e-20, theta0=tuple(theta))
    return track(MODEL.held_at(TRUTH), still, y, u, time=time, dt=H)


def test_prediction_and_gradient_are_exact_at_uneven_times():
    y, u, time = record(400, 0, noise=0.0)
    run, step = held(TRUTH, y, u, time), 1e-5
    assert np.nanmax(np.abs(run.innovation)) < 1e-13
    phi = replay(run)["phi"][..., 0]
    for i in range(4):
        up, down = (plant(TRUTH + sign * step * np.eye(4)[i], time, u) for sign in (1.0, -1.0))
        gradient = (up - down) / (2.0 * step)
        assert np.abs(phi[:, i] - gradient).max() < 1e-7 * np.abs(gradient).max()


@pytest.mark.parametrize("tracker", [RLS(1.0), InstrumentalVariables(1.0)], ids=["RLS", "instruments"])
def test_jittered_samples_give_the_parameters_in_seconds_on_line_and_off_line(tracker):
    """12 records: off line within bands, with the scatter that the bands state."""
    score = []
    for seed in range(12):
        y, u, time = record(1500, seed)
        run = track(MODEL, tracker, y, u, time=time, dt=H)
        assert (np.abs(run.theta[-1] - TRUTH) < 5.0 * run.std[-1]).all()
        fine = run.refine()
        assert fine.std[-1].max() < 0.15
        score.append((fine.theta[-1] - TRUTH) / fine.std[-1])
    assert 0.7 < np.std(score) < 1.3
    assert np.mean(np.abs(score) < 1.96) >= 0.88


def test_least_squares_on_state_variable_filters_is_biased_and_refined_estimates_are_not():
    """With the filter held at its first point and b = 0, the method is least squares of the equation."""
    first, refined = [], []
    for seed in range(6):
        y, u, time = record(1500, seed, noise=0.4)
        run = track(MODEL, RLS(1.0), y, u, time=time, dt=H)
        first.append(run.theta[130] - TRUTH)
        refined.append(run.theta[-1] - TRUTH)
    assert abs(np.mean(first, axis=0)[0]) > 0.5
    assert np.abs(np.mean(refined, axis=0)).max() < 0.3


def test_a_plant_that_changes_is_followed():
    """Its gain falls by half; live, in lanes and after a gap as in the record, with missing data."""
    theta = np.repeat(TRUTH[None], 2000, axis=0)
    theta[1000:, 2:] *= 0.5
    y, u, time = record(2000, 7, noise=0.05, theta=theta)
    y[300:320], u[500], y[700] = np.nan, np.nan, np.inf
    time[1500:] += 3.0
    tracker = RLS(0.995)
    run, live = track(MODEL, tracker, y, u, time=time, dt=H), Live(MODEL, tracker, dt=H)
    for t in range(2000):
        live.update(y[t], u[t], time=time[t])
    assert same(live.theta, run.theta[-1])
    many = track(MODEL, tracker, np.stack([y] * 33), np.stack([u] * 33), by="row", time=time, dt=H)
    assert same(many[32].theta, run.theta)
    gain = run.dc_gain()
    for t, expected in ((999, 1.25), (1499, 0.625), (1999, 0.625)):
        assert abs(gain.value[t, 0] - expected) < 0.06


def test_conversions_simulation_and_the_filters_agree():
    y, u, time = record(600, 3, noise=0.0)
    run = held(TRUTH, y, u, time)
    plain = run.transfer()
    np.testing.assert_allclose([*plain.a, *plain.b], TRUTH)
    assert plain.dt is None
    discrete = plain.discrete(H)
    numerator, denominator = run.model.transfers(run.theta[-1])[1][0]
    np.testing.assert_allclose(denominator[1:], discrete.a)
    np.testing.assert_allclose(numerator[1:], discrete.b)
    even = np.arange(100) * H
    np.testing.assert_allclose(run.simulate(u[:100]).y_hat, plant(TRUTH, even, u[:100]), atol=1e-10)


def test_what_is_no_such_model_is_refused():
    for make, message in (
        (lambda: ContinuousTransfer(5), "poles must be 1 to 4"), (lambda: ContinuousTransfer(2, 2), "zeros fewer"),
        (lambda: ContinuousTransfer(2, dt=0.0), "dt must be"), (lambda: ContinuousTransfer().bind(0), "at least 1"),
        (lambda: ContinuousTransfer(2, cutoff=100.0), "at most 12.5"),
        (lambda: ContinuousTransfer(2, inputs=1, point=(1.0,)), "point must have 3 entries"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            make()


@pytest.mark.parametrize(
    "model", [ContinuousTransfer(), ContinuousTransfer(delay=2), ContinuousTransfer(2, 1)], ids=repr
)
@pytest.mark.parametrize("codes", [1, 3, 10])
def test_codes_in_the_input_are_a_gap_behind_a_gate(model, codes):
    rng = np.random.default_rng(0)
    u, place = rng.normal(size=600), slice(400, 400 + codes)
    y = lfilter([0.0] * (model.delay + 1) + [0.36], [1.0, -0.82], u) + 0.05 * rng.normal(size=600)
    runs = []
    for value in (np.nan, 9999.0):
        bad = u.copy()
        bad[place] = value
        runs.append(track(model, RLS(0.99), y, bad, gate=True))
    np.testing.assert_allclose(runs[1].theta, runs[0].theta, atol=1e-9)
    assert 400 + model.delay + 1 in runs[1].left_out.sample
