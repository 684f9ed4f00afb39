"""What a run keeps of every sample, and in which precision: the rest of the results is the same, from a second pass."""

import sys

import numpy as np
import polars as pl
import pytest
from support import arx_record, damaged, same
from test_bank import N, R, changes
from test_bank import record as jumping

from driftfit import ARX, Bank, Beam, Kalman, Regression, Sensor, Track, track
from driftfit.fleets import Fleet
from driftfit.run.program import Program

K = Kalman(q=1e-4, r=0.01)
NAMES = ("theta", "std", "prediction", "innovation", "innovation_std", "ok", "log_density")


def test_theta_alone_and_the_rest_on_request(tmp_path):
    y, u = damaged(*arx_record(3000, 3))
    full, lean = track(ARX(2, 2), K, y, u), track(ARX(2, 2), K, y, u, keep="theta")
    assert lean._lane.out.nbytes == 3000 * 4 * 8 == full._lane.out.nbytes / 3
    assert lean.stores() == ("theta",)
    lean.save(tmp_path / "lean")
    for run in (lean, Track.load(tmp_path / "lean")):
        assert all(same(getattr(run, name), getattr(full, name)) for name in NAMES)
        assert run.loglik == full.loglik
        assert same(run.cov(200), full.cov(200))
        assert same(run.smooth().theta, full.smooth().theta)
        assert str(run.summary()) == str(full.summary())
    rest = track(ARX(2, 2), K, y, u, warm_start=lean)
    assert same(rest.theta, track(ARX(2, 2), K, y, u, warm_start=full).theta)


def test_a_bank_that_keeps_theta_alone():
    y, u = jumping(120, 5, (40, 90))
    bank = Bank(changes(), [Sensor.nominal(R)], reduce=Beam(9), p0=2.0)
    full, lean = track(Regression(N), bank, y, u), track(Regression(N), bank, y, u, keep="theta")
    assert lean.loglik == full.loglik
    assert same(lean.hypotheses.lag_prob, full.hypotheses.lag_prob)


def test_single_precision_rounds_what_is_stored_and_nothing_else(tmp_path):
    y, u = damaged(*arx_record(3000, 3))
    full, single = track(ARX(2, 2), K, y, u), track(ARX(2, 2), K, y, u, dtype="float32")
    assert 2 * single._lane.out.nbytes == full._lane.out.nbytes
    single.save(tmp_path / "single")
    for run in (single, Track.load(tmp_path / "single")):
        assert run.theta.dtype == np.float32
        for name in ("theta", "var", "prediction", "innovation", "innovation_var"):
            assert same(getattr(run, name), getattr(full, name).astype(np.float32)), name
        assert same(run.ok, full.ok)
        assert same(run.state["P"], full.state["P"])
        assert run.loglik == pytest.approx(full.loglik, rel=1e-5)
        assert same(run.smooth().theta, full.smooth().theta)
        assert run.detect("band", reference=500).onsets.tolist() == full.detect("band", reference=500).onsets.tolist()
    cov = track(ARX(2, 2), K, y[:50], u[:50], keep="cov", dtype=np.float32)
    np.testing.assert_allclose(cov.cov(40), full.cov(40), rtol=1e-6)


def test_fleets(tmp_path):
    rng = np.random.default_rng(0)
    y, u = rng.standard_normal((2, 40, 300))
    full = track(ARX(2, 2), K, y, u, by="row")
    lean = track(ARX(2, 2), K, y, u, by="row", keep="theta", dtype="float32")
    assert lean.nbytes * 6 == full.nbytes
    lean.save(tmp_path / "fleet")
    for fleet in (lean, Fleet.load(tmp_path / "fleet")):
        assert same(fleet[17].theta, full[17].theta.astype(np.float32))
        assert same(fleet[17].std, full[17].std)


def test_a_fleet_is_written_part_by_part(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules["driftfit.run.track"], "BYTES_AT_ONCE", 30_000)
    rng = np.random.default_rng(0)
    table = pl.DataFrame({"pump": np.repeat(np.arange(40), rng.integers(5, 40, 40)).astype(str)})
    table = table.with_columns(y=rng.standard_normal(len(table)), u=rng.standard_normal(len(table)))
    given = {"y": "y", "u": "u", "data": table, "by": "pump"}
    written = track(ARX(2, 2), K, **given, to=tmp_path / "all")
    assert (written.series, written.rows) == (40, len(table))
    files = sorted((tmp_path / "all").iterdir())
    assert len(files) > 2
    assert pl.read_parquet(files).equals(track(ARX(2, 2), K, **given).to_table())
    grid = track(ARX(2, 2), [K, K], *rng.standard_normal((2, 500)), to=tmp_path / "grid", keep="theta")
    assert (grid.series, grid.rows) == (2, 1000)
    with pytest.raises(ValueError, match="exists and is not empty"):
        track(ARX(2, 2), K, **given, to=tmp_path / "all")
    with pytest.raises(ValueError, match="to= is for many series"):
        track(ARX(2, 2), K, *rng.standard_normal((2, 50)), to=tmp_path / "one")


def test_what_is_refused():
    y, u = arx_record(20, 3)
    with pytest.raises(ValueError, match="dtype must be one of 'float64', 'float32'"):
        track(ARX(2, 2), K, y, u, dtype="float16")
    with pytest.raises(ValueError, match="keep='theta' is for models of one output"):
        track(ARX(1, 1, ny=2), K, np.stack([y, y], axis=1), u, keep="theta")


def test_a_driver_refuses_theta_of_another_shape():
    program = Program(Regression(2).bind(2), Kalman(q=1e-3, r=0.1))
    tile, signals = program.tile(), (np.zeros((5, 1)), np.zeros((5, 2, 1)), np.ones((1, 3, 1)))
    for rows, shape in ((1, (5, 3, 1)), (5, (5, 2, 1))):
        with pytest.raises(ValueError, match="one row beside theta"):
            program.drivers().run(tile, *signals, program.written(tile, rows), np.empty(shape))
    with pytest.raises(ValueError, match="5 samples"):
        program.drivers().run(tile, signals[0][:4], *signals[1:], program.written(tile, 1), np.empty((5, 2, 1)))
