"""Time: calendars count as nominal steps, records and streams count alike, and samples that a wrong dt costs are
reported."""

from __future__ import annotations

from datetime import UTC, timedelta

import numpy as np
import pandas as pd
import polars as pl
import pytest

from driftfit import ARX, RLS, Kalman, Live, Regression, track
from driftfit.data.clock import ROUNDED_WITHIN, Clock, median_interval
from driftfit.data.instants import span
from driftfit.engine.settings import DataWarning

MODEL, TRACKER = ARX(1, 1), Kalman(q=1e-3, r=0.1)
T = 60


def signals(seed: int = 0, T: int = T) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=T), rng.normal(size=T)


def same(one, other) -> None:
    for name in ("theta", "std", "innovation", "innovation_std", "ok"):
        assert np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True), name


OFFSETS = pd.offsets
GIVEN = {
    "3d": [timedelta(days=3), "3d", "72 h", "3 days", np.timedelta64(3, "D"), OFFSETS.Day(3), "4320min"],
    "1h": ["1h", "60min", "3600s", OFFSETS.Hour(), pd.Timedelta("1h"), "1 hour"],
    "7d": ["w", "1w", OFFSETS.Week(weekday=2), pd.DateOffset(weeks=1)],
    "10ms": ["10ms", timedelta(milliseconds=10), "0.01s", "10000us"],
    "month": [
        "month",
        "MS",
        "ME",
        "BME",
        OFFSETS.MonthEnd(),
        pd.DateOffset(months=1),
        OFFSETS.CustomBusinessMonthEnd(),
    ],
    "3 months": ["quarter", "3 months", "QE-DEC", OFFSETS.QuarterBegin(), pd.DateOffset(months=3)],
    "12 months": ["year", "12 months", OFFSETS.YearEnd(), pd.DateOffset(years=1)],
    "business day": ["business day", "B", OFFSETS.BDay(), "business days"],
    "business day except 2024-12-25": [
        "business day except 2024-12-25",
        OFFSETS.CustomBusinessDay(holidays=["2024-12-25"]),
    ],
    "label": ["label"],
}


@pytest.mark.parametrize("plain", GIVEN)
def test_an_interval_in_words(plain):
    for given in GIVEN[plain]:
        time = pd.date_range("2024-12-20", periods=20, freq="13h").to_numpy()
        assert np.allclose(Clock.of(given).steps(time), Clock.of(plain).steps(time), rtol=1e-12), given
        result = Clock.of(given).plain
        assert Clock.of(result).plain == result
    assert Clock.of(GIVEN[plain][0]).plain == plain


@pytest.mark.parametrize(
    "given", ["m", "5M", "fortnight", -1, 0, float("nan"), True, "0s", "1.5 months", OFFSETS.SemiMonthEnd(), [1.0],
              np.timedelta64(1, "M"), timedelta(0), pd.DateOffset(day=3)]
)  # fmt: skip
def test_what_is_no_interval(given):
    with pytest.raises(ValueError, match="dt"):
        Clock.of(given)


def test_an_interval_of_the_wrong_kind_is_named():
    y, u = signals()
    days = np.arange(T).astype("datetime64[D]")
    with pytest.raises(ValueError, match=r"dt=2 has no unit.*dt='2s'"):
        track(MODEL, TRACKER, y, u, time=days, dt=2)
    with pytest.raises(ValueError, match="dt='1h' is for dates, but time is numeric"):
        track(MODEL, TRACKER, y, u, time=np.arange(T), dt="1h")
    with pytest.raises(ValueError, match="or 'label' if samples"):
        track(MODEL, TRACKER, y, u, time=days)


