"""The house: imports point one way, counted from the source, lazy and typing-only ones included."""

import ast
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


def test_what_a_function_packs_does_not_leave_it():
    """The numbers of `packed` are on the stack of the function that packs them, and gone when it returns."""
    sources = [*(Path(__file__).parents[1] / "src").rglob("*.py")]
    assert sum("= packed((" in source.read_text(encoding="utf-8") for source in sources) >= 1
    assert [source.name for source in sources if "return packed((" in source.read_text(encoding="utf-8")] == []


RAW = {"njit", "jit", "vectorize", "guvectorize", "cfunc", "stencil"}


def compiled_by_numba(text):
    """Lines that take a compiling decorator from Numba itself, under any name."""
    found, numba = [], set()
    if "numba" not in text:
        return []
    nodes = [*ast.walk(ast.parse(text))]
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "numba":
            found += [node.lineno for one in node.names if one.name in RAW]
        elif isinstance(node, ast.Import):
            numba |= {one.asname or one.name for one in node.names if one.name.split(".")[0] == "numba"}
    for node in nodes:
        if isinstance(node, ast.Attribute) and node.attr in RAW and ast.unparse(node.value) in numba:
            found.append(node.lineno)
    return sorted(found)


def test_what_compiles_by_itself_is_found():
    assert compiled_by_numba("from numba import njit as fast, types\nimport numba as nb\n@nb.jit\ndef f(): ...") == [
        1,
        3,
    ]
    assert compiled_by_numba("import jax\nfrom numba import types\nf = jax.jit(g)\nh = np.vectorize(f)") == []


def test_only_the_engine_compiles():
    """Numba's own cache mixes up layouts when two processes compile at once, and nothing frees what it made."""
    sources = [path for folder in ("src", "lab", "benchmarks", "examples") for path in (HOME / folder).rglob("*.py")]
    assert len(sources) > 400
    found = {path.relative_to(HOME).as_posix(): compiled_by_numba(path.read_text("utf-8")) for path in sources}
    inside = "src/driftfit/engine/numba_internals.py"
    assert found.pop(inside)
    assert {path: lines for path, lines in found.items() if lines} == {}
