"""The house: imports point one way, counted from the source, lazy and typing-only ones included."""

import ast
import re
from pathlib import Path

import pytest

SOURCE = Path(__file__).parent.parent / "src" / "driftfit"

FLOORS = [
    ["engine"],
    ["models", "systems"],
    ["trackers", "models.hammerstein_wiener.trackers"],
    # the arithmetic of smoothers knows arrays and no runs: a stream smooths its last samples with it
    ["data", "smooth.parts"],
    ["run"],
    # how tables and pictures of all results look, which each verb's result needs to print and draw itself
    ["show.parts"],
    ["smooth", "tune", "judge", "use", "models.hammerstein_wiener.results", "trackers.bank.results"],
    ["show"],
    # the facade binds verbs to results
    ["", "results", "fleets", "streams", "tracking", "checks", "extend"],
    ["demo", "embedded", "bridges", "service", "cli", "__main__"],
]
"""Folders and modules by rank, the lowest first; the longest prefix of a module's name counts."""

MODULES = {
    ".".join(file.relative_to(SOURCE).with_suffix("").parts).removesuffix("__init__").removesuffix("."): file
    for file in SOURCE.rglob("*.py")
}


def rank(module: str) -> int:
    fits = [(len(prefix), floor) for floor, names in enumerate(FLOORS) for prefix in names
            if module == prefix or (prefix and module.startswith(f"{prefix}."))]  # fmt: skip
    return max(fits)[1]


def targets(module: str) -> set[str]:
    """Modules of the library that a module imports, anywhere in its source."""
    found = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: imports name their module in full"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    inside = {name.removeprefix("driftfit").removeprefix(".") for name in found if name.split(".")[0] == "driftfit"}
    return {name if name in MODULES else name.rpartition(".")[0] for name in inside} - {module}


GRAPH = {module: targets(module) for module in MODULES}


def circles() -> list[list[str]]:
    """Groups of modules that import each other, by whatever way round."""
    reached = {module: reachable(module) for module in GRAPH}
    knots = {tuple(sorted(o for o in reached[m] if m in reached[o])) for m in GRAPH if m in reached[m]}
    return [list(knot) for knot in sorted(knots)]


def reachable(module: str) -> set[str]:
    seen: set[str] = set()
    todo = list(GRAPH[module])
    while todo:
        one = todo.pop()
        if one not in seen:
            seen.add(one)
            todo += GRAPH[one]
    return seen


def test_every_import_is_of_a_module_that_is_there():
    assert {one for found in GRAPH.values() for one in found} <= MODULES.keys()


def test_no_circles():
    assert circles() == []


def test_no_arrow_points_up():
    up = [f"{one} -> {other}" for one, found in GRAPH.items() for other in sorted(found) if rank(one) < rank(other)]
    assert up == []


def test_few_files_at_the_top():
    files = [file.name for file in SOURCE.glob("*.py")]
    assert len(files) <= 8, files


@pytest.mark.parametrize(("most", "count"), [(12, "files of a folder"), (500, "lines of a file")])
def test_sizes(most, count):
    if count == "lines of a file":
        sizes = {str(file): len(file.read_text(encoding="utf-8").splitlines()) for file in MODULES.values()}
    else:
        folders = {file.parent for file in MODULES.values()}
        sizes = {str(one): sum(file.name != "__init__.py" for file in one.glob("*.py")) for one in folders}
    assert {name: size for name, size in sizes.items() if size > most} == {}


def test_the_graph_is_read_whole():
    """Imports inside of functions and under TYPE_CHECKING count, and a rank is that of the longest prefix."""
    lazy = ast.parse("def f():\n    from driftfit.show.export import write\n")
    assert any(isinstance(node, ast.ImportFrom) for node in ast.walk(lazy))
    assert "show.export" in GRAPH["results"]
    assert rank("models.hammerstein_wiener.trackers.output_error") == rank("trackers.kalman") > rank("models.arx")
    assert rank("trackers.bank.results.events") == rank("judge.verdict") > rank("run.result")


PAGES = [*(SOURCE.parent.parent / "docs").rglob("*.md"), SOURCE.parent.parent / "README.md"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_import_what_is_public(page):
    """From the library itself or one level below it; systems and bridges are modules of their own."""
    found = re.findall(r"^from driftfit\.([\w.]+) import", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert [one for one in found if "." in one and one.split(".")[0] not in ("systems", "bridges")] == []
