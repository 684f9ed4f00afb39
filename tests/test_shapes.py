"""Shapes and times: wrong ones raise and name both sides, right ones of every kind are taken."""

from datetime import datetime, timedelta

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest
from support import arx_record, same

from driftfit import ARX, RLS, AugmentedFLS, Kalman, Live, Regression, track

K = Kalman(q=1e-3, r=0.1)
Y, U = arx_record(40, 1)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"y": np.ones((40, 2))}, ["y", "one axis", "(40, 2)"]),
        ({"y": 3.0}, ["y", "one axis", "()"]),
        ({"y": []}, ["y is empty"]),
        ({"y": ["1.0", "two"]}, ["y", "entry 1", "'two'"]),
        ({"y": np.array(["NaT", "2024-01-31"], "datetime64[ns]")}, ["y", "entry 1", "'2024-01-31"]),
        ({"u": U[:-1]}, ["y has 40 samples", "(39, 1)", "first axis must be time"]),
        ({"u": np.ones((1, 40))}, ["(1, 40)", "u.T has shape (40, 1)"]),
        ({"u": np.ones((40, 1, 1))}, ["u", "(T,) or (T, m)", "(40, 1, 1)"]),
        ({"u": None}, ["ARX", "nb", "give u"]),
        ({"time": np.arange(39)}, ["time", "(39,)", "40 samples"]),
        ({"time": np.r_[np.arange(20), np.arange(20)]}, ["must increase", "time[19] = 19", "time[20] = 0", "sort"]),
        ({"time": np.r_[0.0, 0.0, np.arange(2.0, 40)]}, ["must increase", "time[0]", "time[1]"]),
        ({"time": np.r_[0.0, np.nan, np.arange(2.0, 40)]}, ["must increase", "time[1] = nan"]),
        ({"time": np.arange(40), "dt": 0.0}, ["dt", "positive", "0.0"]),
        ({"time": np.arange(40), "dt": np.nan}, ["dt", "positive", "nan"]),
        ({"time": np.arange(40).astype("datetime64[s]")}, ["dt must be given", "timedelta"]),
        ({"weights": -1.0}, ["weights", "not negative"]),
        ({"weights": np.ones(39)}, ["weights", "(40)", "(39,)"]),
        ({"weights": np.inf}, ["weights", "finite"]),
        ({"drift": np.full(40, np.nan)}, ["drift", "finite"]),
        ({"drift": np.ones((40, 1))}, ["drift", "(40, 1)"]),
        ({"keep": "all"}, ["keep", "'std', 'cov'", "'all'"]),
    ],
)
def test_wrong_shapes_are_named(given, message):
    with pytest.raises(ValueError) as error:
        track(ARX(2, 2), K, **({"y": Y, "u": U} | given))
    for word in message:
        assert word in str(error.value)


def test_the_number_of_inputs_is_named():
    with pytest.raises(ValueError, match=r"2 inputs.*3 columns"):
        track(ARX(1, [1, 1]), K, Y, np.ones((40, 3)))
    with pytest.raises(ValueError, match=r"2 regressors.*1 columns"):
        track(Regression(2), K, Y, U)
    with pytest.raises(ValueError, match=r"1 inputs.*\(2,\)"):
        Live(ARX(2, 2), K).update(1.0, [1.0, 2.0])
    with pytest.raises(ValueError, match=r"1 inputs.*\(2,\)"):
        Live(ARX(2, 2), K).update(1.0, np.ones(2))
    with pytest.raises(ValueError, match=r"1 inputs.*\(0,\)"):
        Live(ARX(2, 2), K).predict([])


@pytest.mark.parametrize("level", [0.0, 1.0, 95, -0.5, np.nan])
def test_a_wrong_level_is_named(level):
    with pytest.raises(ValueError, match=r"level.*between 0 and 1.*0\.95"):
        track(ARX(2, 2), K, Y, U).band(level)


@pytest.mark.parametrize("t", [40, -41])
def test_a_sample_outside_the_record_is_named(t):
    with pytest.raises(IndexError, match=f"40 samples; got {t}"):
        track(ARX(2, 2), K, Y, U).cov(t)


def test_a_missing_covariance_is_reported():
    with pytest.raises(ValueError, match="AugmentedFLS carries no covariance"):
        track(ARX(2, 2), AugmentedFLS(1.0), Y, U, keep="cov")
    assert np.isnan(track(ARX(2, 2), AugmentedFLS(1.0), Y, U).loglik)


@pytest.mark.parametrize(
    "kind",
    [
        list, tuple, pd.Series, pl.Series, pa.array, lambda a: a.astype(object), lambda a: np.ma.masked_array(a),
        lambda a: a[:, None], lambda a: np.repeat(a, 2)[::2], lambda a: a[::-1].copy()[::-1],
    ],
)  # fmt: skip
def test_signals_of_every_kind_are_taken(kind):
    expected = track(ARX(2, 2), K, Y, U).theta
    assert same(track(ARX(2, 2), K, kind(Y), kind(U)).theta, expected)


def test_missing_values_of_every_kind_are_missing():
    y = Y.copy()
    y[[10, 20]] = np.nan
    expected = track(ARX(2, 2), K, y, U).theta
    holes = [None if np.isnan(value) else value for value in y]
    masked = np.ma.masked_invalid(y)
    masked.data[masked.mask] = 99.0
    for given in (holes, pl.Series(holes), pd.Series(holes, dtype="Float64"), pa.array(holes), masked,
                  ["" if value is None else str(value) for value in holes]):  # fmt: skip
        assert same(track(ARX(2, 2), K, given, U).theta, expected), type(given)


