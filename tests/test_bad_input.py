"""Bad input: what a user can put right is named; what is merely missing is counted, and never poisons a state."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from driftfit import ARX, RLS, AugmentedFLS, Bank, DataWarning, Kalman, Live, Regression, track

MODEL, TRACKER = ARX(1, 1), Kalman(q=1e-3, r=0.1)
KINDS = [TRACKER, RLS(0.99), AugmentedFLS(mu=1.0)]


def table(T: int = 40, seed: int = 0) -> pl.DataFrame:
    rng = np.random.default_rng(seed)
    return pl.DataFrame(
        {"unit": ["a"] * T, "t": np.arange(T, dtype=float), "flow": rng.normal(size=T), "u": rng.normal(size=T)}
    )


def message(error: type[Exception], *args, **more) -> str:
    with pytest.raises(error) as caught:
        track(MODEL, TRACKER, *args, **more)
    return str(caught.value)


@pytest.mark.parametrize("argument", ["y", "u", "time", "by", "weights", "drift"])
def test_a_wrong_column_name_lists_near_matches(argument):
    names = {"y": "flow", "u": "u", argument: "Flo"}
    assert message(ValueError, **names, data=table()) == "the table has no column 'Flo': did you mean flow?"
    names[argument] = "zzz"
    assert message(ValueError, **names, data=table()) == "the table has no column 'zzz': there is unit, t, flow, u."


def test_limits_and_hypotheses_of_another_kind_are_named():
    assert message(ValueError, "flow", "u", data=table(), limits=(0, 1)).endswith("as in {'y': (0, 80)}; got (0, 1).")
    with pytest.raises(ValueError, match=r"changes must list at least one hypothesis, each a Change; got \(3,\)"):
        Bank(changes=3)


def test_text_in_a_numeric_column_is_named_with_its_row(tmp_path):
    data = table().with_columns(
        pl.when(pl.col("t") == 7).then(pl.lit("broken")).otherwise(pl.col("u").cast(str)).alias("u")
    )
    assert "the table, row 7 of column 'u' holds 'broken', which is not a number (1 such cell)" in message(
        ValueError, "flow", "u", data=data
    )
    data.write_csv(tmp_path / "a.csv")
    assert f"{tmp_path}/a.csv, row 8 of column 'u' holds 'broken'" in message(
        ValueError, "flow", "u", data=tmp_path / "a.csv"
    )
    with pytest.raises(ValueError, match="u: entry 2 is 'broken', which is not a number"):
        track(MODEL, TRACKER, [1.0, 2.0, 3.0], [1, 2, "broken"])
    assert "row 3 of column 't' holds 'x', which is neither a number nor a date" in message(
        ValueError,
        "flow",
        "u",
        time="t",
        data=table().with_columns(t=pl.Series(["x" if k == 3 else "2024-01-01" for k in range(40)])),
    )


def test_names_and_tables_of_the_wrong_kind():
    assert "with data=, y is the name of a column; got ndarray" in message(ValueError, np.zeros(3), "u", data=table())
    assert "data must be a table (pandas, polars, pyarrow) or a path; got int" in message(ValueError, "y", "u", data=3)
    assert "by='unit' names a column of a table, so data= is needed" in message(ValueError, [1.0], [1.0], by="unit")
    assert "units= maps the names of columns" in message(ValueError, [1.0], [1.0], units={"y": "m"})
    data = table().with_columns(u=pl.Series([pl.date_range(pl.date(2024, 1, 1), pl.date(2024, 1, 2), eager=True)] * 40))
    assert "column 'u' is of type List" in message(ValueError, "flow", "u", data=data)


@pytest.mark.parametrize("which", ["y", "u"])
def test_complex_signals_are_refused(which):
    """Their imaginary parts were left out."""
    given = {"y": np.ones(9), "u": np.ones(9)}
    given[which] = given[which] + 1j
    with pytest.raises(ValueError, match=f"{which} is complex; give its real and imaginary parts as two signals"):
        track(MODEL, TRACKER, **given)
    one = {name: values[0] for name, values in given.items()}
    with pytest.raises(ValueError, match="is complex"):
        Live(MODEL, TRACKER).update(one["y"], one["u"])


@pytest.mark.parametrize("huge", [10**400, -(10**400)], ids=["above", "below"])
def test_whole_numbers_beyond_all_floats_are_missing(huge):
    live = Live(MODEL, TRACKER)
    for y, u in ((1.0, 1.0), (huge, 1.0), (1.0, huge)):
        step = live.update(y, u)
    assert not step[3]
    assert np.isfinite(live.theta).all()
    run = track(MODEL, TRACKER, [1.0, 10**400, 2.0], [1.0, 1.0, -(10**400)])
    assert np.isinf(run.y[1])
    assert np.isinf(run.u[2, 0])


@pytest.mark.parametrize(("size", "counted"), [(1e75, "count as missing"), (1e-75, "as 0")])
@pytest.mark.parametrize("which", ["y", "u"])
def test_signals_of_impossible_size_are_named(size, counted, which):
    """theta was 0, and its deviation inf, without a word."""
    data, rng = table(5000), np.random.default_rng(0)
    given = {"y": data["flow"].to_numpy(), "u": np.column_stack([rng.normal(size=5000), data["u"].to_numpy()])}
    given[which] = given[which] * size if which == "y" else given[which] * np.array([1.0, size])
    name = {"y": "y", "u": "u2"}[which]
    with pytest.warns(DataWarning, match=f"most numbers of {name} are like .*{counted}.*another unit"):
        track(ARX(1, [1, 1]), TRACKER, **given)


@pytest.mark.parametrize("tracker", KINDS, ids=repr)
def test_one_sample_and_no_usable_sample(tracker):
    for y, u in (([1.0], [2.0]), ([np.nan] * 20, [1.0] * 20), ([1.0] * 20, [np.nan] * 20)):
        run = track(MODEL, tracker, y, u)
        assert not run.ok.any()
        assert np.isfinite(run.theta).all()
        text = str(run.summary())
        assert f"{len(y)}, 0 used, {len(y)} skipped" in text
        assert "nothing to compare" in text
        assert np.isinf(run.std).all() or not tracker.covariance
        run.plot()
        assert len(run.to_table()) == len(y)
    with pytest.raises(ValueError, match="y is empty: there is nothing to track"):
        track(MODEL, tracker, [], [])


def test_an_output_missing_before_anything_is_known_is_not_taken_for_theta0():
    rng = np.random.default_rng(3)
    u = rng.normal(size=100)
    y = np.full(100, 30.0)
    for t in range(1, 100):
        y[t] = 12.0 + 0.6 * y[t - 1] + u[t - 1] + 0.1 * rng.normal()
    y[1] = np.nan
    run = track(ARX(1, 1, intercept=True), Kalman(q=0.0, r=0.01), y, u)
    assert np.abs(run.theta[-1] - [0.6, 1.0, 12.0]).max() < 4.0 * run.std[-1].max()
    assert abs(run.theta[-1, 0] - 0.6) < 4.0 * run.std[-1, 0]


def test_more_parameters_than_samples():
    rng = np.random.default_rng(1)
    run = track(Regression(4), Kalman(q=0.0, r=1.0), rng.normal(size=2), rng.normal(size=(2, 4)))
    assert run.ok.all()
    assert np.isinf(run.std).all()
    assert np.isfinite(run.theta).all()
    run.summary()


def test_units_with_one_row_nothing_usable_or_no_time():
    full = table()
    one = full.head(1).with_columns(unit=pl.lit("one"))
    empty = full.with_columns(unit=pl.lit("empty"), flow=pl.lit(None, dtype=pl.Float64))
    timeless = full.with_columns(unit=pl.lit("timeless"), t=pl.lit(None, dtype=pl.Float64))
    fleet = track(MODEL, TRACKER, "flow", "u", data=pl.concat([full, one, empty, timeless]), time="t", by="unit")
    assert list(fleet) == ["a", "one", "empty"]
    assert fleet.failed == {"timeless": "no row has a time"}
    assert np.array_equal(fleet["a"].theta, track(MODEL, TRACKER, full["flow"], full["u"]).theta)
    assert (len(fleet["one"]), fleet["one"].ok.sum(), fleet["empty"].ok.sum()) == (1, 0, 0)
    text = str(fleet.summary())
    assert "3, 1 without a result" in text
    assert "no result for timeless: no row has a time" in text
    assert "40 without a time" in text
    fleet.plot()
    with pytest.raises(KeyError, match="'timeless' has no result: no row has a time"):
        fleet["timeless"]
    assert "there is nothing to track: none of the 40 rows has a time" in message(
        ValueError, "flow", "u", data=timeless, time="t"
    )


def test_mixed_types_between_files(tmp_path):
    data = table()
    data.write_parquet(tmp_path / "a.parquet")
    data.with_columns(flow=pl.col("flow").cast(pl.Float32), u=pl.col("u").cast(str)).write_parquet(
        tmp_path / "b.parquet"
    )
    data.write_csv(tmp_path / "c.csv")
    fleet = track(MODEL, TRACKER, "flow", "u", data=f"{tmp_path}/*", by="file")
    assert np.array_equal(fleet[f"{tmp_path}/a.parquet"].theta, fleet[f"{tmp_path}/c.csv"].theta)
    data.with_columns(t=pl.lit("2024-01-01")).write_csv(tmp_path / "d.csv")
    with pytest.raises(ValueError, match=r"the times of .*c.csv are numbers, but those of .*d.csv are dates"):
        track(MODEL, TRACKER, "flow", "u", data=f"{tmp_path}/*", by="file", time="t")


def test_files_that_cannot_be_read(tmp_path):
    data = table()
    data.write_parquet(tmp_path / "whole.parquet")
    whole = (tmp_path / "whole.parquet").read_bytes()
    files = {
        "cut.parquet": whole[: len(whole) // 2],
        "empty.parquet": b"",
        "empty.csv": b"",
        "header.csv": b"t,flow,u\n",
        "binary.csv": bytes(range(256)) * 20,
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        assert name in message(ValueError, "flow", "u", data=tmp_path / name)
    with pytest.raises(FileNotFoundError, match="absent"):
        track(MODEL, TRACKER, "flow", "u", data=tmp_path / "absent.csv")
    assert "no file matches" in message(ValueError, "flow", "u", data=f"{tmp_path}/absent*.csv")
    assert "none of the 3 files can be read" in message(ValueError, "flow", "u", data=f"{tmp_path}/*.csv")


def test_one_damaged_file_does_not_cost_the_others(tmp_path):
    data = table()
    data.write_csv(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_bytes(b"")
    data.write_csv(tmp_path / "c.csv")
    with pytest.warns(UserWarning, match=r"1 of 3 files cannot be read: .*b\.csv"):
        fleet = track(MODEL, TRACKER, "flow", "u", data=f"{tmp_path}/*.csv", by="file")
    assert list(fleet) == [f"{tmp_path}/a.csv", f"{tmp_path}/c.csv"]
    assert list(fleet.failed) == [f"{tmp_path}/b.csv"]
    assert "no result for" in str(fleet.summary())


def test_a_cut_csv_line_is_missing_not_fatal(tmp_path):
    (tmp_path / "cut.csv").write_text("flow,u\n1.0,2.0\n1.5,3.0\n2.0")
    run = track(MODEL, TRACKER, "flow", "u", data=tmp_path / "cut.csv")
    assert np.isnan(run.u[2, 0])
