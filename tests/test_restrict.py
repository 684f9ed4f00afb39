"""Valid ranges and intervals to leave out: what is outside is missing, and counted, in every way of running."""

from __future__ import annotations

from datetime import date, datetime

import numpy as np
import pandas as pd
import pytest

from driftfit import ARX, Kalman, Live, Regression, select, track, tune

T = 60
MODEL, TRACKER = ARX(1, 1), Kalman(q=1e-3, r=0.1)
TWO = Regression(["b", "a"])


def signals(seed: int = 0, T: int = T) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=T), rng.normal(size=T)


def holes(y, u, at_y=(), at_u=()) -> tuple[np.ndarray, np.ndarray]:
    """The signals with values missing by hand."""
    y, u = y.copy(), u.copy()
    y[list(at_y)], u[list(at_u)] = np.nan, np.nan
    return y, u


def same(one, other) -> None:
    for name in ("theta", "std", "innovation", "ok", "y", "u"):
        assert np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True), name


@pytest.mark.parametrize("keys", [("y", "u"), ("y", 0), ("y", "u1")])
def test_a_number_outside_its_range_is_missing(keys):
    y, u = signals()
    given = y.copy(), u.copy()
    given[0][[7, 30]], given[1][12], given[1][13] = (9999.0, -999.0), 40.0, np.nan
    before = given[0].copy(), given[1].copy()
    limits = {keys[0]: (-5.0, 5.0), keys[1]: (None, 39.9)}
    run = track(MODEL, TRACKER, *given, limits=limits)
    same(run, track(MODEL, TRACKER, *holes(y, u, [7, 30], [12, 13])))
    assert run.labels.missing == {"of y outside its limits": 2, "of u1 outside its limits": 1}
    assert "2 of y outside its limits, 1 of u1 outside its limits" in str(run.summary())
    for kept, was in zip(given, before, strict=True):
        assert np.array_equal(kept, was, equal_nan=True)  # the user's arrays stay as they are


def test_ranges_include_their_ends_and_zero():
    y, u = np.arange(6.0), np.arange(6.0)
    run = track(MODEL, TRACKER, y, u, limits={"y": (1, 4), "u": (None, None)})
    assert np.flatnonzero(np.isnan(run.y)).tolist() == [0, 5]
    assert not np.isnan(run.u).any()


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"z": (0, 1)}, "there is no signal 'z'"), ({1: (0, 1)}, "there is no signal 1"),
        ({"y": (1, 0)}, "lower limit of"), ({"y": 3}, "must be \\(low, high\\)"), ({"y": ("a", 1)}, "must be"),
        ({"y": (0, float("nan"))}, "lower limit of"),
    ],
)  # fmt: skip
def test_wrong_limits_are_named(limits, message):
    with pytest.raises(ValueError, match=message):
        track(MODEL, TRACKER, *signals(), limits=limits)
    with pytest.raises(ValueError, match=message):
        Live(MODEL, TRACKER, limits=limits)


def test_a_stream_has_the_ranges_of_its_record(tmp_path):
    y, u = signals()
    y[[5, 40]], u[20] = 77.0, -77.0
    limits = {"y": (-5, 5), "u": (-5, 5)}
    record, live = track(MODEL, TRACKER, y, u, limits=limits), Live(MODEL, TRACKER, limits=limits)
    for t in range(T):
        if t == 30:
            live.save(tmp_path / "live.npz")
            live = Live.load(tmp_path / "live.npz")
        if t == 20:
            assert np.isnan(Live(ARX(1, 1, nk=0, start="zero"), TRACKER, limits=limits).predict(u[t])[0])
        live.update(y[t], u[t])
        assert np.array_equal(live.theta, record.theta[t])
    assert live.outside == {"y": 2, "u1": 1}
    assert Live(MODEL, TRACKER).outside == {}


def test_a_fleet_from_a_table():
    y, u = signals()
    parts = []
    for k, key in enumerate("pq"):
        part = pd.DataFrame({"flow": y, "valve": u, "t": pd.date_range("2024-03-01", periods=T, freq="h"), "pump": key})
        part.loc[10 + k, "flow"] = 500.0
        parts.append(part)
    table = pd.concat(parts).sample(frac=1.0, random_state=0)
    signs = {"data": table, "time": "t", "dt": "1h", "limits": {"flow": (0 - 5, 80)}}
    fleet = track(MODEL, TRACKER, "flow", "valve", by="pump", exclude=[("2024-03-02", "2024-03-02")], **signs)
    day = range(24, 48)
    same(fleet["p"], track(MODEL, TRACKER, *holes(y, u, [10, *day], day)))
    same(fleet["q"], track(MODEL, TRACKER, *holes(y, u, [11, *day], day)))
    assert fleet["q"].labels.missing == {"of flow outside its limits": 1, "excluded": 24}
    assert "2 of flow outside its limits, 48 excluded" in str(fleet.summary())
    each = track(MODEL, TRACKER, "flow", "valve", by="pump", exclude={"q": [("2024-03-02", None)]}, **signs)
    same(each["p"], track(MODEL, TRACKER, *holes(y, u, [10])))
    same(each["q"], track(MODEL, TRACKER, *holes(y, u, [11, *range(24, T)], range(24, T))))
    with pytest.raises(ValueError, match="there is no series 'r'"):
        track(MODEL, TRACKER, "flow", "valve", by="pump", exclude={"r": [(None, None)]}, **signs)


