"""The structure of the library, as the laboratory prints and draws it."""

import subprocess

import pytest
from typer.testing import CliRunner

from lab import structure
from lab.faults import faults
from lab.program import app

OLD = f"{structure.MOVED}^"


def test_the_present_structure_is_printed_and_drawn(tmp_path):
    result = CliRunner().invoke(app, ["structure", "--picture", str(tmp_path / "layers.png")])
    assert result.exit_code == 0, result.output
    rows = {line[:40].strip(): line.split()[-1] for line in result.output.splitlines() if line.strip()}
    assert rows["imports that point up"] == rows["circles"] == "0"
    assert (tmp_path / "layers.png").stat().st_size > 10_000


def test_an_old_revision_has_the_layers_of_what_its_modules_became():
    if subprocess.run(["git", "cat-file", "-e", OLD], cwd=structure.ROOT, capture_output=True).returncode:
        pytest.skip("the history of the repository is not here")
    old = structure.of_revision(OLD)
    assert max(map(len, old.circles)) == 65
    assert "signals -> trackers.base" not in old.upward  # data may import trackers
    assert {"trackers.bank -> signals", "result -> summary"} <= set(old.upward)
    assert set(old.layers) <= set(old.modules)


def test_every_planted_fault_has_its_text_once():
    sources = structure.ROOT / structure.PACKAGE
    assert [one.text for one in faults() if (sources / one.module).read_text().count(one.text) != 1] == []
