"""The build fails when the docs lie.

Python blocks of a page run in order, in one namespace; a text block right after one is what it prints. `lab.pages`
compares the pages with what examples and reproductions of papers print. In both, three dots stand for lines that a page
leaves out. Links and pictures must exist. Where an optional package is absent, a page is left at the block that imports
it, and the test says so.
"""

import contextlib
import io
import re
import runpy
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lab import pages
from lab.program import app

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"```(\w*)\n(.*?)```", re.S)
OPTIONAL = {"formulaic", "h5py", "river", "sktime", "statsmodels", "xarray"}
"""What extras or the pages themselves ask users to install."""


@contextlib.contextmanager
def present(page):
    """Skip the rest of a page where an optional package is absent."""
    try:
        yield
    except ImportError as error:
        result = f"{error.name or ''} {error.__cause__ or ''} {error}"
        absent = next((name for name in OPTIONAL if name in result), None)
        if absent is None:
            raise
        pytest.skip(f"{page}: {absent} is not installed, so the rest of the page was not run")


@pytest.mark.parametrize(
    "page", [page for page in PAGES if "```python" in page.read_text()], ids=lambda page: page.name
)
def test_python_blocks_print_what_the_page_says(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = page.read_text()
    namespace: dict[str, object] = {}
    blocks = list(BLOCK.finditer(text))
    for i, block in enumerate(blocks):
        if block[1] != "python":
            continue
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), present(page.name):
            exec(compile(block[2], f"{page.name}: block {i}", "exec"), namespace)
        follows = i + 1 < len(blocks) and not text[block.end() : blocks[i + 1].start()].strip()
        if follows and blocks[i + 1][1] == "text":
            assert pages.differences(printed.getvalue(), [blocks[i + 1][2]], sample=False) == []


WARNED = {"examples/counts.py", "examples/segmentation.py"}
"""Scripts whose rare counts and changes of level are warned of as if they were codes, since no gate judges them."""

SHOWN = [
    pytest.param(one, marks=pytest.mark.filterwarnings("ignore:.*looks? like (a )?fault code") if one in WARNED else ())
    for one in pages.shown()
    if not pages.name_of(one)  # of benchmarks test_documented_commands.py compares what it runs anyway
]


@pytest.mark.parametrize("command", SHOWN)
def test_scripts_print_what_the_docs_say(command):
    """All that an example prints, and of the reproduction of a paper the rows that take little time."""
    assert pages.compared(command) == []


def test_a_page_that_no_longer_holds_is_found():
    printed = "Errors\n────\n a   1.5\n b   2.5\n\nMilliseconds\n a   3\n"
    blocks = ["Errors\n───\n a  1.5\n b  2.5\n", "Milliseconds\n a   4\n"]
    assert pages.differences(printed, blocks, sample=False) == []
    assert pages.differences("Errors\n a   1.5\n", blocks, sample=True) == []
    assert pages.differences(printed.replace("1.5", "1.6"), blocks, sample=True) == ["+ a 1.6"]
    assert pages.differences(printed.replace(" b   2.5\n", ""), blocks, sample=False) == ["- b 2.5"]
    cut = ["Errors\n...\n b  2.5\n"]
    assert pages.differences(printed, cut, sample=False) == []
    assert pages.differences(printed.replace("2.5", "2.6"), cut, sample=False) == ["+ a 1.5", "+ b 2.6", "- b 2.5"]
    command = ["pages", "--only", "examples/jumps.py"]
    assert CliRunner().invoke(app, command).output == "examples/jumps.py: no differences\n"


def test_links_lead_somewhere():
    broken = []
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)", page.read_text()):
            if "://" not in target and not (page.parent / target).exists():
                broken.append(f"{page.name}: {target}")
    assert broken == []


NEED_A_FILE = [
    path
    for path in sorted((ROOT / "examples").glob("*.py"))
    if re.search(rf"Run: python examples/{path.name} \w", path.read_text())
]


@pytest.mark.parametrize("path", NEED_A_FILE, ids=lambda path: path.stem)
def test_an_example_without_its_file_says_what_it_needs(path, monkeypatch):
    monkeypatch.setattr("sys.argv", [str(path)])
    monkeypatch.syspath_prepend(path.parent)
    with present(path.name), pytest.raises(SystemExit, match=f"Run: python examples/{path.name} "):
        runpy.run_path(str(path), run_name="__main__")
