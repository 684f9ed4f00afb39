"""Tables: whatever holds the numbers, and in whatever order, the lanes see the same series."""

from __future__ import annotations

import json
import pickle
from datetime import UTC, date, datetime, timedelta
from decimal import Decimal
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest
from support import arx_record

from driftfit import ARX, DataWarning, Fleet, Kalman, Live, Track, track
from driftfit.data.record import time_text

MODEL, TRACKER = ARX(1, 1), Kalman(q=1e-3, r=0.1)
T = 60


def signals(seed: int = 0, T: int = T) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = rng.normal(size=T).round(3)
    y = np.zeros(T)
    for t in range(1, T):
        y[t] = 0.7 * y[t - 1] + u[t - 1] + 0.1 * rng.normal()
    return y, u


def alone(y, u, **more) -> Track:
    return track(MODEL, TRACKER, y, u, **more)


def assert_same(one: Track, other: Track) -> None:
    for name in one.stores():
        assert np.array_equal(one.written(name), other.written(name), equal_nan=True), name


KINDS = {"pandas": pd.DataFrame, "polars": pl.DataFrame, "pyarrow": pa.table, "lazy": pl.LazyFrame}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_table_is_read_alike(kind):
    (y0, u0), (y1, u1) = signals(0), signals(1, T - 7)
    columns = {
        "pump": ["a"] * T + ["b"] * (T - 7),
        "flow": np.concatenate([y0, y1]),
        "valve": np.concatenate([u0, u1]),
    }
    fleet = track(MODEL, TRACKER, "flow", "valve", data=KINDS[kind](columns), by="pump")
    assert list(fleet) == ["a", "b"]
    assert_same(fleet["a"], alone(y0, u0))
    assert_same(fleet["b"], alone(y1, u1))
    assert fleet["b"].names == ("a1", "b1[valve]")


@pytest.mark.parametrize("kind", KINDS)
def test_columns_of_every_type(kind):
    y, _ = signals()
    whole = np.arange(T) % 5
    forms = {
        "int": whole.astype(np.int32),
        "unsigned": whole.astype(np.uint8),
        "single": whole.astype(np.float32),
        "bool": whole > 2,
        "decimal": [Decimal(int(v)) / 4 for v in whole],
        "nullable": [None if v == 3 else int(v) for v in whole],
        "nullable bool": [None if v == 3 else bool(v > 2) for v in whole],
        "text": ["n/a" if v == 3 else f" {v} " for v in whole],
        "other text": [{3: "#N/A", 4: "."}.get(v, str(v)) for v in whole.tolist()],
    }
    numbers = {
        "decimal": whole / 4.0,
        "bool": whole > 2,
        "nullable": np.where(whole == 3, np.nan, whole),
        "nullable bool": np.where(whole == 3, np.nan, whole > 2),
        "text": np.where(whole == 3, np.nan, whole),
        "other text": np.where(whole > 2, np.nan, whole),
    }
    table = KINDS[kind]({"y": y, **forms})
    for name in forms:
        expected = np.asarray(numbers.get(name, whole), dtype=float)
        run = track(MODEL, TRACKER, "y", name, data=table)
        assert np.array_equal(run.u[:, 0], expected, equal_nan=True), name


def test_nullable_types_of_pandas():
    y, _ = signals()
    for kind in ("Int64", "Float64", "boolean", "int64[pyarrow]", "double[pyarrow]", "category"):
        given = pd.Series([None if k % 7 == 0 else k % 2 for k in range(T)])
        column = given.astype("float").astype("boolean") if kind == "boolean" else given.astype(kind)
        expected = np.array([np.nan if k % 7 == 0 else k % 2 for k in range(T)])
        run = track(MODEL, TRACKER, "y", "u", data=pd.DataFrame({"y": y, "u": column}))
        assert np.array_equal(run.u[:, 0], expected, equal_nan=True), kind


@pytest.mark.parametrize("kind", KINDS)
def test_rows_are_sorted_and_of_several_at_one_time_the_first_is_used(kind):
    y, u = signals()
    time = np.arange(T) * 2.0
    shuffled = np.random.default_rng(3).permutation(T)
    rows = np.concatenate([shuffled, [5, 9, 9]])
    flow = y[rows]
    flow[T:] = 99.0  # what comes again at a time that was there
    table = KINDS[kind]({"y": flow, "u": u[rows], "t": time[rows]})
    with pytest.warns(DataWarning, match=r"time: 3 of 63 rows repeat the time .* by= the column.* summer time"):
        run = track(MODEL, TRACKER, "y", "u", data=table, time="t", dt=2)
    assert_same(run, alone(y, u, time=time, dt=2))
    assert np.array_equal(run.time, time)
    assert run.labels.dropped == {"at a repeated time": 3}
    assert "Rows left out   3 at a repeated time" in str(run.summary())


