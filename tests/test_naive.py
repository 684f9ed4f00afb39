"""Every fast thing against its slow twin: shapes, delays, missing data, gaps, weights, drift, in one lane and in 32."""

import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import BAD, run_lanes

from driftfit import ARX, RLS, AugmentedFLS, Kalman, Regression, track
from driftfit.engine.tiles import WIDTH

MODELS = {
    "ARX(1, 1)": lambda start: (ARX(1, 1, start=start), naive.ARX(1, [(1, 1)], False, start)),
    "two inputs, nk = 0 and 2, intercept": lambda start: (
        ARX(1, [1, 1], nk=[0, 2], intercept=True, start=start),
        naive.ARX(1, [(1, 0), (1, 2)], True, start),
    ),
    "ARX(2, 2)": lambda start: (ARX(2, 2, start=start), naive.ARX(2, [(2, 1)], False, start)),
    "Regression(1)": lambda start: (Regression(1), naive.ARX(0, [(1, 0)], False, "zero")),
}
TRACKERS = {
    "Kalman": (Kalman, naive.Kalman),
    "RLS": (RLS, naive.RLS),
    "AugmentedFLS": (AugmentedFLS, naive.AugmentedFLS),
}


def settings_of(name, n):
    """Settings of a tracker, as the twin takes them too."""
    start = {"theta0": st.sampled_from([0.0, 0.5, [0.3, -0.2, 1.0, 0.1][:n]])}
    if name == "AugmentedFLS":
        return st.fixed_dictionaries({"mu": st.floats(0.1, 10.0), "alpha": st.floats(0.2, 1.8), **start})
    prior = {"p0": st.sampled_from([None, 2.0, [0.5, 1.0, 2.0, 3.0][:n], np.eye(n) + 0.3])}
    if name == "RLS":
        return st.fixed_dictionaries({"forgetting": st.sampled_from([0.9, 0.98, 1.0]), **prior, **start})
    size = st.sampled_from([0.0, 0.01, [0.1, 0.0, 0.02, 0.3][:n]])
    return st.fixed_dictionaries({"q": size, "r": st.floats(0.05, 2.0), **prior, **start})


@st.composite
def records(draw, m):
    """y (T,), u (T, m), dt, noise, drift (T,): ordinary numbers with bad ones, gaps, weights and factors put in."""
    T = draw(st.integers(1, 20))
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    signals = rng.standard_normal((1 + m, T))
    at = st.integers(0, T - 1)
    for j, t, value in draw(st.lists(st.tuples(st.integers(0, m), at, st.sampled_from(BAD)), max_size=6)):
        signals[j, t] = value
    for t in range(*sorted(draw(st.tuples(at, at)))):
        signals[0, t] = np.nan if draw(st.booleans()) else signals[0, t]
    dt, noise, drift = np.ones((3, T))
    for t, gap in draw(st.lists(st.tuples(at, st.sampled_from([0.5, 1.25, 2.0, 3.0])), max_size=3)):
        dt[t] = gap if t else 1.0  # the first interval is 1 by definition
    for t, weight in draw(st.lists(st.tuples(at, st.sampled_from([0.0, 0.5, 4.0])), max_size=3)):
        noise[t] = np.inf if weight == 0.0 else 1.0 / weight
    for t, factor in draw(st.lists(st.tuples(at, st.sampled_from([0.0, 10.0])), max_size=3)):
        drift[t] = factor
    return signals[0], signals[1:].T, dt, noise, drift


def assert_like(twin_rows, theta, var, y_hat, e, s, ok, noise):
    expected = [np.array(column, dtype=float) for column in zip(*twin_rows, strict=True)]
    used = np.isfinite(noise)
    size = 1.0 + np.abs(expected[0]).max()
    names = ("theta", "var", "y_hat", "e", "s")
    for name, fast, slow in zip(names, (theta, var, y_hat, e, s), expected[:5], strict=True):
        fast, slow = (fast[used], slow[used]) if name == "s" else (fast, slow)
        np.testing.assert_allclose(fast, slow, rtol=1e-6, atol=1e-7 * size, err_msg=name)
    np.testing.assert_array_equal(ok, expected[5] > 0.0)


