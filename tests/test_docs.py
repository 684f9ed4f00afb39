"""The build fails when the docs lie.

Python blocks of a page run in order, in one namespace; a text block right after one is what it prints. A text block
after a line ``Printed by `examples/NAME.py`:`` is what that script prints. Links and pictures must exist. Where an
optional package is absent, a page is left at the block that imports it, and the test says so.
"""

import contextlib
import io
import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"```(\w*)\n(.*?)```", re.S)
SCRIPT = re.compile(r"Printed by\s`(examples/\w+\.py)`:\n\n```text\n(.*?)```", re.S)


def squeezed(text: str) -> list[str]:
    return [" ".join(line.split()) for line in text.strip().splitlines()]


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
            assert squeezed(printed.getvalue()) == squeezed(blocks[i + 1][2])


WARNED = {"examples/counts.py", "examples/segmentation.py"}
"""Scripts whose rare counts and changes of level are warned of as if they were codes, since no gate judges them."""


def shown() -> list[object]:
    """Each script with its output as the pages show it, the parts of one script together."""
    result: dict[str, list[str]] = {}
    for page in PAGES:
        for found in SCRIPT.finditer(page.read_text()):
            result.setdefault(found[1], []).append(found[2])
    marks = {script: [pytest.mark.filterwarnings("ignore:.*looks? like (a )?fault code")] for script in WARNED}
    return [
        pytest.param(script, parts, id=Path(script).stem, marks=marks.get(script, ()))
        for script, parts in result.items()
    ]


@pytest.mark.parametrize(("script", "parts"), shown())
def test_scripts_print_what_the_docs_say(script, parts, monkeypatch):
    monkeypatch.setattr("sys.argv", ["script"])
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        runpy.run_path(str(ROOT / script), run_name="__main__")
    for result in parts:
        assert squeezed(printed.getvalue()) == squeezed(result)


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