@pytest.mark.parametrize("kind", KINDS)
def test_rows_without_unit_or_time_are_counted(kind):
    y, u = signals()
    time = [None if k == 4 else float(k) for k in range(T)]
    unit = [None if k == 5 else "a" for k in range(T)]
    fleet = track(
        MODEL, TRACKER, "y", "u", data=KINDS[kind]({"y": y, "u": u, "t": time, "unit": unit}), time="t", by="unit"
    )
    kept = [k for k in range(T) if k not in (4, 5)]
    assert_same(fleet["a"], alone(y[kept], u[kept], time=np.array(kept, dtype=float)))
    assert "1 without a unit, 1 without a time" in str(fleet.summary())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("zone", [None, "Europe/Berlin"])
def test_dates_with_and_without_a_zone(kind, zone):
    y, u = signals()
    # across the end of summer time, when the clock in Berlin shows an hour twice
    times = [datetime(2024, 10, 26, 12, tzinfo=UTC) + timedelta(minutes=30) * k for k in range(T)]
    shown = [time.astimezone(ZoneInfo(zone)) if zone else time.replace(tzinfo=None) for time in times]
    table = KINDS[kind]({"y": y, "u": u, "t": pl.Series(shown) if kind in ("polars", "lazy") else shown})
    run = track(MODEL, TRACKER, "y", "u", data=table, time="t", dt=timedelta(minutes=30))
    axis = np.array([time.replace(tzinfo=None) for time in times], dtype="datetime64[us]")
    assert_same(run, alone(y, u, time=axis, dt=np.timedelta64(30, "m")))
    assert np.array_equal(run.time, axis)
    assert run.labels.zone == zone
    assert run.time_text(-1) == ("2024-10-27 18:30:00 CET" if zone else "2024-10-27 17:30:00")
    assert [d.replace(tzinfo=None) for d in run.to_table("polars")["t"]] == [d.replace(tzinfo=None) for d in shown]
    assert list(run.to_table("pandas")["t"]) == [pd.Timestamp(d) for d in shown]
    run.plot()


def test_days_as_objects_and_as_text():
    """What ``column.dt.date`` of pandas and databases give; cells of several zones are instants."""
    y, u = signals()
    days = [date(2024, 1, 1) + timedelta(days=k) for k in range(T)]
    frame = pd.DataFrame({"y": y, "u": u, "t": days})
    assert frame["t"].dtype == object
    for column in (days, [str(day) for day in days]):
        for table in (frame.assign(t=column), pl.DataFrame({"y": y, "u": u, "t": column})):
            assert_same(track(MODEL, TRACKER, "y", "u", data=table, time="t", dt="1d"), alone(y, u))
    hours = [datetime(2024, 1, 1, tzinfo=UTC) + timedelta(hours=k) for k in range(T)]
    mixed = [one.astimezone(ZoneInfo("Asia/Tokyo")) if k % 2 else one for k, one in enumerate(hours)]
    several = track(MODEL, TRACKER, "y", "u", data=frame.assign(t=pd.Series(mixed, dtype=object)), time="t", dt="1h")
    assert_same(several, alone(y, u))
    assert several.time_text(1) == "2024-01-01 01:00:00 UTC"
    without = pd.Series([pd.NaT if k == 7 else day for k, day in enumerate(days)], dtype=object)
    assert len(track(MODEL, TRACKER, "y", "u", data=frame.assign(t=without), time="t", dt="1d")) == T - 1
    for cell, what in (("soon", "row 7 of the time holds 'soon', which is not a date"), (hours[7], "with a zone and")):
        wrong = pd.Series([cell if k == 7 else day for k, day in enumerate(days)], dtype=object)
        with pytest.raises(ValueError, match=what):
            track(MODEL, TRACKER, "y", "u", data=frame.assign(t=wrong), time="t", dt="1d")


@pytest.mark.parametrize("kind", KINDS)
def test_a_column_without_any_value_is_missing(kind):
    """Its type is then that of null."""
    table = KINDS[kind]({"y": [1.0, 2.0, 3.0], "u": [None] * 3})
    run = track(MODEL, TRACKER, "y", "u", data=table)
    assert np.isnan(run.u).all()
    assert not run.ok.any()