def check_record(model_name, tracker_name, data):
    start = data.draw(st.sampled_from(["drop", "zero"]))
    model, twin = MODELS[model_name](start)
    given_settings = data.draw(settings_of(tracker_name, model.n))
    y, u, dt, noise, drift = data.draw(records(model.m))
    fast, slow = TRACKERS[tracker_name]
    with np.errstate(divide="ignore"):
        weights = 1.0 / noise
    run = track(model, fast(**given_settings), y, u, time=np.cumsum(dt), weights=weights, drift=drift)
    rows = twin.run(slow(model.n, **given_settings), y, u, dt, noise, drift)
    written = (run.written(name) for name in ("theta", "var", "y_hat", "e", "s", "ok"))
    assert_like(rows, *written, noise)


@pytest.mark.parametrize("tracker_name", TRACKERS)
@pytest.mark.parametrize("model_name", ["ARX(1, 1)", "two inputs, nk = 0 and 2, intercept"])
@settings(max_examples=40)
@given(data=st.data())
def test_records(model_name, tracker_name, data):
    check_record(model_name, tracker_name, data)


@pytest.mark.parametrize("model_name", ["ARX(2, 2)", "Regression(1)"])
@settings(max_examples=40)
@given(data=st.data())
def test_records_of_other_models(model_name, data):
    check_record(model_name, "AugmentedFLS", data)


@pytest.mark.parametrize("tracker_name", TRACKERS)
@settings(max_examples=8)
@given(data=st.data())
def test_lanes(tracker_name, data):
    """Thirty-two series with settings of their own; three lanes are compared."""
    fast, slow = TRACKERS[tracker_name]
    start = data.draw(st.sampled_from(["drop", "zero"]))
    model, _ = MODELS["ARX(2, 2)"](start)
    T = 20
    rng = np.random.default_rng(data.draw(st.integers(0, 10_000)))
    y, u = rng.standard_normal((T, WIDTH)), rng.standard_normal((T, 1, WIDTH))
    trackers = [fast(**settings_of_lane(tracker_name, lane)) for lane in range(WIDTH)]
    known = np.ones((T, 3, WIDTH))
    known[:, 0] = rng.choice([1.0, 0.5, 2.0], (T, WIDTH), p=[0.9, 0.05, 0.05])
    compared = data.draw(st.permutations(range(WIDTH)))[:3]
    for lane in compared:
        alone, drive, dt, noise, drift = data.draw(records(1))
        short = len(alone)
        y[:short, lane], u[:short, :, lane] = alone, drive
        known[:short, :, lane] = np.stack([dt, noise, drift], axis=1)
    out, _ = run_lanes(model.bind(1), trackers, y, u, known)
    for lane in compared:
        _, twin = MODELS["ARX(2, 2)"](start)
        tracker = slow(model.n, **settings_of_lane(tracker_name, lane))
        rows = twin.run(tracker, y[:, lane], u[:, :, lane], *known[:, :, lane].T)
        written = (out[name][..., lane] for name in ("theta", "var", "y_hat", "e", "s", "ok"))
        assert_like(rows, *written, known[:, 1, lane])


def settings_of_lane(name, lane):
    """Other settings in every lane, every third one with a prior."""
    if name == "AugmentedFLS":
        return {"mu": 0.1 + lane, "theta0": 0.1 * lane}
    prior = {"p0": 1.0 + lane if lane % 3 == 0 else None, "theta0": 0.1 * lane}
    return prior | ({"forgetting": 1.0 - 0.003 * lane} if name == "RLS" else {"q": 0.01 * lane, "r": 0.1 + 0.1 * lane})
