"""Names and indices: inputs go to the model by name, rows belong together, names and dates are kept."""

from __future__ import annotations

import numpy as np
import pandas as pd
import polars as pl
import pytest

from driftfit import ARX, DataWarning, HammersteinWiener, Kalman, Live, Regression, segment, select, track, tune

T = 60
TRACKER = Kalman(q=1e-3, r=0.1)
NAMED = Regression(["b", "a"])


def record(T: int = T) -> tuple[pd.Series, pd.DataFrame]:
    rng = np.random.default_rng(0)
    X = pd.DataFrame({"a": rng.normal(size=T), "b": rng.normal(size=T)})
    y = X["a"] + 5.0 * X["b"] + 0.1 * rng.normal(size=T)
    return y.rename("flow"), X


def ways(y: pd.Series, X: pd.DataFrame) -> dict[str, tuple]:
    """The same signals as everything that has names."""
    both = X.assign(flow=y)
    return {
        "columns": ("flow", ["a", "b"], both),
        "columns of polars": ("flow", ["a", "b"], pl.from_pandas(both)),
        "pandas": (y, X, None),
        "polars": (pl.from_pandas(y), pl.from_pandas(X), None),
        "pyarrow": (y.to_numpy(), pl.from_pandas(X).to_arrow(), None),
        "lazy": (y, pl.from_pandas(X).lazy(), None),
        "mapping": (list(y), {"a": X["a"], "b": list(X["b"])}, None),
        "nullable": (y.astype("Float64"), X.astype("double[pyarrow]"), None),
    }


@pytest.mark.parametrize("way", ways(*record()))
def test_inputs_go_to_the_model_by_name(way):
    """Before, the two coefficients came back swapped, without a word."""
    y, X = record()
    output, inputs, data = ways(y, X)[way]
    run = track(NAMED, TRACKER, output, inputs, data=data)
    by_place = track(NAMED, TRACKER, y.to_numpy(), X[["b", "a"]].to_numpy())
    assert (run.names, run.model) == (("b", "a"), by_place.model)
    assert np.array_equal(run.theta, by_place.theta)
    assert np.array_equal(run.u, by_place.u)
    assert abs(run.theta[-1] - [5.0, 1.0]).max() < 0.2


def test_inputs_of_every_model_are_matched():
    y, X = record()
    arx = track(ARX(1, (1, 2), nk=0, inputs=["b", "a"]), TRACKER, y, X)
    place = track(ARX(1, (1, 2), nk=0, inputs=["b", "a"]), TRACKER, y.to_numpy(), X[["b", "a"]].to_numpy())
    assert arx.names == ("a1", "b1[b]", "b1[a]", "b2[a]")
    assert np.array_equal(arx.theta, place.theta)
    with pytest.raises(ValueError, match=r"HammersteinWiener has the inputs valve, but u has the columns a"):
        track(HammersteinWiener(1, 1, inputs="valve"), TRACKER, y, X["a"])
    fleet = track(NAMED, TRACKER, "flow", ["a", "b"], data=pd.concat([X.assign(flow=y, k=k) for k in "pq"]), by="k")
    alone = track(NAMED, TRACKER, y, X)
    assert np.array_equal(fleet["q"].theta, alone.theta)
    assert fleet.records.labels.u == ("b", "a")


def test_outputs_are_matched_by_name():
    y, X = record()
    both = pd.DataFrame({"one": y, "two": -y})
    model = Regression(["b", "a"], ny=["two", "one"])
    frame = track(model, TRACKER, both, X, weights=np.tile([1.0, 2.0], (T, 1)))
    table = track(
        model, TRACKER, ["one", "two"], ["a", "b"], data=both.join(X).assign(w=1.0, v=2.0), weights=["w", "v"]
    )
    place = track(model, TRACKER, both[["two", "one"]].to_numpy(), X[["b", "a"]].to_numpy(),
                  weights=np.tile([2.0, 1.0], (T, 1)))  # fmt: skip
    for run in (frame, table):
        assert run.outputs == ("two", "one")
        assert np.array_equal(run.theta, place.theta)
        assert np.array_equal(run.innovation_std, place.innovation_std, equal_nan=True)
    assert track(Regression(ny=2), TRACKER, both, X).outputs == ("one", "two")
    with pytest.raises(ValueError, match="has the outputs two, three, but y has the columns one, two"):
        track(Regression(ny=["two", "three"]), TRACKER, both, X)


