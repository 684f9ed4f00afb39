"""The command line over tables: fleets, units, patterns, and a tracker of the user's own."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

from driftfit import ARX, Kalman, track
from driftfit.cli import app

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


def run(*arguments: str) -> str:
    result = CliRunner().invoke(app, ["track", *arguments])
    assert result.exit_code == 0, result.output
    return result.output


def test_a_fleet_over_a_pattern(folder):
    settings = (
        "--model",
        "arx:1,1",
        "--tracker",
        "kalman",
        "-p",
        "q=1e-3",
        "-p",
        "r=0.1",
        "--time",
        "t",
        "--unit",
        "flow=l/min",
    )
    text = run(
        "*.csv", "--y", "flow", "--u", "valve", "--by", "pump", *settings, "--out", "fleet.parquet", "--plot", "f.png"
    )
    assert "Series   2, 0 without a result" in text
    table = pl.read_parquet("fleet.parquet")
    data = pl.read_csv("b.csv")
    alone = track(ARX(1, 1), Kalman(q=1e-3, r=0.1), data["flow"], data["valve"])
    assert np.array_equal(table.filter(pump="b")["theta_b1[valve]"], alone.theta[:, 1])
    assert (folder / "f.png").stat().st_size > 1000


def test_a_tracker_of_the_users_own(folder):
    text = run(
        "a.csv",
        "--y",
        "flow",
        "--u",
        "valve",
        "--model",
        "arx:1,1",
        "--with",
        "mine_for_cli:Mine",
        "-p",
        "q=0",
        "-p",
        "r=1",
    )
    assert "Mine(q=0.0, r=1.0" in text
    for place, said in (
        ("mine_for_cli:Other", "has no Tracker of the name Other"),
        ("mine_for_cli", "name the module and the class"),
        ("absent_module:Mine", "No module named 'absent_module'"),
    ):
        result = CliRunner().invoke(app, ["track", "a.csv", "--y", "flow", "--u", "valve", "--with", place])
        assert result.exit_code == 2
        assert said in " ".join(result.output.split())


def test_what_is_wrong_is_said_in_one_line(folder):
    for arguments, said in (
        (["a.csv", "--y", "flo"], "has no column 'flo': did you mean flow?"),
        (["z*.csv", "--y", "flow"], "no file matches z*.csv"),
        (["a.csv", "--y", "flow", "--unit", "flow"], "a unit is given as column=unit"),
    ):
        result = CliRunner().invoke(
            app, ["track", *arguments, "--model", "arx:1,0", "--tracker", "kalman", "-p", "q=0", "-p", "r=1"]
        )
        assert result.exit_code == 2
        assert said in " ".join(result.output.split())
