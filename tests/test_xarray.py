"""Results as xarray datasets."""

import re
import sys

import numpy as np
import pytest

from driftfit import RLS, Regression, track


def test_without_xarray_the_message_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "xarray", None)
    run = track(Regression(1), RLS(1.0), np.arange(9.0), np.ones(9))
    with pytest.raises(ImportError, match=re.escape('pip install "driftfit[xarray]"')):
        run.to_xarray()


def test_a_track_and_a_fleet():
    pytest.importorskip("xarray", reason="xarray is not installed")
    rng = np.random.default_rng(0)
    u = rng.normal(size=(40, 2))
    y = u @ [1.0, 2.0] + 0.1 * rng.normal(size=40)
    time = np.datetime64("2024-01-01") + np.arange(40) * np.timedelta64(1, "D")
    run = track(Regression(["a", "b"]), RLS(1.0), y, u, time=time, dt="1d")
    found = run.to_xarray()
    assert found.theta.sel(parameter="b", time="2024-02-09").item() == run.theta[-1, 1]
    np.testing.assert_array_equal(found.theta_std, run.std)
    assert dict(found.sizes) == {"time": 40, "parameter": 2, "input": 2}
    fleet = track(Regression(2), RLS(1.0), np.stack([y, 2 * y]), np.stack([u, u]), by="row")
    many = fleet.to_xarray()
    assert dict(many.sizes) == {"unit": 2, "sample": 40, "parameter": 2, "input": 2}
    np.testing.assert_array_equal(many.theta[1], fleet[1].theta)


def test_several_outputs():
    pytest.importorskip("xarray", reason="xarray is not installed")
    rng = np.random.default_rng(0)
    y, u = rng.normal(size=(40, 2)), rng.normal(size=(40, 2, 1))
    shared = track(Regression(1, ny=2, shared=True), RLS(1.0), y, u)
    found = shared.to_xarray()
    assert dict(found.sizes) == {"sample": 40, "parameter": 1, "output": 2, "input": 1}
    np.testing.assert_array_equal(found.innovation.sel(output="y2"), shared.innovation[:, 1])
    each = track(Regression(1, ny=2), RLS(1.0), y, u[:, 0]).to_xarray()
    assert each.sizes["output"] == 2
