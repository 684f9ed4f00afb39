"""MATLAB's files and experiments: there and back, plain variables, version 7.3, merged experiments."""

import numpy as np
import pytest
from scipy.io import savemat

from driftfit import ARX, RLS, track
from driftfit.bridges.matlab import Experiment, merge, read_mat, write_mat


def experiment(T=60, seed=0):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(T, 2))
    y = np.zeros(T)
    for t in range(1, T):
        y[t] = 0.7 * y[t - 1] + u[t - 1, 0] - 2 * u[t - 1, 1] + 0.05 * rng.normal()
    return Experiment(y, u, 0.5, ("flow",), ("pressure", "current"), {"flow": "l/min", "current": "A"}, "minutes", 3.0)


def test_a_file_there_and_back(tmp_path):
    given = merge(experiment(), experiment(80, seed=1))
    write_mat(tmp_path / "plant.mat", given, "plant")
    again = read_mat(tmp_path / "plant.mat")
    assert len(again) == 2
    for one, two in zip(given, again, strict=True):
        np.testing.assert_array_equal(one.y, two.y)
        np.testing.assert_array_equal(one.u, two.u)
        assert (two.Ts, two.y_names, two.u_names) == (0.5, ("flow",), ("pressure", "current"))
        assert (two.units, two.time_unit, two.time[1]) == ({"flow": "l/min", "current": "A"}, "minutes", 3.5)


def test_plain_variables_and_wrong_names(tmp_path):
    savemat(str(tmp_path / "plain.mat"), {"y": np.arange(5.0)[:, None], "u": np.ones((5, 1)), "Ts": 0.1})
    one = read_mat(tmp_path / "plain.mat")[0]
    assert (one.y.shape, one.u.shape, one.Ts) == ((5,), (5, 1), 0.1)
    with pytest.raises(ValueError, match="no variable 'z'"):
        read_mat(tmp_path / "plain.mat", "z")
    with pytest.raises(ValueError, match="not a struct"):
        read_mat(tmp_path / "plain.mat", "y")
    savemat(str(tmp_path / "two.mat"), {"a": {"y": np.ones(3)}, "b": {"y": np.ones(3)}})
    with pytest.raises(ValueError, match="name= must say"):
        read_mat(tmp_path / "two.mat")
    with pytest.raises(ValueError, match="one length"):
        Experiment(np.ones(4), np.ones((5, 1)))


def test_version_7_3(tmp_path):
    h5py = pytest.importorskip("h5py", reason="h5py is not installed")
    given = experiment()
    # the layout in which MATLAB stores a struct; the first 512 bytes are text, by which a reader knows the version
    with h5py.File(tmp_path / "new.mat", "w", userblock_size=512) as file:
        s = file.create_group("s")
        s["y"], s["u"], s["Ts"] = given.y[None, :], given.u.T, np.array([[given.Ts]])
        cells = []
        for place, name in enumerate(given.u_names):
            text = file.create_dataset(f"#refs#/{place}", data=np.array([[ord(letter)] for letter in name], np.uint16))
            text.attrs["MATLAB_class"] = np.bytes_("char")
            cells.append(text.ref)
        names = s.create_dataset("InputName", data=np.array([cells], dtype=h5py.ref_dtype), dtype=h5py.ref_dtype)
        names.attrs["MATLAB_class"] = np.bytes_("cell")
    with open(tmp_path / "new.mat", "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    again = read_mat(tmp_path / "new.mat")[0]
    np.testing.assert_array_equal(again.y, given.y)
    np.testing.assert_array_equal(again.u, given.u)
    assert (again.Ts, again.u_names) == (0.5, ("pressure", "current"))


def test_merged_experiments_share_no_regressor():
    first, second = experiment(60), experiment(60, seed=1)
    model = ARX(1, [1, 1])
    y, u = merge(first, second).joined(model)
    joined = track(model, RLS(1.0), y, u)
    assert joined.ok.sum() == 59 + 59
    rows = [np.c_[one.y[:-1], one.u[:-1], one.y[1:]] for one in (first, second)]
    rows = np.concatenate(rows)
    expected = np.linalg.lstsq(rows[:, :3], rows[:, 3], rcond=None)[0]
    np.testing.assert_allclose(joined.theta[-1], expected, rtol=1e-9)
    pure = track(ARX(2, 0), RLS(1.0), merge(Experiment(first.y), Experiment(second.y)).joined(ARX(2, 0))[0])
    assert pure.ok.sum() == 58 + 58
