"""Parts of an HTML page: sections, tables, and pictures as SVG in the colours of the page."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from io import StringIO
from typing import TYPE_CHECKING

from driftfit.show.page_style import STYLE
from driftfit.show.parts.axes import BLUE, GREY, RED

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from driftfit.run.result import Track

LONG = 3000
"""In longer records the points of pictures are an image inside the SVG."""

SHORT = 12
"""A table with at most this many rows is not split between two printed pages."""

INK = "#1b1b1b"
"""Colour of text and axes while a picture is drawn; replaced by the text colour of the page."""

COLOURS = {INK: "ink", BLUE: "blue", RED: "red", GREY: "grey", "#b0b0b0": "rule"}


def document(heading: str, sections: Sequence[str]) -> str:
    """Combine sections into one page."""
    body = "\n".join(sections)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(heading)}</title><style>{STYLE}</style></head>\n<body><main>\n{body}\n</main></body></html>\n"
    )


def section(title: str, body: str) -> str:
    return f"<section><h2>{escape(title)}</h2>\n{body}</section>"


def table(caption: str, heads: tuple[str, ...], rows: Sequence[tuple[str, ...]], words: Sequence[int] = ()) -> str:
    """A table; cells are HTML already, and ``words`` are the columns aligned as text, besides the first."""
    kinds = [' class="words"' if column in words else "" for column in range(len(heads))]

    def line(tag: str, cells: tuple[str, ...]) -> str:
        return "".join(f"<{tag}{kind}>{cell}</{tag}>" for kind, cell in zip(kinds, cells, strict=True))

    top, body = line("th", heads), "".join(f"<tr>{line('td', row)}</tr>" for row in rows)
    short = " short" if len(rows) <= SHORT else ""
    return (
        f'<div class="wide{short}"><table><caption>{escape(caption)}</caption>'
        f"<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def picture(figure: Figure, run: Track, caption: str) -> str:
    return f"<figure>{svg(figure, len(run) > LONG)}<figcaption>{escape(caption)}</figcaption></figure>\n"


def svg(figure: Figure, thin: bool = False) -> str:
    """A figure as SVG text in the colours of the page; ``thin`` draws the samples as an image."""
    import matplotlib

    for axis in figure.axes:
        _inked(axis)
        for artist in (*axis.lines, *axis.collections, *axis.patches):
            artist.set_rasterized(thin)
    figure.patch.set_alpha(0.0)
    text = StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": figure.axes[0].get_ylabel() or "driftfit"}):
        figure.savefig(text, format="svg", dpi=110, metadata={"Date": None, "Creator": None}, transparent=True)
    drawn = text.getvalue()
    drawn = drawn[drawn.index("<svg") :]
    drawn = re.sub(r"<metadata>.*?</metadata>", "", drawn, flags=re.S)
    for colour, name in COLOURS.items():
        drawn = drawn.replace(colour, f"var(--{name})")
    drawn = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font: \1px system-ui, sans-serif", drawn)
    return drawn


def _inked(axis: object) -> None:
    """Give text, ticks and frame of an axis the text colour of the page."""
    from matplotlib.axes import Axes

    assert isinstance(axis, Axes)
    for side in axis.spines.values():
        side.set_edgecolor(INK)
        side.set_linewidth(0.6)
    axis.tick_params(colors=INK, which="both")
    legend = axis.get_legend()
    titles = [axis.title, axis._left_title] if hasattr(axis, "_left_title") else [axis.title]
    words = [
        axis.xaxis.label,
        axis.yaxis.label,
        axis.xaxis.get_offset_text(),
        axis.yaxis.get_offset_text(),
        *axis.texts,
    ]
    for word in (*titles, *words, *(legend.get_texts() if legend else ())):
        if word.get_color() in ("black", "k", "#000000"):
            word.set_color(INK)
