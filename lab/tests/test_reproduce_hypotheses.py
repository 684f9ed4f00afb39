"""The reproduction of banks of hypotheses: errors are the reference's up to sampling, and the ranking holds."""

import numpy as np
import pytest
from typer.testing import CliRunner

from driftfit.systems.jumps import jumping, poles
from lab.program import app
from lab.reproduce.hypotheses.contests import contests
from lab.reproduce.hypotheses.scores import measure

RUNS = 25


def test_errors_on_clean_records_are_those_of_the_reference():
    clean = contests()[0]
    names = (
        "KF diag(.004,.004,.04)",
        "RLS-EF 0.75",
        "Decide d=2",
        "GPB(2)",
        "IMM",
        "Beam M=9",
        "oracle (events known)",
    )
    found = {name: measure(clean, name, RUNS).values for name in names}
    for name, values in found.items():
        rmse, after, steady, detected, *_, nees, leaves = clean.reference[name]
        assert values[0] == pytest.approx(rmse, rel=0.04), name
        assert values[2] == pytest.approx(after, rel=0.04), name
        assert values[3] == pytest.approx(steady, rel=0.12), name
        if detected is not None:
            assert values[4] == pytest.approx(detected, abs=0.07), name
            assert values[8] == pytest.approx(nees, rel=0.07), name
            assert values[9] == pytest.approx(leaves, rel=0.01), name
    error = {name: values[0] for name, values in found.items()}
    assert error["oracle (events known)"] < error["Beam M=9"] < error["IMM"] < error["KF diag(.004,.004,.04)"]


def test_records_are_what_they_say():
    record = jumping(3, fault="frozen")
    assert all(poles(a1, a2) < 0.96 for a1, a2, _ in record.theta)
    assert np.ptp(record.y[record.bad]) > 0.0
    assert np.abs(np.diff(record.theta, axis=0)).max(axis=1)[~np.isin(np.arange(1, 600), record.jumps)].max() < 0.02
    assert jumping(3).jumps.min() > 30


def test_the_command_prints_a_table():
    result = CliRunner().invoke(app, ["reproduce", "hypotheses", "--quick", "--only", "regimes"])
    assert result.exit_code == 0, result.output
    assert "IMM Markov" in result.output
    assert "RMSE against the reference: median" in result.output