def test_what_is_no_table_says_so():
    for data, what in (
        ([{"y": 1.0}], "got a list with a dict"),
        (pl.DataFrame({"y": [], "u": []}), "the table has no rows"),
        (pl.DataFrame({"y": [1.0], "u": [2.0]}), "time and y are both the column 'y'"),
    ):
        with pytest.raises(ValueError, match=what):
            track(MODEL, TRACKER, "y", "u", data=data, time="y" if "both" in what else None)


def test_gaps_are_those_of_the_unit():
    y, u = signals()
    time = np.arange(T, dtype=float)
    time[30:] += 10.0
    table = pl.DataFrame({"y": [*y, *y], "u": [*u, *u], "t": [*time, *(time + 1000.0)], "k": [1] * T + [2] * T})
    fleet = track(MODEL, TRACKER, "y", "u", data=table, time="t", by="k")
    for key in (1, 2):
        assert_same(fleet[key], alone(y, u, time=time))
        assert fleet[key].ok[29]
        assert not fleet[key].ok[30]  # the gap breaks the lags


def test_dates_need_an_interval():
    table = pl.DataFrame({"y": [1.0, 2.0], "t": [date(2024, 1, 1), date(2024, 1, 2)]})
    with pytest.raises(ValueError, match="with datetimes dt must be given"):
        track(ARX(1, 0), TRACKER, "y", data=table, time="t")


def test_several_columns_tell_units_apart():
    y, u = signals()
    table = pd.DataFrame({"y": [*y, *y], "u": [*u, *u], "plant": ["n"] * T + ["s"] * T, "pump": [1] * 2 * T})
    fleet = track(MODEL, TRACKER, "y", "u", data=table, by=["plant", "pump"])
    assert list(fleet) == [("n", 1), ("s", 1)]
    assert fleet.to_table("polars").columns[:3] == ["plant", "pump", "sample"]


def test_weights_drift_and_settings_per_unit():
    y, u = signals()
    w, d = np.where(np.arange(T) % 3, 1.0, 0.5), np.where(np.arange(T) == 20, 100.0, 1.0)
    table = pl.DataFrame({"y": [*y, *y], "u": [*u, *u], "w": [*w, *w], "d": [*d, *d], "k": ["a"] * T + ["b"] * T})
    own = {"b": Kalman(q=1.0, r=0.1), "a": TRACKER}
    fleet = track(MODEL, own, "y", "u", data=table, by="k", weights="w", drift="d")
    assert_same(fleet["a"], alone(y, u, weights=w, drift=d))
    assert_same(fleet["b"], track(MODEL, own["b"], y, u, weights=w, drift=d))


def test_files_and_patterns(tmp_path):
    (y0, u0), (y1, u1) = signals(0), signals(1)
    pl.DataFrame({"y": y0, "u": u0}).write_csv(tmp_path / "run1.csv")
    pl.DataFrame({"y": y1, "u": u1}).write_parquet(tmp_path / "run2.parquet")
    assert_same(track(MODEL, TRACKER, "y", "u", data=tmp_path / "run1.csv"), alone(y0, u0))
    assert_same(track(MODEL, TRACKER, "y", "u", data=str(tmp_path / "run2.parquet")), alone(y1, u1))
    together = track(MODEL, TRACKER, "y", "u", data=str(tmp_path / "run*"))
    assert_same(together, alone(np.concatenate([y0, y1]), np.concatenate([u0, u1])))
    apart = track(MODEL, TRACKER, "y", "u", data=str(tmp_path / "run*"), by="file")
    assert list(apart) == [str(tmp_path / "run1.csv"), str(tmp_path / "run2.parquet")]
    assert_same(apart[str(tmp_path / "run2.parquet")], alone(y1, u1))


def test_csv_with_semicolons_comments_and_whole_numbers_as_units(tmp_path):
    (tmp_path / "a.csv").write_text("# from the plant\nunit;y;u\n7;1.5;2\n7;2.5;3\n8;;NA\n")
    fleet = track(MODEL, TRACKER, "y", "u", data=tmp_path / "a.csv", by="unit")
    assert list(fleet) == [7, 8]
    assert np.array_equal(fleet[7].y, [1.5, 2.5])
    assert np.isnan(fleet[8].u).all()


