"""The gate wherever a tracker runs: what is said of it, saved with it, and decided for many."""

import numpy as np
import pytest

from driftfit import (
    ARX,
    RLS,
    AdaptiveKalman,
    Bank,
    DataWarning,
    Gate,
    Kalman,
    Live,
    LiveSelection,
    Regression,
    Track,
    grid,
    select,
    track,
    tune,
)
from driftfit.readings.left_out import KEPT

PLANT, TRACKER = ARX(1, 1), Kalman(q=1e-6, r=1e-4)


def plant(T=200, codes=()):
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal(T), np.zeros(T)
    for t in range(1, T):
        y[t] = 0.8 * y[t - 1] + u[t - 1] + 0.01 * rng.standard_normal()
    y[list(codes)] = 9999.0
    return y, u


def test_what_was_left_out_is_a_table():
    run = track(PLANT, TRACKER, *plant(codes=[5, 100]), gate=True)
    assert run.left_out.decided.tolist() == [17, 100]  # the first samples are judged together
    lines = str(run.left_out).splitlines()
    assert [line.split()[:3] for line in lines[1:]] == [["5", "y", "9999"], ["100", "y", "9999"]]
    assert str(track(PLANT, TRACKER, *plant(), gate=True).left_out) == "nothing left out"


@pytest.mark.parametrize("way", ["update", "update_many"])
def test_a_stream_counts_what_it_left_out_and_keeps_the_last(way):
    y, u = plant(codes=[5, *range(40, 200, 8)])
    run, live = track(PLANT, TRACKER, y, u, gate=True), Live(PLANT, TRACKER, gate=True)
    if way == "update":
        for t in range(200):
            live.update(y[t], u[t])
    else:
        for part in (slice(0, 11), slice(11, 90), slice(90, 200)):
            live.update_many(y[part], u[part])
    assert live.left_out.counts == run.left_out.counts
    assert live.left_out.last == tuple(run.left_out)[-KEPT:]
    again = Live.from_bytes(live.to_bytes())
    assert (again.left_out.counts, again.left_out.last) == (live.left_out.counts, live.left_out.last)


@pytest.mark.parametrize("names", [(), ("flow", "heat")])
@pytest.mark.parametrize("at", [5, 100])
def test_the_input_that_is_left_out_is_named(names, at):
    rng = np.random.default_rng(0)
    u = rng.standard_normal((200, 2))
    y = u @ [1.0, 2.0] + 0.01 * rng.standard_normal(200)
    u[at, 1] = 9999.0
    model = Regression(names or 2)
    run, live = track(model, TRACKER, y, u, gate=True), Live(model, TRACKER, gate=True)
    live.update_many(y, u)
    assert [(one.sample, one.signal) for one in run.left_out] == [(at, (names or ("u1", "u2"))[1])]
    assert live.left_out.last == tuple(run.left_out)
    assert ("Inputs left out" if at == 100 else "Left out at the start") in str(run.summary())


def test_decisions_of_a_stream_with_times_have_them():
    y, u = plant(codes=[5, 100])
    live = Live(PLANT, TRACKER, gate=True)
    for t in range(200):
        live.update(y[t], u[t], 1000.0 + t)
    assert [one.sample for one in live.left_out.last] == [1005.0, 1100.0]


def test_smoothers_covariances_and_likelihood_take_the_decisions():
    y, u = plant(codes=[5, 100])
    run = track(PLANT, TRACKER, y, u, gate=True)
    missing = track(PLANT, TRACKER, np.where(y == 9999.0, np.nan, y), u)
    assert run.loglik == pytest.approx(missing.loglik, rel=1e-12)
    np.testing.assert_allclose(run.smooth().theta, missing.smooth().theta, rtol=1e-9)
    np.testing.assert_array_equal(run.cov(-1), missing.cov(-1))
    np.testing.assert_array_equal(run.ok[20:], missing.ok[20:])


