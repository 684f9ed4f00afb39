"""Fault codes among the first samples, which are judged together; and scales of inputs that rest on fault codes."""

import numpy as np
import pytest

from driftfit import ARX, RLS, AdaptiveKalman, Equation, Kalman, Live, Regression, track
from driftfit.readings.left_out import KEPT
from driftfit.smooth.problem import walk_of

T, THETA = 600, (1.1, -0.5, 1.0, 0.5)
PLANT = ARX(2, 2)


def plant(seed=0):
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=T), np.zeros(T)
    for t in range(2, T):
        y[t] = 1.1 * y[t - 1] - 0.5 * y[t - 2] + u[t - 1] + 0.5 * u[t - 2] + 0.1 * rng.normal()
    return y, u


def left_out(run):
    return len(run.left_out)


def wrong(run, t):
    return np.abs(run.theta[t] - THETA).max()


@pytest.mark.parametrize("codes", [[], [4], [2, 9], [0, 1, 2], [*range(8)], [*range(40)]], ids=len)
def test_what_was_left_out_is_listed_and_a_stream_lists_the_same(codes):
    y, u = plant()
    y[codes] = 9999.0
    run, live = track(PLANT, AdaptiveKalman(), y, u), Live(PLANT, AdaptiveKalman())
    for one in zip(y[:100], u[:100], strict=True):
        live.update(*one)
    assert run.left_out.sample.tolist() == codes
    assert live.left_out.last == tuple(run.left_out)[-KEPT:]
    assert np.array_equal(live.theta, run.theta[99])


@pytest.mark.parametrize("a", [0.9, 0.5])
def test_a_first_reading_without_a_response_is_a_code(a):
    """The plant rests with noise, of which a = 0 is no worse an explanation than a."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        u, y = rng.normal(size=T), np.zeros(T)
        u[:100] = 0.0
        for t in range(1, T):
            y[t] = a * y[t - 1] + u[t - 1] + 0.05 * rng.normal()
        y[0] = 9999.0
        run = track(ARX(1, 1), RLS(1.0), y, u, gate=True)
        assert run.left_out.sample.tolist() == [0]
        assert run.theta[-1, 0] == pytest.approx(a, abs=0.02)
        y[0] = 100.0
        for t in range(1, 10):
            y[t] += a**t * 100.0
        assert left_out(track(ARX(1, 1), RLS(1.0), y, u, gate=True)) == 0  # a start that the plant forgets


def test_a_large_response_to_a_large_input_is_kept():
    y, u = plant()
    rng = np.random.default_rng(1)
    u *= 0.001
    u[3] = 100.0
    y = np.zeros(T)
    for t in range(2, T):
        y[t] = 1.1 * y[t - 1] - 0.5 * y[t - 2] + u[t - 1] + 0.5 * u[t - 2] + 0.1 * rng.normal()
    run = track(PLANT, AdaptiveKalman(), y, u)
    assert wrong(run, 30) < 0.02  # without this one response the inputs would tell nothing


def test_first_samples_of_another_level_are_no_fault_codes():
    rng = np.random.default_rng(0)
    u = np.r_[np.zeros(7), np.ones(T - 7)]
    y = 50.0 * u + 0.01 * rng.normal(size=T)
    run = track(Regression(1, intercept=True), AdaptiveKalman(), y, u)
    assert run.ok[:20].all()
    np.testing.assert_allclose(run.theta[-1], [50.0, 0.0], atol=0.02)


@pytest.mark.parametrize("large", [1000.0, 1e5])
def test_an_input_that_moves_less_from_now_on_is_still_followed(large):
    rng = np.random.default_rng(1)
    u = rng.normal(size=3000)
    u[:100] *= large
    b = np.where(np.arange(3000) < 1500, 2.0, 3.0)
    run = track(Regression(1, intercept=True), AdaptiveKalman(), 5.0 + b * u + 0.1 * rng.normal(size=3000), u)
    np.testing.assert_allclose(run.theta[[1499, 1600, 2999], 0], [2.0, 3.0, 3.0], atol=0.05)


def test_a_scale_that_rests_on_a_few_fault_codes_is_lost_again():
    rng = np.random.default_rng(1)
    u = rng.normal(size=T)
    y = 5.0 + 2.0 * u + 0.1 * rng.normal(size=T)
    u[:8] = 9999.0
    run = track(Regression(1, intercept=True), AdaptiveKalman(), y, u)
    np.testing.assert_allclose(run.theta[-1], [2.0, 5.0], atol=0.05)


def test_a_smoother_leaves_out_the_same_samples():
    """With a linearised model y is judged as it was measured, not without the part that the linearisation explains."""
    curve = Equation("y = theta.c + theta.k * u + 0.5 * theta.k * theta.k * u * u")
    counts = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        u = rng.normal(size=300)
        y = 3.0 + u + 0.5 * u * u + 0.1 * rng.normal(size=300)
        y[rng.choice(np.arange(1, 10), rng.integers(1, 5), replace=False)] = 9999.0
        run = track(curve, AdaptiveKalman(), y, u)
        counts.append((left_out(run), np.sum(walk_of(run).weight == 0.0)))
    assert sum(count > 0 for count, _ in counts) >= 5
    assert all(count == found for count, found in counts)


@pytest.mark.parametrize(("held", "at"), [(5, 12), (20, 40)])
@pytest.mark.parametrize("code", [999.0, -999.0])
def test_a_code_beside_inputs_that_are_held_and_a_coarse_meter(held, at, code):
    """Readings that repeat are few, but the plant is not at rest: they show its range."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        u, y = np.repeat(rng.normal(size=400 // held + 1), held)[:400], np.zeros(400)
        for t in range(1, 400):
            y[t] = 0.7 * y[t - 1] + 2.0 * u[t - 1] + 0.1 * rng.normal()
        y = 0.5 * np.round(2.0 * y)
        y[at] = code
        run = track(ARX(1, 1), Kalman(q=1e-6, r=0.01), y, u, gate=True)
        np.testing.assert_allclose(run.theta[-1], [0.7, 2.0], atol=0.1)


