"""Fleets: every lane gives, bit for bit, the results of its series alone."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from time import sleep

import numpy as np
import polars as pl
import pytest

from driftfit import ARX, RLS, AugmentedFLS, Kalman, Track, track
from driftfit.data.record import Known, Records
from driftfit.judge import on_all_cores
from driftfit.run import parallel_lanes
from driftfit.run.fleet import run_fleet
from driftfit.run.program import Program

KALMAN = Kalman(q=1e-3, r=0.1)
MODEL = ARX(1, 1)


def rows(units: int, T: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Records of first-order systems whose gain wanders, a tenth of the outputs and some inputs missing."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(units, T))
    gain = 1.0 + np.cumsum(0.05 * rng.normal(size=(units, T)), axis=1)
    y = np.zeros((units, T))
    for t in range(1, T):
        y[:, t] = 0.7 * y[:, t - 1] + gain[:, t] * u[:, t - 1] + 0.1 * rng.normal(size=units)
    y[rng.random((units, T)) < 0.1] = np.nan
    u[rng.random((units, T)) < 0.02] = np.inf
    return y, u


def assert_same(one: Track, other: Track) -> None:
    for name in one.stores():
        assert np.array_equal(one.written(name), other.written(name), equal_nan=True), name
    for name, value in one.state.items():
        assert np.array_equal(value, other.state[name], equal_nan=True), name
    assert one.loglik == other.loglik or not one.tracker.covariance


def test_series_of_unequal_length_end_in_the_state_they_had_alone():
    y, u = rows(40, 600, seed=1)
    length = np.random.default_rng(2).integers(1, 600, 40)
    length[:3] = 600, 256, 1  # the longest, a whole block, one sample
    records = Records(tuple(range(40)), np.arange(40) * 600, length, y.ravel(), u.reshape(-1, 1), Known.of())
    fleet = run_fleet([Program(MODEL.bind(1), KALMAN)] * 40, records)
    for key in range(40):
        assert len(fleet[key]) == length[key]
        assert_same(fleet[key], track(MODEL, KALMAN, y[key, : length[key]], u[key, : length[key]]))


def test_times_weights_and_drift_per_row():
    y, u = rows(12, 200, seed=3)
    rng = np.random.default_rng(4)
    time = np.cumsum(rng.choice([1.0, 1.0, 2.0], (12, 200)), axis=1)
    weights, drift = rng.choice([0.0, 1.0, 2.0], (12, 200)), rng.choice([1.0, 50.0], (12, 200))
    fleet = track(MODEL, KALMAN, y, u, by="row", time=time, weights=weights, drift=drift)
    shared = track(MODEL, KALMAN, y, u, by="row", time=time[0])
    for key in (0, 11):
        alone = track(MODEL, KALMAN, y[key], u[key], time=time[key], weights=weights[key], drift=drift[key])
        assert_same(fleet[key], alone)
        assert_same(shared[key], track(MODEL, KALMAN, y[key], u[key], time=time[0]))
        assert np.array_equal(fleet[key].time, time[key])


def test_a_list_of_trackers_is_a_grid_over_one_series():
    y, u = rows(1, 300, seed=5)
    grid = [Kalman(q=10.0**-k, r=0.1) for k in range(11)] + [RLS(0.9), RLS(0.99)]
    fleet = track(MODEL, grid, y[0], u[0])
    assert list(fleet) == list(range(13))
    for key, tracker in enumerate(grid):
        assert fleet[key].tracker == tracker
        assert_same(fleet[key], track(MODEL, tracker, y[0], u[0]))
    named = track(MODEL, {"slow": KALMAN, "fast": replace(KALMAN, q=1.0)}, y[0], u[0])
    assert_same(named["slow"], track(MODEL, KALMAN, y[0], u[0]))


def test_settings_per_series():
    y, u = rows(12, 200, seed=6)
    own = [replace(KALMAN, r=0.1 + k) for k in range(12)]
    fleet = track(MODEL, own, y, u, by="row")
    for key in (0, 5, 11):
        assert_same(fleet[key], track(MODEL, own[key], y[key], u[key]))
    with pytest.raises(ValueError, match="11 trackers were given for 12 series"):
        track(MODEL, own[:11], y, u, by="row")
    with pytest.raises(ValueError, match="missing for 1 of 12 series, such as 11"):
        track(MODEL, dict(enumerate(own[:11])), y, u, by="row")


def test_covariances_and_replay_are_those_of_the_series():
    y, u = rows(12, 100, seed=7)
    kept = track(MODEL, KALMAN, y, u, by="row", keep="cov")
    plain = track(MODEL, KALMAN, y, u, by="row")
    alone = track(MODEL, KALMAN, y[7], u[7])
    assert np.array_equal(kept[7].cov(50), alone.cov(50))
    assert np.array_equal(plain[7].cov(50), alone.cov(50))


def test_a_fleet_loads_and_saves_one_series(tmp_path):
    y, u = rows(12, 100, seed=8)
    run = track(MODEL, KALMAN, y, u, by="row")[3]
    run.save(tmp_path / "run.npz")
    assert_same(Track.load(tmp_path / "run.npz"), run)


def test_smoothed_paths_are_those_of_each_series(monkeypatch):
    """By threads, and by processes where it takes longer."""
    y, u = rows(8, 60, seed=9)
    fleet = track(MODEL, KALMAN, y, u, by="row")
    for worth in (on_all_cores.WORTH, 0.0):
        monkeypatch.setattr(on_all_cores, "WORTH", worth)
        found = fleet.smooth()
        assert found.columns == ["series", "sample", "theta_a1", "std_a1", "theta_b1", "std_b1"]
        for key, run in fleet.items():
            smoothed, own = run.smooth(), found.filter(pl.col("series") == key)
            for i, name in enumerate(run.names):
                assert (own[f"theta_{name}"].to_numpy() == smoothed.theta[:, i]).all()
                assert (own[f"std_{name}"].to_numpy() == smoothed.std[:, i]).all()


def test_mapping():
    y, u = rows(12, 50, seed=9)
    fleet = track(MODEL, KALMAN, y, u, by="row")
    assert list(fleet.keys()) == list(range(12))
    assert 5 in fleet
    assert 12 not in fleet
    with pytest.raises(KeyError, match=r"the fleet has no 'five'; it has 12 keys: 0, 1, 2, 3, 4, \.\.\."):
        fleet["five"]
    assert fleet.stack("theta").shape == (12, 50, 2)
    assert np.array_equal(fleet.stack("prediction")[4], fleet[4].prediction, equal_nan=True)
    assert "Fleet of 12 series, 600 samples" in repr(fleet)


def test_an_interrupt_keeps_what_is_finished(monkeypatch):
    y, u = rows(70, 50, seed=10)
    begun = []

    class SlowAfterTheFirst(ThreadPoolExecutor):
        def submit(self, work, *arguments):
            begun.append(work)
            wait = 0.2 if len(begun) > 1 else 0.0
            return super().submit(lambda: (sleep(wait), work(*arguments)))

    def interrupted(waiting):
        yield next(iter(as_completed(waiting)))
        raise KeyboardInterrupt

    monkeypatch.setattr(parallel_lanes, "ThreadPoolExecutor", SlowAfterTheFirst)
    monkeypatch.setattr(parallel_lanes, "as_completed", interrupted)
    monkeypatch.setattr(parallel_lanes, "cores", lambda: 1)
    with pytest.warns(UserWarning, match=r"interrupted: \d+ of 70 series are finished"):
        fleet = track(MODEL, KALMAN, y, u, by="row")
    assert fleet.failed
    assert fleet.keys() | fleet.failed.keys() == set(range(70))
    for key in fleet:
        assert_same(fleet[key], track(MODEL, KALMAN, y[key], u[key]))
    with pytest.raises(KeyError, match="has no result: interrupted"):
        fleet[next(iter(fleet.failed))]


def test_shapes_are_named():
    y, u = rows(12, 50, seed=11)
    with pytest.raises(ValueError, match=r"y must be \(units, T\), not empty; got shape \(50,\)"):
        track(MODEL, KALMAN, y[0], u[0], by="row")
    with pytest.raises(ValueError, match=r"u must be \(12, 50\) or \(12, 50, m\); got shape \(50, 12\)"):
        track(MODEL, KALMAN, y, u.T, by="row")
    with pytest.raises(ValueError, match=r"time must be \(50,\) or \(12, 50\); got shape \(12, 2\)"):
        track(MODEL, KALMAN, y, u, by="row", time=np.zeros((12, 2)))
    with pytest.raises(ValueError, match=r"weights must be a number, \(50,\) or \(12, 50\); got shape \(2, 2\)"):
        track(MODEL, KALMAN, y, u, by="row", weights=np.ones((2, 2)))
    with pytest.raises(ValueError, match="carries no covariance to keep"):
        track(MODEL, AugmentedFLS(1.0), y, u, by="row", keep="cov")


def test_a_fleet_that_continues_none_of_its_series_says_so(tmp_path):
    """Keys that were numbers and are text now would all start from the beginning, unnoticed."""
    y, u = rows(2, 60)
    signals = {"y": y.ravel(), "u": u.ravel()}
    before, after = (pl.DataFrame(signals | {"k": np.repeat(keys, 60)}) for keys in ([7, 8], ["7", "8"]))
    first = track(MODEL, KALMAN, "y", "u", data=before, by="k")
    with pytest.warns(UserWarning, match="all series start from the beginning.* '7' here and 7 there"):
        track(MODEL, KALMAN, "y", "u", data=after, by="k", warm_start=first)
    absent = tmp_path / "absent" / "fleet.npz"
    with pytest.raises(FileNotFoundError, match=re.escape(str(absent))):
        first.save(absent)
