"""First passage of a limit, against paths that are drawn, and forecasts of fleets."""

from __future__ import annotations

from datetime import timedelta

import numpy as np
import pandas as pd
import polars as pl
import pytest

from driftfit import ARX, FLS, AugmentedFLS, Kalman, Regression, track

T, Q, R = 60, 1e-3, 0.1
TRACKER = Kalman(q=Q, r=R)


def record(seed: int = 0, T: int = T) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(T, 2))
    theta = np.array([3.0, 1.0]) + np.cumsum(np.sqrt(Q) * rng.normal(size=(T, 2)), axis=0)
    return np.sum(theta * u, axis=1) + np.sqrt(R) * rng.normal(size=T), u


def passed(start, walk, limit: float, h: int, sub: int) -> np.ndarray:
    """Share of drawn paths that have fallen below a limit by each sample, looked at ``sub`` times a sample."""
    rng = np.random.default_rng(1)
    x = start[0] + start[1] * rng.normal(size=20000)
    beyond = x <= limit
    by = [beyond.mean()]
    for _ in range(h):
        for _ in range(sub):
            x += walk / np.sqrt(sub) * rng.normal(size=len(x))
            beyond |= x <= limit
        by.append(beyond.mean())
    return np.array(by)


@pytest.mark.parametrize("away", [0.0, 0.05, 0.3, -0.2])
def test_a_random_walk_passes_as_paths_do(away):
    y, u = record()
    run = track(Regression(["gain", "other"]), TRACKER, y, u)
    limit = run.theta[-1, 0] - away
    found = run.crossing("gain", below=limit, horizon=40)
    drawn = passed((run.theta[-1, 0], run.std[-1, 0]), np.sqrt(Q), limit, 40, 30)
    assert np.abs(found.by - drawn).max() < 0.025
    assert abs(found.by[0] - drawn[0]) < 0.01
    # the same above, mirrored
    mirrored = track(Regression(["gain", "other"]), TRACKER, -y, u).crossing("gain", above=-limit, horizon=40)
    assert np.allclose(mirrored.by, found.by, rtol=1e-9)


def test_a_path_that_is_looked_at_once_a_sample_passes_as_if_the_limit_were_farther():
    y, u = record()
    run = track(Regression(["gain", "other"]), TRACKER, y, u)
    limit = run.theta[-1, 0] - 0.3
    farther = run.crossing("gain", below=limit - 0.5826 * np.sqrt(Q), horizon=40).by
    drawn = passed((run.theta[-1, 0], run.std[-1, 0]), np.sqrt(Q), limit, 40, 1)
    assert np.abs(farther - drawn).max() < 0.015


def test_crossings_of_a_known_start_and_of_constant_parameters():
    y, u = record()
    known = track(Regression(2), Kalman(q=Q, r=R, theta0=[3.0, 1.0], p0=0.0), y[:1], u[:1] * 0.0)
    start = np.sqrt(Q)  # the first sample is preceded by one step
    by = known.crossing("theta1", below=2.5, horizon=5).by
    assert np.abs(by - passed((3.0, start), np.sqrt(Q), 2.5, 5, 1)).max() < 0.01
    still = track(Regression(2), Kalman(q=0.0, r=R), y, u)
    found = still.crossing("theta1", below=float(still.theta[-1, 0] - still.std[-1, 0]), horizon=30)
    assert np.allclose(found.by, 0.15865525)
    assert found.median == np.inf
    assert found.low == 0.0  # 5 % were beyond already


def test_quantiles_times_and_text():
    y, u = record()
    days = pd.date_range("2024-01-01", periods=T, freq="B", tz="Europe/Berlin")
    run = track(Regression(["gain", "other"]), TRACKER, y, u, time=days, dt="business day")
    found = run.crossing("gain", below=2.7, horizon=500, level=0.8)
    for p, q in ((0.1, found.low), (0.5, found.median), (0.9, found.high)):
        assert found.quantile(p) == q
        if np.isfinite(q) and q > 0:
            assert found.by[int(q) - 1] < p <= found.by[int(q)]
    assert found.probability == found.by[-1]
    assert len(found.times) == 500
    assert found.time(1) == np.datetime64("2024-03-24T23:00")  # Monday 25 March in Berlin
    assert "gain below 2.7 within 500 samples: probability" in str(found)
    assert "CE" in str(found)
    assert track(Regression(["gain", "other"]), TRACKER, y, u).crossing("gain", below=2.7).times is None
    assert run.crossing("gain", below=2.7).horizon == T


def test_a_slope_carries_the_parameter_over_the_limit():
    rng = np.random.default_rng(3)
    u = np.ones((80, 1))
    level = 5.0 - 0.02 * np.arange(80)
    run = track(Regression(["level"]), FLS(1e6, differences=2), level + 0.05 * rng.normal(size=80), u)
    found = run.crossing("level", below=3.0, horizon=60)
    assert found.probability > 0.95
    assert abs(found.median - 20.0) < 4.0
    assert found.low < found.median < found.high
    assert run.crossing("level", above=8.0, horizon=60).probability < 0.05


def test_the_output_passes_as_its_forecast_says():
    rng = np.random.default_rng(4)
    T = 200
    u, y = rng.normal(size=T), np.zeros(T)
    for t in range(1, T):
        y[t] = 0.7 * y[t - 1] + u[t - 1] + 0.3 * rng.normal()
    run = track(ARX(1, 1), Kalman(q=1e-4, r=0.09), y, u)
    later = np.concatenate([np.zeros(5), np.ones(25)])
    found = run.crossing("y", above=3.0, u=later)
    ahead = run.forecast(30, later)
    assert found.by[5] < 0.02
    assert found.by[0] == 0.0
    assert found.probability > 0.8
    assert found.probability >= np.mean(rng.normal(ahead.y_hat[-1], ahead.y_std[-1], 4000) > 3.0)
    with pytest.raises(ValueError, match="depends on 1 inputs"):
        run.crossing("y", above=3.0)


