"""The reproduction of flexible least squares: its medians are the reference's, and the command runs."""

import re

import numpy as np
import pytest
from typer.testing import CliRunner

from driftfit.systems.time_varying import MU
from lab.program import app
from lab.reproduce.fls import BEST, METHODS, REFERENCE, measure, worst_ratio
from lab.reproduce.fls.cost import banded, dense, smoothed


def test_medians_over_one_hundred_seeds_are_those_of_the_reference():
    found = {name: measure(name, MU[name], range(100)) for name in MU}
    ratio, where = worst_ratio(found)
    assert ratio < 0.03, where
    wrong = {name: values * 1.05 for name, values in found.items()}
    assert worst_ratio(wrong)[0] > 0.03  # the comparison can fail
    assert set(REFERENCE) == set(BEST) == set(MU)


@pytest.mark.parametrize(("name", "best"), BEST.items())
def test_the_best_weights_give_the_reference_error(name, best):
    for method, (error, mu) in zip(METHODS, best, strict=False):
        found = np.median(measure(name, mu, range(40))[:, METHODS.index(method), 0])
        assert found == pytest.approx(error, rel=0.05)


def test_dense_banded_and_recursive_solutions_agree():
    rng = np.random.default_rng(0)
    for n in (1, 2):
        phi, y = rng.normal(size=(30, n)), rng.normal(size=30)
        np.testing.assert_allclose(banded(phi, y), dense(phi, y), rtol=1e-9)
        np.testing.assert_allclose(smoothed(phi, y), dense(phi, y), rtol=1e-9)


def test_the_command_runs_and_draws(tmp_path):
    result = CliRunner().invoke(app, ["reproduce", "fls", "--quick", "--figures", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert len(list(tmp_path.glob("fls_paper_*.png"))) == 11


def test_unknown_reproductions_are_named():
    result = CliRunner().invoke(app, ["reproduce", "flss"])
    assert result.exit_code == 2
    assert re.search("did you mean fls", result.output)
    assert "fls" in CliRunner().invoke(app, ["reproduce"]).output