def test_days_and_months_are_those_of_the_zone(tmp_path):
    """Midnight in Tokyo is on the day before in UTC, where Monday would be a Sunday."""
    y, u = signals()
    plain = track(MODEL, TRACKER, y, u)
    for zone in ("Asia/Tokyo", "America/New_York", "Europe/Berlin", "+09:00"):
        for freq, dt in (("B", "business day"), ("MS", "month"), ("QE", "quarter")):
            time = pd.date_range("2020-01-01", periods=T, freq=freq, tz=zone)
            same(track(MODEL, TRACKER, y, u, time=time, dt=dt), plain)
            run = track(MODEL, TRACKER, y, u, time=time, dt=dt)
            table = pd.DataFrame({"y": y, "u": u, "t": time})
            same(track(MODEL, TRACKER, "y", "u", data=table, time="t", dt=dt), plain)
            live = Live(MODEL, TRACKER, dt=dt)
            for t in range(T):
                if t == T // 2:
                    live.save(tmp_path / "live.npz")
                    live = Live.load(tmp_path / "live.npz")
                live.update(y[t], u[t], time=time[t])
            assert np.array_equal(live.theta, plain.theta[-1])
            ahead = pd.DatetimeIndex(Clock.of(dt, run.labels.zone).ahead(run.time[-1], 5)).tz_localize("UTC")
            assert list(ahead.tz_convert(zone)) == list(pd.date_range(time[-1], periods=6, freq=freq))[1:]


CALENDARS = {
    "business day": ["B"],
    "month": ["MS", "ME", "BME", "BMS"],
    "quarter": ["QS", "QE", "BQE"],
    "year": ["YS", "YE", "BYE"],
    "1s": ["s"],
    "30d": ["30D"],
}


@pytest.mark.parametrize("dt", CALENDARS)
def test_a_calendar_is_regular(dt):
    """Every sample is used, as if it had no time: before, Mondays or all samples were lost, or dt was refused."""
    y, u = signals()
    plain = track(MODEL, TRACKER, y, u)
    for freq in CALENDARS[dt]:
        time = pd.date_range("2019-01-07 17:30", periods=T, freq=freq)
        same(track(MODEL, TRACKER, y, u, time=time, dt=dt), plain)
        same(track(MODEL, TRACKER, y, u, time=time, dt=time.freq), plain)
        table = pd.DataFrame({"y": y, "u": u, "t": time})
        same(track(MODEL, TRACKER, "y", "u", data=table, time="t", dt=dt), plain)


def test_gaps_of_a_calendar():
    time = np.array(["2024-01-31", "2024-02-29", "2024-05-31", "2024-06-15"], dtype="datetime64[D]")
    assert Clock.of("month").steps(time)[:3].tolist() == [1.0, 1.0, 3.0]
    assert abs(Clock.of("month").steps(time)[3] - (14 / 30 + 1 / 31)) < 1e-12
    days = np.array(["2024-12-23", "2024-12-24", "2024-12-26", "2024-12-27", "2024-12-30"], dtype="datetime64[D]")
    assert Clock.of("B").steps(days).tolist() == [1, 1, 2, 1, 1]
    assert Clock.of("business day except 2024-12-25").steps(days).tolist() == [1, 1, 1, 1, 1]
    week = np.arange("2024-06-06", "2024-06-12", dtype="datetime64[D]")  # a Thursday to a Tuesday
    assert Clock.of("B").steps(week).tolist() == [1, 1, 1, 0, 0, 1]


@pytest.mark.parametrize("dt", ["business day", "month", "quarter", "30d", "1s", "business day except 2021-01-01"])
def test_times_ahead_are_one_step_apart(dt):
    for start in ("2020-01-31", "2020-02-28", "2020-12-31", "2021-01-04"):
        last = np.datetime64(start, "us") + np.timedelta64(3600, "s")
        ahead = Clock.of(dt).ahead(last, 30)
        steps = Clock.of(dt).steps(np.concatenate([[last], ahead]))
        assert np.all(np.abs(steps - 1.0) < ROUNDED_WITHIN + 1e-9)
    month_ends = Clock.of("month").ahead(np.datetime64("2024-01-31", "us"), 2).astype("datetime64[D]")
    assert list(map(str, month_ends)) == ["2024-02-29", "2024-03-31"]
    assert Clock.of("label").ahead(np.datetime64("2024-01-31"), 2) is None