@pytest.mark.parametrize("unit", [1.0, 1e-6])
@pytest.mark.parametrize("tracker", [AdaptiveKalman(), RLS(0.99)])
def test_a_start_between_two_levels_of_a_coarse_meter_has_no_fault_codes(tracker, unit):
    """Whole litres that were interpolated to other times: 32 and 32.0015 by turns, and one reading in three is 33."""
    rng = np.random.default_rng(1)
    litres = np.where(np.arange(12) % 3 == 2, 33.0, 32.0) + 0.0015 * (np.arange(12) % 2)
    run = track(Regression(1, intercept=True), tracker, unit * litres, rng.normal(size=12), gate=True)
    assert run.ok.all()
    assert left_out(run) == 0
    assert run.innovation_std[-1] > 0.2 * unit


EACH = {"y1": Kalman(q=1e-6, r=0.01), "y2": Kalman(q=1e-5, r=0.02, p0=10.0)}


@pytest.mark.parametrize("tracker", [EACH, AdaptiveKalman()], ids=["Kalman", "AdaptiveKalman"])
@pytest.mark.parametrize("model", [ARX(1, 1, ny=2), Regression(1, ny=2)], ids=["lags", "none"])
def test_codes_of_several_outputs_are_those_of_gaps(tmp_path, model, tracker):
    """A code in one output is a lag of the others: all are run again, and a stream and a file say the same."""
    rng = np.random.default_rng(0)
    u, noise = rng.normal(size=200), 0.1 * rng.normal(size=(200, 2))
    y, moved = np.outer(u, [1.0, 0.5]) + noise, np.outer(np.r_[0.0, u[:-1]], [1.0, 0.5]) + noise
    for t in range(1, 200 if isinstance(model, ARX) else 0):
        y[t] = np.array([[0.7, 0.2], [-0.3, 0.5]]) @ y[t - 1] + moved[t]
    codes, gaps, strange, unknown = y.copy(), y.copy(), u.copy(), u.copy()
    codes[3, 1], codes[7:9, 0], strange[5] = 9999.0, -999.0, 1e6
    gaps[3, 1], gaps[7:9, 0], unknown[5] = np.nan, np.nan, np.nan
    run, clean = (track(model, tracker, *signals, gate=True) for signals in ((codes, strange), (gaps, unknown)))
    live = Live(model, tracker, gate=True)
    for one in zip(codes, strange, strict=True):
        live.update(*one)
    run.save(tmp_path / "run.zip")
    np.testing.assert_array_equal(run.theta[30:], clean.theta[30:])
    np.testing.assert_array_equal(live.theta, run.theta[-1])
    assert live.left_out.counts == {"Left out at the start": 5}
    for found in (run, type(run).load(tmp_path / "run.zip")):
        assert [found[name].left_out.sample.tolist() for name in run.outputs] == [[5, 7, 8], [3, 5]]
        assert found.loglik == pytest.approx(clean.loglik, rel=1e-12)
        np.testing.assert_array_equal(found["y1"].smooth().theta, clean["y1"].smooth().theta)


def test_each_series_of_a_fleet_begins_again_with_its_own_settings():
    y, u = plant()
    y[[4, 9]] = 9999.0
    settings = [Kalman(q=1e-6, r=0.01, p0=1.0), Kalman(q=1e-2, r=1.0, p0=3.0)]
    fleet = track(PLANT, settings, np.stack([y, y]), np.stack([u, u])[..., None], by="row", gate=True)
    for k, tracker in enumerate(settings):
        np.testing.assert_array_equal(fleet[k].theta, track(PLANT, tracker, y, u, gate=True).theta)


FIRST = pytest.param(0, 5, marks=pytest.mark.xfail(reason="a code at the very first pulse is believed", strict=True))


@pytest.mark.parametrize(("code", "learned"), [(None, 2), FIRST, (1, 2)])
def test_the_first_pulses_of_an_input_at_rest_are_learned_from(code, learned):
    """Of two fault codes the first, at the first pulse of all, cannot be told from a response."""
    rng = np.random.default_rng(4)
    u, y = np.zeros((4, 500)), 0.1 * rng.normal(size=(4, 500))
    for row, height in enumerate((1.0, 10.0, 1e-3, -1.0)):
        pulses = np.arange(30 + 40 * row, 500, 50)
        u[row, pulses] = height * rng.uniform(0.5, 1.5, len(pulses))
        y[row] += 5.0 * u[row] / height
        if code is not None:
            y[row, pulses[code]] = -999.0
    fleet = track(Regression(1), AdaptiveKalman(), y, u, by="row", gate=True)
    for row, height in enumerate((1.0, 10.0, 1e-3, -1.0)):
        pulses = np.flatnonzero(u[row])
        assert (~fleet[row].ok).sum() <= {None: 0, 0: 2, 1: 1}[code]
        assert fleet[row].theta[pulses[learned], 0] * height == pytest.approx(5.0, abs=0.5)
        assert fleet[row].theta[pulses[-1], 0] * height == pytest.approx(5.0, abs=0.2)
