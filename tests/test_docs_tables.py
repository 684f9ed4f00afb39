"""The tables of functions of other packages: every line of code in the last column runs after the page's own code."""

import re
from pathlib import Path

import matplotlib
import pytest

import driftfit
from driftfit import models, trackers

DOCS = Path(__file__).parent.parent / "docs"
PAGES = [DOCS / "from_matlab.md", DOCS / "from_r.md"]
ROW = re.compile(r"^\| (?P<theirs>.+?) \| .+? \| `(?P<ours>.+)` \|$", re.M)


@pytest.mark.filterwarnings("ignore::driftfit.DataWarning")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_line_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    text = page.read_text()
    namespace: dict[str, object] = {}
    exec(re.search(r"```python\n(.*?)```", text, re.S)[1], namespace)
    failed = {}
    for row in ROW.finditer(text):
        try:
            exec(row["ours"], namespace)
        except Exception as error:  # collected, so that one run shows all of them
            failed[row["theirs"]] = error
    assert failed == {}
    assert len(list(ROW.finditer(text))) == sum(line.startswith("| `") for line in text.splitlines())


def test_matlab_has_sixty_functions():
    rows = ROW.finditer((DOCS / "from_matlab.md").read_text())
    assert sum(row["theirs"].count("`") // 2 for row in rows) >= 60


def test_every_tracker_and_model_is_public():
    """But for what a model becomes when it is bound."""
    assert {*models.found(), *trackers.found()} - {*driftfit.__all__} == set()
