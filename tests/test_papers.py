"""The pages that a reader of a paper looks things up in."""

import re
from pathlib import Path

import pytest

import driftfit
from driftfit.smooth import augmented
from driftfit.systems import arc_furnace, drift, hammerstein_wiener
from driftfit.use import system_from_path

PAGES = sorted((Path(__file__).parent.parent / "docs/papers").glob("*.md"))
HOMES = (driftfit, drift, hammerstein_wiener, arc_furnace, system_from_path, augmented)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_reader_of_a_paper_finds_the_call(page):
    text = page.read_text()
    calls = {name.split(".")[0] for name in re.findall(r"`(?:driftfit(?:\.\w+)*\.)?([A-Z]\w+|\w+(?=\())[(.`]", text)}
    assert len(calls) > 8
    assert {name for name in calls if not any(hasattr(home, name) for home in HOMES)} == set()
    for heading in ("Symbols and calls", "Errata: what was wrong in print, and why", "The open p"):
        assert f"## {heading}" in text
