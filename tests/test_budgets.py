"""The budgets of the house: no figure rises above its limit, and a limit is what was earned last."""

import pytest
from typer.testing import CliRunner

from lab.budgets import LIMITS, budgets
from lab.program import app

SLACK = 0.03


@pytest.fixture(scope="module")
def figures():
    return budgets()


def test_every_figure_has_a_limit(figures):
    assert list(figures) == list(LIMITS)


@pytest.mark.parametrize("name", LIMITS)
def test_nothing_is_above_its_limit(name, figures):
    assert figures[name] <= LIMITS[name], f"{name}: {figures[name]:,}, limit {LIMITS[name]:,} (lab/budgets.py)"


@pytest.mark.parametrize("name", LIMITS)
def test_what_is_earned_is_kept(name, figures):
    """A limit far above the figure would let what was earned be spent."""
    assert figures[name] >= (1 - SLACK) * LIMITS[name], f"{name}: lower the limit to {figures[name]:,} (lab/budgets.py)"


def test_the_command_prints_every_figure(figures, monkeypatch):
    monkeypatch.setattr("lab.budgets.budgets", lambda: figures)
    printed = CliRunner().invoke(app, ["budgets"])
    assert printed.exit_code == 0
    assert all(name in printed.output for name in LIMITS)
