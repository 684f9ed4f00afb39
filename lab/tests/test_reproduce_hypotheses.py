"""The reproduction of banks of hypotheses: errors are the reference's up to sampling, and the ranking holds."""

import numpy as np
import pytest

from lab.jumps import jumping, poles
from lab.reproduce.hypotheses.contests import contests
from lab.reproduce.hypotheses.scores import measure

RUNS = 25


EXACT = {
    "KF diag(.004,.004,.04)": (0.3612, 0.7257, 0.2080, None, 0.9681),
    "RLS-EF 0.75": (0.4160, 0.8519, 0.2273, None, 1.9085),
    "Decide d=2": (0.2936, 0.6740, 0.0609, 0.8440, 1.4076),
    "GPB(2)": (0.2997, 0.6606, 0.1151, 0.6525, 0.8391),
    "IMM": (0.3089, 0.6647, 0.1380, 0.6454, 0.7865),
    "Beam M=9": (0.2849, 0.6555, 0.0611, 0.7305, 1.1763),
    "oracle (events known)": (0.2581, 0.5948, 0.0546, None, 1.0946),
}
"""RMSE, after jumps, steady, detected and NEES / n on these records."""


def test_errors_on_clean_records_are_those_of_the_reference():
    """As they are to four digits, so that nothing changes unseen; and the reference, up to the scatter of records."""
    clean = contests()[0]
    rows = {name: measure(clean, name, RUNS) for name in EXACT}
    found = {name: row.values for name, row in rows.items()}
    for name, values in found.items():
        for exact, value in zip(EXACT[name], (*values[0:1], *values[2:5], values[8]), strict=True):
            assert exact is None or value == pytest.approx(exact, abs=2e-4), name
        rmse, after, steady, detected, *_, nees, leaves = clean.reference[name]
        assert values[0] == pytest.approx(rmse, rel=0.04), name  # a standard error of such records is .06
        assert values[2] == pytest.approx(after, rel=0.04), name
        error = np.sqrt((RUNS - 1) * np.var(rows[name].without[:, 2]))  # of the jackknife
        assert abs(values[3] - steady) < 2.5 * error, name
        assert error < 0.08 * steady, name
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
