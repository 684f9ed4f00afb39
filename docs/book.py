"""A hook of mkdocs: pages that the repository writes itself.

The gallery shows every figure of the chapters, with a link to its chapter and the code of its script. The page of the
algorithms holds the docstring of every module with equations or a source: what is computed, cost, departures. The
changelog is that of the repository. A new figure, algorithm or version appears by existing.
"""

import ast
import re
from pathlib import Path

HOME = Path(__file__).parent
SOURCE = HOME.parent / "src" / "driftfit"
FIGURE = re.compile(r"!\[(?P<caption>[^\]]*)\]\((?:\.\./)?figures/(?P<name>\w+)\.png\)")
SCRIPT = re.compile(r"examples/(\w+)\.py")
MODULE = re.compile(r"\]\((?:\.\./)+src/driftfit/([\w/]+)\.py\)")
FOLDERS = {
    "trackers": "Trackers",
    "bank": "Banks of hypotheses",
    "readings": "The gate in front of trackers",
    "models": "Models",
    "smooth": "Smoothers",
    "tune": "Tuning",
    "judge": "Tests, alarms, segments, structures",
    "use": "Forecasts and simulation",
    "run": "Streams and alarms on line",
}
"""Parts of the page of the algorithms, by folder."""


def on_page_markdown(markdown, page, **_):
    """Fill the pages that are written here; links to source files of algorithms lead to their page."""
    name = page.file.src_uri
    if name == "gallery.md":
        return markdown.replace("<!-- figures -->", figures())
    if name == "algorithms.md":
        return markdown.replace("<!-- algorithms -->", algorithms())
    if name == "changelog.md":
        return markdown.replace("<!-- changelog -->", (HOME.parent / "CHANGELOG.md").read_text().partition("\n")[2])
    up = "../" * name.count("/")
    return MODULE.sub(lambda found: f"]({up}algorithms.md#{place_of(found[1])})", markdown)


def place_of(module):
    """The anchor of a module, given its path without the ending."""
    return "math-" + module.replace("/", "-")


def algorithms():
    """The docstrings of all modules with equations or a source, by folder."""
    parts = []
    for folder, title in FOLDERS.items():
        parts.append(f"## {title}")
        for path in sorted((SOURCE / folder).rglob("*.py")):
            said = ast.get_docstring(ast.parse(path.read_text())) or ""
            if re.search(r"\bSources?:|^    \S", said, re.M):
                module = path.relative_to(SOURCE).with_suffix("").as_posix()
                head, _, text = said.partition("\n")
                parts.append(f"### {module.replace('/', '.')} {{#{place_of(module)}}}")
                parts.append(f"**{plain(head)}**\n\n{plain(text.strip(chr(10)))}")
    return "\n\n".join(parts)


SIGN = re.compile(r"`[^`]*`|(?<![\w*])\*[A-Za-z][^*]*[A-Za-z]\*(?!\w)|[*\[<]")
"""Code and emphasis, which stay, and letters that would mean something in Markdown."""


def plain(text):
    """A docstring as Markdown: lists, code, emphasis and indented equations stay, other letters mean themselves."""
    lines = []
    for line in text.splitlines():
        bullet = "* " if line.startswith("* ") else ""
        escaped = SIGN.sub(lambda found: f"&#{ord(found[0])};" if len(found[0]) == 1 else found[0], line[len(bullet) :])
        lines.append(line if line.startswith("    ") else bullet + escaped)
    return "\n".join(lines)


def figures():
    """One section for each chapter that has figures."""
    sections = []
    for chapter in sorted(HOME.rglob("*.md")):
        text = chapter.read_text()
        found = [(match["caption"], match["name"], match.start()) for match in FIGURE.finditer(text)]
        if found and chapter.stem not in ("index", "gallery") and not chapter.stem.startswith("scoreboard"):
            place = chapter.relative_to(HOME).as_posix()
            title = text.splitlines()[0].removeprefix("# ")
            sections.append(f"## [{title}]({place})\n\n" + "\n".join(panel(text, *one) for one in found))
    return "\n\n".join(sections)


def panel(text, caption, name, place):
    """One figure with its caption, and the script that is named last before it."""
    scripts = SCRIPT.findall(text[:place])
    path = HOME.parent / "examples" / f"{scripts[-1]}.py" if scripts else None
    code = (
        ""
        if path is None or not path.exists()
        else f'\n??? example "examples/{path.name}"\n\n' + indented(path.read_text())
    )
    return f"![{caption}](figures/{name}.png)\n\n{caption}\n{code}\n"


def indented(code):
    """Code as the content of a block that opens."""
    return "\n".join(f"    {line}".rstrip() for line in ["```python", *code.splitlines(), "```"]) + "\n"
