"""The command line over tables: fleets, units, patterns, and a tracker of the user's own."""

from __future__ import annotations

import io
import runpy
from functools import partial
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from cli_support import fails
from cli_support import run as command

import driftfit
from driftfit import ARX, Kalman, track
from driftfit.data.files import without_formulas
from driftfit.fleets import Fleet, Outputs
from driftfit.show import export

run = partial(command, "track")
KALMAN = ("--tracker", "kalman", "-p", "q=1e-3", "-p", "r=0.1")
FLOW = ("--y", "flow", "--u", "valve", "--model", "arx:1,1")
OWN = '''
from dataclasses import dataclass

from driftfit.trackers.kalman import Kalman


@dataclass(frozen=True)
class Mine(Kalman):
    """A random-walk Kalman filter under another name."""
'''


@pytest.fixture
def folder(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    for name in ("a", "b"):
        u = rng.normal(size=80)
        y = np.concatenate([[0.0], 2.0 * u[:-1]]) + 0.1 * rng.normal(size=80)
        pl.DataFrame({"pump": [name] * 80, "t": np.arange(80), "flow": y, "valve": u}).write_csv(
            tmp_path / f"{name}.csv"
        )
    (tmp_path / "mine_for_cli.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_fleet_over_a_pattern(folder):
    settings = (*FLOW, *KALMAN, "--by", "pump", "--time", "t", "--unit", "flow=l/min")
    text = run("*.csv", *settings, "--out", "fleet.parquet", "--plot", "f.png")
    assert "Series   2, 0 without a result" in text
    table = pl.read_parquet("fleet.parquet")
    data = pl.read_csv("b.csv")
    alone = track(ARX(1, 1), Kalman(q=1e-3, r=0.1), data["flow"], data["valve"])
    assert np.array_equal(table.filter(pump="b")["theta_b1[valve]"], alone.theta[:, 1])
    assert (folder / "f.png").stat().st_size > 1000


@pytest.mark.parametrize("rows", [(), ("--rows", "1:80")])
def test_texts_that_mean_no_value_and_a_row_of_units(folder, rows):
    lines = Path("a.csv").read_text().splitlines()
    cells = [line.split(",") for line in lines]
    cells[6][2], cells[8][2] = "Offline", "-999"
    Path("a.csv").write_text("\n".join(",".join(row) for row in [cells[0], ["", "", "l/min", "V"], *cells[1:]]))
    missing = ("--missing", "Offline", "--missing", "-999")
    printed = run("a.csv", *FLOW, *KALMAN, "--time", "t", *missing, *rows)
    assert "flow (l/min) from valve (V)" in printed
    assert "1 marked as missing" in printed
    assert "80, 77 used, 3 skipped" in printed


def test_a_tracker_of_the_users_own(folder):
    text = run("a.csv", *FLOW, "--with", "mine_for_cli:Mine", "-p", "q=0", "-p", "r=1", "--out", "own.npz")
    assert "Mine(q=0.0, r=1.0" in text
    again = ["a.csv", "--y", "flow", "--u", "valve", "--start", "own.npz"]
    assert "Mine(q=0.0, r=1.0" in run(*again, "--with", "mine_for_cli:Mine")
    assert "needs mine_for_cli:Mine" in fails("track", *again)
    for place, message in (
        ("mine_for_cli:Other", "has no Tracker of the name Other"),
        ("mine_for_cli", "name the module and the class"),
        ("absent_module:Mine", "No module named 'absent_module'"),
    ):
        assert message in fails("track", "a.csv", "--y", "flow", "--u", "valve", "--with", place)


@pytest.fixture
def tanks(tmp_path, monkeypatch):
    """Two records of two outputs that see each other's past, in one file."""
    rng = np.random.default_rng(1)
    parts = []
    for name in ("a", "b"):
        u, y = rng.normal(size=120), np.zeros((120, 2))
        for t in range(1, 120):
            y[t, 0] = 0.5 * y[t - 1, 0] + 0.3 * y[t - 1, 1] + u[t - 1]
            y[t, 1] = 0.4 * y[t - 1, 1] - u[t - 1]
            y[t] += 0.1 * rng.normal(size=2)
        columns = {"tank": [name] * 120, "level": y[:, 0], "flow": y[:, 1], "valve": u, "pump": rng.normal(size=120)}
        parts.append(pl.DataFrame(columns))
    parts[0].write_csv(tmp_path / "one.csv")
    pl.concat(parts).write_csv(tmp_path / "all.csv")
    monkeypatch.chdir(tmp_path)
    return parts


TWO = ("--y", "level", "--y", "flow", "--model", "arx:1,1", *KALMAN)


def test_several_outputs(tanks):
    text = run("one.csv", *TWO, "--u", "valve", "--out", "two.parquet", "--plot", "two.png", "--report", "two.html")
    assert {"level", "flow"} <= {line.strip() for line in text.splitlines()}
    assert "a1[flow<-level]" in text
    data = tanks[0]
    alone = track(
        ARX(1, 1, ny=("level", "flow")), Kalman(q=1e-3, r=0.1), np.stack([data["level"], data["flow"]], 1),
        data["valve"].to_numpy()[:, None],
    )  # fmt: skip
    table = pl.read_parquet("two.parquet")
    assert np.array_equal(table["theta_a1[level<-flow]"], alone["level"].theta[:, 1])
    assert np.array_equal(table["prediction[flow]"], alone.prediction[:, 1], equal_nan=True)
    assert np.array_equal(table["valve"], data["valve"])
    run("one.csv", "--y", "level,flow", "--u", "valve", "--model", "arx:1,1", *KALMAN, "--out", "two.npz")
    assert np.array_equal(Outputs.load("two.npz").theta, alone.theta)
    text = run("one.csv", "--y", "level,flow", "--u", "valve,pump", "--model", "regression:shared,ny=2", *KALMAN)
    assert "theta1" in text


def test_a_fleet_of_several_outputs(tanks):
    text = run("all.csv", *TWO, "--u", "valve", "--by", "tank", "--out", "two.csv", "--report", "two.html")
    assert "Series   4, 0 without a result" in text
    assert "b, flow" in text
    assert "farthest" in text  # heads are not cut
    table = pl.read_csv("two.csv")
    data = tanks[1]
    alone = track(
        ARX(1, 1, ny=("level", "flow")), Kalman(q=1e-3, r=0.1), np.stack([data["level"], data["flow"]], 1),
        data["valve"].to_numpy()[:, None],
    )  # fmt: skip
    assert table.filter(tank="b")["theta_a1[level<-flow]"].to_numpy() == pytest.approx(alone.theta[:, 0, 1])
    run("all.csv", *TWO, "--u", "valve", "--by", "tank", "--out", "two.npz", "--plot", "two.png")
    assert np.array_equal(Fleet.load("two.npz")["b"].theta, alone.theta)
    assert Path("two.png").stat().st_size > 1000


def test_the_package_is_the_command(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["driftfit", "--version"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("driftfit", run_name="__main__")
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"driftfit {driftfit.__version__}\n"


@pytest.mark.parametrize("name", ["flow, cold", "flow (l/min)", "flow 'a'", 'the "old" flow', "flow=2", "a;b", "$x"])
def test_columns_of_any_name_can_be_given(folder, name):
    """A name with a comma is quoted as in a CSV file; every other sign stands for itself."""
    pl.read_csv("a.csv").rename({"valve": name, "flow": "level, left", "t": "t (s)"}).write_csv("named.csv")
    written = f'"{name}"' if "," in name else name
    settings = ("--model", "arx:1,1", "--tracker", "kalman", "-p", "q=1e-3", "-p", "r=0.1", "--time", "t (s)")
    limits = ("--limits", f"{name}=-9:9", "--unit", f"{name}=l/min")
    text = run("named.csv", "--y", '"level, left"', "--u", written, *settings, *limits)
    assert f"b1[{name}]" in text


def test_an_output_among_the_inputs_of_a_table_is_named(folder):
    with pytest.raises(ValueError, match="u contains the output 'flow'"):
        track(ARX(1, 1), Kalman(q=0.0, r=1.0), "flow", ["valve", "flow"], data="a.csv")


def test_no_cell_of_an_export_is_a_formula(tmp_path):
    """A unit that was called =cmd|'/c calc'!A0 ran a program in a spreadsheet."""
    wicked = ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(1)", "\tx", "plain", "-5", "+1e3", "a=b"]
    table = pl.DataFrame({"=key": wicked, "at": range(9), "kind": pl.Series(wicked, dtype=pl.Categorical)})
    again = pl.read_csv(io.StringIO(without_formulas(table).write_csv()))
    assert again.columns == ["'=key", "at", "kind"]
    assert again["'=key"].to_list() == again["kind"].to_list() == [f"'{one}" for one in wicked[:5]] + wicked[5:]
    rng = np.random.default_rng(0)
    u = rng.normal(size=80)
    data = pl.DataFrame({"unit": np.repeat(wicked[:2], 40), "=u": u, "y": np.roll(u, 1)})
    export.write(track(ARX(1, 1), Kalman(q=1e-3, r=0.1), "y", "=u", data=data, by="unit"), tmp_path / "fleet.csv")
    cells = {cell for line in (tmp_path / "fleet.csv").read_text().splitlines() for cell in line.split(",")}
    assert "'=1+1" in cells
    assert "'=u" in cells
    assert not {one for one in cells if one[:1] in "=+@" and one}