def test_units_reach_tables_files_and_the_summary(tmp_path):
    y, u = signals()
    units = {"flow": "l/min", "pressure": "bar"}
    run = track(
        ARX(1, 1, intercept=True),
        TRACKER,
        "flow",
        "pressure",
        data=pl.DataFrame({"flow": y, "pressure": u}),
        units=units,
    )
    assert run.units == ("", "(l/min)/bar", "l/min")
    assert run.to_table("pandas").attrs["units"]["theta_b1[pressure]"] == "(l/min)/bar"
    assert run.to_table("pyarrow").schema.field("prediction").metadata == {b"unit": b"l/min"}
    run.to_parquet(tmp_path / "run.parquet")
    about = json.loads(pl.read_parquet_metadata(tmp_path / "run.parquet")["driftfit"])
    assert about["units"]["innovation"] == "l/min"
    assert "b1[pressure]  (l/min)/bar" in str(run.summary())
    assert "flow (l/min) from pressure (bar)" in str(run.summary())
    assert "b1[pressure]\n(l/min)/bar" in [axis.get_ylabel() for axis in run.plot().axes]


def test_exports_agree():
    y, u = signals()
    table = pd.DataFrame({"y": [*y, *y], "u": [*u, *u], "ok": ["a"] * T + ["b"] * T})
    fleet = track(MODEL, TRACKER, "y", "u", data=table, by="ok")
    polars = fleet.to_table("polars")
    assert polars.equals(pl.DataFrame(fleet))
    assert polars.equals(pl.from_arrow(fleet.to_table("pyarrow")))
    assert np.array_equal(fleet.to_table("pandas")["theta_a1"], polars["theta_a1"])
    assert np.array_equal(polars["theta_a1"][T:], fleet["b"].theta[:, 0])
    assert polars.columns[:6] == ["ok", "sample", "y", "u", "prediction", "innovation"]
    one = pl.DataFrame(fleet["b"])
    assert np.array_equal(one["std_b1[u]"], fleet["b"].std[:, 1])
    with pytest.raises(ValueError, match="kind must be one of 'polars', 'pandas', 'pyarrow'; got 'duckdb'"):
        fleet.to_table("duckdb")


def test_fleet_plot_and_ranking():
    rng = np.random.default_rng(5)
    rows, gains = [], {"still": 0.0, "slow": 0.003, "fast": 0.02}
    for name, slope in gains.items():
        u = rng.normal(size=400)
        y = (1.0 + slope * np.arange(400)) * np.concatenate([[0.0], u[:-1]]) + 0.1 * rng.normal(size=400)
        rows.append(pl.DataFrame({"unit": name, "y": y, "u": u}))
    fleet = track(MODEL, Kalman(q=1e-3, r=0.01), "y", "u", data=pl.concat(rows), by="unit")
    units = fleet.summary().units
    assert [unit.key for unit in units] == ["fast", "slow", "still"]
    assert units[0].parameter == "b1[u]"
    assert units[0].last == fleet["fast"].theta[-1, 1]
    assert units[0].error < units[0].persistence
    figure = fleet.plot()
    assert [axis.get_title() for axis in figure.axes] == ["fast", "slow", "still"]
    with pytest.raises(ValueError, match=r"no parameter 'b2\[u\]'; did you mean b1\[u\]"):
        fleet.plot("b2[u]")


def test_names_of_units_keep_their_type():
    """Parts of a table agree on it: text stays text in a table; files of text have no types."""
    rows = pl.DataFrame({"unit": ["1", "2"], "t": [0.0, 0.0], "flow": [1.0, 2.0], "u": [1.0, 2.0]})
    fleet = track(ARX(1, 1), Kalman(q=1e-3, r=0.1), "flow", "u", data=rows, time="t", by="unit")
    assert list(fleet) == ["1", "2"]
    assert fleet.to_table()["unit"].dtype == pl.String


def test_files_agree_on_the_type_of_units(tmp_path):
    for name, unit in (("a", "7"), ("b", "x")):
        (tmp_path / f"{name}.csv").write_text(f"unit,flow,u\n{unit},1,1\n")
    one = track(ARX(1, 1), Kalman(q=1e-3, r=0.1), "flow", "u", data=tmp_path / "a.csv", by="unit")
    both = track(ARX(1, 1), Kalman(q=1e-3, r=0.1), "flow", "u", data=tmp_path / "*.csv", by="unit")
    assert (list(one), list(both)) == ([7], ["7", "x"])


def test_a_table_without_a_usable_row_is_an_empty_fleet(tmp_path):
    rows = pl.DataFrame({"unit": ["a", "b", None], "t": [None, float("nan"), 1.0], "flow": [1.0] * 3, "u": [1.0] * 3})
    for tracker in (Kalman(q=1e-3, r=0.1), {"a": Kalman(q=1e-3, r=0.1)}):
        fleet = track(ARX(1, 1), tracker, "flow", "u", data=rows, time="t", by="unit")
        assert (len(fleet), fleet.failed) == (0, dict.fromkeys("ab", "no row has a time"))
        assert fleet.dropped == {"without a time": 2, "without a unit": 1}
        fleet.save(tmp_path / "fleet")
        for again in (fleet, Fleet.load(tmp_path / "fleet"), pickle.loads(pickle.dumps(fleet))):
            assert (again.names, again.failed) == (("a1", "b1[u]"), fleet.failed)
            assert "no result for a: no row has a time" in str(again.summary())
            assert again.to_table().columns == ["unit", "t", "flow", "u", *again.programs[0].schema()]
            assert again.to_table().height == 0
        with pytest.raises(ValueError, match="no series has a result to draw"):
            fleet.plot()


