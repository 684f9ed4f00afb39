"""The house: imports point one way, counted from the source, lazy and typing-only ones included."""

import re
from pathlib import Path

import pytest

from lab.structure import Structure, layer_of, present

HOME = Path(__file__).parent.parent
HOUSE = present()


def test_every_import_is_of_a_module_that_is_there():
    assert {one for found in HOUSE.imports.values() for one in found} <= HOUSE.modules.keys()


def test_no_circles():
    assert HOUSE.circles == []


def test_no_arrow_points_up():
    assert HOUSE.upward == []


def test_few_files_at_the_top():
    assert HOUSE.files[""] + 1 <= 8, "with __init__.py"


@pytest.mark.parametrize(("most", "count"), [(12, "files of a folder"), (500, "lines of a file")])
def test_sizes(most, count):
    lines = {path: len(text.splitlines()) for path, text in HOUSE.sources.items()}
    sizes = lines if count == "lines of a file" else HOUSE.files
    assert {name: size for name, size in sizes.items() if size > most} == {}


def test_the_graph_is_read_whole():
    """Imports inside of functions and under TYPE_CHECKING count, and a layer is that of the longest prefix."""
    lazy = "def f():\n    from driftfit.b import g\n"
    typed = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from driftfit import a\n"
    found = Structure({"a.py": lazy, "b.py": typed, "c/__init__.py": "import driftfit.a"}, {"a": 0, "b": 1, "c": 2})
    assert found.imports == {"a": {"b"}, "b": {"a"}, "c": {"a"}}
    assert found.circles == [("a", "b")]
    assert found.upward == ["a -> b"]
    assert "show.export" in HOUSE.imports["results"]
    low, high = "models.hammerstein_wiener.output_error", "bank.results.events"
    assert layer_of(low) == layer_of("trackers.kalman") > layer_of("models.arx")
    assert layer_of(high) == layer_of("judge.verdict") > layer_of("run.result")


PAGES = [*(HOME / "docs").rglob("*.md"), HOME / "README.md"]


def test_pages_import_what_is_public():
    """From the library itself or one level below it; systems and bridges are modules of their own."""
    deep = {}
    for page in PAGES:
        found = re.findall(r"^ *from driftfit\.([\w.]+) import", page.read_text(encoding="utf-8"), re.MULTILINE)
        deep[page.name] = [one for one in found if "." in one and one.split(".")[0] not in ("systems", "bridges")]
    assert {page: names for page, names in deep.items() if names} == {}
