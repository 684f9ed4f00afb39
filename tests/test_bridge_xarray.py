"""Results as xarray datasets."""

import numpy as np
import pytest

from driftfit import RLS, Regression, track

pytest.importorskip("xarray", reason="xarray is not installed")

from driftfit.bridges.xarray import to_xarray


def test_a_track_and_a_fleet():
    rng = np.random.default_rng(0)
    u = rng.normal(size=(40, 2))
    y = u @ [1.0, 2.0] + 0.1 * rng.normal(size=40)
    time = np.datetime64("2024-01-01") + np.arange(40) * np.timedelta64(1, "D")
    run = track(Regression(["a", "b"]), RLS(1.0), y, u, time=time, dt="1d")
    found = to_xarray(run)
    assert found.theta.sel(parameter="b", time="2024-02-09").item() == run.theta[-1, 1]
    np.testing.assert_array_equal(found.theta_std, run.std)
    assert dict(found.sizes) == {"time": 40, "parameter": 2, "input": 2}
    fleet = track(Regression(2), RLS(1.0), np.stack([y, 2 * y]), np.stack([u, u]), by="row")
    many = to_xarray(fleet)
    assert dict(many.sizes) == {"unit": 2, "sample": 40, "parameter": 2, "input": 2}
    np.testing.assert_array_equal(many.theta[1], fleet[1].theta)
    with pytest.raises(TypeError, match="expected a Track"):
        to_xarray(y)
