"""Fleets and grids of records with several outputs: tiles, verbs, warnings, settings of each output."""

from copy import copy

import numpy as np
import polars as pl
import pytest
from test_outputs import NAMES, coupled
from test_outputs_everywhere import JOINT, same

from driftfit import ARX, AdaptiveKalman, Fleet, Kalman, Regression, track


@pytest.mark.parametrize("kind", ["joint", "apart", "shared"])
def test_a_fleet_of_several_outputs_runs_in_wide_tiles_and_says_what_each_record_says(kind, tmp_path):
    """Twenty records share tiles of 32 lanes: whatever their lengths, each is the record alone, also after a file."""
    rng = np.random.default_rng(3)
    data = [coupled(int(rng.integers(20, 60)), seed=k) for k in range(20)]
    for y, _ in data:
        y[rng.random(y.shape) < 0.1] = np.nan
    model = {"joint": ARX(1, 1, ny=NAMES), "apart": Regression(1, ny=NAMES), "shared": Regression(1, ny=2, shared=True)}
    columns = {"unit": [k for k, (y, _) in enumerate(data) for _ in y]}
    columns |= {name: np.concatenate([y[:, j] for y, _ in data]) for j, name in enumerate(NAMES)}
    columns |= {"u": np.concatenate([u for _, u in data])}
    inputs = [["u"], ["u"]] if kind == "shared" else "u"
    tracker = Kalman(q=1e-3, r=0.1)
    fleet = track(model[kind], tracker, NAMES, inputs, data=pl.DataFrame(columns), by="unit")
    fleet.save(tmp_path / "fleet")
    again = Fleet.load(tmp_path / "fleet")
    assert list(again) == list(fleet)
    for k, (y, u) in enumerate(data):
        given = np.repeat(u[:, None, None], 2, axis=1) if kind == "shared" else u
        alone = track(model[kind], tracker, y, given)
        for found in (fleet, again, copy(fleet)):
            same(found[k], alone)
    if kind != "shared":
        assert len(fleet) == 40
        np.testing.assert_array_equal(fleet[3, "flow"].theta, fleet[3]["flow"].theta)
        assert fleet.by == ("unit", "output")


def test_verbs_of_a_fleet_of_several_outputs():
    """Summary, picture, forecast, alarms, verdict: all with keys (series, output)."""
    y, u = np.stack([coupled(300, seed=k)[0] for k in range(3)]), np.stack([coupled(300, seed=k)[1] for k in range(3)])
    fleet = track(JOINT, Kalman(q=1e-5, r=0.01), y, u, by="row")
    axes = fleet.plot("b1[flow<-u]").axes
    assert sorted(axis.get_title() for axis in axes) == ["0, flow", "1, flow", "2, flow"]
    drawn = {axis.get_title(): axis.get_lines()[0].get_ydata() for axis in axes}
    np.testing.assert_array_equal(drawn["1, flow"], fleet[1].theta[:, 1, 2])
    assert {unit.key for unit in fleet.summary().units} == set(fleet)
    assert {row.key for row in fleet.verdict().rows} == set(fleet)
    assert {row.key for row in fleet.detect("band", reference=150).rows} == set(fleet)
    ahead = fleet.forecast(2, np.ones(2))
    assert ahead.columns[:2] == ["series", "output"]
    one = ahead.filter((pl.col("series") == 2) & (pl.col("output") == "flow"))
    np.testing.assert_array_equal(one["y_hat"], fleet[2].forecast(2, np.ones(2)).y_hat[:, 1])


def test_a_fleet_of_several_outputs_warns_of_what_it_cannot_learn():
    y, u = coupled(80)
    with pytest.warns(UserWarning, match=r"in 4 of 4 series b1\[level<-u\]"):
        track(ARX(1, 1, ny=NAMES), AdaptiveKalman(), np.stack([y, y]), np.zeros((2, *u.shape)), by="row")


def test_a_grid_of_several_outputs_has_settings_of_each():
    y, u = coupled(60)
    own = {"level": Kalman(q=1e-4, r=0.01), "flow": Kalman(q=1e-2, r=0.01)}
    grid = track(JOINT, [both := Kalman(q=1e-3, r=0.01), own], y, u)
    same(grid[0], track(JOINT, both, y, u))
    same(grid[1], track(JOINT, own, y, u))
    fleet = track(JOINT, [both, own], np.stack([y, y]), np.stack([u, u]), by="row")
    same(fleet[1], grid[1])