def test_rows_and_grids():
    y, u = signals()
    limits = {"y": (-1.0, 1.0)}
    out = np.abs(y) > 1.0
    alone = track(MODEL, TRACKER, *holes(y, u, [*np.flatnonzero(out), 4, 5], [4, 5]))
    rows = track(MODEL, TRACKER, np.stack([y, y]), np.stack([u, u]), by="row", limits=limits, exclude=[(4, 5)])
    grid = track(MODEL, [TRACKER, TRACKER], y, u, limits=limits, exclude=[(4, 5)])
    for fleet in (rows, grid):
        for key in (0, 1):
            same(fleet[key], alone)
            assert fleet[key].labels.missing["excluded"] == 2


ENDS = {
    "numbers": (None, (10, 19), range(10, 20)),
    "open": (None, (None, 3), range(4)),
    "times": (2.0 * np.arange(T), (20.0, 38.5), range(10, 20)),
    "text": (2.0 * np.arange(T), ("20", "39"), range(10, 20)),
    "dates": ("h", ("2024-03-01 10:00", "2024-03-01T19:00"), range(10, 20)),
    "days": ("h", (date(2024, 3, 2), date(2024, 3, 2)), range(24, 48)),
    "days of numpy": ("h", (np.datetime64("2024-03-02"), np.datetime64("2024-03-02")), range(24, 48)),
    "months": ("h", ("2024-03", "2024-03"), range(T)),
    "text with a zone": ("h", ("2024-03-02T00:00:00Z", "2024-03-02 04:00+01:00"), range(24, 28)),
    "datetimes": ("h", (datetime(2024, 3, 2), datetime(2024, 3, 2, 3)), range(24, 28)),
    "stamps": ("h", (pd.Timestamp("2024-03-02"), pd.Timestamp("2024-03-02 03:00")), range(24, 28)),
}


@pytest.mark.parametrize("kind", ENDS)
def test_an_interval_is_left_out(kind):
    time, interval, rows = ENDS[kind]
    y, u = signals()
    axis = pd.date_range("2024-03-01", periods=T, freq="h").to_numpy() if isinstance(time, str) else time
    more = {} if axis is None else {"time": axis, "dt": "1h" if isinstance(time, str) else 2}
    run = track(MODEL, TRACKER, y, u, exclude=[interval], **more)
    same(run, track(MODEL, TRACKER, *holes(y, u, rows, rows), **more))
    assert run.labels.missing == {"excluded": len(rows)}
    # nothing of the interval reaches a lag, so the sample after it is skipped as well
    after = [t for t in (rows[-1] + 1,) if t < T]
    assert not run.ok[[*rows, *after]].any()
    wild = y.copy()
    wild[list(rows)] = 1e6
    same(track(MODEL, TRACKER, wild, u, exclude=[interval], **more), run)


def test_dates_without_a_zone_are_in_that_of_the_table():
    y, u = signals()
    table = pd.DataFrame({"y": y, "u": u, "t": pd.date_range("2024-03-01", periods=T, freq="h", tz="Asia/Tokyo")})
    for interval in (
        ("2024-03-02", "2024-03-02"),
        (datetime(2024, 3, 2), pd.Timestamp("2024-03-02 14:59", tz="UTC")),
    ):
        run = track(MODEL, TRACKER, "y", "u", data=table, time="t", dt="1h", exclude=[interval])
        assert np.flatnonzero(np.isnan(run.u[:, 0])).tolist() == list(range(24, 48))


@pytest.mark.parametrize(
    ("exclude", "message"),
    [
        ([(5, 3)], "must not end before"), ((3, 5), "each interval must be"), (["ab"], "each interval must be"),
        ([("x", 5)], "must be a number"), ([(1, 2, 3)], "each interval must be"),
    ],
)  # fmt: skip
def test_wrong_intervals_are_named(exclude, message):
    with pytest.raises(ValueError, match=message):
        track(MODEL, TRACKER, *signals(), exclude=exclude)


def test_several_outputs_shared_or_not():
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=(T, 2)), rng.normal(size=(T, 2))
    wild, clean = y.copy(), y.copy()
    wild[9, 1], clean[9, 1] = 50.0, np.nan
    clean[20:26] = np.nan
    gone = u.copy()
    gone[20:26] = np.nan
    model = Regression(["b", "a"], ny=["one", "two"])
    limits = {"two": (-10, 10)}
    run = track(model, TRACKER, wild, u, limits=limits, exclude=[(20, 25)])
    same(run, track(model, TRACKER, clean, gone))
    assert run["two"].labels.missing == {"of two outside its limits": 1, "excluded": 6}
    assert run["one"].labels.missing == {"excluded": 6}
    live = Live(model, TRACKER, limits=limits)
    for t in range(20):
        live.update(wild[t], u[t])
    assert np.array_equal(live.theta, run.theta[19])
    assert live.outside == {"two": 1}
    both = Regression(2, ny=["one", "two"], shared=True)
    rows, hole = np.stack([u, u[:, ::-1]], axis=1), np.stack([gone, gone[:, ::-1]], axis=1)
    shared = track(both, TRACKER, wild, rows, limits=limits, exclude=[(20, 25)])
    same(shared, track(both, TRACKER, clean, hole))
    assert shared.rows.labels.missing["excluded"] == 6


def test_tune_and_select():
    y, u = signals(1, 150)
    wild = y.copy()
    wild[[30, 90]] = 9999.0
    given = {"limits": {"y": (-10, 10)}, "exclude": [(100, 109)]}
    y, u_with_holes = holes(y, u, [30, 90, *range(100, 110)], range(100, 110))
    assert tune(MODEL, Kalman(r=0.1), wild, u, **given).tracker == tune(MODEL, Kalman(r=0.1), y, u_with_holes).tracker
    one = select([MODEL, ARX(2, 1)], wild, u, tracker=TRACKER, **given)
    assert one.rows == select([MODEL, ARX(2, 1)], y, u_with_holes, tracker=TRACKER).rows