def test_a_gate_is_saved_with_results_and_states(tmp_path):
    y, u = plant(codes=[100])
    gate = Gate(far=12.0)
    run = track(PLANT, TRACKER, y, u, gate=gate)
    run.save(tmp_path / "run")
    loaded = Track.load(tmp_path / "run")
    assert loaded.program.gate == gate
    assert list(loaded.left_out) == list(run.left_out)
    track(PLANT, TRACKER, y, u, gate=run.left_out).save(tmp_path / "decided")
    assert list(Track.load(tmp_path / "decided").left_out) == list(run.left_out)
    fleet = track(PLANT, TRACKER, np.stack([y, y]), np.stack([u, u]), by="row", gate=gate)
    fleet.save(tmp_path / "fleet")
    assert list(type(fleet).load(tmp_path / "fleet")[1].left_out) == list(run.left_out)
    live = Live(PLANT, TRACKER, warm_start=run, gate=gate)
    assert Live.from_bytes(live.to_bytes()).programs[0].gate == gate
    with pytest.raises(ValueError, match="gate of the earlier run"):
        Live(PLANT, TRACKER, warm_start=run, gate=True)
    with pytest.raises(ValueError, match="another model, tracker, gate"):
        track(PLANT, TRACKER, y, u, gate=True).program.unpack(run.program.pack(run.program.tile()))


def test_off_is_said_once_with_the_values_and_the_remedy():
    y, u = plant(codes=[100, 150])
    with pytest.warns(DataWarning, match=r"^track: y: 2 values look like fault codes \(9999\)\. .*gate=True") as said:
        track(PLANT, TRACKER, y, u)
    assert len(said) == 1
    clean, strange = plant()[0], u.copy()
    strange[60] = -9999.0
    with pytest.warns(DataWarning, match=r"y: 2 values .*\(9999\); u: 1 value looks .*\(-9999\)") as said:
        track(PLANT, TRACKER, np.stack([y, clean, clean]), np.stack([u, u, strange]), by="row")
    assert len(said) == 1
    live = Live(PLANT, TRACKER)
    with pytest.warns(DataWarning, match=r"^Live.update_many: y: 2 values .*\(9999\).*gate=True"):
        live.update_many(y, u)
    live.update_many(y, u)


@pytest.mark.parametrize("what", ["nothing", "jump", "pulse"])
def test_what_is_no_code_is_not_warned_of(what):
    y, u = plant()
    if what == "jump":
        y[100:] += 1000.0
    if what == "pulse":
        u[100] = 1000.0
        for t in range(1, 200):
            y[t] = 0.8 * y[t - 1] + u[t - 1]
    track(PLANT, TRACKER, y, u)
    Live(PLANT, TRACKER).update_many(y, u)


def test_tuning_takes_the_decisions_of_one_reference_run():
    """Settings are compared on the same readings, and the final run has the likelihood that was found."""
    y, u = plant(codes=[5, 100, 150])
    tuned = tune(PLANT, Kalman(), y, u, gate=True)
    assert tuned.left_out.sample.tolist() == [5, 100, 150]
    run = track(PLANT, tuned.tracker, y, u, gate=tuned.left_out)
    assert run.loglik == pytest.approx(tuned.loglik, rel=1e-9)
    missing = tune(PLANT, Kalman(), np.where(y == 9999.0, np.nan, y), u)
    assert tuned.noise == pytest.approx(missing.noise, rel=1e-6)
    assert "2 samples far outside" in str(tuned)


def test_tuning_without_a_gate_uses_every_reading_and_says_so():
    with pytest.warns(UserWarning, match="tune: ") as said:
        assert tune(PLANT, Kalman(), *plant(codes=[100])).noise > 1.0
    assert sum("y: 1 value looks like a fault code (9999)" in str(one.message) for one in said) == 1


def test_structures_are_compared_on_the_same_readings():
    y, u = plant(codes=[100])
    found = select(grid(ARX, na=[1, 2], nb=[1]), y, u, gate=True)
    assert [one.sample.tolist() for one in found.left_out.values()] == [[100]]
    assert found.simplest.startswith("ARX(na=1")
    assert "left out: 1 sample far" in str(found)


