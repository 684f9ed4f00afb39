"""The reproduction of flexible least squares; `tests/test_docs.py` compares what it prints with its page."""

import re

import numpy as np
import pytest
from typer.testing import CliRunner

from lab.program import app
from lab.reproduce.fls import BEST, METHODS, cost, measure
from lab.reproduce.fls.cost import banded, dense, smoothed
from lab.reproduce.fls.figures import draw


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


def test_every_figure_is_drawn(tmp_path):
    draw(tmp_path, range(3))
    assert len(list(tmp_path.glob("fls_paper_*.png"))) == 10
    assert len(cost.plot(cost.measure((50, 100))).axes[0].lines) == len(cost.ALGORITHMS)


def test_unknown_reproductions_are_named():
    result = CliRunner().invoke(app, ["reproduce", "flss"])
    assert result.exit_code == 2
    assert re.search("did you mean fls", result.output)
    assert "fls" in CliRunner().invoke(app, ["reproduce"]).output
