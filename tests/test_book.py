"""The book builds without a warning, its links lead somewhere, its search finds words, and every page is reachable."""

import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag

import pytest

import driftfit
from driftfit.trackers import found

ROOT = Path(__file__).parent.parent


class Links(HTMLParser):
    """What a page links to, what it shows, and the places in it that can be linked to."""

    def __init__(self) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.places: set[str] = set()

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.places |= {given[name] for name in ("id", "name") if given.get(name)}
        self.targets += [given[name] for name in ("href", "src") if given.get(name)]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the built book."""
    pytest.importorskip("mkdocs", reason='mkdocs is not installed: pip install ".[docs]"')
    pytest.importorskip("mkdocstrings", reason='mkdocstrings is not installed: pip install ".[docs]"')
    folder = tmp_path_factory.mktemp("site")
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site):
    """Every page with its links, by its path."""
    found = {}
    for path in site.rglob("*.html"):
        links = Links()
        links.feed(path.read_text(encoding="utf-8"))
        found[path] = links
    return found


def test_every_link_leads_somewhere(site, pages):
    broken = []
    for path, links in pages.items():
        if path.name == "404.html":  # its links are those of the server's root
            continue
        for target in links.targets:
            address, place = urldefrag(unquote(target))
            if re.match(r"[a-z]+:|//|#__", address or target):
                continue
            there = (path if not address else path.parent / address).resolve()
            there = there / "index.html" if there.is_dir() else there
            if not there.exists() or (place and there in pages and place not in pages[there].places):
                broken.append(f"{path.relative_to(site)}: {target}")
    assert broken == []


def test_every_page_can_be_reached_from_the_first(site, pages):
    reached, todo = set(), [site / "index.html"]
    while todo:
        path = todo.pop()
        if path in reached or path not in pages:
            continue
        reached.add(path)
        for target in pages[path].targets:
            there = (path.parent / urldefrag(unquote(target))[0]).resolve()
            todo.append(there / "index.html" if there.is_dir() else there)
    assert {path for path in pages if path.name != "404.html"} == reached
    chapters = {page.relative_to(ROOT / "docs").with_suffix("") for page in (ROOT / "docs").rglob("*.md")}
    assert len(reached) == len(chapters)


def test_search_and_reference_have_every_public_name(site, pages):
    index = json.loads((site / "search" / "search_index.json").read_text())
    places = {entry["location"] for entry in index["docs"]}
    text = " ".join(entry["text"] for entry in index["docs"])
    for word in ("forgetting factor", "cusum", "iddata", "Hammerstein"):
        assert word.lower() in text.lower()
    anchors = set().union(*(links.places for links in pages.values()))
    for name in set(driftfit.__all__) - {"__version__"}:
        assert f"driftfit.{name}" in anchors, name
        assert any(place.endswith(f"#driftfit.{name}") for place in places), name


def test_every_algorithm_has_its_mathematics_and_its_source(site, pages):
    """The equations of a module's docstring are in the book, and each public tracker is among them."""
    text = (site / "algorithms" / "index.html").read_text()
    places = pages[site / "algorithms" / "index.html"].places
    assert len([place for place in places if place.startswith("math-")]) > 50
    for kind in found().values():
        assert "math-" + kind.__module__.removeprefix("driftfit.").replace(".", "-") in places, kind
    assert text.count("Source: ") > 50
    assert "Unreleased" in (site / "changelog" / "index.html").read_text()


def test_the_reference_refers_to_itself(site, pages):
    """Names in docstrings are links where they are public."""
    (reference,) = (links for path, links in pages.items() if path.parent.name == "verbs")
    assert sum("#driftfit." in target for target in reference.targets) > 100
