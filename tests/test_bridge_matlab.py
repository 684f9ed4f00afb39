"""MATLAB's files and experiments: there and back, plain variables, version 7.3, merged experiments."""

import numpy as np
import pytest
from scipy.io import savemat
from support import arx_record

from driftfit import ARX, RLS, Kalman, select, track, tune
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
    assert len(read_mat(tmp_path / "plain.mat", y="u", u=["y"])[0]) == 5
    with pytest.raises(ValueError, match="no variable 'z'"):
        read_mat(tmp_path / "plain.mat", "z")
    with pytest.raises(ValueError, match="not a struct"):
        read_mat(tmp_path / "plain.mat", "y")
    savemat(str(tmp_path / "two.mat"), {"a": {"y": np.ones(3)}, "b": {"y": np.ones(3)}})
    with pytest.raises(ValueError, match="name= must say"):
        read_mat(tmp_path / "two.mat")
    with pytest.raises(ValueError, match="one length"):
        Experiment(np.ones(4), np.ones((5, 1)))


@pytest.mark.parametrize("turned", [(), ("flow", "pressure"), ("flow",), ("pressure", "current")])
def test_vectors_are_series_whatever_their_orientation(tmp_path, turned):
    given = experiment()
    signals = {"flow": given.y[:, None], "pressure": given.u[:, :1], "current": given.u[:, 1:]}
    signals = {name: one.T if name in turned else one for name, one in signals.items()}
    savemat(str(tmp_path / "log.mat"), {**signals, "Ts": 0.5})
    one = read_mat(tmp_path / "log.mat", y="flow", u=["pressure", "current"])[0]
    np.testing.assert_array_equal(one.y, given.y)
    np.testing.assert_array_equal(one.u, given.u)
    assert (one.Ts, one.y_names, one.u_names) == (0.5, ("flow",), ("pressure", "current"))
    savemat(str(tmp_path / "s.mat"), {"s": {"y": signals["flow"], "u": signals["pressure"]}})
    np.testing.assert_array_equal(read_mat(tmp_path / "s.mat")[0].y, given.y)
    savemat(str(tmp_path / "plain.mat"), {"y": signals["flow"], "u": signals["current"]})
    np.testing.assert_array_equal(read_mat(tmp_path / "plain.mat")[0].u, given.u[:, 1:])
    with pytest.raises(ValueError, match="no numbers of the name 'speed'; it has"):
        read_mat(tmp_path / "log.mat", y="speed")
    with pytest.raises(ValueError, match="one length; their numbers of samples are: flow 60, Ts 1"):
        read_mat(tmp_path / "log.mat", y=["flow", "Ts"])


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


def test_settings_of_merged_experiments_are_those_of_all_of_them():
    """The log-likelihoods of the experiments add up, each from the start; nothing runs from one into the next."""
    merged = merge(experiment(120), experiment(90, seed=1), experiment(150, seed=2))
    tuned = tune(ARX(1, [1, 1]), Kalman(), **merged.arguments)
    fleet = track(ARX(1, [1, 1]), tuned.tracker, **merged.arguments)
    assert list(fleet) == [0, 1, 2]
    assert fleet[1].names == ("a1", "b1[pressure]", "b1[current]")
    assert fleet[1].time[1] == 3.5
    assert tuned.loglik == pytest.approx(sum(run.loglik for run in fleet.values()), rel=1e-9)
    alone = [tune(ARX(1, [1, 1]), Kalman(), one.y, one.u).tracker.r for one in merged]
    assert min(alone) < tuned.tracker.r < max(alone)
    assert tuned.interval["r"][1] / tuned.interval["r"][0] < 1.4  # of 357 samples: exp(2 * 1.96 sqrt(2 / 357))
    shuffled = tune(ARX(1, [1, 1]), Kalman(), **merge(merged[2], merged[0], merged[1]).arguments)
    assert shuffled.tracker.r == pytest.approx(tuned.tracker.r, rel=1e-6)


def test_the_structure_of_merged_experiments():
    """The logliks of the experiments add up, each from the start, and so do the variances of their differences."""
    merged = merge(*(Experiment(*arx_record(130, seed)) for seed in range(4)))
    models = [ARX(1, 1), ARX(2, 2)]
    result = select(models, tracker=RLS(1.0), **merged.arguments)
    assert result.best == result.simplest == "ARX(na=2, nb=2)"
    alone = [select(models, one.y, one.u, tracker=RLS(1.0)) for one in merged]
    assert result.scored == sum(one.scored for one in alone)
    for row in result.rows:
        assert row.loglik == pytest.approx(sum(r.loglik for one in alone for r in one.rows if r.n == row.n))
    spread = [row.std for one in alone for row in one.rows if row.n == 2]
    assert result.rows[1].std == pytest.approx(np.sqrt(np.sum(np.square(spread))))
    assert len(result.average().y_hat) == 4 * 130


def test_merged_experiments_need_one_interval():
    with pytest.raises(ValueError, match=r"Ts must be the same in all; got 1, 0\.5"):
        _ = merge(Experiment(np.ones(9), np.ones((9, 2))), experiment(9)).arguments


def test_tuning_of_rows_and_of_several_outputs():
    """`by` is that of track; a smoother's criteria pool the residuals of all records."""
    y, u = map(np.stack, zip(*(arx_record(100, seed) for seed in (0, 1)), strict=True))
    model = ARX(1, 1)
    rows = tune(model, Kalman(), y, u, by="row")
    fleet = track(model, rows.tracker, y, u, by="row")
    assert rows.loglik == pytest.approx(sum(run.loglik for run in fleet.values()), rel=1e-9)
    loo = tune(model, Kalman(), y, u, by="row", method="loo")
    paths = [run.smooth() for run in track(model, loo.tracker, y, u, by="row").values()]
    pooled = np.nanmean(np.concatenate([path.loo for path in paths]) ** 2)
    assert loo.table["loo"].min() == pytest.approx(pooled, rel=1e-6)
    each = tune(ARX(1, 1, ny=2), Kalman(), np.stack([y, 2 * y], axis=-1), u, by="row")
    assert each["y2"].tracker.r == pytest.approx(4 * each["y1"].tracker.r, rel=1e-3)
    with pytest.raises(ValueError, match="samples of one record"):
        tune(model, Kalman(), y, u, by="row", order_by=np.arange(100))
