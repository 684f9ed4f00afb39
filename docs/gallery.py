"""A hook of mkdocs: the gallery shows every figure of the chapters, with a link to its chapter and the code of its
script, so that a new figure appears there by existing.
"""

import re
from pathlib import Path

HOME = Path(__file__).parent
FIGURE = re.compile(r"!\[(?P<caption>[^\]]*)\]\((?:\.\./)?figures/(?P<name>\w+)\.png\)")
SCRIPT = re.compile(r"examples/(\w+)\.py")


def on_page_markdown(markdown, page, **_):
    """Fill the page of the gallery."""
    return markdown.replace("<!-- figures -->", figures()) if page.file.src_uri == "gallery.md" else markdown


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