def test_times_of_every_kind_give_the_same():
    gaps = np.where(np.arange(40) == 20, 3.0, 1.0)
    seconds = np.cumsum(gaps)
    expected = track(ARX(2, 2), K, Y, U, time=seconds).theta
    start = datetime(2024, 3, 1)
    dates = [start + timedelta(seconds=float(s)) for s in seconds]
    second = timedelta(seconds=1)
    for time, dt in (
        (10 * seconds, 10),
        (seconds.astype(int), 1),
        (seconds.tolist(), None),
        (dates, second),
        (np.array(dates, dtype="datetime64[ns]"), np.timedelta64(1, "s")),
        (pd.Series(dates), second),
        (pd.DatetimeIndex(dates), pd.Timedelta(seconds=1)),
        (pl.Series(dates), second),
    ):
        assert same(track(ARX(2, 2), K, Y, U, time=time, dt=dt).theta, expected), type(time)
        live = Live(ARX(2, 2), K, dt=dt)
        for t in range(40):
            live.update(Y[t], U[t : t + 1], time=time[t])
        assert same(live.theta, expected[-1]), type(time)


def test_a_gap_breaks_the_lags_and_an_uneven_step_does_not():
    time = np.arange(40.0)
    time[20:] += 0.4
    assert track(ARX(2, 2), K, Y, U, time=time).ok[2:].all()
    time[20:] += 0.2
    run = track(ARX(2, 2), K, Y, U, time=time)
    assert np.flatnonzero(~run.ok).tolist() == [0, 1, 20, 21]


@pytest.mark.parametrize("value", [1, 1.0, np.float64(1), np.float32(1), np.int64(1), True])
def test_live_takes_numbers_of_every_kind(value):
    one, two = Live(ARX(2, 2), K), Live(ARX(2, 2), K)
    for _ in range(10):
        one.update(1.0, 1.0)
        two.update(value, value)
    assert same(one.theta, two.theta)
    for u in ([1.0], (1,), np.ones(1, np.float32), np.ones((1, 1)), [None], None):
        assert len(two.update(1.0, u)) == 4


@pytest.mark.parametrize("nothing", [pd.NA, pd.NaT, float("nan")])
def test_whatever_stands_for_no_value_is_missing_as_none_is(nothing):
    """In outputs, in inputs one by one and by name, in fleets and records; without a time a sample is ignored."""
    two = ARX(2, 2, inputs=["a", "b"])
    one, other, more, same_more = Live(ARX(2, 2), K), Live(ARX(2, 2), K), Live(two, K), Live(two, K)
    for t in range(20):
        for live, given in ((one, nothing), (other, None)):
            live.update(given if t == 10 else Y[t], given if t == 15 else U[t])
        for live, given in ((more, nothing), (same_more, None)):
            live.update(Y[t], {"a": 1.0 * t, "b": given if t == 15 else U[t]})
    assert same(one.theta, other.theta)
    assert same(more.theta, same_more.theta)
    assert same(track(ARX(2, 2), K, [nothing, *Y[1:]], U).theta, track(ARX(2, 2), K, [None, *Y[1:]], U).theta)
    timed = Live(ARX(2, 2), K)
    for t in (0.0, 1.0, nothing):
        assert timed.update(1.0, 1.0, time=t)[3] == 0
    assert timed.ignored == 1
    keys = ["a", nothing, "a"] if nothing is pd.NA else ["a", None, "a"]
    for kind in ("string", "object"):
        table = pd.DataFrame({"y": [1.0, 2.0, 3.0], "u": 1.0, "unit": pd.Series(keys, dtype=kind)})
        assert track(Regression(1), K, "y", "u", data=table, by="unit").dropped == {"without a unit": 1}


@pytest.mark.parametrize("kind", ["Int64", "boolean", "Float64", "int64[pyarrow]"])
def test_a_key_of_a_nullable_type_may_be_missing(kind):
    table = pd.DataFrame({"y": [1.0, 2.0, 3.0], "u": 1.0, "unit": pd.Series([1, None, 1]).astype(kind)})
    fleet = track(Regression(1), K, "y", "u", data=table, by="unit")
    assert (list(fleet), fleet.dropped) == ([1], {"without a unit": 1})


def test_live_needs_no_input_where_the_model_has_none():
    y = np.sin(np.arange(30.0))
    live = Live(ARX(2, 0), RLS(1.0))
    for value in y:
        live.update(value)
    assert same(live.theta, track(ARX(2, 0), RLS(1.0), y).theta[-1])


def test_live_refuses_weights_and_factors_that_are_none():
    live = Live(ARX(2, 2), K)
    before = live._tile.tobytes()
    for wrong in ({"weight": -1.0}, {"weight": np.nan}, {"drift": -0.1}, {"drift": np.inf}):
        with pytest.raises(ValueError, match=r"(weights|drift) must be finite and not negative"):
            live.update(1.0, 1.0, **wrong)
    with pytest.raises(ValueError, match="dt must be given"):
        live.update(1.0, 1.0, time=datetime(2024, 1, 1))
    assert live._tile.tobytes() == before