def test_candidates_on_line_take_the_decisions_of_one_reference():
    y, u = plant(codes=[100])
    one = LiveSelection([ARX(1, 1), ARX(2, 1)], TRACKER, gate=True)
    two = LiveSelection([ARX(1, 1), ARX(2, 1)], TRACKER)
    for t in range(200):
        one.update(y[t], u[t])
        two.update(np.nan if t == 100 else y[t], u[t])
    assert [decision.sample for decision in one.reference.left_out.last] == [100]
    np.testing.assert_array_equal(one.weights, two.weights)
    again = LiveSelection.from_bytes(one.to_bytes())
    assert again.reference.left_out.counts == {"Left out": 1}


def rows(T=200):
    """y (T, 2) and u (T, 2, 2) of two sensors of one theta, with codes and with gaps for them."""
    rng = np.random.default_rng(0)
    u = rng.standard_normal((T, 2, 2))
    y = u @ [1.0, 2.0] + 0.01 * rng.standard_normal((T, 2))
    codes, strange, gaps, unknown = y.copy(), u.copy(), y.copy(), u.copy()
    codes[[3, 100, 101], [0, 1, 1]], strange[[6, 150], [1, 0], [0, 1]] = 9999.0, -999.0
    gaps[codes == 9999.0], unknown[strange == -999.0] = np.nan, np.nan
    return (codes, strange), (gaps, unknown)


SHARED = Regression(2, ny=("left", "right"), shared=True)
CODES = [(3, "left"), (6, "u1[right]"), (100, "right"), (101, "right"), (150, "u2[left]")]


@pytest.mark.parametrize("tracker", [TRACKER, AdaptiveKalman(), RLS(0.99), Bank()], ids=lambda one: type(one).__name__)
def test_outputs_that_share_a_theta_are_judged_each_with_its_inputs(tracker, tmp_path):
    signals, gaps = rows()
    run, clean = track(SHARED, tracker, *signals, gate=True), track(SHARED, tracker, *gaps, gate=True)
    assert [(one.sample, one.signal) for one in run.left_out] == CODES
    np.testing.assert_array_equal(run.theta[20:], clean.theta[20:])
    assert run.loglik == pytest.approx(clean.loglik, rel=1e-12)
    live, parts = Live(SHARED, tracker, gate=True), Live(SHARED, tracker, gate=True)
    for one in zip(*signals, strict=True):
        live.update(*one)
    for part in (slice(0, 11), slice(11, 101), slice(101, 200)):
        parts.update_many(*(signal[part] for signal in signals))
        parts = Live.from_bytes(parts.to_bytes())
    fleet = track(SHARED, tracker, *(np.stack([one, one]) for one in signals), by="row", gate=True)
    fleet.save(tmp_path / "fleet")
    for found in (live, parts):
        np.testing.assert_array_equal(found.theta, run.theta[-1])
        assert found.left_out.last == tuple(run.left_out)
    for found in (fleet[1], type(fleet).load(tmp_path / "fleet")[1]):
        np.testing.assert_array_equal(found.theta, run.theta)
        assert list(found.left_out) == list(run.left_out)


def test_outputs_that_share_a_theta_are_tuned_on_one_decision():
    signals, _ = rows()
    tuned, selection = tune(SHARED, Kalman(), *signals, gate=True), select(SHARED, *signals)
    run = track(SHARED, tuned.tracker, *signals, gate=tuned.left_out)
    assert run.loglik == pytest.approx(tuned.loglik, rel=1e-12)
    for found in (tuned.left_out, run.left_out, selection.left_out[0]):
        assert [(one.sample, one.signal) for one in found] == CODES
    with pytest.warns(
        DataWarning, match=r"left: 1 value .*\(9999\); u2\[left\]: 1 .*; right: 2 values .*; u1\[right\]"
    ):
        track(SHARED, TRACKER, *signals)


