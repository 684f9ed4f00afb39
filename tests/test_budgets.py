"""The budgets of the house: no figure rises above its limit, and a limit is what was earned last."""

from typer.testing import CliRunner

from lab.budgets import LIMITS, budgets
from lab.program import app

SLACK = 0.03


def test_every_figure_is_at_its_limit_and_printed(monkeypatch):
    """Above it, something was spent; a limit far above its figure would let what was earned be spent."""
    figures = budgets()
    assert list(figures) == list(LIMITS)
    wrong = {
        name: f"{figure:,}, limit {LIMITS[name]:,}: {'above' if figure > LIMITS[name] else 'lower'} it (lab/budgets.py)"
        for name, figure in figures.items()
        if not (1 - SLACK) * LIMITS[name] <= figure <= LIMITS[name]
    }
    assert wrong == {}
    monkeypatch.setattr("lab.budgets.budgets", lambda: figures)
    printed = CliRunner().invoke(app, ["budgets"])
    assert printed.exit_code == 0
    assert all(name in printed.output for name in LIMITS)