def test_tune_and_select_match_names():
    y, X = record()
    found = tune(NAMED, Kalman(r=0.1), y, X, groups="each")
    place = tune(NAMED, Kalman(r=0.1), y.to_numpy(), X[["b", "a"]].to_numpy(), groups="each")
    assert found.tracker == place.tracker
    y, X = record(200)
    chosen = select(Regression(["b", "a"]), y, X, tracker=TRACKER)
    assert set(chosen.regressors()) == {"a", "b"}
    alone = select(Regression(["b", "a"]), y, X, tracker=TRACKER, keep=["b"], most=1)
    assert alone.regressors() == ("b",)
    assert alone.rows[0].loglik == select(Regression(["b"]), y, X[["b"]], tracker=TRACKER).rows[0].loglik
    with pytest.raises(ValueError, match="same inputs in the same order"):
        select([Regression(["b", "a"]), Regression(["a", "b"])], y, X, tracker=TRACKER)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"a": "c"}, "has the inputs b, a, but u has the columns c, b; 'a' is missing; 'c' is none of them"),
        ({"a": "x", "b": "y"}, "'b' is missing"),
    ],
)
def test_names_that_do_not_match_are_refused(columns, message):
    y, X = record()
    renamed = X.rename(columns=columns)
    with pytest.raises(ValueError, match=message):
        track(NAMED, TRACKER, y, renamed)
    with pytest.raises(ValueError, match=message):
        track(NAMED, TRACKER, "flow", list(renamed), data=renamed.assign(flow=y))
    with pytest.raises(ValueError, match=r"'c' is none of them.*select columns"):
        track(NAMED, TRACKER, y, X.assign(c=1.0))
    with pytest.raises(ValueError, match="column names must be different"):
        track(Regression(2), TRACKER, y, X.set_axis(["a", "a"], axis=1))


def test_columns_without_names_go_by_place():
    y, X = record()
    run = track(NAMED, TRACKER, y, pd.DataFrame(X[["b", "a"]].to_numpy()))
    assert np.array_equal(run.theta, track(NAMED, TRACKER, y, X).theta)
    assert track(Regression(), TRACKER, y, pd.DataFrame(X.to_numpy())).names == ("theta1", "theta2")


def test_rows_that_do_not_belong_together_are_refused():
    """Before, a shuffled frame was taken row by row."""
    y, X = record()
    shuffled = X.sample(frac=1.0, random_state=1)
    with pytest.raises(ValueError, match=r"in row \d+ their indices are .*u = u.loc\[y.index\]"):
        track(NAMED, TRACKER, y, shuffled)
    run = track(NAMED, TRACKER, y, shuffled.loc[y.index])
    assert np.array_equal(run.theta, track(NAMED, TRACKER, y, X).theta)
    later = X.set_axis(X.index + 5)
    with pytest.raises(ValueError, match="align"):
        track(NAMED, TRACKER, y, later)
    assert len(track(NAMED, TRACKER, *y.align(later, "inner", 0))) == T - 5
    track(NAMED, TRACKER, y, later.to_numpy())
    with pytest.raises(ValueError, match="the rows of y and weights do not match"):
        track(NAMED, TRACKER, y, X, weights=pd.Series(1.0, index=shuffled.index))
    with pytest.raises(ValueError, match=r"u\['b'\]|the rows of a and b"):
        track(NAMED, TRACKER, y, {"a": X["a"], "b": shuffled["b"]})
    with pytest.raises(ValueError, match="do not match"):
        tune(NAMED, Kalman(r=0.1), y, shuffled)


