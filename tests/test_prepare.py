"""Preparation: its steps are recorded, can be undone exactly, and never look ahead."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from driftfit import ARX, Kalman, Regression, prepare, track


def record(T: int = 400, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = np.zeros(T + 1)
    for t in range(1, T + 1):
        u[t] = 0.9 * u[t - 1] + rng.normal()
    y = np.zeros(T)
    for t in range(1, T):
        y[t] = 0.7 * y[t - 1] + 3.0 * u[t] + 0.1 * rng.normal()
    return y, u[1:]


@pytest.mark.parametrize(
    "step",
    [
        prepare.remove_level,
        lambda x: prepare.remove_level(x, first=50),
        lambda x: prepare.remove_level(x, level=20.0),
        lambda x: prepare.remove_trend(x, first=50),
        lambda x: prepare.scale(x, first=50),
        lambda x: prepare.scale(x, by=7.0),
        lambda x: prepare.scale(
            prepare.remove_trend(prepare.scale(prepare.remove_level(x), by=2), first=100), first=90
        ),
    ],
)
def test_what_was_done_is_noted_and_undone(step):
    raw = 20.0 + 3.0 * np.random.default_rng(0).normal(size=300)
    raw[7] = np.nan
    done = step(raw)
    assert done.notes
    assert not np.allclose(done.values, raw, equal_nan=True)
    np.testing.assert_allclose(done.raw(done.values), raw)
    assert np.array_equal(np.asarray(done), done.values, equal_nan=True)


def test_levels_and_trends():
    line = 5.0 + 0.5 * np.arange(100)
    assert np.allclose(prepare.remove_trend(line, first=10).values, 0.0)
    assert np.allclose(prepare.remove_level(line, first=1).values, line - 5.0)
    assert np.isclose(prepare.scale(line, first=100).values.std(), 1.0)
    means = np.array([0.0, *(line[:t].mean() for t in range(1, 100))])
    assert np.allclose(prepare.remove_level(line).values, line - means)


@pytest.mark.parametrize(
    "step", [prepare.remove_level, lambda x: prepare.remove_level(x, 50), lambda x: prepare.remove_trend(x, 50)]
)
def test_nothing_looks_ahead(step):
    raw = np.random.default_rng(1).normal(size=200)
    other = raw.copy()
    other[120:] += 50.0
    assert np.array_equal(step(raw).values[:120], step(other).values[:120])


def test_results_come_back_in_the_users_units():
    y, u = record()
    raw_y, raw_u = 1000.0 + 40.0 * y, 5.0 + 0.01 * u
    flow = prepare.scale(prepare.remove_level(raw_y, level=1000.0), by=40.0)
    valve = prepare.scale(prepare.remove_level(raw_u, level=5.0), by=0.01)
    model = ARX(1, 1, intercept=True)
    run = track(model, Kalman(q=1e-4, r=0.01), flow, valve)
    result = prepare.restore(run, flow, valve)
    assert np.allclose(result.factors, [1.0, 4000.0, 40.0])
    assert np.isclose(result.theta[-1, 1], 3.0 * 4000.0, rtol=0.05)
    assert np.allclose(result.std[-1], run.std[-1] * result.factors)
    ok = run.ok
    assert np.allclose((result.prediction + result.innovation)[ok], raw_y[ok])
    assert result.notes["y"] == ("level 1000 removed", "divided by 40")
    two = track(Regression(2), Kalman(q=0, r=1), flow, np.stack([valve, valve], axis=1))
    assert np.allclose(prepare.restore(two, flow, [valve, u]).factors, [4000.0, 40.0])


def test_restore_refuses_what_it_cannot_know():
    y, u = record()
    run = track(ARX(1, 1), Kalman(q=0, r=1), y, u)
    with pytest.raises(ValueError, match="the model has 1 inputs, but 2 were given"):
        prepare.restore(run, y, [u, u])


def test_resampling_uses_what_lies_before():
    time = np.array([0.0, 0.4, 1.0, 1.2, 4.0])
    values = np.array([[1.0, 1.0], [2.0, 2.0], [4.0, np.nan], [8.0, 8.0], [16.0, np.nan]])
    grid = prepare.resample(time, values, 1.0)
    assert np.array_equal(grid.time, [0.0, 1.0, 2.0, 3.0, 4.0])
    assert np.array_equal(grid.values[:, 0], [1.0, 3.0, 8.0, np.nan, 16.0], equal_nan=True)
    assert np.array_equal(grid.values[:, 1], [1.0, 2.0, 8.0, np.nan, np.nan], equal_nan=True)
    assert np.array_equal(grid.samples, [1, 2, 1, 0, 1])
    last = prepare.resample(time, values, 1.0, how="last")
    assert np.array_equal(last.values[:, 0], [1.0, 4.0, 8.0, np.nan, 16.0], equal_nan=True)
    dates = np.datetime64("2024-01-01", "s") + (time * 10).astype("timedelta64[s]")
    assert np.array_equal(
        prepare.resample(dates, values[:, 0], np.timedelta64(10, "s")).values, grid.values[:, 0], equal_nan=True
    )
    with pytest.raises(ValueError, match="time must increase"):
        prepare.resample(time[::-1], values, 1.0)
    same = prepare.resample(pd.Series(dates), values[:, 0], "10s")
    assert np.array_equal(same.time, prepare.resample(dates, values[:, 0], np.timedelta64(10, "s")).time)
    with pytest.raises(ValueError, match="fixed interval"):
        prepare.resample(dates, values[:, 0], "month")


@pytest.mark.parametrize("lag", [0, 1, 7])
def test_delay_is_found_through_a_slow_input(lag):
    y, u = record(T=800)
    shifted = np.concatenate([np.zeros(lag), y[: len(y) - lag]])
    found = prepare.delay(shifted, np.concatenate([[0.0], u[:-1]]), max_lag=20)
    assert found.samples == lag
    assert abs(found.correlation) > 3.0 * found.bound
    noise = np.random.default_rng(5).normal(size=800)
    assert abs(prepare.delay(noise, u, max_lag=20).correlation) < 3.0 * found.bound
    with pytest.raises(ValueError, match="30 samples are too few"):
        prepare.delay(y[:30], u[:30])


def test_a_closed_loop_is_warned_of_and_an_open_one_is_not():
    y, u = record()
    assert prepare.feedback(y, u).probability > 0.001
    rng = np.random.default_rng(2)
    y, u = np.zeros(400), np.zeros(400)
    for t in range(1, 400):
        y[t] = 0.9 * y[t - 1] + u[t - 1] + rng.normal()
        u[t] = -0.5 * y[t - 1] + 0.5 * rng.normal()
    with pytest.warns(UserWarning, match=r"the past of y predicts u \(F = "):
        assert prepare.feedback(y, u).probability < 1e-6


def test_what_cannot_be_prepared():
    with pytest.raises(ValueError, match="the first 2 samples contain no value"):
        prepare.remove_level([np.nan, np.nan, 1.0], first=2)
    with pytest.raises(ValueError, match="a scale must be positive; got 0"):
        prepare.scale(np.ones(5), first=5)
    with pytest.raises(ValueError, match="give either by="):
        prepare.scale(np.ones(5))
    with pytest.raises(ValueError, match="a trend needs two values"):
        prepare.remove_trend([1.0, np.nan, 2.0], first=2)
    with pytest.raises(ValueError, match=r"a signal is \(T,\), not empty"):
        prepare.scale(np.ones((2, 2)), by=1)
    with pytest.raises(ValueError, match="7 samples are too few for 5 lags"):
        prepare.feedback([1.0, 2.0, 3.0, 1.0, 2.0, 3.0, 1.0], [1.0, 2.0, 3.0, 1.0, 2.0, 3.0, 1.0])