def test_the_parameters_of_a_sample_in_one_column():
    y, u = arx_record(30)
    run = track(ARX(1, 1), Kalman(q=1e-3, r=0.1), y, u)
    program = run.program
    for kind in ("polars", "pandas", "pyarrow"):
        table = run.to_table(kind, arrays=True)
        names = table.columns if kind == "polars" else list(getattr(table, "column_names", table))
        assert names == ["sample", "y", "u1", *program.schema(arrays=True)]
        rows = table["theta"].to_pylist() if kind == "pyarrow" else list(table["theta"])
        assert np.array_equal(np.array([list(row) for row in rows]), run.theta)
    assert run.to_table().columns == ["sample", "y", "u1", *program.schema()]
    two = track(ARX(1, 1, ny=2), Kalman(q=1e-3, r=0.1), np.stack([y, y], 1), u).to_table(arrays=True)
    assert [name for name in two.columns if name.startswith("theta")] == ["theta[y1]", "theta[y2]"]


def test_a_fleet_continues_from_its_states_as_bytes():
    y, u = (np.stack(part) for part in zip(*(arx_record(60, k) for k in range(3)), strict=True))
    K = Kalman(q=1e-3, r=0.1)
    whole = track(ARX(1, 1), K, y, u, by="row")
    first = track(ARX(1, 1), K, y[:, :25], u[:, :25], by="row")
    rest = track(ARX(1, 1), K, y[:, 25:], u[:, 25:], by="row", warm_start=first.states())
    assert np.array_equal(rest.stack("theta"), whole.stack("theta")[:, 25:])
    assert np.array_equal(Live.from_bytes(rest.states()[2]).cov, whole[2].cov(59))
    with pytest.raises(ValueError, match="a mapping from key to its end or bytes"):
        track(ARX(1, 1), K, y, u, by="row", warm_start=b"one")


def test_names_of_columns_with_blanks_around_them_or_quotes_are_found(tmp_path):
    """A header such as "time, flow, level" has names with blanks, and quotes in a quoted name are doubled."""
    y, u = arx_record(60, 1)
    (tmp_path / "a.csv").write_text(
        'lev, flow ,"the ""old"" flow"\n' + "\n".join(f"{a},{b},{b}" for a, b in zip(y, u, strict=True))
    )
    options = {"model": ARX(1, 1), "tracker": Kalman(q=1e-3, r=0.1), "data": str(tmp_path / "a.csv")}
    found = [track(y="lev", u=name, **options).theta for name in ("flow", 'the "old" flow')]
    assert np.array_equal(*found)


def test_days_are_keys_of_saved_fleets(tmp_path):
    days = [date(2024, 1, 2)] * 20 + [date(2023, 1, 1)] * 20
    rows = pl.DataFrame({"day": days, "flow": np.arange(40.0), "u": np.ones(40)})
    fleet = track(ARX(1, 1), Kalman(q=1e-3, r=0.1), "flow", "u", data=rows, by="day")
    fleet.save(tmp_path / "fleet")
    again = Fleet.load(tmp_path / "fleet")
    assert list(again) == list(fleet) == [date(2024, 1, 2), date(2023, 1, 1)]
    np.testing.assert_array_equal(again[date(2023, 1, 1)].theta, fleet[date(2023, 1, 1)].theta)


def test_times_as_text_tell_fast_samples_and_seconds_since_1970_apart():
    at = np.datetime64("2024-03-01T06:00:00.000150")
    assert time_text(at, None) == "2024-03-01 06:00:00.00015"
    assert time_text(at, "Europe/Berlin") == "2024-03-01 07:00:00.00015 CET"
    assert time_text(np.datetime64("2024-03-01"), None) == "2024-03-01"
    assert time_text(np.datetime64("2024-03-01T00:00:01"), "UTC") == "2024-03-01 00:00:01 UTC"
    assert [time_text(t, None) for t in (1.7e9 + 0.25, 1700000001.0, 7 * 5e-5, 0.1 + 0.2)] == [
        "1700000000.25", "1700000001", "0.00035", "0.3",
    ]  # fmt: skip