@pytest.mark.parametrize(
    ("tracker", "arguments", "message"),
    [
        (TRACKER, {"what": "gains", "below": 1.0}, "there is no 'gains'; did you mean gain"),
        (TRACKER, {"what": "gain"}, "give one limit"),
        (TRACKER, {"what": "gain", "below": 1.0, "above": 2.0}, "give one limit"),
        (TRACKER, {"what": "gain", "below": np.nan}, "is not finite"),
        (TRACKER, {"what": "gain", "below": 1.0, "level": 2.0}, "level must be"),
        (AugmentedFLS(10.0), {"what": "gain", "below": 1.0}, "AugmentedFLS carries no covariance"),
    ],
)
def test_what_cannot_be_asked(tracker, arguments, message):
    y, u = record()
    with pytest.raises(ValueError, match=message):
        track(Regression(["gain", "other"]), tracker, y, u).crossing(**arguments)


def test_what_is_not_known_yet():
    y, u = record()
    with pytest.raises(ValueError, match="is not determined yet"):
        track(Regression(["gain", "other"]), TRACKER, y[:1], u[:1]).crossing("gain", below=1.0)


def fleet_of(tracker=TRACKER):
    """Three pumps whose gains are 3, 2 and 1 less wear, hourly in Tokyo."""
    parts = []
    for k, key in enumerate("pqr"):
        y, u = record(k)
        time = pd.date_range("2024-03-01", periods=T - k, freq="h", tz="Asia/Tokyo")
        y = y - k * u[:, 0]
        parts.append(pd.DataFrame({"y": y[: T - k], "a": u[: T - k, 0], "b": u[: T - k, 1], "t": time, "pump": key}))
    return track(
        Regression(), tracker, "y", ["a", "b"], data=pd.concat(parts), time="t", by="pump", dt=timedelta(hours=1)
    )


def test_forecasts_of_a_fleet_are_one_table():
    fleet = fleet_of()
    inputs = {"p": np.ones((4, 2)), "q": np.zeros((4, 2))}
    table = fleet.forecast(4, inputs)
    assert table.columns == [
        "pump",
        "step",
        "t",
        "y_hat",
        "y_std",
        "low",
        "high",
        "theta_a",
        "std_a",
        "theta_b",
        "std_b",
    ]
    assert table.height == 12
    alone = fleet["q"].forecast(4, inputs["q"])
    part = table.filter(pl.col("pump") == "q")
    assert np.array_equal(part["y_std"].to_numpy(), alone.y_std)
    assert np.array_equal(part["std_b"].to_numpy(), alone.std[:, 1])
    assert str(part["t"][0]) == "2024-03-03 11:00:00+09:00"
    assert table.filter(pl.col("pump") == "r")["y_hat"].is_nan().all()


def test_crossings_of_a_fleet_come_first_on_top():
    fleet = fleet_of()
    table = fleet.crossing("a", below=0.5, horizon=2000)
    assert table["pump"].to_list() == ["r", "q", "p"]
    one = fleet["r"].crossing("a", below=0.5, horizon=2000)
    assert table.row(0)[:3] == ("r", one.probability, one.median)
    assert (table["low"] <= table["median"]).all()
    assert table.columns[:4] == ["pump", "probability", "median", "median_time"]
    first = fleet["r"].time[-1] + int(one.median) * np.timedelta64(1, "h")
    assert table["median_time"].dtype == pl.Datetime("us", "Asia/Tokyo")
    assert table["median_time"].dt.convert_time_zone("UTC").dt.replace_time_zone(None).to_numpy()[0] == first
    assert fleet.crossing("a", below=-50.0, horizon=20)["median_time"].is_null().all()
    each = fleet.crossing("a", below={"p": 3.5, "q": 1.0, "r": -5.0}, horizon=100)
    assert each["pump"][0] == "p"
    assert each["median"][0] == 0.0


def test_a_series_that_determines_nothing_is_the_last_of_its_fleet():
    """One dead meter in five hundred must not hide when the others will cross."""
    rng = np.random.default_rng(0)
    u = 1.0 + rng.random((3, 80))
    y = 3.0 * u + 0.1 * rng.normal(size=u.shape)
    y[1] = np.nan
    fleet = track(Regression(["gain"]), TRACKER, y, u, by="row")
    table = fleet.crossing("gain", below=2.5, horizon=20)
    assert table[fleet.by[0]].to_list()[-1] == 1
    assert table.row(2)[1:] == pytest.approx((np.nan,) * 4, nan_ok=True)
    assert table["probability"][0] == fleet[table[fleet.by[0]][0]].crossing("gain", below=2.5, horizon=20).probability


def test_the_keys_of_a_mapping_are_those_of_series():
    fleet = fleet_of()
    with pytest.raises(ValueError, match=r"below has no 'r', but the key 'R', which no series has; give one for all"):
        fleet.crossing("a", below={"p": 3.5, "q": 1.0, "R": -5.0}, horizon=10)
    with pytest.raises(ValueError, match=r"u has no 'p', but the key 'P', which no series has"):
        fleet.forecast(2, {"P": np.ones((2, 2)), "q": np.ones((2, 2))})
    every = {key: np.ones((2, 2)) for key in "pqrs"}  # one more does no harm
    assert fleet.forecast(2, every)["y_hat"].is_not_nan().all()