def test_names_and_dates_of_a_frame_are_kept(tmp_path):
    y, X = record()
    dates = pd.date_range("2024-03-01", periods=T, freq="B", tz="Europe/Berlin", name="day")
    plain = track(Regression(intercept=True), TRACKER, y.to_numpy(), X.to_numpy())
    for index in (dates, dates.tz_localize(None), dates.tz_localize(None).to_period("D")):
        run = track(Regression(intercept=True), TRACKER, y.set_axis(index), X.set_axis(index))
        assert run.names == ("a", "b", "intercept")
        assert np.array_equal(run.theta, plain.theta)  # dates are labels: no interval is a gap
        assert run.time_text(0).startswith("2024-03-01")
        assert "flow from a, b" in str(run.summary())
        assert run.to_table("pandas").columns[:4].tolist() == ["day", "flow", "a", "b"]
        run.save(tmp_path / "run.npz")
        assert type(run).load(tmp_path / "run.npz").labels == run.labels
    only = track(Regression(intercept=True), TRACKER, y.to_numpy(), X.set_axis(dates))
    assert only.labels.zone == "Europe/Berlin"
    timed = track(ARX(1, 1), TRACKER, y.set_axis(dates), X["a"].set_axis(dates), dt="2d")
    assert timed.known.interval[:4].tolist() == [1.0, 1.5, 0.5, 0.5]
    newest_first = y.set_axis(dates[::-1])
    with pytest.raises(ValueError, match="time must increase"):
        track(Regression(intercept=True), TRACKER, newest_first, X.to_numpy())


@pytest.mark.parametrize("model", [NAMED, ARX(1, 1, inputs=["b", "a"], nk=0)])
def test_a_stream_takes_names(model):
    y, X = record()
    run = track(model, TRACKER, y, X)
    live = Live(model, TRACKER)
    for t in range(T):
        row = X.iloc[t] if t % 2 else {"a": X["a"][t], "b": X["b"][t]}
        assert live.predict(row) == live.predict(X[["b", "a"]].iloc[t].to_numpy()) or np.isnan(live.predict(row)[0])
        live.update(y[t], row)
        assert np.array_equal(live.theta, run.theta[t])
    with pytest.raises(ValueError, match="'b' is missing"):
        live.update(1.0, {"a": 1.0})
    with pytest.raises(ValueError, match="have no names"):
        Live(Regression(2), TRACKER).update(1.0, {"a": 1.0, "b": 2.0})
    assert Live(model, TRACKER).update(1.0, pd.Series([1.0, 2.0]))[3] == (model == NAMED)


def test_a_stream_with_several_outputs_takes_names():
    y, X = record()
    both = pd.DataFrame({"one": y, "two": -y})
    model = Regression(["b", "a"], ny=["two", "one"])
    run, live = track(model, TRACKER, both, X), Live(model, TRACKER)
    for t in range(T):
        live.update(both.iloc[t], {"a": X["a"][t], "b": X["b"][t]})
        assert np.array_equal(live.theta, run.theta[t])
    with pytest.raises(ValueError, match="'one' is missing"):
        live.update({"two": 1.0, "b": 1.0}, [1.0, 2.0])


def test_future_inputs_are_matched():
    y, X = record()
    model = ARX(1, 1, inputs=["b", "a"], nk=0)
    run = track(model, TRACKER, y, X)
    later = X.iloc[:5]
    assert np.array_equal(run.forecast(5, later).y_hat, run.forecast(5, later[["b", "a"]].to_numpy()).y_hat)
    assert np.array_equal(run.simulate(later).y_hat, run.simulate(later[["b", "a"]].to_numpy()).y_hat)


def test_a_table_needs_no_list_of_the_inputs_that_the_model_names():
    y, X = record()
    table = X.assign(flow=y, other=1.0)
    named = track(NAMED, TRACKER, "flow", data=table)
    assert np.array_equal(named.theta, track(NAMED, TRACKER, "flow", ["a", "b"], data=table).theta)
    fleet = track(NAMED, TRACKER, "flow", data=table.assign(pump="A"), by="pump")
    assert np.array_equal(fleet["A"].theta, named.theta)
    with pytest.raises(ValueError, match=r"the model has 2 regressors .*, but u has 0 columns"):
        track(Regression(2), TRACKER, "flow", data=table)