def kinds_of(time: np.ndarray) -> list[list]:
    """The same times as every kind of Python object."""
    stamps = pd.DatetimeIndex(time)
    naive = [stamp.to_pydatetime() for stamp in stamps]
    return [list(time), list(stamps), naive, [one.replace(tzinfo=UTC) for one in naive],
            list(stamps.tz_localize("UTC").tz_convert("Asia/Tokyo"))]  # fmt: skip


@pytest.mark.parametrize("dt", ["B", "month", "36h", "label"])
def test_a_stream_counts_as_its_record(dt):
    y, u = signals()
    rng = np.random.default_rng(1)
    time = np.datetime64("2024-01-01", "us") + np.cumsum(rng.integers(1, 90, T)) * np.timedelta64(1, "h")
    for kind in kinds_of(time):
        record = track(MODEL, TRACKER, y, u, time=kind, dt=dt)
        live = Live(MODEL, TRACKER, dt=dt)
        for t in range(T):
            step = live.update(y[t], u[t], time=kind[t])
            assert step[3] == record.ok[t]
            assert np.array_equal(live.theta, record.theta[t])
        assert np.array_equal(live.std, record.std[-1])
        assert live.update(1.0, 1.0, time=kind[-1])[3] is False
        assert live.ignored == 1


def test_a_warm_start_counts_from_the_end_of_the_run_before():
    y, u = signals()
    time = pd.date_range("2024-01-01", periods=T, freq="B")
    whole = track(MODEL, TRACKER, y, u, time=time, dt="B")
    first = track(MODEL, TRACKER, y[:25], u[:25], time=time[:25], dt="B")
    rest = track(MODEL, TRACKER, y[25:], u[25:], time=time[25:], dt="B", warm_start=first)
    assert np.array_equal(rest.theta, whole.theta[25:])


def test_samples_lost_to_dt_are_reported():
    y, u = signals()
    with pytest.warns(
        DataWarning, match=r"59 of 60 samples .* median interval is 10, dt is 1, .* Give dt=10, or dt='label'"
    ):
        run = track(MODEL, TRACKER, y, u, time=10.0 * np.arange(T))
    assert not run.ok.any()
    for freq, dt in (("MS", "month"), ("B", "business day")):  # of the latter only Mondays are lost
        with pytest.warns(DataWarning, match=f"dt='{dt}'"):
            track(MODEL, TRACKER, y, u, time=pd.date_range("2024-01-01", periods=T, freq=freq), dt="1d")
    table = pd.DataFrame(
        {"y": np.tile(y, 2), "u": np.tile(u, 2), "t": np.tile(10 * np.arange(T), 2), "k": [0] * T + [1] * T}
    )
    with pytest.warns(DataWarning, match="118 of 120") as result:
        track(MODEL, TRACKER, "y", "u", data=table, by="k", time="t")
    assert len(result) == 1
    assert result[0].filename == __file__
    live = Live(MODEL, TRACKER)
    with pytest.warns(DataWarning, match="first 20 samples") as result:
        [live.update(y[t], u[t], time=10.0 * t) for t in range(T)]
    assert [one.filename for one in result] == [__file__]


def test_no_warning_where_no_sample_is_lost():
    y, u = signals()
    rng = np.random.default_rng(0)
    track(MODEL, TRACKER, y, u, time=10.0 * np.arange(T), dt="label")
    track(MODEL, TRACKER, y, u, time=10.0 * np.arange(T), dt=10)
    track(MODEL, TRACKER, y, u, time=np.cumsum(rng.choice([1, 1, 1, 4], T)))
    track(MODEL, TRACKER, y[:1], u[:1], time=[0.0])