def test_several_outputs_are_tuned_on_the_decisions_of_each(tmp_path):
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((300, 2)), np.zeros((300, 2))
    for t in range(1, 300):
        y[t] = [[0.6, 0.2], [0.1, 0.7]] @ y[t - 1] + u[t - 1] + 0.05 * rng.standard_normal(2)
    model, clean = ARX(1, [1, 1], ny=2), y.copy()
    y[100, 0], y[[200, 201], 1], clean[100, 0], clean[[200, 201], 1] = 9999.0, -999.0, np.nan, np.nan
    tuned, selection = tune(model, Kalman(), y, u, gate=True), select([model], y, u)
    run = track(model, tuned.tracker, y, u, gate=tuned.left_out)
    run.save(tmp_path / "run")
    judged = track(model, tuned.tracker, y, u, gate=True)
    np.testing.assert_array_equal(run.theta[30:], judged.theta[30:])
    assert run.loglik == pytest.approx(tuned.loglik, abs=1e-9)
    assert tuned.loglik == pytest.approx(tune(model, Kalman(), clean, u).loglik, rel=1e-3)
    for found in (tuned.left_out, run.left_out, judged.left_out, type(run).load(tmp_path / "run").left_out):
        assert {name: one.sample.tolist() for name, one in found.items()} == {"y1": [100], "y2": [200, 201]}
    assert [len(selection[name].left_out[0]) for name in ("y1", "y2")] == [1, 2]
    with pytest.raises(ValueError, match="give those of each by its name"):
        track(model, TRACKER, y, u, gate=run["y1"].left_out)


def by_sklearn(y, u, gate):
    pytest.importorskip("sklearn")
    from driftfit.bridges.sklearn import TrackedRegressor

    return TrackedRegressor(TRACKER, gate=gate).fit(u[:, None], y).run_.left_out.counts


def by_river(y, u, gate):
    pytest.importorskip("river")
    from driftfit.bridges.river import TrackedRegressor

    model = TrackedRegressor(TRACKER, gate=gate)
    for output, x in zip(y, u, strict=True):
        model.learn_one({"x": x}, output)
    return model._live.left_out.counts


def by_sktime(y, u, gate):
    pd = pytest.importorskip("pandas")
    pytest.importorskip("sktime")
    from driftfit.bridges.sktime import TrackedForecaster

    return TrackedForecaster(TRACKER, lags=1, gate=gate).fit(pd.Series(y)).run_.left_out.counts


def by_formula(y, u, gate):
    pd = pytest.importorskip("pandas")
    pytest.importorskip("formulaic")
    from driftfit.bridges.formula import TimeVaryingRegression

    found = TimeVaryingRegression.from_formula("y ~ x", pd.DataFrame({"y": y, "x": u}), TRACKER, gate).fit()
    assert ("Left out" in found.summary().as_text()) == gate
    return found.run.left_out.counts


@pytest.mark.parametrize("bridge", [by_sklearn, by_river, by_sktime, by_formula])
def test_bridges_have_the_argument(bridge):
    rng = np.random.default_rng(0)
    u = rng.standard_normal(200)
    y = u + 0.01 * rng.standard_normal(200)
    assert bridge(y, u, False) == {}
    y[100] = 9999.0
    assert bridge(y, u, True) == {"Left out": 1}


def test_settings_of_a_grid_take_the_decisions_of_one_reference():
    y, u = plant(codes=[100])
    y[60] = 3.0  # far for the small noise variance, and for it alone
    fleet = track(PLANT, [Kalman(q=1e-6, r=1e-8), Kalman(q=1e-6, r=1.0)], y, u, gate=True)
    assert [one.left_out.sample.tolist() for one in fleet.values()] == [[100]] * 2
    assert [one.ok.sum() for one in fleet.values()] == [198] * 2
    assert "2 samples far outside" in str(fleet.summary())
    several = np.column_stack([y, plant(codes=[150])[0]])
    fleet = track(ARX(1, 1, ny=2), [Kalman(q=1e-6, r=1e-8), Kalman(q=1e-6, r=1.0)], several, u, gate=True)
    assert [one.left_out.sample.tolist() for one in fleet.values()] == [[100], [150]] * 2