def test_an_index_of_dates_labels_the_rows_of_a_table():
    y, X = record()
    days = pd.date_range("2024-01-05", periods=T, freq="B", name="day")
    for index in (days, days.tz_localize("Europe/Berlin"), pd.period_range("1990Q1", periods=T, freq="Q")):
        table = X.assign(flow=y).set_axis(index)
        run, same = track(NAMED, TRACKER, "flow", data=table), track(NAMED, TRACKER, table["flow"], table[["a", "b"]])
        assert np.array_equal(run.time, same.time)
        assert np.array_equal(run.theta, same.theta)
    table = X.assign(flow=y).set_axis(days)
    assert track(ARX(1, 1), TRACKER, "flow", "a", data=table).ok.sum() == T - 1
    with pytest.warns(UserWarning, match="business day"):
        assert track(ARX(1, 1), TRACKER, "flow", "a", data=table, dt="1d").ok.sum() < T - 5
    assert np.array_equal(track(NAMED, TRACKER, "flow", data=table.reset_index(drop=True)).time, np.arange(T))
    assert track(NAMED, TRACKER, "flow", data=table.assign(day=0)).labels.time == "time"


def as_index(table):
    return table.set_index("day")


@pytest.mark.parametrize("kind", [as_index, pd.DataFrame, pl.from_pandas, lambda table: pl.from_pandas(table).lazy()])
@pytest.mark.parametrize("by", [None, "plant"])
def test_rows_in_another_order_than_their_dates_are_sorted(kind, by):
    y, X = record()
    days = pd.date_range("2024-01-05", periods=T, freq="B", name="day")
    table = X.assign(flow=y, plant="north").set_axis(days).reset_index()
    shuffled = table.sample(frac=1.0, random_state=0)
    run = track(NAMED, TRACKER, "flow", data=kind(table), by=by)
    for other in (table[::-1], shuffled):
        with pytest.warns(DataWarning, match=r"not in the order of 'day', and are sorted by it; .* give time='day'"):
            same = track(NAMED, TRACKER, "flow", data=kind(other), by=by)
        one, two = (run, same) if by is None else (run["north"], same["north"])
        assert np.array_equal(one.theta, two.theta)
        assert np.array_equal(two.time, days)


@pytest.mark.parametrize(
    ("verb", "what"),
    [
        (lambda **data: tune(NAMED, Kalman(r=0.1), **data), lambda tuned: tuned.loglik),
        (lambda **data: select([NAMED, ARX(1, 0)], tracker=TRACKER, **data), str),
        (lambda **data: segment(**data), lambda found: found.segments[0].theta.tolist()),
    ],
)
def test_every_verb_sorts_rows_by_their_dates(verb, what):
    y, X = record()
    table = X.assign(flow=y).set_axis(pd.date_range("2024-01-05", periods=T, name="day"))
    with pytest.warns(DataWarning, match="not in the order of 'day'"):
        found = verb(y="flow", u=["a", "b"], data=table[::-1])
    assert what(found) == what(verb(y="flow", u=["a", "b"], data=table))


def test_dates_that_repeat():
    y, X = record()
    days = pd.date_range("2024-01-05", periods=T // 2, freq="D", name="day").repeat(2)
    table = X.assign(flow=y).set_axis(days)
    with pytest.warns(DataWarning, match=rf"{T // 2} of {T} rows repeat .* by= the column .* or the mean"):
        assert track(NAMED, TRACKER, "flow", data=table).labels.dropped == {"at a repeated time": T // 2}
    table = table.reset_index()  # a column that nobody named as the time does not cost rows
    assert np.array_equal(track(NAMED, TRACKER, "flow", data=table).time, np.arange(T))
    with pytest.warns(DataWarning, match=rf"{T // 2} of them .* in the order of the table; give time='day', by="):
        assert len(track(NAMED, TRACKER, "flow", data=table[::-1])) == T


def test_periods_that_an_index_leaves_out_are_not_skipped_silently():
    y, X = record()
    index = pd.period_range("1980Q1", periods=T + 3, freq="Q").delete([30, 31, 50])
    y, X = y.set_axis(index), X.set_axis(index)
    message = r"leaves out 3 periods, the first after 1987Q2, .* Give dt='quarter', or dt='label'"
    for signals in ({"y": y, "u": X}, {"y": "flow", "u": ["a", "b"], "data": X.assign(flow=y)}):
        with pytest.warns(DataWarning, match=message):
            track(NAMED, TRACKER, **signals)
        for dt in ("quarter", "label"):
            track(NAMED, TRACKER, **signals, dt=dt)