def test_the_best_interval_is_found():
    rng = np.random.default_rng(0)
    for freq, best in (("B", "business day"), ("ME", "month"), ("QS", "quarter"), ("YE", "year"), ("15min", "15min"),
                       ("D", "1d"), ("W", "7d"), ("s", "1s")):  # fmt: skip
        assert median_interval(pd.date_range("2020-01-01", periods=50, freq=freq).to_numpy())[1] == best
    jitter = np.arange(50) * np.timedelta64(86400, "s") + rng.integers(0, 500, 50).astype("timedelta64[s]")
    assert "business" not in median_interval(np.datetime64("2024-01-01", "s") + jitter)[1]


PERIODS = {
    "1970 Q1": ("1970-01-01", "1970-03-31"), "1970-Q2": ("1970-04-01", "1970-06-30"),
    "1970q4": ("1970-10-01", "1970-12-31"), "Q3 1970": ("1970-07-01", "1970-09-30"),
    "1Q1970": ("1970-01-01", "1970-03-31"), "2020M03": ("2020-03-01", "2020-03-31"),
    "2020-12": ("2020-12-01", "2020-12-31"), "02/2020": ("2020-02-01", "2020-02-29"),
    "Mar 2020": ("2020-03-01", "2020-03-31"), "2020 September": ("2020-09-01", "2020-09-30"),
    "2020-W05": ("2020-01-27", "2020-02-02"), "2020W05-3": ("2020-01-29", "2020-01-29"),
    "2020H2": ("2020-07-01", "2020-12-31"), "2020-01-27/2020-02-02": ("2020-01-27", "2020-02-02"),
}  # fmt: skip


@pytest.mark.parametrize("text", PERIODS)
def test_a_period_begins_with_its_first_day_and_ends_with_its_last(text):
    first, after = span(text)
    assert (str(first), str(after - timedelta(1))) == PERIODS[text]


@pytest.mark.parametrize("text", ["2020-13", "1970Q5", "2021-W53", "Ma 2020", "spring 1970", "2020", "2020-01-31"])
def test_what_is_no_period(text):
    assert span(text) is None


def test_quarters_as_text_are_times_wherever_times_are_given():
    rng = np.random.default_rng(0)
    y, u = rng.standard_normal((2, 8))
    texts = [f"{1970 + k // 4} Q{k % 4 + 1}" for k in range(8)]
    wanted = track(Regression(1), RLS(1.0), y, u, time=np.arange("1970-01", "1972-01", 3, "M8[M]"), dt="quarter")
    frame, index = {"t": texts, "y": y, "u": u}, pd.PeriodIndex([text.replace(" ", "") for text in texts], freq="Q")
    tables = pl.DataFrame(frame), pd.DataFrame(frame), pd.DataFrame(frame | {"t": index})
    runs = [track(Regression(1), RLS(1.0), y, u, time=times, dt="quarter") for times in (texts, index, np.array(texts))]
    runs += [track(Regression(1), RLS(1.0), "y", "u", data=table, time="t", dt="quarter") for table in tables]
    for run in runs:
        np.testing.assert_array_equal(run.time, wanted.time)
        np.testing.assert_array_equal(run.theta, wanted.theta)
    live = Live(Regression(1), RLS(1.0), dt="quarter")
    for t in range(3):
        live.update(y[t], u[t], time=texts[t])
    assert live.theta[0] == wanted.theta[2, 0]
    left = track(Regression(1), RLS(1.0), y, u, time=texts, dt="quarter", exclude=[("1970 Q2", "1970 Q3")])
    assert np.flatnonzero(~left.ok).tolist() == [1, 2]
    for wrong in (["spring 1970", *texts[1:]], [*texts[:7], "1971 Q5"]):
        with pytest.raises(ValueError, match=r"is not a date; write 2024-01-31.*'1970 Q1'"):
            track(Regression(1), RLS(1.0), y, u, time=wrong, dt="quarter")
        with pytest.raises(ValueError, match=r"neither a number nor a date.*'1970 Q1'"):
            track(Regression(1), RLS(1.0), "y", "u", data=pl.DataFrame(frame | {"t": wrong}), time="t", dt="quarter")
